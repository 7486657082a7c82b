"""A capture seen from its wall: points in the wall's frame, legs, time axis, light of one laser point.

Reconstruction and export share it: neither depends on the layout of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.capture.time_axis import bin_centres
from nlosrender.errors import FileError
from nlosrender.files.layout import ZNLOS_FROM_LOCAL, Float64
from nlosrender.files.reading.reader import StoredCapture, finite
from nlosrender.files.reading.stored_header import StoredHeader, intensity
from nlosrender.files.reading.stored_points import FLATNESS, Numbers
from nlosrender.scene.bounding_box import Bounds, box_corners
from nlosrender.scene.pose import Pose, euler_xyz

Float32 = NDArray[np.float32]

BAND_BYTES = 128 * 2**20  # of samples read at a time


@dataclass(frozen=True, eq=False)
class Scan:
    """Where and when a capture was measured, in the wall's frame: wall in z = 0, hidden scene at z > 0 [m]."""

    scan_type: str
    sensors: Float64  # (Ny, Nx, 3) m
    lasers: Float64  # (Ly, Lx, 3) m; (1, 1, 3) for single, the sensors for confocal
    sensor_position: Float64 | None  # (3,) m, where the sensor stands; None when the file does not say
    laser_position: Float64 | None
    legs_counted: bool  # whether time includes the legs laser -> wall and wall -> sensor
    sensor_legs: Float64  # (Ny, Nx) m, from sensor point to sensor; zero where legs are not counted in time
    laser_legs: Float64  # (Ly, Lx) m
    start_opl: float  # m
    bin_width_opl: float  # m
    n_bins: int
    hidden_aabb: Bounds | None  # around the hidden geometry, as the file has it
    wall_to_file: Float64  # (4, 4)
    wall_to_scene: Float64 | None  # (4, 4); None when the file does not say
    has_sensor_list: bool = False  # whether the sensor points are a list in one row, which may stand anywhere

    @property
    def confocal(self) -> bool:
        """Whether laser and sensor point coincide."""
        return self.scan_type == "confocal"

    @property
    def planar(self) -> bool:
        """Whether all points lie in one plane parallel to z = 0."""
        points = np.concatenate([self.sensors.reshape(-1, 3), self.lasers.reshape(-1, 3)])
        extent = np.ptp(points, axis=0)
        return bool(extent[2] <= FLATNESS * max(extent[0], extent[1], 1e-9))

    def bin_centres(self) -> Float64:
        """Return the optical path length in the middle of every bin, (bin,) [m]."""
        return bin_centres(self.start_opl, self.bin_width_opl, self.n_bins)


def read_scan(capture: StoredCapture) -> Scan:
    """Read grids, legs and time axis of a capture and bring them into the wall's frame.

    Raises
    ------
    FileError
        It is no capture of a relay wall. Positions are missing or not finite, or the file counts the legs but does not
        say where laser and sensor stand.
    """
    header, stored = capture.header, capture.positions
    if header.scan_type == LINE_OF_SIGHT:
        raise FileError(
            f"{capture.path}: is a line_of_sight capture, a camera's pictures over time: there is no relay wall to "
            "reconstruct from or to export. See `nlosrender frames`."
        )
    wall_from_file = wall_frame(header)
    if not all(np.isfinite(part).all() for part in (stored.sensor_positions, stored.laser_positions, header.start_opl)):
        raise FileError(f"{capture.path}: t0 or a position on the wall is not a finite number")
    sensors = moved(stored.sensor_positions, wall_from_file)
    lasers = moved(stored.laser_positions, wall_from_file)
    counted = bool(header.attributes.get("account_first_and_last_bounces", True))  # the layout's rule
    sensor, laser = (_device(place, wall_from_file) for place in (header.sensor_position, header.laser_position))
    to_scene = _matrix(header, "file_to_scene")
    wall_to_file: Float64 = np.linalg.inv(wall_from_file).astype(np.float64)
    return Scan(
        scan_type=header.scan_type,
        sensors=sensors,
        lasers=lasers,
        sensor_position=sensor,
        laser_position=laser,
        legs_counted=counted,
        sensor_legs=_legs(capture, sensors, sensor, counted, "cameraPosition"),
        laser_legs=_legs(capture, lasers, laser, counted, "laserPosition"),
        start_opl=header.start_opl,
        bin_width_opl=header.bin_width_opl,
        n_bins=header.n_bins,
        hidden_aabb=hidden_box(header, wall_from_file),
        wall_to_file=wall_to_file,
        wall_to_scene=None if to_scene is None else to_scene @ wall_to_file,
        has_sensor_list=header.is_list(),
    )


