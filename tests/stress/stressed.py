"""Scenes of the stress suite, and what is compared of their renders."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.rendering import Rendering, flat_wall, render

Array = NDArray[np.float64]

# What both engines are asked for. The gather is deterministic, the paths repeat with their seed.
ENGINES: dict[str, dict[str, Any]] = {
    "path": {"engine": "path", "spp": 512},
    "virtual_lights": {"engine": "virtual_lights", "spp": None, "target_error": 0.01},
}
# Of most laws the default run looks at one engine: both take a minute.
BOTH = ["path", pytest.param("virtual_lights", marks=pytest.mark.stress)]
PLATE: dict[str, Any] = {
    "type": "rectangle",
    "width": 0.75,
    "height": 0.5,
    "center": [0.25, -0.125, 0.625],
    "normal": [0.2, -0.1, -1.0],
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
WITH_LEGS = {"account_first_and_last_bounces": True, "laser_position": [0.5, 0, 1], "sensor_position": [-0.5, 0.25, 1]}


def scene(*hidden: dict[str, Any], engine: str = "path", **changes: Any) -> dict[str, Any]:
    """Return the configuration of hidden items (default: the plate) for one engine; ``changes`` as ``flat_wall``'s."""
    settings = {"bins": (0.0, 0.03125, 160), **ENGINES[engine], **changes}
    return flat_wall(*(hidden or (PLATE,)), **settings)


def placed(config: dict[str, Any], factor: float = 1.0, turn: Array | None = None, origin: Any = (0, 0, 0)) -> dict:
    """Return a configuration of rectangles with every length times ``factor``, turned about 0, and moved [m]."""
    config = copy.deepcopy(config)
    turn = np.eye(3) if turn is None else turn
    wall, capture = config["scene"]["relay_wall"], config["capture"]

    def point(xyz: Any) -> list[float]:
        return (np.asarray(origin) + turn @ (factor * np.asarray(xyz, dtype=np.float64))).tolist()

    for item in (wall, *config["scene"]["hidden_geometry"]):
        item |= {key: item[key] * factor for key in ("width", "height")}
        item["center"] = point(item.get("center", [0, 0, 0]))
        item["normal"] = (turn @ item.get("normal", [0, 0, 1] if item is wall else [0, 0, -1])).tolist()
        item["up"] = (turn @ item.get("up", [0, 1, 0])).tolist()
    for key in ("laser_position", "sensor_position"):
        if key in capture:
            capture[key] = point(capture[key])
    if "laser_point" in capture:
        capture["laser_point"] = [factor * x for x in capture["laser_point"]]
    for key in ("start_opl", "bin_width_opl"):
        config["time_axis"][key] *= factor
    return config


def rendered(*hidden: dict[str, Any], engine: str = "path", **changes: Any) -> Rendering:
    """Render ``scene`` into memory; nothing in it may be less than finite, or negative."""
    result = render(scene(*hidden, engine=engine, **changes))
    for values in (result.mean, result.variance, result.outside):
        assert np.isfinite(values).all()
        assert (values >= 0).all()
    return result


def relative_difference(a: Array, b: Array) -> float:
    """Return the relative L2 difference of two histograms; 0 for two empty ones."""
    difference, size = float(np.linalg.norm(a - b)), float(np.linalg.norm(b))
    return difference / size if size else difference


def noise_of(a: Rendering, b: Rendering) -> float:
    """Return the relative L2 difference that two renders may have by their errors: twice that to be expected."""
    return 2 * float(np.hypot(a.error_estimate, b.error_estimate)) + 1e-6
