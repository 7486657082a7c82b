"""Samples of a data set as learning programs take them: histograms counted from the wall, pictures as the wall sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.errors import FileError
from nlosrender.files.export.wall_order import ordered_capture, rectification
from nlosrender.files.layout import axes_last
from nlosrender.files.reading.reader import explained_read, open_capture, open_hdf5
from nlosrender.files.reading.scan import chosen_bounces, read_scan
from nlosrender.files.truth_datasets import read_ground_truth

Float32 = NDArray[np.float32]
WALL_NORMALS = "cameraGridNormals"


@dataclass(frozen=True, eq=False)
class WallSample:
    """One capture, rows from the top and columns from the left as seen from the wall; lengths in wall widths."""

    light: Float32  # (bin, row, column), bin 0 begins when light is at the wall; bounces summed, colours averaged
    bin_width: float  # optical path
    image: Float32 | None  # (row, column) what a flash at the wall shows: albedo times cosine
    depth: Float32 | None  # (row, column) from the wall, NaN: nothing
    width: float  # of the wall's grid [m]
    confocal: bool


def wall_sample(path: Path) -> WallSample:
    """Read a capture.

    Raises
    ------
    FileError
        It is neither confocal nor of one laser point, no square grid on a plane, or damaged.
    """
    with open_capture(path) as capture:
        capture.header.refuse_spots("this format")
        bounces = chosen_bounces(capture.header, "all")
        ordered = ordered_capture(capture, read_scan(capture), bounces, x_descends=True, y_descends=True)
        scan = ordered.scan
        rows, columns = scan.sensors.shape[:2]
        one_laser = scan.confocal or scan.lasers[..., 0].size == 1
        if not (ordered.is_grid and scan.planar and one_laser) or rows != columns:
            raise FileError(
                f"{path}: {scan.scan_type}, {columns} x {rows} points: this format takes square grids on a flat wall, "
                "confocal or with one laser point. Use format webdataset."
            )
        move = rectification(scan)
        bands = [move.apply(light, part) for part, light in ordered.bands()]
    light = np.moveaxis(np.concatenate(bands), -1, 0)
    width = float(np.ptp(scan.sensors[..., 0])) * columns / max(columns - 1, 1)
    truth = read_ground_truth(path)
    depth = truth.get("gt_depth")
    return WallSample(
        light=np.ascontiguousarray(light, dtype=np.float32),
        bin_width=scan.bin_width_opl / width,
        image=_image(path, truth),
        depth=None if depth is None else (depth[::-1, ::-1] / width).astype(np.float32),
        width=width,
        confocal=scan.confocal,
    )


def _image(path: Path, truth: Mapping[str, NDArray[Any]]) -> Float32 | None:
    """Return albedo times the cosine to the wall's normal; without an albedo 1 where there is something."""
    if "gt_albedo" in truth:
        image = np.nan_to_num(truth["gt_albedo"]).mean(axis=0)
    elif "gt_depth" in truth:
        image = np.isfinite(truth["gt_depth"]).astype(float)
    else:
        return None
    if "gt_normal" in truth:
        with open_hdf5(path) as file, explained_read(path):
            towards = axes_last(file[WALL_NORMALS][()].astype(float)).mean(axis=(0, 1))
        image = image * np.clip(-np.nan_to_num(axes_last(truth["gt_normal"])) @ towards, 0, None)
    return image[::-1, ::-1].astype(np.float32)


def rounding(stored: NDArray[Any], exact: NDArray[Any]) -> float:
    """Return the relative L2 error of ``stored``; 0 where all is dark."""
    square = float(np.square(exact, dtype=np.float64).sum())
    difference = float(np.square(stored.astype(np.float64) - exact).sum())
    return float(np.sqrt(difference / square)) if square else 0.0
