"""Capture files of a few hidden points, in closed form: no renderer, and the truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.files.capture_header import CaptureHeader
from nlosrender.scene.pose import Pose
from support.partial_captures import write_capture

Array = NDArray[np.float64]
Point = Sequence[float]

POSE = Pose.from_normal_up([3.0, -2.0, 1.0], [1.0, 0.5, -0.2], [0.1, 1.0, 0.3])  # nothing lies along an axis
LASER_POINT = (0.2, -0.1)  # of single captures
LASERS = (3, 2, 0.9, 0.7)  # of exhaustive captures: columns, rows, width, height


def cells(nx: int, ny: int, width: float, height: float) -> Array:
    """Return cell centres (ny, nx, 3) in the plane z = 0 [m]."""
    x = ((np.arange(nx) + 0.5) / nx - 0.5) * width
    y = ((np.arange(ny) + 0.5) / ny - 0.5) * height
    return np.stack(np.broadcast_arrays(x, y[:, None], 0.0), axis=-1)


def points_header(
    scan: str,
    sensors: Array,
    lasers: Array | None = None,
    *,
    bins: tuple[float, float, int] = (0.0, 0.01, 400),
    legs: bool = False,
    **changes: Any,
) -> CaptureHeader:
    """Return the header of a capture with these sensor points (Ny, Nx, 3) [m]; bins: start, width [m], number."""
    if lasers is None:
        single = np.array([[[*LASER_POINT, 0.0]]])
        lasers = {"single": single, "confocal": sensors}.get(scan, cells(*LASERS))
    up = np.array([0.0, 0.0, 1.0])
    fields: dict[str, Any] = {
        "scan_type": scan,
        "sensor_positions": sensors,
        "sensor_normals": np.broadcast_to(up, sensors.shape),
        "laser_positions": lasers,
        "laser_normals": np.broadcast_to(up, lasers.shape),
        "sensor_position": np.array([0.3, 0.2, 1.5]),
        "laser_position": np.array([-0.5, 0.1, 0.25]),
        "sensor_grid_size": (2.0, 1.6),
        "laser_grid_size": (1.0, 1.0),
        "n_bins": bins[2],
        "bin_width_opl": bins[1],
        "start_opl": bins[0],
        "n_channels": 1,
        "bounce_indices": (0, 1),
        "max_bounces": 3,
        "split_bounces": True,
        "account_first_and_last_bounces": legs,
        "hidden_bounds": (np.array([-0.3, -0.2, 0.6]), np.array([0.4, 0.3, 1.1])),
        "pose": POSE,
    }
    return CaptureHeader(**(fields | changes))


def point_light(header: CaptureHeader, points: Sequence[Point]) -> Array:
    """Return (Ly, Lx, Ny, Nx, bin): third bounces of unit scatterers, cosines left out.

    A deposit is shared by the two bins whose middles are nearest, so that its mean time is exact.
    """
    sensors = header.sensor_positions
    ly, lx = (1, 1) if header.confocal else header.laser_positions.shape[:2]
    light = np.zeros((ly, lx, *sensors.shape[:2], header.n_bins + 1))
    rows, columns = np.indices(sensors.shape[:2])
    counted = float(header.account_first_and_last_bounces)
    sensor_legs = counted * np.linalg.norm(sensors - header.sensor_position, axis=-1)
    for y, x in np.ndindex(ly, lx):
        laser = sensors if header.confocal else header.laser_positions[y, x]
        laser_leg = counted * np.linalg.norm(laser - header.laser_position, axis=-1)
        for point in points:
            forth, back = (np.linalg.norm(np.asarray(point) - end, axis=-1) for end in (laser, sensors))
            place = (forth + back + laser_leg + sensor_legs - header.start_opl) / header.bin_width_opl - 0.5
            first = np.floor(place).astype(int)
            assert first.min() >= 0
            assert first.max() < header.n_bins - 1
            strength = 1 / (forth * back) ** 2 * np.ones(first.shape)
            np.add.at(light[y, x], (rows, columns, first), strength * (1 - place + first))
            np.add.at(light[y, x], (rows, columns, first + 1), strength * (place - first))
    return light[..., :-1]


def write_points(path: Path, header: CaptureHeader, points: Sequence[Point], **attributes: object) -> Path:
    """Write the capture of some points (wall's frame, [m]); its second bounce is bright and false."""
    return write_light(path, header, point_light(header, points), **attributes)


def write_light(path: Path, header: CaptureHeader, light: Array, **attributes: object) -> Path:
    """Write third bounces (Ly, Lx, Ny, Nx, bin) with a second bounce that is bright and false."""
    third = light.astype(np.float32)
    block = np.stack([np.full_like(third, third.max()), third])[None]
    if len(header.bounce_indices) == 1:
        block = block[:, 1:]
    return write_capture(path, header, block, attributes=attributes)
