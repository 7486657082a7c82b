"""Pictures for papers: theme, size, scale of the frames, marks, glyphs."""

from __future__ import annotations

import itertools
import re
import warnings
from pathlib import Path

import h5py
import matplotlib.image
import numpy as np
import pytest
from matplotlib.text import Text
from support.point_captures import LASER_POINT, cells, points_header, write_light

from nlosrender.analysis.drawn_picture import Picture
from nlosrender.analysis.frames_plot import grid_place
from nlosrender.analysis.picture_style import PictureStyle, picture_size
from nlosrender.analysis.plots import capture_picture, plot_capture
from nlosrender.analysis.theme import DARK, LIGHT, drawable
from nlosrender.bench.bench_report import LABEL_STEP, pushed_apart
from nlosrender.errors import OptionError

ROWS, COLUMNS, BINS = 3, 5, 40
WIDTH, HEIGHT = 2.0, 1.6


def write(path: Path, scan: str = "single") -> Path:
    """Write a capture whose light falls off by ten thousand over time: frames differ in brightness."""
    header = points_header(scan, cells(COLUMNS, ROWS, WIDTH, HEIGHT), bins=(0.0, 0.01, BINS))
    lasers = header.laser_positions.shape[:2] if scan == "exhaustive" else (1, 1)
    decay = np.logspace(0, -4, BINS)
    return write_light(path, header, decay * np.random.default_rng(0).random((*lasers, ROWS, COLUMNS, BINS)))


def texts_of(picture: Picture) -> str:
    return "\n".join(text.get_text() for text in picture.figure.findobj(Text))


def frames_of(picture: Picture) -> list:
    """Return the axes of the frames: those that show the grid of sensor points."""
    return [axes for axes in picture.figure.axes if axes.images and axes.images[0].get_array().shape == (ROWS, COLUMNS)]


