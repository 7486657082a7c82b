"""A line-of-sight capture from its configuration to its file, and from there to pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.partial_captures import validate_file
from support.rendering import configured
from support.views import view_config

from nlosrender import pipeline
from nlosrender.analysis.frames import FrameOptions, write_frames
from nlosrender.analysis.pictures import angle_of_polarization, degree_of_polarization
from nlosrender.analysis.plots import plot_capture
from nlosrender.analysis.summary import summarise
from nlosrender.capture.part import Selection
from nlosrender.errors import FileError, OptionError
from nlosrender.files.export.export import export_capture
from nlosrender.files.parts.merge import merge_captures
from nlosrender.files.reading.reader import open_capture

WALL = {"type": "rectangle", "width": 2, "height": 2, "center": [0, 0, 0], "normal": [0, 0, 1]}
WALL |= {"bsdf": {"type": "diffuse", "reflectance": [0.5, 0.4, 0.1]}}
LAMP = {"type": "point", "position": [-0.5, 0.3, 1], "intensity": 1.0}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered file: a wall lit from its upper left, 5 x 3 pixels."""
    return rendered(tmp_path_factory.mktemp("view") / "view.hdf5")


def rendered(path: Path, selection: Selection | None = None) -> Path:
    """Render into a file."""
    config = view_config(WALL, emitters=[LAMP], bins=(4.0, 0.05, 80), max_bounces=2, spp=64)
    pipeline.render_capture(configured(config | {"output": {"path": str(path)}}), selection=selection or pipeline.WHOLE)
    return path


def test_the_file_says_what_it_holds(capture: Path) -> None:
    """Shape as of a single laser, bounces from 0, unit, pixels instead of sensor points; the layout is kept."""
    assert validate_file(capture) == []
    summary = summarise(capture)
    assert summary["scan_type"] == "line_of_sight"
    assert summary["bounces"] == [0, 1, 2]
    assert summary["channels"] == "rgb"
    with open_capture(capture) as opened:
        header = opened.header
        assert header.data_shape == (3, 80, 6, 3, 5, 1, 1)
        assert header.data_attributes["unit"] == "W m^-2 sr^-1"
        assert "surface interactions" in str(header.data_attributes["bounces"])
        assert "camera" in str(header.attributes["sensor_points"])
        assert header.sensor_position == pytest.approx((0, -4, 0))  # Z-NLOS frame: the plane looks along -y


def test_shards_merge_to_the_same_file(capture: Path, tmp_path: Path) -> None:
    """Parts rendered apart are the whole, bit for bit."""
    parts = [rendered(tmp_path / f"{i}.hdf5", Selection(shard=(i, 2))) for i in (1, 2)]
    merge_captures(parts, tmp_path / "merged.hdf5")
    with open_capture(capture) as whole, open_capture(tmp_path / "merged.hdf5") as merged:
        assert np.array_equal(whole.read_block(), merged.read_block())


def test_frames_add_up_to_the_steady_picture(capture: Path, tmp_path: Path) -> None:
    """Every bin is in one frame; rows run downwards: the lamp's corner is at the upper left."""
    import OpenEXR

    options = FrameOptions(every=7, start_opl=4.0, end_opl=8.0)
    written = write_frames(capture, tmp_path / "frames", options)
    assert [path.name for path in written[-2:]] == ["steady.exr", "steady.png"]
    pictures = []
    for path in written[:-1]:
        with OpenEXR.File(str(path)) as file:
            pictures.append(file.channels()["RGB"].pixels.copy())
    *frames, steady = pictures
    assert len(frames) == 12
    assert np.sum(frames, axis=0) == pytest.approx(steady, rel=1e-5)
    assert np.unravel_index(steady[..., 0].argmax(), (3, 5)) == (0, 1)
    with open_capture(capture) as opened:
        samples = opened.read_block().sum(axis=(1, 2, 3, 6))
    assert steady == pytest.approx(np.moveaxis(samples, 0, -1)[::-1], rel=1e-5)


