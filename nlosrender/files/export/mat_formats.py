"""MATLAB files of f-k migration, the light-cone transform, phasor-field diffraction, and networks trained on f-k's.

All of them want bin 0 to be the moment at which light is at the wall, and none holds positions: what the order of
rows and columns means on the wall is each program's own (``exports.PROGRAMS`` has it).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from nlosrender.constants import opl_to_seconds
from nlosrender.errors import FileError, OptionError
from nlosrender.files.export.mat73 import chunk_rows, new_mat73
from nlosrender.files.export.wall_order import SAME, OrderedCapture, Rectification, rectification
from nlosrender.files.layout import Float64
from nlosrender.files.reading.scan import Float32, Scan

PS = 1e12  # picoseconds in a second
FK_BIN_PS = 32.0  # bin width [ps] that is a constant in f-k's program: the file has no place for it
FK_BINS = 2048  # at least: f-k's demo reads as many, its program 512
LCT_BIN_PS = 4.0
LCT_BINS = 2048  # at least: the authors' program empties up to 800 of the first bins, and halves their number twice
PHASOR_BINS = 4  # bins come in multiples of it: the authors' program halves their number twice
NETWORK_BINS = 512  # bins of FK_BIN_PS: the input size of the networks
MAX_VARIABLE_BYTES = 2**31 - 1  # of one variable in a version 7 file
TIME_FIRST = ("data",)  # keys whose readers want (t, row, column): nlos3d


def write_fk(path: Path, ordered: OrderedCapture) -> list[str]:
    """Write ``meas`` (row, column, t) and ``tofgrid`` (row, column) [ps], by which the reader shifts histograms.

    Raises
    ------
    FileError
        The capture is not confocal, or its wall not a plane with a grid.
    OSError
        The disk refuses.
    """
    scan = ordered.scan
    _refuse_pairs(ordered, "f-k migration")
    # a start after 0 becomes empty bins: the reader's shift is circular
    lead = max(int(np.ceil(scan.start_opl / scan.bin_width_opl - 1e-9)), 0)
    delay = scan.sensor_legs + scan.laser_legs - scan.start_opl + lead * scan.bin_width_opl
    shape = (*scan.sensors.shape[:2], max(lead + scan.n_bins, FK_BINS))
    with new_mat73(path) as mat:
        samples = mat.samples("meas", shape)
        for rows, light in ordered.bands(multiple=chunk_rows(shape)):
            mat.fill(samples, rows, light, lead)
        mat.put("tofgrid", opl_to_seconds(1.0) * PS * delay)
        mat.put("wall_size", max(_extent(ordered)))
        mat.put("bin_resolution", opl_to_seconds(scan.bin_width_opl))
    return _square_losses(scan) + _bin_losses(scan, FK_BIN_PS)


def write_lct(path: Path, ordered: OrderedCapture) -> list[str]:
    """Write ``rect_data`` (column, row, t), time counted from the wall, and ``width``, half the wall's [m].

    Raises
    ------
    FileError
        The capture is not confocal, its wall not a plane with a grid, or it is too large.
    OSError
        The disk refuses.
    """
    scan = ordered.scan
    _refuse_pairs(ordered, "the light-cone transform")
    move = rectification(scan)
    n_bins = max(LCT_BINS, 1 << (move.n_bins - 1).bit_length())  # their resampling works with powers of two
    _refuse_large(ordered, n_bins)
    rect_data = np.zeros((*scan.sensors.shape[1::-1], n_bins), dtype=np.float32)
    for rows, light in ordered.bands():
        rect_data[:, rows, : move.n_bins] = move.apply(light, rows).swapaxes(0, 1)
    width, bin_width = max(_extent(ordered)) / 2, opl_to_seconds(scan.bin_width_opl)
    _save(path, {"rect_data": rect_data, "width": width, "bin_resolution": bin_width})
    return _square_losses(scan) + _bin_losses(scan, LCT_BIN_PS) + shift_losses(move)


def write_phasor_mat(path: Path, ordered: OrderedCapture) -> list[str]:
    """Write ``rect_data`` (row, column, t), ``ts`` [s], ``sampling_spacing``, ``aperturefullsize`` [m], ``SPAD_index``.

    Their captures have one sensor point and many laser points; a single capture is that by reciprocity, so its laser
    point takes the place of the SPAD: (row, column), counted from 1.

    Raises
    ------
    FileError
        The capture is not single, its wall not a plane with a grid, or its points not equally spaced in both
        directions.
    OSError
        The disk refuses.
    """
    scan, capture = ordered.scan, ordered.capture
    if scan.confocal or scan.lasers.shape[:2] != (1, 1):
        raise FileError(
            f"{capture.path}: is {scan.scan_type}: files for phasor-field diffraction hold one fixed point and "
            "one grid. Export a capture of scan_type single."
        )
    _refuse_shape(ordered)
    n_rows, n_columns = scan.sensors.shape[:2]
    spacing = _spacing(ordered)
    (x, y), (left, top) = scan.lasers[0, 0, :2], scan.sensors[0, 0, :2]
    place = np.array([top - y, x - left]) / (spacing or 1.0) + 1
    index = np.rint(place)
    move = rectification(scan)
    losses = shift_losses(move)
    if np.abs(place - index).max() > SAME:
        losses.append(
            f"the laser point is not on the sensor grid: SPAD_index {index.tolist()} stands for "
            f"{place.round(3).tolist()}"
        )
    shape = (n_rows, n_columns, -(-move.n_bins // PHASOR_BINS) * PHASOR_BINS)
    with new_mat73(path) as mat:
        samples = mat.samples("rect_data", shape)
        for rows, light in ordered.bands(multiple=chunk_rows(shape)):
            mat.fill(samples, rows, move.apply(light, rows))
        mat.put("ts", opl_to_seconds(scan.bin_width_opl))
        mat.put("sampling_spacing", spacing)
        mat.put("aperturefullsize", [spacing * (n_rows - 1), spacing * (n_columns - 1)])
        mat.put("SPAD_index", index)
    return losses


def write_learned(path: Path, ordered: OrderedCapture, key: str) -> list[str]:
    """Write a variable ``key`` of 512 bins of 32 ps, time counted from the wall: what networks take.

    Raises
    ------
    FileError
        The capture is not confocal, its wall not a plane with a grid, or it is too large.
    OptionError
        ``key`` is no name of a variable.
    OSError
        The disk refuses.
    """
    if not re.fullmatch(r"[A-Za-z]\w{0,62}", key, re.ASCII):
        raise OptionError(f"--key: got {key!r}, need a name of a MATLAB variable such as measlr, final_meas or data")
    scan = ordered.scan
    _refuse_pairs(ordered, "networks trained on f-k migration's captures")
    _refuse_large(ordered, NETWORK_BINS)
    move = rectification(scan)
    bins = opl_to_seconds(scan.bin_width_opl) * PS / FK_BIN_PS  # bins of FK_BIN_PS in one of the capture
    found = np.empty((*scan.sensors.shape[:2], NETWORK_BINS), dtype=np.float32)
    total = 0.0
    for rows, light in ordered.bands():
        total += float(light.sum(dtype=np.float64))
        for row, column in np.ndindex(*light.shape[:2]):
            where = (rows.start + row, column)
            found[where] = _rebinned(light[row, column], float(move.shift[where]), bins)
    _save(path, {key: found.transpose(2, 0, 1) if key in TIME_FIRST else found})
    losses = [*_square_losses(scan), f"histograms are added up in {NETWORK_BINS} bins of {FK_BIN_PS:g} ps"]
    outside = 1 - float(found.sum(dtype=np.float64)) / total if total > 0 else 0.0
    if outside > 1e-6:  # float32 sums
        losses.append(f"{100 * outside:.3g} % of the light arrives outside these bins and is left out")
    return losses


def _rebinned(histogram: Float32, shift: float, per_bin: float) -> Float64:
    """Return a histogram, moved by ``shift`` bins, in ``NETWORK_BINS`` bins, each ``1 / per_bin`` of its own wide."""
    before = np.concatenate([[0.0], np.cumsum(histogram, dtype=np.float64)])
    edges = np.arange(NETWORK_BINS + 1) / per_bin - shift
    return np.diff(np.interp(edges, np.arange(len(before)), before))


def _spacing(ordered: OrderedCapture) -> float:
    sensors = ordered.scan.sensors
    steps = [float(np.ptp(sensors[..., axis])) / max(sensors.shape[1 - axis] - 1, 1) for axis in (0, 1)]
    spacing = max(steps)
    if min(step for step in steps if step > 0 or spacing == 0) < spacing * (1 - SAME):
        raise FileError(
            f"{ordered.capture.path}: its sensor points are {steps[0]:.4g} m apart along x and {steps[1]:.4g} m along "
            "y; files for phasor-field diffraction have one spacing. Render it with square cells."
        )
    return spacing


def _extent(ordered: OrderedCapture) -> tuple[float, float]:
    """Return width and height of the sensor grid [m], whole cells."""
    size, sensors = ordered.capture.header.sensor_grid_size, ordered.scan.sensors
    if size is not None and len(size) == 2 and min(size) > 0:
        return size[0], size[1]
    rows, columns = sensors.shape[:2]
    width, height = (float(np.ptp(sensors[..., axis])) for axis in (0, 1))
    return width * columns / max(columns - 1, 1), height * rows / max(rows - 1, 1)


def _refuse_pairs(ordered: OrderedCapture, program: str) -> None:
    scan = ordered.scan
    if not scan.confocal:
        raise FileError(
            f"{ordered.capture.path}: is {scan.scan_type}: files for {program} hold confocal captures only. "
            "Render it with capture.scan_type: confocal, or export it as tal."
        )
    _refuse_shape(ordered)


def _refuse_shape(ordered: OrderedCapture) -> None:
    path = ordered.capture.path
    if not ordered.scan.planar:
        raise FileError(
            f"{path}: its points lie in no plane (a curved relay wall, or a camera that sees several "
            f"surfaces), and this format holds no positions. Export it as tal."
        )
    if not ordered.is_grid:
        are = "a list" if ordered.scan.has_sensor_list else "no grid along the wall's axes"
        raise FileError(f"{path}: its sensor points are {are}, and this format holds no positions. Export it as tal.")


def _refuse_large(ordered: OrderedCapture, n_bins: int) -> None:
    size = 4 * ordered.scan.sensors[..., 0].size * n_bins
    if size > MAX_VARIABLE_BYTES:
        raise FileError(
            f"{ordered.capture.path}: {size / 2**30:.3g} GiB do not fit into a version 7 .mat file, which ends at "
            "2 GiB. Export it as fk or tal, or render fewer points."
        )


def _square_losses(scan: Scan) -> list[str]:
    rows, columns = scan.sensors.shape[:2]
    width, height = (float(np.ptp(scan.sensors[..., axis])) for axis in (0, 1))
    if rows == columns and abs(width - height) <= SAME * max(width, height):
        return []
    return [
        f"the grid is {columns} x {rows} points over about {width:.3g} x {height:.3g} m: the authors' program takes it "
        "for square"
    ]


def _bin_losses(scan: Scan, assumed_ps: float) -> list[str]:
    width_ps = opl_to_seconds(scan.bin_width_opl) * PS
    if abs(width_ps - assumed_ps) <= SAME * assumed_ps:
        return []
    return [
        f"bins are {width_ps:.4g} ps wide: the authors' program has {assumed_ps:g} ps as a constant; set its "
        "bin_resolution to the file's"
    ]


def shift_losses(move: Rectification) -> list[str]:
    """Say what counting time from the wall does to a capture."""
    moved = "time is counted from the wall: histograms are moved, and blurred by up to a bin"
    return [] if move.is_identity else [moved]


def _save(path: Path, variables: dict[str, object]) -> None:
    from scipy.io import savemat

    with path.open("wb") as stream:
        savemat(stream, variables, do_compression=True, oned_as="row")
