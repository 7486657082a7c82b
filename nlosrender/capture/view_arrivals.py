"""When light can reach a camera: bounds on the optical path length from the box around the scene."""

from __future__ import annotations

import numpy as np

from nlosrender.capture.grids import Capture
from nlosrender.scene.hidden_geometry import Bounds, box_corners

MARGIN_INTERACTIONS = 4  # that "n_bins: auto" makes room for: each adds at most the scene's diameter


def earliest_view(capture: Capture, bounds: Bounds | None) -> float:
    """Return a lower bound on the optical path length of any light [m]; inf for an empty scene."""
    if bounds is None:
        return float("inf")
    if not capture.account_first_and_last_bounces:
        return 0.0
    camera = capture.sensor_position
    return float(np.linalg.norm(np.maximum(np.maximum(bounds[0] - camera, camera - bounds[1]), 0)))


def latest_view(capture: Capture, bounds: Bounds | None, interactions: int | None) -> float:
    """Return a bound on the optical path length after so many surface interactions, in vacuum [m].

    The leg to the camera is at most as long as the way to the farthest corner of the box around the scene, every
    other leg as its diagonal. Glass makes light later by its refractive index. For None: four interactions.
    """
    if bounds is None:
        return 0.0
    count = MARGIN_INTERACTIONS if interactions is None else interactions
    last = float(np.linalg.norm(box_corners(bounds) - capture.sensor_position, axis=-1).max())
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0]))
    return (last if capture.account_first_and_last_bounces else 0.0) + count * diagonal
