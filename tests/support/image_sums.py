"""Image method for flat mirrors: the third bounce in float64 numpy, independent of the engines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis

Array = NDArray[np.float64]


def image_sum(mirrors: Array, screens: Array, capture: Capture, time_axis: TimeAxis) -> Array:
    """Return H (laser, sensor, bin) of mirrors that reflect everything on either side, before a wall of albedo 1.

    Parameters
    ----------
    mirrors, screens
        (n, 3, 3) corners of triangles, which reflect or stop light [m, local frame]; each side of a mirror stops it.
    capture, time_axis
        Points, legs and bins; a confocal capture has one laser per sensor point: (1, sensor, bin).
    """
    grids = capture.laser_grid, capture.sensor_grid
    (lasers, laser_normals), (sensors, sensor_normals) = (
        (grid.positions.reshape(-1, 3), grid.normals.reshape(-1, 3)) for grid in grids
    )
    n_lasers, n_sensors, is_confocal = len(lasers), len(sensors), capture.scan_type == "confocal"
    s = np.tile(np.arange(n_sensors), 1 if is_confocal else n_lasers)
    laser = s if is_confocal else np.repeat(np.arange(n_lasers), n_sensors)
    found = [_reflections(corners, lasers[laser], sensors[s]) for corners in mirrors]
    pair, points, distance = (np.concatenate(values) for values in zip(*found, strict=True))
    row, s, laser = (0 * pair if is_confocal else laser[pair]), s[pair], laser[pair]
    value, everything = 1 / (np.pi * distance) ** 2, np.concatenate([mirrors, screens])
    for start, normal in ((sensors[s], sensor_normals[s]), (lasers[laser], laser_normals[laser])):
        way = points - start
        cosine = np.einsum("nx,nx->n", normal, way) / np.linalg.norm(way, axis=1)
        value *= np.maximum(cosine, 0) * ~_is_stopped(everything, start, way)
    opl = distance + capture.laser_legs.reshape(-1)[laser] + capture.sensor_legs.reshape(-1)[s] - time_axis.start_opl
    place = np.floor(opl / time_axis.bin_width_opl).astype(int)
    inside = (place >= 0) & (place < time_axis.n_bins)
    light = np.zeros((1 if is_confocal else n_lasers, n_sensors, time_axis.n_bins))
    np.add.at(light, (row[inside], s[inside], place[inside]), value[inside])
    return light


def _reflections(corners: Array, lasers: Array, sensors: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Return which pairs of points are reflected by a triangle, the points of reflection, lengths of the ways."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    height, above = ((points - corners[0]) @ normal for points in (sensors, lasers))
    to_image = lasers - 2 * above[:, None] * normal - sensors
    points = sensors + to_image * (height / (height + above))[:, None]
    inside = height * above > 0
    for one, other in ((0, 1), (1, 2), (2, 0)):
        inside &= np.cross(corners[other] - corners[one], points - corners[one]) @ normal > 0
    (found,) = np.nonzero(inside)
    return found, points[found], np.linalg.norm(to_image[found], axis=1)


def _is_stopped(triangles: Array, start: Array, way: Array) -> NDArray[np.bool_]:
    """Return whether a triangle lies between the ends of segments (n, 3); one at the end itself does not."""
    stopped = np.zeros(len(start), bool)
    for a, b, c in triangles:
        across = np.cross(way, c - a)
        determinant = across @ (b - a)
        with np.errstate(all="ignore"):
            u = np.einsum("nx,nx->n", start - a, across) / determinant
            other = np.cross(start - a, b - a)
            v, t = np.einsum("nx,nx->n", way, other) / determinant, other @ (c - a) / determinant
            stopped |= (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1 - 1e-9)
    return stopped
