"""Processes that render one capture after another."""

from __future__ import annotations

import gc
import weakref
from typing import Any

import pytest
from support.rendering import flat_wall, render

from nlosrender.rendering import stages

PLATE = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0.1, 0, 0.9]}
SIDE = {"type": "rectangle", "width": 0.4, "height": 0.3, "center": [0.3, 0.3, 0.6], "normal": [-1, 0, 0.2]}
LIGHTS = {"engine": "virtual_lights", "spp": None, "target_error": 0.2}


@pytest.mark.parametrize("settings", [{"spp": 16}, LIGHTS], ids=["path", "virtual_lights"])
def test_a_scene_is_gone_when_its_render_ends(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """No reference cycle keeps it until the collector comes: kernels have the code of every living BSDF and shape, so
    that each capture of a sweep would be compiled anew, and would be larger than the one before."""
    load, scenes = stages.load_scene, []

    def noted(*arguments: Any) -> Any:
        built = load(*arguments)
        scenes.append(weakref.ref(built))
        return built

    monkeypatch.setattr(stages, "load_scene", noted)
    gc.disable()
    try:
        render(flat_wall(PLATE, SIDE, max_bounces=4, **settings))
        assert [scene() for scene in scenes] == [None]
    finally:
        gc.enable()
