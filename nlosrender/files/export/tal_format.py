"""HDF5_TAL: the capture format of y-tal. Grids are (x, y), the wall lies in z = 0, the hidden scene at z > 0."""

from __future__ import annotations

import json
from enum import IntEnum
from pathlib import Path

import h5py
import numpy as np

from nlosrender.files.export.wall_order import OrderedCapture, Rectification, rectification
from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.files.layout import Float64
from nlosrender.files.reading.reader import StoredCapture
from nlosrender.files.reading.scan import Scan


class HFormat(IntEnum):
    """What the axes of ``H`` are, as y-tal numbers it."""

    UNKNOWN = 0
    T_Sx_Sy = 1
    T_Lx_Ly_Sx_Sy = 2
    T_Si = 3
    T_Li_Si = 4


class GridFormat(IntEnum):
    """What the axes of a grid are, as y-tal numbers it."""

    UNKNOWN = 0
    N_3 = 1
    X_Y_3 = 2


class VolumeFormat(IntEnum):
    """What the axes of a volume are, as y-tal numbers it."""

    UNKNOWN = 0
    N_3 = 1
    X_Y_Z_3 = 2
    X_Y_3 = 3


def write_tal(path: Path, ordered: OrderedCapture, keep_legs: bool) -> list[str]:
    """Write ``path`` laser point by laser point; return what the format does not hold.

    A capture of 1 x 1 laser points is ``T_Sx_Sy`` as in y-tal's own files, and so is a confocal one.

    Parameters
    ----------
    path, ordered
        File and capture.
    keep_legs
        Leave time as it is in the capture; else count it from the wall. Without legs it is counted so.

    Raises
    ------
    OSError
        The disk refuses.
    """
    scan = ordered.scan
    move = rectification(scan) if scan.legs_counted and not keep_legs else None
    lasers = (1, 1) if scan.confocal else scan.lasers.shape[:2]
    pairs = lasers != (1, 1)
    n_bins = scan.n_bins if move is None else move.n_bins
    columns, rows = scan.sensors.shape[1], scan.sensors.shape[0]
    with HDF5Writer(path) as hdf5:
        file = hdf5.file
        shape = (n_bins, *(lasers[::-1] if pairs else ()), columns, rows)
        chunk = (n_bins, *((1, 1) if pairs else ()), 1, rows)
        samples = file.create_dataset("H", shape, "<f4", chunks=chunk, compression="gzip", compression_opts=1)
        for y, x in np.ndindex(*lasers):
            for part, stored in ordered.bands((y, x)):
                light = stored if move is None else move.apply(stored, part, (0, 0) if scan.confocal else (y, x))
                for column in range(columns):
                    hdf5.fill(samples, (slice(None), *((x, y) if pairs else ()), column, part), light[:, column].T)
        _write_enum(file, "H_format", HFormat.T_Lx_Ly_Sx_Sy if pairs else HFormat.T_Sx_Sy)
        _write_grids(file, ordered)
        _write_enum(file, "volume_format", VolumeFormat.X_Y_Z_3)
        file["delta_t"] = scan.bin_width_opl
        file["t_start"] = scan.start_opl if move is None else 0.0
        file["t_accounts_first_and_last_bounces"] = scan.legs_counted and keep_legs
        file["scene_info"] = _scene_info(ordered.capture, scan)
    return [*_list_losses(ordered.capture), *_leg_losses(scan, move)]


def _list_losses(capture: StoredCapture) -> list[str]:
    return [
        f"the {name} points are a list, here a grid of {count} x 1: take methods that go by positions, such as bp"
        for name, (_, count) in (("sensor", capture.header.sensor_grid), ("laser", capture.header.laser_grid))
        if capture.header.is_list(name)
    ]


def _leg_losses(scan: Scan, move: Rectification | None) -> list[str]:
    if move is None:
        kept = "the legs are left in: of y-tal's methods only bp and pf_dev take them off"
        return [kept] if scan.legs_counted else []
    if move.is_identity:
        return []
    what = "the legs laser -> wall and wall -> sensor are taken off"
    return [f"{what}: histograms are moved, and blurred by up to a bin; --legs keep leaves time as it is"]


def _write_grids(file: h5py.File, ordered: OrderedCapture) -> None:
    scan, stored = ordered.scan, ordered.capture.positions
    for name, position, points, normals, order in (
        ("sensor", scan.sensor_position, scan.sensors, stored.sensor_normals, ordered.sensor_order),
        ("laser", scan.laser_position, scan.lasers, stored.laser_normals, ordered.laser_order),
    ):
        file[f"{name}_xyz"] = h5py.Empty(float) if position is None else position.astype(np.float32)
        file[f"{name}_grid_xyz"] = _x_first(points)
        # normals go by the inverse's transpose
        file[f"{name}_grid_normals"] = (
            h5py.Empty(float) if normals is None else _x_first(order.sorted(normals) @ scan.wall_to_file[:3, :3])
        )
        _write_enum(file, f"{name}_grid_format", GridFormat.X_Y_3)


def _x_first(points: Float64) -> np.ndarray:
    """Turn (rows, columns, 3) into y-tal's (x, y, 3) float32."""
    return points.transpose(1, 0, 2).astype(np.float32)


def _write_enum(file: h5py.File, name: str, value: IntEnum) -> None:
    kinds = h5py.enum_dtype({kind.name: kind.value for kind in type(value)}, basetype="i")
    file.create_dataset(name, (1,), dtype=kinds)[0] = value.value


def _scene_info(capture: StoredCapture, scan: Scan) -> str:
    info: dict[str, object] = {"original_format": "HDF5_ZNLOS", "original_file": capture.path.name}
    if scan.hidden_aabb is not None:
        low, high = scan.hidden_aabb
        info["volume"] = {"center": ((low + high) / 2).tolist(), "rotation": [0, 0, 0], "size": (high - low).tolist()}
    config = capture.header.attributes.get("config")
    if isinstance(config, str):
        info["nlosrender_config"] = config
    return json.dumps(info)  # y-tal reads YAML, of which JSON is a part
