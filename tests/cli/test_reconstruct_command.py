"""``reconstruct`` as a user meets it: files, report, exit codes, messages."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.point_captures import cells, points_header, write_points
from support.rendering import configured
from typer.testing import CliRunner

from nlosrender.cli.app import app
from nlosrender.config.load import config_to_dict
from nlosrender.errors import EXIT_USAGE, FileError, NlosError

PATCH = {"type": "rectangle", "width": 0.1, "height": 0.1, "center": [0.1, -0.1, 0.8], "normal": [0, 0, -1]}


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A confocal capture of a point, whose configuration says it is a 10 cm patch."""
    config = configured(
        {
            "scene": {"relay_wall": {"type": "rectangle", "width": 2, "height": 1.6}, "hidden_geometry": [PATCH]},
            "capture": {"scan_type": "confocal", "sensor_grid": {"nx": 12, "ny": 9}},
        }
    )
    header = points_header("confocal", cells(12, 9, 2.0, 1.6), legs=True, bins=(0.5, 0.02, 300))
    return write_points(tmp_path / "patch.hdf5", header, [PATCH["center"]], config=json.dumps(config_to_dict(config)))


def run(*arguments: object) -> str:
    """Run the command line, let errors through, return stdout."""
    result = CliRunner().invoke(
        app, ["reconstruct", *map(str, arguments)], catch_exceptions=False, standalone_mode=True
    )
    if isinstance(result.exception, NlosError):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


OPTIONS = ("--volume-center", "0.05,0,0.8", "--volume-size", "0.8,0.7,0.4", "--voxel-size", "0.05")


@pytest.mark.parametrize("method", ["phasor", "backprojection"])
def test_a_volume_a_picture_and_a_score(capture: Path, method: str) -> None:
    """Coordinates, attributes and the score are in the file; the picture is a PNG; the report names both."""
    told = run(capture, "--method", method, *OPTIONS, "--wavelength", "0.3", "--png", "--score")
    volume_path = capture.with_name(f"patch-{method}.hdf5")
    picture = volume_path.with_suffix(".png")
    assert f"wrote {volume_path}, {picture}" in told
    assert "IoU" in told
    assert picture.read_bytes().startswith(b"\x89PNG")
    with h5py.File(volume_path) as file:
        volume = file["volume"][()]
        assert volume.shape == (8, 14, 16)
        z, y, x = np.unravel_index(int(volume.argmax()), volume.shape)
        found = [file[axis][index] for axis, index in zip("xyz", (x, y, z), strict=True)]
        np.testing.assert_allclose(found, PATCH["center"], atol=0.051)  # a voxel
        assert file.attrs["method"] == method
        assert file.attrs["wavelength"] == 0.3
        assert file["silhouette"].shape == (14, 16)
        assert 0 < file.attrs["score_iou"] <= 1
        to_file = file.attrs["wall_to_file"]
    with h5py.File(capture) as file:
        expected = file["cameraGridPositions"][:, 0, 0]
    corner = cells(12, 9, 2.0, 1.6)[0, 0]
    np.testing.assert_allclose(to_file[:3, :3] @ corner + to_file[:3, 3], expected, atol=1e-6)


def test_json(capture: Path, tmp_path: Path) -> None:
    """--json prints one object with what was chosen."""
    report = json.loads(run(capture, "--voxels", 12, "-o", tmp_path / "out.hdf5", "--json"))
    assert report["written"] == [str(tmp_path / "out.hdf5")]
    assert max(report["voxels"]) == 12
    assert report["wavelength"] > 0
    assert report["score"] is None


def test_mistakes(capture: Path, tmp_path: Path) -> None:
    """Usage, overwriting the capture, no scene to score against: each its own message."""
    result = CliRunner().invoke(app, ["reconstruct", str(capture), "--volume-size", "1,x"])
    assert result.exit_code == EXIT_USAGE
    assert "need lengths in m" in result.output
    with pytest.raises(FileError, match="is read for this and would be replaced"):
        run(capture, "--voxels", 6, "-o", capture)
    bare = write_points(tmp_path / "bare.hdf5", points_header("single", cells(4, 3, 1.0, 1.0)), [(0, 0, 0.8)])
    with pytest.raises(FileError, match="nothing to score against"):
        run(bare, "--voxels", 6, "--score")
    with pytest.raises(FileError, match="there is no such file"):
        run(tmp_path / "missing.hdf5")