@pytest.mark.parametrize("kind", ["png", "gif"])
def test_pictures_for_the_eye(kind: str, capture: Path, tmp_path: Path) -> None:
    """An animation is one file, other frames are many; small pictures are enlarged."""
    from PIL import Image

    written = write_frames(capture, tmp_path, FrameOptions(kind=kind, every=10))
    with Image.open(written[0]) as image:
        assert image.width % 5 == image.height % 3 == 0
        assert getattr(image, "n_frames", 1) > 1 if kind == "gif" else len(written) > 4


def test_a_plot(capture: Path, tmp_path: Path) -> None:
    """``plot`` draws such files, too."""
    assert plot_capture(capture, tmp_path / "view.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "mp4"}, "use gif"),
        ({"kind": "bmp"}, "need one of exr, png, gif"),
        ({"every": 0}, "--every: got 0"),
        ({"frames_per_second": 0}, "--fps"),
        ({"start_opl": float("nan")}, "--from: got nan"),
        ({"end_opl": float("-inf")}, "--to: got -inf"),
    ],
)
def test_options_that_make_no_pictures(options: dict, message: str) -> None:
    """Each is refused with the option's name."""
    with pytest.raises(OptionError, match=message):
        FrameOptions(**options)


def test_a_range_without_bins(capture: Path, tmp_path: Path) -> None:
    """Frames outside the time axis do not exist."""
    with pytest.raises(OptionError, match="no bin of the file"):
        write_frames(capture, tmp_path, FrameOptions(start_opl=20.0, end_opl=30.0))


def test_what_needs_a_relay_wall_is_refused(capture: Path, tmp_path: Path) -> None:
    """Exports have no place for a camera's pictures."""
    with pytest.raises(FileError, match="no relay wall to reconstruct from or to export"):
        export_capture(capture, tmp_path / "out.hdf5", "tal", "all")


def test_polarised_files_name_their_channels(tmp_path: Path) -> None:
    """Four channels are Stokes components, with their reference in words; pictures have them by name."""
    import OpenEXR

    path = tmp_path / "stokes.hdf5"
    glass = {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.4, "bsdf": {"type": "dielectric"}}
    config = view_config(WALL, glass, emitters=[LAMP], bins=(2.0, 0.2, 40), polarized=True, spp=16)
    pipeline.render_capture(configured(config | {"output": {"path": str(path)}}))
    assert validate_file(path) == []
    summary = summarise(path)
    assert summary["channels"] == "stokes"
    with open_capture(path) as opened:
        assert "to the right in the picture" in str(opened.header.attributes["stokes_frame"])
        assert opened.header.data_shape[0] == 4
    written = write_frames(path, tmp_path / "frames", FrameOptions(every=10))
    with OpenEXR.File(str(written[-2])) as file:
        assert set(file.channels()) == {"I", "Q", "U", "V"}
    assert plot_capture(path, tmp_path / "stokes.png").exists()


def test_degree_and_angle_of_polarisation() -> None:
    """Half of the light polarised at 30 degrees; no light has no degree."""
    stokes = np.array([[2.0, np.cos(np.pi / 3), np.sin(np.pi / 3), 0.0], [0, 0, 0, 0]], dtype=np.float32)
    assert degree_of_polarization(stokes) == pytest.approx([0.5, 0.0])
    assert angle_of_polarization(stokes)[0] == pytest.approx(np.pi / 6)


def test_energy_of_polarised_light_is_its_intensity(tmp_path: Path) -> None:
    """Q, U and V have signs: they are no part of the energy a report sums up."""
    metal = WALL | {"bsdf": {"type": "roughconductor", "material": "Cu", "alpha": 0.3}}
    config = view_config(metal, emitters=[LAMP], bins=(2.0, 0.2, 40), polarized=True, spp=16)
    path = tmp_path / "metal.hdf5"
    report = pipeline.render_capture(configured(config | {"output": {"path": str(path)}}))
    with open_capture(path) as opened:
        stokes = opened.read_block().sum(axis=(1, 2, 3, 4, 5, 6))
    assert abs(stokes[1:]).max() > 1e-3 * stokes[0]
    assert sum(report.energy.values()) == pytest.approx(stokes[0], rel=1e-5)
