"""Two-sided Lambertian surfaces: each side is a one-sided surface, in the third bounce of the virtual lights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import relative_l2
from support.rendering import flat_wall
from support.varied_scenes import Stage

pytestmark = pytest.mark.usefixtures("backend")

ONE = {"type": "diffuse", "reflectance": [0.2, 0.5, 0.8]}
BOTH = {"type": "twosided", "nested": ONE}
# across the wall: laser and sensor points lie on either side of its plane
ACROSS = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.2, 0, 0.8], "normal": [1, 0.1, 0.2]}
BEHIND = ACROSS | {"center": [0, 0.1, 1.2], "normal": [0.1, 0, 1]}


def light_of(plate: dict[str, Any], scan: str) -> NDArray[np.float64]:
    """Return the third bounce of one plate, summed over time."""
    config = flat_wall(plate, scan=scan, sensors=(9, 7), lasers=(3, 2), bins=(0, 0.03, 300), spp=None)
    config["render"] |= {"engine": "virtual_lights"}
    stage = Stage.of(config)
    assert stage.engine.settings.is_diffuse
    return np.asarray(stage.engine.third.gather(stage.batch, 0.2).values.sum(axis=-1))


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("plate", [ACROSS, BEHIND], ids=["across", "behind"])
def test_both_sides_are_one_sided_surfaces(plate: dict[str, Any], scan: str) -> None:
    """Their light adds up: what reaches one side leaves it on that side."""
    back = plate | {"normal": [-x for x in plate["normal"]]}
    both, one, other = (
        light_of(side | {"bsdf": bsdf}, scan) for side, bsdf in ((plate, BOTH), (plate, ONE), (back, ONE))
    )
    assert both.sum() > 0
    assert relative_l2(one + other - both, both) < 3e-3  # a turned plate is cut along its other diagonals
