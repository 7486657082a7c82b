"""The listing of the package read top to bottom is the data path: a stage imports only stages above it."""

import ast
import subprocess
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

import nlosrender

PACKAGE = Path(nlosrender.__file__).parent
STAGES = ("config", "scene", "capture", "engine", "sensor", "files", "rendering", "analysis", "bench", "api", "cli")
SHARED = ("constants", "errors", "interruption", "readable")
MODULES = sorted(PACKAGE.rglob("*.py"))
IN_STAGES = [path for path in MODULES if path.relative_to(PACKAGE).parts[0] in STAGES]
SCENE = PACKAGE / "scene"
BUILDERS = (SCENE / "build.py", SCENE / "view.py", *(SCENE / "loading").glob("*.py"))
ENGINE_FOLDERS = ("path", "virtual_lights", "line_of_sight")
IN_ENGINE = {  # what each part of engine/ may import of engine/, besides itself
    "interface": {"launch"},  # for type checking only: histograms and passes cross it
    "backend": set(),
    "launch": {"interface"},
    **{folder: {"interface", "launch"} for folder in ENGINE_FOLDERS},
    "preflight": {"interface", "launch", "backend"},  # of the backend: the memory of a process
    "planner": {"interface", "launch", *ENGINE_FOLDERS},
}
ENGINE_MODULES = sorted(
    path for path in (PACKAGE / "engine").rglob("*.py") if path.parent.name != "engine" or path.name != "__init__.py"
)
PARALLEL_PARTS = {"engine", "tuning", "cost"}  # module names that every engine folder may have
MUST_NOT_RENDER = [
    path for path in MODULES if path.relative_to(PACKAGE).parts[0] not in ("engine", "bench") and path not in BUILDERS
]


@cache
def imported(path: Path) -> set[str]:
    """Return the dotted names of our own modules, or of things in them, that a module imports anywhere in it."""
    package = (PACKAGE.name, *path.relative_to(PACKAGE).parent.parts)
    return imported_by(path.read_text(), package)


@cache
def imports(source: str) -> list[ast.Import | ast.ImportFrom]:
    """Return the statements of a module, anywhere in it, that import."""
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)]


def imported_by(source: str, package: tuple[str, ...]) -> set[str]:
    """Return the names below ``nlosrender`` that ``source``, a module of ``package``, imports."""
    names = set()
    for node in imports(source):
        if isinstance(node, ast.ImportFrom):
            base = [*package[: len(package) - node.level + 1]] if node.level else []
            base += node.module.split(".") if node.module else []
            names |= {".".join((*base, alias.name)) for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name for name in names if name.startswith(f"{PACKAGE.name}.")}


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("from nlosrender import pipeline", "nlosrender.pipeline"),
        ("import nlosrender.files.layout", "nlosrender.files.layout"),
        ("from ..path.engine import PathEngine", "nlosrender.engine.path.engine.PathEngine"),
        ("from . import histogram", "nlosrender.engine.launch.histogram"),
        ("def f():\n    from nlosrender.files import layout", "nlosrender.files.layout"),
    ],
)
def test_every_form_of_import_is_seen(source, name):
    """Absolute, relative, of the package itself, and inside functions."""
    assert imported_by(source, ("nlosrender", "engine", "launch")) == {name}


def test_stages_are_the_folders():
    """The list above is all of the package."""
    folders = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__", "__main__", "pipeline"}
    assert (folders, modules) == (set(STAGES), set(SHARED))


@pytest.mark.parametrize("path", ENGINE_MODULES, ids=lambda path: str(path.relative_to(PACKAGE / "engine")))
def test_an_engine_knows_no_other_engine(path):
    """Engine folders import the interface, ``launch/`` and themselves; the planner alone imports all of them."""
    part = path.relative_to(PACKAGE / "engine").with_suffix("").parts[0]
    found = {parts[2] for name in imported(path) if (parts := name.split("."))[1] == "engine"}
    assert found <= IN_ENGINE[part] | {part}


def test_module_names_are_unique():
    """One name, one thing: only parts that every engine has are named alike."""
    places = defaultdict(list)
    for path in MODULES:
        if path.name not in ("__init__.py", "__main__.py"):
            places[path.stem].append(path.relative_to(PACKAGE))
    several = {name: found for name, found in places.items() if len(found) > 1}
    assert set(several) <= PARALLEL_PARTS, several
    assert all(
        path.parts[0] == "engine" and path.parts[1] in ENGINE_FOLDERS for found in several.values() for path in found
    )


@pytest.mark.parametrize("path", IN_STAGES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_stage_imports_only_stages_above_it(path):
    """Light flows down the listing, and so do the imports; benchmarks and the command line use the pipeline."""
    stage = path.relative_to(PACKAGE).parts[0]
    allowed = {"__version__", *SHARED, *STAGES[: STAGES.index(stage) + 1]} | (
        {"pipeline"} if stage in ("bench", "api", "cli") else set()
    )
    found = {name.split(".")[1] for name in imported(path)}
    assert found <= allowed, f"{path.name} imports {sorted(found - allowed)}, below it in the listing"


@pytest.mark.parametrize("path", MUST_NOT_RENDER, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_only_the_scene_builder_and_the_engine_know_mitsuba(path):
    """Everything else has to work on a machine that cannot render."""
    found = imports(path.read_text())
    names = {alias.name for node in found if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in found if isinstance(node, ast.ImportFrom) and node.module}
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