@pytest.mark.parametrize(("theme", "ground"), [("dark", DARK.ground), ("light", LIGHT.ground)])
def test_size_and_ground(tmp_path: Path, theme: str, ground: str) -> None:
    """A picture has as many pixels as inches times --dpi, and its theme's ground in the corner."""
    style = PictureStyle(theme, (7.0, 4.0), 150)
    plot_capture(write(tmp_path / "a.hdf5"), tmp_path / "a.png", look=style)
    image = matplotlib.image.imread(tmp_path / "a.png")
    assert image.shape[:2] == (600, 1050)
    expected = [int(ground[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    np.testing.assert_allclose(image[-1, -1, :3], expected, atol=1e-6)


def test_text_stays_inside_a_small_picture(tmp_path: Path) -> None:
    """Titles above the frames, and the captions, overlap nothing and end inside the smallest picture allowed."""
    picture = capture_picture(write(tmp_path / "a.hdf5", "confocal"), look=PictureStyle("light", (6.5, 3.6), 100))
    picture.figure.draw_without_rendering()
    titles = [axes.title.get_window_extent() for axes in frames_of(picture)]
    assert all(left.x1 <= right.x0 for left, right in itertools.pairwise(titles))
    texts = [text for part in picture.figure.subfigs for text in part.texts]
    assert texts
    assert all(text.get_window_extent().x1 <= 650 for text in texts)


def test_frames_say_what_their_colours_mean(tmp_path: Path) -> None:
    """Each frame's own upper end stands above it; a shared scale has one, and a bar without ticks beyond it."""
    path = write(tmp_path / "a.hdf5")
    own = frames_of(capture_picture(path))
    assert len({axes.images[0].get_clim() for axes in own}) == len(own) > 2
    for axes in own:
        stated = float(re.search(r"up to (\S+)$", axes.get_title())[1])
        assert stated == pytest.approx(axes.images[0].get_clim()[1], rel=0.05)  # two digits
    picture = capture_picture(path, look=PictureStyle(shared_scale=True))
    shared = frames_of(picture)
    assert len({axes.images[0].get_clim() for axes in shared}) == 1
    bars = [axes for axes in picture.figure.axes if axes.get_label() == "<colorbar>"]
    assert len(bars) == 2  # of the frames, of the row over time
    for bar in bars:
        low, high = bar.get_ylim()
        assert all(low <= tick <= high for tick in bar.get_yticks())


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_the_laser_is_marked(tmp_path: Path, scan: str) -> None:
    """A ring at the laser point, in metres on the wall; of a confocal capture where the sensor point is."""
    picture = capture_picture(
        write(tmp_path / "a.hdf5", scan), laser=(1, 2) if scan == "exhaustive" else None, pixel=(2, 1)
    )
    cross, ring = frames_of(picture)[0].lines
    assert (cross.get_marker(), ring.get_marker()) == ("+", "o")
    at_pixel = cells(COLUMNS, ROWS, WIDTH, HEIGHT)[2, 1, :2]
    np.testing.assert_allclose(cross.get_xydata()[0], at_pixel, atol=1e-12)
    expected = {"single": LASER_POINT, "confocal": at_pixel, "exhaustive": cells(3, 2, 0.9, 0.7)[1, 2, :2]}[scan]
    # positions are float32 [m], the fit adds some roundings
    np.testing.assert_allclose(ring.get_xydata()[0], expected, atol=1e-6)


def test_a_flash_is_told(tmp_path: Path) -> None:
    """The mark is where its axis meets the wall, and is no lit point."""
    path = write(tmp_path / "a.hdf5")
    before = texts_of(capture_picture(path))
    with h5py.File(path, "r+") as file:
        file.attrs["laser_flash"] = "a flash: a cone of 40 degrees"
    assert "a flash, not a laser point" in texts_of(capture_picture(path))
    assert "flash" not in before


def test_a_point_is_placed_on_a_grid_in_any_pose() -> None:
    """Row and column follow from positions alone; a curved grid, or a point off its plane, has none."""
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    rows, columns = np.indices((4, 6))
    flat = np.stack([0.3 * columns, 0.2 * rows, 0 * rows], axis=-1) @ rotation + [1.0, 2.0, 3.0]
    point = np.array([0.3 * 2.5, 0.2 * 1.25, 0.0]) @ rotation + [1.0, 2.0, 3.0]
    assert grid_place(flat, point) == pytest.approx((1.25, 2.5), abs=1e-9)
    assert grid_place(flat, point + 0.2 * rotation[2]) is None
    bent = np.stack([0.3 * columns, 0.2 * rows, 0.1 * (columns - 2.5) ** 2], axis=-1)
    assert grid_place(bent, bent[1, 1]) is None


def test_no_glyph_is_missing(tmp_path: Path) -> None:
    """Characters that the font lacks are written out; those it has stay, accents and Greek among them."""
    assert drawable("文a\x07é-λ") == r"\u6587a\x07é-λ"
    path = write(tmp_path / "文字 λ.hdf5")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_capture(path, tmp_path / "a.pdf")
    assert b"/Type3" not in (tmp_path / "a.pdf").read_bytes()


@pytest.mark.parametrize(
    ("text", "size"), [("7x4", (7, 4)), ("18 x 10cm", (18 / 2.54, 10 / 2.54)), ("180x100mm", (18 / 2.54, 10 / 2.54))]
)
def test_sizes(text: str, size: tuple[float, float]) -> None:
    """Inches, or with a unit."""
    assert picture_size(text) == pytest.approx(size)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"theme": "ligth"}, "--theme: got 'ligth', need one of dark, light. Did you mean light"),
        ({"size": (3.5, 2.0)}, "--size: got 3.5 x 2 inches, need 6.5 x 3.6 to"),
        ({"size": (7.0, 1e9)}, "--size"),
        ({"dots_per_inch": 0.0}, "--dpi: got 0"),
        ({"dots_per_inch": float("nan")}, "--dpi: got nan"),
        ({"size": (60.0, 60.0), "dots_per_inch": 600.0}, "--dpi: makes 36000 pixels"),
    ],
)
def test_styles_that_cannot_be(values: dict, message: str) -> None:
    """The option is named, with what is allowed."""
    with pytest.raises(OptionError, match=re.escape(message)):
        PictureStyle(**values)


@pytest.mark.parametrize("text", ["7", "axb", "7x", "1.2.3x4", "-7x4", "7x4px"])
def test_sizes_that_are_none(text: str) -> None:
    """Two numbers, with at most a unit."""
    with pytest.raises(OptionError, match="--size: got"):
        picture_size(text)


def test_labels_of_lines_do_not_meet() -> None:
    """Labels keep their order and at least one line's distance, inside the axes; far ones stay where they are."""
    heights = [0.5, 0.51, 0.2, 0.99, 1.3, 0.98, -0.2]
    placed = pushed_apart(heights, LABEL_STEP)
    assert [*np.argsort(placed)] == [*np.argsort(heights)]
    assert min(np.diff(sorted(placed))) >= LABEL_STEP - 1e-12
    assert min(placed) >= 0
    assert max(placed) <= 1
    assert placed[2] == 0.2
    assert pushed_apart([], LABEL_STEP) == []