def chosen_bounces(header: StoredHeader, bounces: str | None) -> tuple[int, ...]:
    """Return the indices on the file's bounce axis that are reconstructed from.

    ``bounces`` is ``3`` (the third bounce), ``all``, or None: the third where the file keeps it apart, else all.

    Raises
    ------
    FileError
        The third bounce is asked for and the file holds only the sum of all.
    """
    apart = header.split_bounces is not False and header.sizes["bounce"] > 1
    if bounces == "all" or (bounces is None and not apart):
        return header.bounce_indices
    if not apart:
        raise FileError(
            f"{header.path}: holds the sum of all bounces, not the third alone. Use --bounces all, or render it "
            "with render.split_bounces: true."
        )
    if header.third_index is None:
        stored = header.data_attributes.get("third_bounce", "missing")
        raise FileError(
            f"{header.path}: attribute third_bounce of data is {stored!r}, need the third bounce's index from 0 to "
            f"{header.sizes['bounce'] - 1}. Use --bounces all, or correct it."
        )
    return (header.third_index,)


def light_bands(
    capture: StoredCapture, laser: tuple[int, int], bounces: tuple[int, ...]
) -> Iterator[tuple[slice, Float32]]:
    """Yield (rows, (row, Nx, bin)): the light of one laser point, a few rows of sensor points at a time.

    Bounces are summed and colours averaged; of polarised light it is the intensity.

    Raises
    ------
    FileError
        The file is damaged, or holds a number that is not finite.
    """
    for rows, band in capture.bands(laser, bounces, BAND_BYTES):
        yield rows, finite(capture.path, intensity(capture.header, band).sum(axis=0))


def read_light(
    capture: StoredCapture, laser: tuple[int, int], rows: slice | None, columns: slice | None, bounces: tuple[int, ...]
) -> Float32:
    """Return (row, column, bin) of one laser point, bounces summed, colours averaged, of polarised light the intensity.

    Raises
    ------
    FileError
        The file is damaged, or holds a number that is not finite.
    """
    block = capture.read_block(lasers=laser, sensors=(rows, columns), bounces=bounces)
    return finite(capture.path, intensity(capture.header, block[:, :, 0, 0]).sum(axis=0))


def _device(position: Numbers | None, wall_from_file: Float64) -> Float64 | None:
    if position is None or len(position) != 3 or not np.isfinite(position).all():
        return None
    return moved(np.asarray(position), wall_from_file)


def _legs(capture: StoredCapture, points: Float64, device: Float64 | None, counted: bool, name: str) -> Float64:
    if not counted:
        return np.zeros(points.shape[:2])
    if device is None:
        raise FileError(f"{capture.path}: counts the legs to the wall but has no {name}, so they are unknown")
    return np.linalg.norm(points - device, axis=-1)


def wall_frame(header: StoredHeader) -> Float64:
    """Return the (4, 4) matrix from a file's positions to the wall's frame."""
    to_scene, wall_to_scene = _matrix(header, "file_to_scene"), _matrix(header, "relay_wall_to_scene")
    if to_scene is not None and wall_to_scene is not None:
        return np.linalg.inv(wall_to_scene) @ to_scene
    by_layout = np.eye(4)  # another writer's file: the layout puts the wall into y = 0
    by_layout[:3, :3] = ZNLOS_FROM_LOCAL.T
    return by_layout


def wall_pose(header: StoredHeader) -> Pose:
    """Return the pose of the wall's frame in the scene; where the file does not say, it is the scene's."""
    to_scene = _matrix(header, "relay_wall_to_scene")
    return Pose(np.eye(3), np.zeros(3)) if to_scene is None else Pose(to_scene[:3, :3], to_scene[:3, 3])


def _matrix(header: StoredHeader, name: str) -> Float64 | None:
    try:
        matrix = np.asarray(header.attributes.get(name), dtype=np.float64)
    except (TypeError, ValueError):
        return None
    usable = matrix.shape == (4, 4) and np.isfinite(matrix).all()
    return matrix if usable and abs(np.linalg.det(matrix[:3, :3])) > 1e-6 else None


def moved(points: Float64, matrix: Float64) -> Float64:
    """Return points (..., 3) in the frame that a (4, 4) matrix goes to."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def hidden_box(header: StoredHeader, wall_from_file: Float64) -> Bounds | None:
    """Return the box around the hidden geometry along the wall's axes; None where the file has none."""
    edges, center = header.hidden_volume_edges, header.hidden_volume_position
    if not edges or not max(edges) > 0 or center is None or len(center) != 3:
        return None
    angles = header.hidden_volume_rotation or (0.0, 0.0, 0.0)
    if len(edges) not in (1, 3) or len(angles) != 3 or not np.isfinite((*edges, *center, *angles)).all():
        return None
    half = np.broadcast_to(edges, 3) / 2
    corners = box_corners((-half, half)) @ euler_xyz(np.degrees(angles)).T + np.asarray(center)
    corners = moved(corners, wall_from_file)
    return corners.min(axis=0), corners.max(axis=0)
