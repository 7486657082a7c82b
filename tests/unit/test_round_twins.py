"""Balls and tubes in one place: what rays cannot tell apart is said before a render."""

from __future__ import annotations

import pytest
from rendering import configured, flat_wall

from nlosrender.config.warnings import config_warnings

BALL = {"type": "sphere", "center": [0.1, 0.0, 0.8], "radius": 0.15}
TUBE = {"type": "cylinder", "center": [0.0, 0.0, 0.7], "axis": [0.3, 1.0, 0.0], "radius": 0.15, "height": 0.6}


def said(*items):
    """Warnings about surfaces in one place."""
    return [text for text in config_warnings(configured(flat_wall(*items))) if "apart" in text]


@pytest.mark.parametrize("item", [BALL, TUBE], ids=["ball", "tube"])
@pytest.mark.parametrize("gap", [0.0, 1e-6, 1.5e-5])
def test_a_shell_as_near_as_rays_do_not_tell_is_a_warning(item, gap):
    """The wall is 2 m wide: 3e-5 of that is 60 um."""
    (text,) = said(item, item | {"radius": 0.15 + gap})
    assert "scene.hidden_geometry.0" in text
    assert "scene.hidden_geometry.1" in text


@pytest.mark.parametrize(
    "items",
    [
        (BALL, BALL | {"radius": 0.1501}),
        (BALL, BALL | {"center": [0.1, 0.001, 0.8]}),
        (BALL, BALL | {"inside": True}),
        (TUBE, TUBE | {"radius": 0.1501}),
        (TUBE, TUBE | {"axis": [0.31, 1.0, 0.0]}),
        (TUBE, TUBE | {"center": [0.3, 1.0, 0.7]}),
        (BALL, TUBE),
    ],
)
def test_round_surfaces_that_rays_tell_apart_are_none(items):
    """Farther apart, beside each other along an axis, or seen from opposite sides."""
    assert said(*items) == []
