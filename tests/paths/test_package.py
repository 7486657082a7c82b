"""The way of somebody who installs the wheel: what it holds is enough, away from the repository."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import nlosrender

ROOT = Path(__file__).parents[2]
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--no-cache-dir")
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "nlosrender", "configs", "scenes")


def run(*command: object, folder: Path, **variables: str) -> str:
    """Return what a command prints; it has to succeed."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | variables
    done = subprocess.run(
        [str(part) for part in command], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow  # 10 s: a wheel is built, and a process started for each command
def test_an_installed_wheel_renders_away_from_the_repository(tmp_path: Path) -> None:
    """Built offline, installed into an empty environment beside the packages that it needs, and used by its script."""
    source, environment, work = tmp_path / "source", tmp_path / "environment", tmp_path / "work"
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        source.mkdir(exist_ok=True)
        copy(ROOT / name, source / name)
    run(*PIP, "wheel", "--no-deps", "--no-build-isolation", "--no-index", "-w", "dist", ".", folder=source)
    (wheel,) = (source / "dist").glob("*.whl")
    assert wheel.name == f"nlosrender-{nlosrender.__version__}-py3-none-any.whl"
    run(sys.executable, "-m", "venv", "--without-pip", environment, folder=tmp_path)
    python, command = environment / "bin/python", environment / "bin/nlosrender"
    run(*PIP, "--python", python, "install", "--no-deps", "--no-index", wheel, folder=tmp_path)
    shutil.rmtree(source)
    (site,) = environment.glob("lib/python3.*/site-packages")
    # the packages it needs, not itself: links in this folder, such as that of an editable install, are not followed
    (site / "needed.pth").write_text(sysconfig.get_path("purelib"))
    work.mkdir()
    assert run(command, "--version", folder=work) == f"{nlosrender.__version__}\n"
    assert run(python, "-m", "nlosrender", "--version", folder=work) == f"{nlosrender.__version__}\n"
    assert str(site) in run(python, "-c", "import nlosrender; print(nlosrender.__file__)", folder=work)
    assert "used: llvm" in run(command, "doctor", folder=work)
    run(command, "new", "starter.yaml", folder=work)
    small = ["--set", "capture.sensor_grid.nx=5", "--set", "capture.sensor_grid.ny=3"]
    assert "wrote starter.hdf5" in run(command, "render", "starter.yaml", *small, folder=work)
    run(command, "new", "wall.yaml", "--example", "mesh-wall", folder=work)
    assert "wall.yaml: ok" in run(command, "validate", "wall.yaml", folder=work)
    assert "spad-532" in run(command, "measure", "--list", folder=work)
    run(command, "plot", "starter.hdf5", folder=work)
    run(command, "report", "starter.hdf5", "-o", "report.html", folder=work)
    written = {"starter.yaml", "starter.hdf5", "wall.yaml", "wavy-wall.ply", "starter.png", "report.html"}
    assert {path.name for path in work.iterdir()} == written


def test_a_shell_completes_commands_and_options(tmp_path: Path) -> None:
    """By the script that ``--install-completion`` writes."""
    code = "import sys; sys.argv = ['nlosrender']; from nlosrender.__main__ import main; main()"
    asked = {"_NLOSRENDER_COMPLETE": "complete_bash", "PYTHONPATH": str(ROOT)}
    for words, expected in (("nlosrender rec", ["reconstruct"]), ("nlosrender render --res", ["--resume"])):
        at = str(words.count(" "))
        found = run(sys.executable, "-c", code, folder=tmp_path, COMP_WORDS=words, COMP_CWORD=at, **asked)
        assert found.split() == expected


def test_the_version_is_stated_once() -> None:
    """The package's own; the citation names the version that it cites, which is the same."""
    assert 'dynamic = ["version"]' in (ROOT / "pyproject.toml").read_text()
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None
    assert cited[1] == nlosrender.__version__
