"""Frames, axis order and chunks."""

from __future__ import annotations

import numpy as np
import pytest

from nlosrender.files import layout
from nlosrender.files.layout import CHUNK_SAMPLES, chunk_shape, cuts, sensor_tile
from nlosrender.scene.pose import Pose

POSE = Pose.from_normal_up([4.0, -2.0, 0.5], [0.3, 0.2, 1.0], [0.0, 1.0, 0.1])


def test_znlos_frame_is_the_walls_with_depth_along_minus_y() -> None:
    """(X, Y, Z) = (x, -z, y): the wall lies in Y = 0, faces (0, -1, 0), and its y axis points up along Z."""
    frame = layout.file_frame("znlos", POSE)
    assert frame.to_scene([0.1, 0.2, 0.7]).tolist() == [0.1, -0.7, 0.2]
    assert frame.direction_to_scene([0.0, 0.0, 1.0]).tolist() == [0.0, -1.0, 0.0]
    assert np.linalg.det(frame.rotation) == 1.0  # a rotation: nothing is mirrored


@pytest.mark.parametrize("name", layout.FRAMES)
def test_file_to_scene_undoes_the_frame(name: str) -> None:
    """A point taken to the file's frame and on by ``file_to_scene`` is where the pose puts it in the scene."""
    local = np.random.default_rng(1).normal(size=(3, 5, 3))
    points = layout.file_frame(name, POSE).to_scene(local)
    matrix = layout.file_to_scene(name, POSE)
    # a handful of float64 operations on numbers below 10
    np.testing.assert_allclose(points @ matrix[:3, :3].T + matrix[:3, 3], POSE.to_scene(local), atol=1e-14)


def test_unknown_frame_is_refused() -> None:
    """Only the two frames of the layout exist."""
    with pytest.raises(ValueError, match="frame: got 'wall', need one of znlos, scene"):
        layout.file_frame("wall", POSE)


@pytest.mark.parametrize(
    ("n_bins", "rows", "columns"),
    [
        (1, 1, 1),
        (7, 4, 5),
        (2048, 64, 64),
        (1600, 3, 300),
        (1600, 300, 3),
        (4096, 65, 63),
        (300_000, 5, 4),
        (262_144, 2, 9),
    ],
)
def test_a_chunk_is_whole_histograms_of_at_most_a_mebibyte(n_bins: int, rows: int, columns: int) -> None:
    """Bins stay whole up to 262144; a chunk never exceeds 1 MiB, is not needlessly small and fits the grid."""
    bins, tile_rows, tile_columns = sensor_tile(n_bins, rows, columns)
    assert bins == min(n_bins, CHUNK_SAMPLES)
    assert bins * tile_rows * tile_columns <= CHUNK_SAMPLES
    assert 1 <= tile_rows <= rows
    assert 1 <= tile_columns <= columns
    # evening out halves each side at the most, and rounding the side of the square down costs less than half again
    whole = (tile_rows, tile_columns) == (rows, columns)
    assert whole or bins * tile_rows * tile_columns > CHUNK_SAMPLES / 8


def test_a_chunk_holds_one_laser_one_bounce_one_channel() -> None:
    """The chunk's length is 1 along every axis but the bins and the sensor grid."""
    sizes = {"channel": 3, "bounce": 2, "laser_y": 2, "laser_x": 3, "sensor_y": 4, "sensor_x": 5, "bin": 7}
    assert chunk_shape(sizes, confocal=False) == (1, 7, 1, 4, 5, 1, 1)
    assert chunk_shape(sizes, confocal=True) == (1, 7, 1, 4, 5)


def test_cuts_fall_on_chunk_borders_and_cover_the_range() -> None:
    """[5, 17) cut at the multiples of 4."""
    assert list(cuts(5, 17, 4)) == [(5, 8), (8, 12), (12, 16), (16, 17)]
    assert list(cuts(3, 3, 4)) == []
