"""``nlosrender paper``: a page whose numbers come from its own run."""

from __future__ import annotations

import json
from pathlib import Path

from support.commands import run

from nlosrender.bench.paper.figure import Check, PaperFigure, Picture, Table
from nlosrender.bench.paper.page import write_page

CONFIGS = Path(__file__).parents[2] / "configs" / "paper"


def test_the_z_letter_arrives_when_its_geometry_says(tmp_path: Path) -> None:
    """Figure 4 renders, measures and is shown."""
    result = run(tmp_path, "paper", "--quick", "--figure", "4", "--configs", CONFIGS, "-o", "out")
    assert result.returncode == 0, result.stderr
    report = json.loads((tmp_path / "out" / "paper.json").read_text())
    (figure,) = report["figures"]
    assert figure["name"] == "Figure 4"
    assert [check["holds"] for check in figure["checks"]] == [True]
    page = (tmp_path / "out" / "index.html").read_text()
    for picture in figure["pictures"]:
        assert (tmp_path / "out" / picture["path"]).stat().st_size > 10_000
        assert picture["path"] in page
    assert figure["measured"] in page


def test_an_unknown_figure_names_the_nearest(tmp_path: Path) -> None:
    """A slip of the pen is a usage error, before anything is rendered."""
    result = run(tmp_path, "paper", "--figure", "tabel1", "--configs", CONFIGS, "-o", "out")
    assert result.returncode == 2
    assert "table1" in result.stderr
    assert not (tmp_path / "out").exists()


def test_only_the_meshes(tmp_path: Path) -> None:
    """``--meshes-only`` writes what the room configurations name, renders nothing, and names its files."""
    result = run(tmp_path, "paper", "--meshes-only", "--configs", CONFIGS, "-o", "out")
    assert result.returncode == 0, result.stderr
    written = sorted((tmp_path / "out").rglob("*.*"))
    assert [path.name for path in written] == ["room-furniture.ply", "room-statue.ply"]
    assert sorted(result.stdout.splitlines()) == [f"mesh: {path}" for path in written]


def test_the_page_escapes_what_it_is_given(tmp_path: Path) -> None:
    """Texts are texts, and a check that fails is marked."""
    picture = tmp_path / "pictures" / "a.png"
    figure = PaperFigure(
        name="Figure 0",
        title="<b>bold</b>",
        reported="a < b",
        measured="1 & 2",
        pictures=(Picture(picture, 'a "caption"'),),
        tables=(Table(("x", "y"), (("1", "<2>"),)),),
        checks=(Check("that holds", True), Check("that does not", False)),
    )
    page = write_page([figure], tmp_path, {"date": "today"}).read_text()
    assert "<b>" not in page
    assert "&lt;b&gt;bold&lt;/b&gt;" in page
    assert "&lt;2&gt;" in page
    assert "class=no>that does not" in page
    assert "src='pictures/a.png'" in page
    assert not figure.holds
