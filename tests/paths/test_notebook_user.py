"""The way of somebody with a notebook: docs/python.md and docs/notebook.ipynb, word for word."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

DOCS = Path(__file__).parents[2] / "docs"
NOTEBOOK = json.loads((DOCS / "notebook.ipynb").read_text(encoding="utf-8"))

pytestmark = pytest.mark.filterwarnings("ignore::nlosrender.NlosWarning")


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's current folder."""
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    return tmp_path


def shown(source: str, names: dict[str, Any]) -> Any:
    """Run a cell as a notebook does, and return the value of its last expression; None where it ends otherwise."""
    *statements, last = ast.parse(source).body
    if not isinstance(last, ast.Expr):
        exec(source, names)
        return None
    exec(compile(ast.Module(statements, []), "cell", "exec"), names)
    return eval(compile(ast.Expression(last.value), "cell", "eval"), names)


def test_the_page_does_what_it_says(empty_folder: Path, backend: None, capsys: pytest.CaptureFixture[str]) -> None:
    """Every block of docs/python.md, one after the other; files and shapes are those that it names."""
    pytest.importorskip("xarray")
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", (DOCS / "python.md").read_text(encoding="utf-8"), re.DOTALL):
        shown(block, names)
    written = {"z.hdf5", "z.png", "counts.hdf5", "front.png", "z-0.2.hdf5", "z-0.8.hdf5", "sweep"}
    assert {path.name for path in empty_folder.iterdir()} == written
    assert names["changed"].config.capture.sensor_grid.ny == 12
    assert "capture.sensor_grid.nx: got 0, need an integer >= 1" in capsys.readouterr().out
    assert names["samples"].sel(sensor_x=0.3, method="nearest").dims == ("channel", "bounce", "sensor_y", "time")
    assert names["light"].H.shape == (1, 2, 2, 200, 200)
    assert names["volume"].score().iou > 0.8
    assert len(names["captures"]) == 2


def test_the_notebook_runs_and_shows(empty_folder: Path, backend: None) -> None:
    """Cell by cell; tables are HTML, pictures drawn; the letter is found, and light falls faster and faster."""
    names: dict[str, Any] = {}
    values = [shown("".join(cell["source"]), names) for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    table, picture, wall, volume, energies = (value for value in values if value is not None)
    assert "confocal" in table._repr_html_()
    assert all(shown_picture.figure.axes for shown_picture in (picture, volume))  # drawn: tests/cli/test_python_api.py
    assert len(wall.axes) == 2
    assert len(energies.axes) == 1
    assert names["volume"].score().iou > 0.8
    slopes = np.diff(np.log(names["energies"])) / np.diff(np.log(names["distances"]))
    assert (np.diff(slopes) < 0).all()
    assert -4 < slopes[-1] < -3  # half of the points within a metre of the axis, seen from 2 to 4 m


def test_the_notebook_is_stored_without_outputs() -> None:
    """A difference of two versions is one of its text; pictures of an earlier version would show what no longer is."""
    code = [cell for cell in NOTEBOOK["cells"] if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)
    links = re.findall(r"\]\((\S+?)\)", "".join(line for cell in NOTEBOOK["cells"] for line in cell["source"]))
    assert links
    assert all((DOCS / link).exists() for link in links)
