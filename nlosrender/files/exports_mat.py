"""MATLAB files of f-k migration, the light-cone transform and phasor-field diffraction (.mat version 7).

All three take time as a bin number, and want bin 0 to be the moment at which light is at the wall. Rows ascend in wall
y, columns in wall x.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlosrender.errors import FileError
from nlosrender.files.layout import Float64
from nlosrender.files.reader import StoredCapture
from nlosrender.files.scan import Float32, Scan, light_bands
from nlosrender.units import opl_to_seconds

PS = 1e12  # picoseconds in a second
FK_BIN_PS = 32.0  # their program's constant: the file has no place for it
LCT_BIN_PS = 4.0
MAX_VARIABLE_BYTES = 2**31 - 1  # of one variable in a version 7 file
SAME = 1e-3  # relative difference of two lengths that count as equal


def write_fk(path: Path, capture: StoredCapture, scan: Scan, bounces: tuple[int, ...]) -> list[str]:
    """Write ``meas`` (y, x, T) and ``tofgrid`` (y, x) [ps], by which the reader shifts each histogram to the wall.

    Raises
    ------
    FileError
        The capture is not confocal, its wall not planar, or it is too large.
    """
    _refuse_pairs(capture, scan, "f-k migration")
    light = _light(capture, scan, bounces)
    # a start after 0 becomes empty bins: the reader's shift goes round the end
    lead = max(int(np.ceil(scan.start_opl / scan.bin_width_opl - 1e-9)), 0)
    light = np.pad(light, ((0, 0), (0, 0), (lead, 0)))
    delay = scan.sensor_legs + scan.laser_legs - scan.start_opl + lead * scan.bin_width_opl
    losses = _square_losses(scan) + _bin_losses(scan, FK_BIN_PS, "bin_resolution")
    _save(
        path,
        {
            "meas": light,
            "tofgrid": opl_to_seconds(1.0) * PS * delay,
            "wall_size": max(_extent(capture, scan)),
            "bin_resolution": opl_to_seconds(scan.bin_width_opl),
        },
    )
    return losses


def write_lct(path: Path, capture: StoredCapture, scan: Scan, bounces: tuple[int, ...]) -> list[str]:
    """Write ``rect_data`` (y, x, T), time counted from the wall, and ``width``, half the wall's [m].

    Raises
    ------
    FileError
        The capture is not confocal, its wall not planar, or it is too large.
    """
    _refuse_pairs(capture, scan, "the light-cone transform")
    losses = _square_losses(scan) + _bin_losses(scan, LCT_BIN_PS, "bin_resolution")
    rectified = _rectified(_light(capture, scan, bounces), scan, scan.sensor_legs + scan.laser_legs)
    _save(
        path,
        {
            "rect_data": rectified,
            "width": max(_extent(capture, scan)) / 2,
            "bin_resolution": opl_to_seconds(scan.bin_width_opl),
        },
    )
    return losses + _shift_losses(scan)


def write_phasor_mat(path: Path, capture: StoredCapture, scan: Scan, bounces: tuple[int, ...]) -> list[str]:
    """Write ``rect_data`` (T, x, y), ``ts`` [s], ``sampling_spacing`` [m] and ``SPAD_index`` (x, y), from 0.

    Their captures have one sensor point and many laser points; a single capture is that by reciprocity, so its laser
    point takes the place of the SPAD.

    Raises
    ------
    FileError
        The capture is not single, its wall not planar, its points not equally spaced in both directions, or it is
        too large.
    """
    if scan.confocal or scan.lasers.shape[:2] != (1, 1):
        raise FileError(
            f"{capture.path}: is {scan.scan_type}: files for phasor-field diffraction hold one fixed point and "
            "one grid. Export a capture of scan_type single."
        )
    _refuse_curved(capture, scan)
    steps = [float(np.ptp(scan.sensors[..., axis])) / max(scan.sensors.shape[1 - axis] - 1, 1) for axis in (0, 1)]
    spacing = max(steps)
    if min(step for step in steps if step > 0 or spacing == 0) < spacing * (1 - SAME):
        raise FileError(
            f"{capture.path}: its sensor points are {steps[0]:.4g} m apart along x and {steps[1]:.4g} m along y; files "
            "for phasor-field diffraction have one spacing. Render it with square cells."
        )
    place = (scan.lasers[0, 0, :2] - scan.sensors[0, 0, :2]) / (spacing or 1.0)
    index = np.rint(place)
    losses = _shift_losses(scan)
    if np.abs(place - index).max() > SAME:
        losses.append(
            f"the laser point is not on the sensor grid: SPAD_index {index.tolist()} stands for "
            f"{place.round(3).tolist()}"
        )
    rectified = _rectified(_light(capture, scan, bounces), scan, scan.sensor_legs + scan.laser_legs[0, 0])
    _save(
        path,
        {
            "rect_data": rectified.transpose(2, 1, 0),
            "ts": opl_to_seconds(scan.bin_width_opl),
            "sampling_spacing": spacing,
            "SPAD_index": index,
        },
    )
    return losses


def _light(capture: StoredCapture, scan: Scan, bounces: tuple[int, ...]) -> Float32:
    """Return (Ny, Nx, bin) of the only laser point, or of a confocal capture."""
    rows, columns = scan.sensors.shape[:2]
    size = 4 * rows * columns * (scan.n_bins + max(int(scan.start_opl / scan.bin_width_opl), 0) + 1)
    if size > MAX_VARIABLE_BYTES:
        raise FileError(f"{capture.path}: {size / 2**30:.3g} GiB do not fit into a .mat file, which ends at 2 GiB")
    light = np.empty((rows, columns, scan.n_bins), dtype=np.float32)
    for part, band in light_bands(capture, (0, 0), bounces):
        light[part] = band
    return light


def _rectified(light: Float32, scan: Scan, legs: Float64) -> Float32:
    """Return histograms (Ny, Nx, bin) without legs (Ny, Nx) [m] that start at 0, as many bins as reach the last light.

    Each bin is shared by the two that it covers: energy is kept, and light before 0 is not expected on a plane.
    """
    shift = (scan.start_opl - legs) / scan.bin_width_opl
    whole = np.floor(shift).astype(int)
    later = (shift - whole).astype(np.float32)[..., None]
    n_bins = scan.n_bins + int(whole.max()) + 1
    moved = np.zeros((*light.shape[:2], max(n_bins, 1)), dtype=np.float32)
    for row, column in np.ndindex(*light.shape[:2]):
        for share, start in ((1 - later, whole), (later, whole + 1)):
            first = int(start[row, column])
            part = light[row, column, max(-first, 0) :] * share[row, column]
            begin = max(first, 0)
            length = min(len(part), moved.shape[2] - begin)
            moved[row, column, begin : begin + length] += part[:length]
    return moved


def _extent(capture: StoredCapture, scan: Scan) -> tuple[float, float]:
    """Return width and height of the sensor grid [m], whole cells."""
    size = capture.header.sensor_grid_size
    if size is not None and len(size) == 2 and min(size) > 0:
        return size[0], size[1]
    width, height = (
        float(np.ptp(scan.sensors[..., axis])) * count / max(count - 1, 1)
        for axis, count in zip((0, 1), scan.sensors.shape[1::-1], strict=True)
    )
    return width, height


def _refuse_pairs(capture: StoredCapture, scan: Scan, program: str) -> None:
    if not scan.confocal:
        raise FileError(
            f"{capture.path}: is {scan.scan_type}: files for {program} hold confocal captures only. "
            "Render it with capture.scan_type: confocal, or export it as tal."
        )
    _refuse_curved(capture, scan)


def _refuse_curved(capture: StoredCapture, scan: Scan) -> None:
    if not scan.planar:
        raise FileError(
            f"{capture.path}: has a curved relay wall, and this format holds no positions. Export it as tal."
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


def _bin_losses(scan: Scan, assumed_ps: float, name: str) -> list[str]:
    width_ps = opl_to_seconds(scan.bin_width_opl) * PS
    if abs(width_ps - assumed_ps) <= SAME * assumed_ps:
        return []
    return [
        f"bins are {width_ps:.4g} ps wide: the authors' program has {assumed_ps:g} ps as a constant; set its {name} to "
        "the file's"
    ]


def _shift_losses(scan: Scan) -> list[str]:
    if not scan.legs_counted and scan.start_opl == 0:
        return []
    return ["time is counted from the wall: histograms are moved, and blurred by up to a bin"]


def _save(path: Path, variables: dict[str, object]) -> None:
    from scipy.io import savemat

    with path.open("wb") as stream:
        savemat(stream, variables, do_compression=True, oned_as="row")
