"""Samples of a capture for xarray: named dimensions, coordinates in metres and seconds.

Dimensions are channel, bounce, laser_y, laser_x, sensor_y, sensor_x and time; a confocal capture has no laser
dimensions. Coordinates:

- ``time`` [s] and ``opl`` [m]: the middle of each bin;
- ``bounce``: bounce numbers, 7 being 7 and above, where the file keeps bounces apart;
- ``channel``: r, g, b or I, Q, U, V;
- ``sensor_x``, ``sensor_y``, ``laser_x``, ``laser_y`` [m]: on a flat wall, from its centre;
- ``sensor_position_x``, ``_y``, ``_z`` [m], and those of the laser: in the frame of a wall that is not flat. A camera
  has none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.constants import SPEED_OF_LIGHT
from nlosrender.errors import OptionError
from nlosrender.files import layout
from nlosrender.files.layout import Float64
from nlosrender.files.reading.reader import Part, StoredCapture
from nlosrender.files.reading.scan import read_scan
from nlosrender.files.reading.stored_header import StoredHeader
from nlosrender.files.reading.stored_points import FLATNESS

if TYPE_CHECKING:
    from xarray import DataArray

METRES = {"units": "m"}
CHANNELS = {3: ["r", "g", "b"], 4: ["I", "Q", "U", "V"]}


def named_samples(
    stored: StoredCapture,
    lasers: tuple[Part, Part] | None,
    sensors: tuple[Part, Part] | None,
    bounces: tuple[int, ...] | None,
    dataset: str,
) -> DataArray:
    """Return part of the samples of an open capture; parameters and errors as of ``read_block``.

    Raises
    ------
    OptionError
        The package xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise OptionError("xarray is not installed: pip install 'nlosrender[xarray]', or use numpy().") from error
    header = stored.header
    block = stored.read_block(lasers, sensors, bounces, dataset)
    dims = [*layout.MEMORY_AXES[:-1], "time"]
    if header.confocal:
        block, dims = block[:, :, 0, 0], [dim for dim in dims if not dim.startswith("laser")]
    opl = header.bin_centres()
    coordinates: dict[str, Any] = {"time": ("time", opl / SPEED_OF_LIGHT, {"units": "s"})}
    coordinates["opl"] = ("time", opl, METRES | {"long_name": "optical path length"})
    if header.split_bounces is not False:
        numbers = [index + header.first_bounce for index in bounces or header.bounce_indices]
        coordinates["bounce"] = ("bounce", numbers)
    if header.sizes["channel"] in CHANNELS:
        coordinates["channel"] = ("channel", CHANNELS[header.sizes["channel"]])
    if header.scan_type != LINE_OF_SIGHT:
        scan = read_scan(stored)
        coordinates |= _places("sensor", scan.sensors, sensors)
        coordinates |= {} if header.confocal else _places("laser", scan.lasers, lasers)
    attributes = {"units": _unit(header, dataset), "scan_type": header.scan_type, "file": str(header.path)}
    name = dataset if dataset != layout.DATA else "counts" if header.is_measured else "H"
    return xarray.DataArray(block, coordinates, dims, name, attributes)


def _places(grid: str, points: Float64, part: tuple[Part, Part] | None) -> dict[str, Any]:
    """Return the coordinates of part of a grid of points (rows, columns, 3) [m, wall's frame]."""
    rows, columns = (_kept(index) for index in part or (None, None))
    points = points[rows][:, columns]
    x, y, z = points[:1, :, 0], points[:, :1, 1], points[..., 2]
    off = max(np.ptp(points[..., 0] - x), np.ptp(points[..., 1] - y), np.ptp(z))
    if off <= FLATNESS * max(np.ptp(x), np.ptp(y), 1e-9):
        return {f"{grid}_x": (f"{grid}_x", x[0], METRES), f"{grid}_y": (f"{grid}_y", y[:, 0], METRES)}
    dims = (f"{grid}_y", f"{grid}_x")
    return {f"{grid}_position_{axis}": (dims, points[..., index], METRES) for index, axis in enumerate("xyz")}


def _kept(index: Part) -> slice:
    """Return a part as a slice: an index keeps its axis."""
    return slice(None) if index is None else index if isinstance(index, slice) else slice(index, index + 1)


def _unit(header: StoredHeader, dataset: str) -> str:
    return header.unit if dataset == layout.DATA else f"({header.unit})^2"
