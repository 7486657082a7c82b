"""Helmholtz reciprocity: whether H(l, s) = H(s, l), so that half of an exhaustive capture is enough to compute."""

from __future__ import annotations

import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING, VirtualLightTuning
from nlosrender.scene.build import BuiltScene


def is_reciprocal(
    built: BuiltScene,
    capture: Capture,
    n_bins: int,
    *,
    is_lambertian: bool,
    tuning: VirtualLightTuning = DEFAULT_TUNING,
) -> bool:
    """Return whether an exhaustive capture that fits one batch is the same with laser and sensor points exchanged.

    The grids have to be the same, and so have the legs. Lambertian surfaces (``is_lambertian``: wall and hidden ones)
    are reciprocal unless their shading normals are interpolated: those are used towards the lasers only.
    """
    if capture.scan_type != "exhaustive" or not is_lambertian:
        return False
    # of the capture, not of the batches it is cut into: these must not change results
    if capture.n_sensors * capture.n_lasers * n_bins > tuning.max_reciprocal_sums:
        return False
    if not np.array_equal(capture.laser_grid.lattice.positions, capture.sensor_grid.lattice.positions):
        return False
    if not np.array_equal(capture.laser_legs.ravel(), capture.sensor_legs.ravel()):
        return False
    shapes = built.hidden_shapes if built.wall.is_planar else built.scene.shapes()
    return not any(shape.is_mesh() and shape.has_vertex_normals() for shape in shapes)
