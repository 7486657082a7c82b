"""The figures of a source tree, on a tree that is written for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import structure

FILES = {
    "nlosrender/__init__.py": "",
    "nlosrender/engine/planner.py": """
from typing import TYPE_CHECKING
from nlosrender.engine.path.engine import PathEngine
if TYPE_CHECKING:
    from nlosrender.engine import memory

def choose(engine):
    return isinstance(engine, PathEngine)
""",
    "nlosrender/engine/memory.py": """
from nlosrender.engine import planner
from nlosrender.engine.path.engine import PathEngine
LARGE = 2**20  # B
LARGEST = 2**30  # B: measured, beyond it the machine swaps

def batch_bytes(engine):
    return 1 if isinstance(engine, (int, PathEngine)) else 2
""",
    "nlosrender/engine/path/engine.py": """
from . import tuning
FEW = 3

class PathEngine:
    def render(self):
        return isinstance(self, PathEngine)
""",
    "nlosrender/engine/path/tuning.py": """
NAMES = ("a", "b")

class Tuning:
    margin: float = 1.1
    \"\"\"Of the patches: derived in docs/virtual-lights.md, 6.2.\"\"\"
    lanes: int = 2 * 512
""",
    "nlosrender/bench/skips.py": "from nlosrender.engine import memory\nmemory.LARGE = 1\nmemory.size = 2\n",
    "nlosrender/bench/memory.py": "",
    "tests/test_a.py": """
from nlosrender.engine import memory

def test_a(monkeypatch):
    monkeypatch.setattr(memory, "LARGE", 1)
    monkeypatch.setattr(memory, "batch_bytes", len)
    monkeypatch.setattr("nlosrender.engine.memory.LARGEST", 1)
""",
}


@pytest.fixture
def figures(tmp_path: Path) -> dict[str, Any]:
    """The figures of a small tree."""
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return structure.figures_of(tmp_path, batches=False)


def test_imports_and_names(figures: dict[str, Any]) -> None:
    """Relative imports count, those for types alone do not; two modules share a name."""
    engine = figures["imports"]["engine"]
    assert (engine["modules"], engine["levels"], engine["edges"], engine["cycles"]) == (4, 4, 4, [])
    assert engine["longest_chain"] == ["memory", "planner", "path.engine", "path.tuning"]
    assert figures["duplicated_names"] == {"memory": ["bench/memory.py", "engine/memory.py"]}
    assert figures["lines"]["engine"]["modules"] == 4


def test_checks_of_engines_outside_the_planner(figures: dict[str, Any]) -> None:
    """The planner and an engine's own folder may ask what they have."""
    assert figures["engine_checks"] == ["nlosrender/engine/memory.py:8 PathEngine"]


def test_constants(figures: dict[str, Any]) -> None:
    """Those set from outside, with places; those without a word, and those whose words name no origin."""
    assert figures["patched_constants"] == {
        "LARGE": ["nlosrender/bench/skips.py:2", "tests/test_a.py:5"],
        "LARGEST": ["tests/test_a.py:7"],
    }
    numbers = figures["constants"]
    assert numbers["all"] == 5
    assert [row["name"] for row in numbers["without_a_word"]] == ["FEW", "Tuning.lanes"]
    assert [row["name"] for row in numbers["without_an_origin"]] == ["LARGE", "FEW", "Tuning.lanes"]


def test_the_way_of_a_batch() -> None:
    """Returns are steps to another file that had been entered before."""
    way = structure.way_of(["a", "b", "b", "a", "c", "b", "b", "d"])
    assert way == {"functions": 8, "files": 4, "returns": 2, "entered": ["a", "b", "c", "d"]}
