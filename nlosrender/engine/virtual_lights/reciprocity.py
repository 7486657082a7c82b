"""Whether light takes as much energy from a laser point to a sensor point as the other way."""

from __future__ import annotations

import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.scene.build import BuiltScene

MOST_SUMS = 2**27  # of a capture that gains: a larger one is cut into batches with few of the other halves


def is_reciprocal(built: BuiltScene, capture: Capture, n_bins: int, *, is_lambertian: bool) -> bool:
    """Return whether H(l, s) = H(s, l) in an exhaustive capture that fits one batch, so that half of it says all.

    The grids have to be the same, and so have the legs; a Lambertian surface looks the same from both sides as long as
    its shading normals are its own: interpolated ones are used towards the lasers only.

    Parameters
    ----------
    built, capture
        The scene and its points.
    n_bins
        Of each of them.
    is_lambertian
        Whether wall and hidden surfaces are.
    """
    if capture.scan_type != "exhaustive" or not is_lambertian:
        return False
    # whatever the batches of this render: how a capture is cut must not show in it
    if capture.n_sensors * capture.n_lasers * n_bins > MOST_SUMS:
        return False
    if not np.array_equal(capture.laser_grid.positions, capture.sensor_grid.positions):
        return False
    if not np.array_equal(capture.laser_legs, capture.sensor_legs):
        return False
    shapes = built.hidden_shapes if built.wall.is_planar else built.scene.shapes()
    return not any(shape.is_mesh() and shape.has_vertex_normals() for shape in shapes)
