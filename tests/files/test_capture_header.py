"""A header that contradicts itself is never built."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

WRONG = [
    ({"scan_type": "raster"}, "scan_type: got raster, need one of single"),
    ({"frame": "wall"}, "frame: got wall"),
    ({"sensor_positions": np.zeros((4, 5, 2))}, r"sensor_positions: got shape \(4, 5, 2\)"),
    ({"sensor_positions": np.zeros((0, 5, 3))}, r"sensor_positions: got shape \(0, 5, 3\)"),
    ({"sensor_positions": np.full((4, 5, 3), np.nan)}, "sensor_positions: got a value that is not finite"),
    ({"sensor_normals": np.zeros((5, 4, 3))}, r"sensor_normals: got shape \(5, 4, 3\), need shape \(4, 5, 3\)"),
    ({"sensor_normals": np.full((4, 5, 3), 0.5)}, "sensor_normals: got a normal of length 0.866"),
    ({"laser_normals": np.full((2, 3, 3), 2.0)}, "laser_normals: got a normal of length 3.46"),
    ({"laser_position": [0.0, 1.0]}, r"laser_position: got shape \(2,\)"),
    ({"sensor_position": [0.0, 1.0, np.inf]}, "sensor_position: got a value that is not finite"),
    ({"sensor_position": [0.0, 1.0, 1e39]}, "sensor_position: got a value beyond float32"),
    ({"sensor_grid_size": (2.0, -1.0)}, "sensor_grid_size: .* need lengths >= 0"),
    ({"n_bins": 0}, "n_bins: got 0"),
    ({"n_bins": 7.0}, "n_bins: got 7.0, need an integer"),
    ({"n_bins": True}, "n_bins: got True"),
    ({"n_bins": 2**31}, "n_bins: got 2147483648"),
    ({"bin_width_opl": 0.0}, "bin_width_opl: got 0.0, need a length > 0"),
    ({"bin_width_opl": 1e-60}, "bin_width_opl: got 1e-60"),
    ({"start_opl": np.nan}, "start_opl: got a value that is not finite"),
    ({"n_channels": 2}, "n_channels: got 2, need 1"),
    ({"bounce_indices": ()}, r"bounce_indices: got \(\)"),
    ({"bounce_indices": (1, 0)}, r"bounce_indices: got \(1, 0\), need ascending"),
    ({"bounce_indices": (1, 1)}, "bounce_indices: .* need ascending"),
    ({"bounce_indices": (5, 6)}, "bounce_indices: .* from 0 to 5"),
    ({"split_bounces": False}, "bounce_indices: .* need one index when bounces are not split"),
    ({"max_bounces": 1}, "max_bounces: got 1"),
    ({"hidden_bounds": (np.ones(3), np.zeros(3))}, "hidden_bounds: .* lowest corner <= highest"),
    ({"hidden_bounds": (np.zeros(3), np.full(3, np.inf))}, "hidden_bounds: got a value that is not finite"),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_impossible_fields_are_named(header_of: Callable, changes: dict, message: str) -> None:
    """Each mistake raises a ValueError that starts with the field."""
    with pytest.raises(ValueError, match=f"^{message}"):
        header_of("exhaustive", **changes)


def test_single_has_one_laser_point(header_of: Callable) -> None:
    """A single capture with a laser grid is refused."""
    with pytest.raises(ValueError, match="laser_positions: got 2 x 3 points, need one"):
        header_of("exhaustive", scan_type="single")


def test_confocal_lasers_are_the_sensor_points(header_of: Callable) -> None:
    """A confocal capture whose laser points lie elsewhere is refused."""
    header = header_of("confocal")
    with pytest.raises(ValueError, match="laser_positions: got other points"):
        header_of("confocal", laser_positions=header.sensor_positions + 1e-9)
    with pytest.raises(ValueError, match="laser_normals: got other normals"):
        header_of("confocal", laser_normals=-header.sensor_normals)


def test_header_is_frozen_down_to_its_arrays(header_of: Callable) -> None:
    """Neither fields nor array elements can be changed, and the caller's arrays are not shared."""
    header = header_of()
    with pytest.raises(FrozenInstanceError):
        header.n_bins = 3
    with pytest.raises(ValueError, match="read-only"):
        header.sensor_positions[0, 0, 0] = 1.0
    mine = np.array(header.sensor_positions)
    other = header_of(sensor_positions=mine)
    mine[0, 0, 0] = 99.0
    assert other.sensor_positions[0, 0, 0] != 99.0


def test_sizes_of_a_confocal_capture_have_one_laser(header_of: Callable) -> None:
    """In memory a confocal capture has laser axes of length 1, whatever its grid."""
    sizes = header_of("confocal").sizes
    assert [sizes[axis] for axis in ("laser_y", "laser_x", "sensor_y", "sensor_x", "bin")] == [1, 1, 4, 5, 7]


def test_bounce_names(header_of: Callable) -> None:
    """Index k is bounce k + 2; only an unlimited or higher render adds "and above" to bounce 7."""
    header = header_of(bounce_indices=(0, 1, 5), max_bounces=None)
    assert [header.bounce_name(slot) for slot in range(3)] == ["bounce 2", "bounce 3", "bounce 7 and above"]
    assert header_of(bounce_indices=(5,), max_bounces=7).bounce_name(0) == "bounce 7"
    assert header_of(bounce_indices=(1,), split_bounces=False).bounce_name(0) == "all bounces"
