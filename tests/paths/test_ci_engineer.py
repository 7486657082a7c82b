"""The way of somebody with continuous integration: docs/continuous-integration.md, word for word."""

from __future__ import annotations

import json
import os
import pty
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from support.doc_blocks import block_with, shell
from support.render_processes import plate_scene

PAGE = "continuous-integration.md"
STEPS = yaml.safe_load(block_with(PAGE, "yaml", "jobs:"))["jobs"]["check"]["steps"]
SCENE = plate_scene("""\
capture:
  scan_type: confocal
  sensor_grid: {nx: 16, ny: 12}
  account_first_and_last_bounces: false
time_axis: {bin_width_opl: 0.02, n_bins: 200}
render: {max_bounces: 3, engine: path, spp: 2000}
""")

pytestmark = pytest.mark.slow  # several processes that start the renderer


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository with two configurations, and what ``make install`` leaves in it."""
    (tmp_path / "configs").mkdir()
    for name in ("plate", "z-letter"):
        (tmp_path / "configs" / f"{name}.yaml").write_text(SCENE)
    program = tmp_path / ".venv" / "bin" / "nlosrender"
    program.parent.mkdir(parents=True)
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m nlosrender "$@"\n')
    program.chmod(0o755)
    return tmp_path


def environment(folder: Path) -> dict[str, str]:
    """Return an environment in which ``nlosrender`` is found, as after ``. .venv/bin/activate``."""
    modules = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)
    return {**os.environ, "PATH": f"{folder}/.venv/bin{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": modules}


def step(name: str) -> str:
    """Return the commands of a step of the workflow."""
    (found,) = [each["run"] for each in STEPS if each.get("name") == name]
    return found


def run(folder: Path, block: str) -> subprocess.CompletedProcess[str]:
    """Run a block in the repository."""
    return shell(block, folder, environment(folder))


def updated(folder: Path, block: str, answer: str) -> int:
    """Run a block at a terminal, and answer its question."""
    main, terminal = pty.openpty()
    os.write(main, f"{answer}\n".encode())
    done = shell(block, folder, environment(folder), stdin=terminal)
    os.close(main)
    os.close(terminal)
    assert f"Replace {1} references" in done.stderr
    return done.returncode


def test_from_references_to_a_change_that_is_meant(repository: Path) -> None:
    """References, a run that passes, a change that fails with reports to look at, references replaced, a run again."""
    assert {each.get("run") for each in STEPS if "name" not in each} == {None, "make install"}
    assert re.search(r"^install:", (Path(__file__).parents[2] / "Makefile").read_text(), re.MULTILINE)
    references = run(repository, block_with(PAGE, "sh", "mkdir -p reference"))
    assert references.returncode == 0, references.stderr
    again, check = step("Render the captures again"), step("Compare them with the references")
    assert run(repository, again).returncode == 0
    done = run(repository, check)
    assert done.returncode == 0, done.stderr
    assert "2 of 2 captures agree" in done.stdout

    moved = SCENE.replace("center: [0.1, 0, 0.9]", "center: [0.1, 0, 1.1]")
    (repository / "configs" / "z-letter.yaml").write_text(moved)
    shutil.rmtree(repository / "out")
    assert run(repository, again).returncode == 0
    assert run(repository, check).returncode == 4
    cases = ElementTree.parse(repository / "out" / "check.xml").getroot().iter("testcase")
    assert {case.get("name"): len(case) for case in cases} == {"plate.hdf5": 0, "z-letter.hdf5": 1}
    page = (repository / "out" / "check.html").read_text()
    assert page.count("<img") == 3  # new, reference and difference of the one that differs
    hook = run(repository, block_with(PAGE, "sh", "check.json"))
    assert hook.returncode == 1
    assert json.loads(hook.stdout)["agrees"] is False

    update = block_with(PAGE, "sh", "--update")
    assert run(repository, update).returncode == 2  # stdin is no terminal: nobody is asked
    assert updated(repository, update, "n") == 4
    assert updated(repository, update, "y") == 0
    assert run(repository, check).returncode == 0


def test_the_file_of_tolerances(repository: Path) -> None:
    """The file of the page is read, and its first pattern that fits decides."""
    (repository / "tolerances.yaml").write_text(block_with(PAGE, "yaml", "# tolerances.yaml"))
    command = ".venv/bin/nlosrender render configs/plate.yaml -q --set capture.sensor_grid.nx=5 -o"
    assert run(repository, f"mkdir -p reference/noisy; {command} reference/z-letter.hdf5").returncode == 0
    for name in ("noisy/a.hdf5", "plain.hdf5"):
        shutil.copy(repository / "reference" / "z-letter.hdf5", repository / "reference" / name)
    shutil.copytree(repository / "reference", repository / "out")
    other = f"{command} out/z-letter.hdf5 --overwrite --set render.seed=1; cp out/z-letter.hdf5 out/noisy/a.hdf5"
    assert run(repository, f"{other}; cp out/z-letter.hdf5 out/plain.hdf5").returncode == 0
    done = run(repository, "nlosrender check out/ --reference reference/ --tolerances tolerances.yaml --json")
    found = {file["name"]: file["status"] for file in json.loads(done.stdout)["files"]}
    # another seed: noise of some percent, without any change of the energy or a shift
    assert found == {"noisy/a.hdf5": "ok", "plain.hdf5": "ok", "z-letter.hdf5": "exceeds"}
