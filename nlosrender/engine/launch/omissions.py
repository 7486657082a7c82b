"""Reports of work that several engines omit: shadow rays, triangles, paths past the time gate."""

from __future__ import annotations

from collections.abc import Iterator

from nlosrender.engine.interface import OmittedWork
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.scene.build import count_triangles


def omitted_visibility() -> OmittedWork:
    """Return the report that no shadow ray is traced."""
    return OmittedWork("shadow rays", "one convex object stands alone before a planar wall: nothing lies between")


def omitted_triangles(device: DeviceCapture) -> Iterator[OmittedWork]:
    """Yield the number of triangles that are not sampled, if any."""
    total = count_triangles(device.built.sampled_shapes)  # others are not sampled because points lie on them
    if dark := total - device.sampler.n_triangles:
        why = "they face away from the whole wall or lie behind it: no ray is sent to them"
        yield OmittedWork(f"{dark} of {total} triangles", why)


def omitted_by_time_gate(device: DeviceCapture) -> Iterator[OmittedWork]:
    """Yield the report of the time gate's roulette, where light can arrive after the window."""
    if device.capture_gate is not None:
        many = round(1 / device.options.gate_survival)
        why = f"one in {many} goes on, with {many} times the weight: the light outside the window is not biased"
        yield OmittedWork("most paths on which light can only arrive after the time window", why)
