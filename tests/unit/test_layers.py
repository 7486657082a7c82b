"""The listing of the package read top to bottom is the data path: a stage imports only stages above it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import nlosrender

PACKAGE = Path(nlosrender.__file__).parent
STAGES = ("config", "scene", "capture", "engine", "sensor", "files", "rendering", "analysis", "bench", "cli")
SHARED = ("constants", "errors", "interruption", "readable")
MODULES = sorted(PACKAGE.rglob("*.py"))
IN_STAGES = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] in STAGES]
SCENE = PACKAGE / "scene"
BUILDERS = (SCENE / "build.py", SCENE / "view.py", *(SCENE / "loading").glob("*.py"))
MUST_NOT_RENDER = [
    path for path in MODULES if path.relative_to(PACKAGE).parts[0] not in ("engine", "bench") and path not in BUILDERS
]


def imported(path: Path) -> set[str]:
    """Return the dotted names of our own modules that a module imports anywhere."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name for name in names if name.startswith("nlosrender.")}


@pytest.mark.parametrize("path", IN_STAGES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_stage_imports_only_stages_above_it(path):
    """Light flows down the listing, and so do the imports; the command line may use the pipeline."""
    stage = path.relative_to(PACKAGE).parts[0]
    allowed = {*SHARED, *STAGES[: STAGES.index(stage) + 1]} | ({"pipeline"} if stage == "cli" else set())
    found = {name.split(".")[1] for name in imported(path)}
    assert found <= allowed, f"{path.name} imports {sorted(found - allowed)}, below it in the listing"


@pytest.mark.parametrize("path", MUST_NOT_RENDER, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_the_scene_builder_and_the_engine_know_mitsuba(path):
    """Everything else has to work on a machine that cannot render."""
    tree = ast.parse(path.read_text())
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
    assert not {name for name in names if name.split(".")[0] in ("mitsuba", "drjit")}


@pytest.mark.parametrize("module", ["nlosrender.cli.app", "nlosrender.pipeline", "nlosrender.engine.backend.start"])
def test_importing_a_module_starts_nothing(module):
    """No Mitsuba, no Dr.Jit, no variant: those wait for a render."""
    code = f"import {module}, sys; sys.exit('mitsuba' in sys.modules or 'drjit' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_the_command_line_loads_no_heavy_package_for_help():
    """``--help`` must not wait for numpy, pydantic, h5py or matplotlib."""
    code = (
        "import sys; from nlosrender.cli.app import app; sys.argv = ['nlosrender', '--help'];"
        "\ntry: app()\nexcept SystemExit: pass\n"
        "sys.exit(bool({'numpy', 'pydantic', 'h5py', 'matplotlib', 'yaml', 'tqdm'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0
