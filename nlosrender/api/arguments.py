"""What callers of a capture's methods name: bounces, points, a sensor."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from numbers import Real
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nlosrender.analysis.laser_view import Point, check_point
from nlosrender.errors import OptionError
from nlosrender.files.path_argument import path_argument
from nlosrender.files.reading.reader import Part, StoredCapture, read_header
from nlosrender.files.reading.scan import read_scan
from nlosrender.files.reading.stored_header import StoredHeader

if TYPE_CHECKING:
    from nlosrender.config.sensor import SensorConfig


def sensor_for(
    path: Path, sensor: str | os.PathLike[str] | Mapping[str, object] | None, changes: Sequence[str]
) -> SensorConfig | None:
    """Return the sensor that is described; None: that of the capture file, as it is.

    Errors are those of ``load_sensor``, and OptionError for an argument of another type.
    """
    from nlosrender.config.sensor_load import load_sensor
    from nlosrender.files.measured import sensor_of

    if sensor is None and not changes:
        return None
    known = sensor_of(read_header(path)) if sensor is None else None
    if sensor is not None and not isinstance(sensor, Mapping):
        sensor = str(path_argument("sensor", sensor, "a mapping, a profile or the name of a YAML file"))
    return load_sensor(sensor, known, changes)


def bounce_indices(header: StoredHeader, bounces: int | Sequence[int] | None) -> tuple[int, ...] | None:
    """Return the indices of bounce numbers on the file's bounce axis; None: all that hold light."""
    if bounces is None:
        return None
    try:
        wanted = [index(bounce) for bounce in np.atleast_1d(np.asarray(bounces, dtype=object))]
    except TypeError as error:
        raise OptionError(f"bounces: got {bounces!r}, need bounce numbers, integers") from error
    if header.split_bounces is False:
        raise OptionError(f"bounces: got {wanted}, but {header.path} holds the sum of all; leave it away")
    known = [slot + header.first_bounce for slot in header.bounce_indices]
    if not wanted or (missing := [bounce for bounce in wanted if bounce not in known]):
        raise OptionError(f"bounces: got {missing if wanted else wanted}, need some of {', '.join(map(str, known))}")
    return tuple(bounce - header.first_bounce for bounce in wanted)


def laser_point(header: StoredHeader, laser: Point | None) -> Point:
    """Return a laser point as ``plot`` chooses it."""
    rows, columns = header.sizes["laser_y"], header.sizes["laser_x"]
    return check_point("laser", laser, rows, columns) or (rows // 2, columns // 2)


def check_parts(name: str, parts: tuple[Part, Part] | None) -> None:
    """Raise OptionError for what is no part of a grid; whether the grid has it the reader says."""
    kinds = (int, np.integer, slice, type(None))
    if parts is None or (
        isinstance(parts, (tuple, list))
        and len(parts) == 2
        and all(isinstance(part, kinds) and getattr(part, "step", None) in (None, 1) for part in parts)
    ):
        return
    need = "(row, column), each an integer, a slice of step 1 or None: (slice(0, 8), None)"
    raise OptionError(f"{name}: got {parts!r}, need {need}")


def nearest_point(stored: StoredCapture, x: float | None, y: float | None) -> Point:
    """Return row and column of the sensor point nearest to a place on a flat wall [m]."""
    if not (isinstance(x, Real) and isinstance(y, Real)):
        raise OptionError(f"x, y: got {x!r:.60}, {y!r:.60}, need two numbers [m], or pixel=(row, column)")
    scan = None if stored.header.has_pixels else read_scan(stored)
    if scan is None or not scan.planar:
        what = "a camera" if scan is None else "a curved wall"
        raise OptionError(f"x, y: {what} has no such coordinates; give pixel=(row, column)")
    points = scan.sensors[..., :2]
    rows, columns = points.shape[:2]
    size = stored.header.sensor_grid_size or tuple(np.ptp(points, axis=(0, 1)))
    half = np.array(size) / (2 * np.array([columns, rows]))  # of the cell around a point
    low, high = points.min(axis=(0, 1)) - half, points.max(axis=(0, 1)) + half
    if not (low[0] <= x <= high[0] and low[1] <= y <= high[1]):
        need = f"x from {low[0]:.6g} to {high[0]:.6g} and y from {low[1]:.6g} to {high[1]:.6g} m"
        raise OptionError(f"x, y: got {x:g}, {y:g}, off the sensor grid; need {need}")
    row, column = np.unravel_index(int(((points - (x, y)) ** 2).sum(axis=-1).argmin()), (rows, columns))
    return int(row), int(column)
