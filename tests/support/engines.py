"""Engines made anew with other options, and budgets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any


def with_options(engine: Any, **options: Any) -> Any:
    """Return an engine of the same kind for the same capture, with fields of its ``RenderOptions`` changed."""
    from nlosrender.engine.launch.device_capture import DeviceCapture

    changed = replace(engine.options, **options)
    parts = engine.built, engine.capture, engine.time_axis, changed
    if engine.name == "line_of_sight":
        return type(engine)(*parts)
    device = DeviceCapture(*parts)
    if engine.name == "path":
        return type(engine)(device)
    return type(engine)(device, type(engine.paths)(device, first_bounce=4), engine.third.lanes)


def in_bins(budget: Any) -> Any:
    """Return a budget that adds light above the third bounce in bins, not in longer time steps."""
    return replace(
        budget, bins_per_step=None, steps_variance=None, bins_per_step_of_paths=None, steps_variance_of_paths=None
    )
