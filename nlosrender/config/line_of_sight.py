"""The rules between sections that tell line-of-sight captures from those of a relay wall."""

from __future__ import annotations

from collections.abc import Iterator

from nlosrender.config.capture import CaptureConfig
from nlosrender.config.mitsuba_xml import read_mitsuba_xml
from nlosrender.config.refusal import Fault, refusal
from nlosrender.config.render import RenderConfig
from nlosrender.config.scene import SceneConfig
from nlosrender.errors import KeyPath

_SCAN: KeyPath = ("capture", "scan_type")
_FEWEST_BOUNCES = 2  # of a relay wall: laser point and sensor point


def line_of_sight_faults(scene: SceneConfig, capture: CaptureConfig, render: RenderConfig) -> Iterator[Fault]:
    """Yield what a capture by a camera lacks, or has too much."""
    if capture.camera is None:
        needs: tuple[KeyPath, ...] = (_SCAN, ("capture", "camera"), ("scene", "mitsuba"))
        example = "such as {position: [0, 1, 4], look_at: [0, 1, 0], width: 64, height: 64}."
        if scene.mitsuba is None:
            yield Fault(("capture", "camera"), f"missing, a line_of_sight capture needs it, {example}", needs=needs)
        elif read_mitsuba_xml(scene.mitsuba)[1] is None:
            lacking = "has no perspective sensor with a whole film"
            message = f"missing, and {scene.mitsuba.name} {lacking}; need a camera, {example}"
            yield Fault(("capture", "camera"), message, needs=needs)
    if render.engine == "virtual_lights":
        message = "got virtual_lights, which need a relay wall; a line_of_sight capture needs auto or path."
        yield Fault(("render", "engine"), message, needs=(_SCAN, ("render", "engine")))
    if render.temporal_kernel_opl > 0:
        message = refusal(render.temporal_kernel_opl, "0: a line_of_sight capture has plain bins")
        yield Fault(("render", "temporal_kernel_opl"), message, needs=(_SCAN, ("render", "temporal_kernel_opl")))
    yield from _too_few_bounces(render, 0, "0 is the emitters alone, 1 what they light.")


def _polarized_faults(scene: SceneConfig, capture: CaptureConfig, render: RenderConfig) -> Iterator[Fault]:
    needs: tuple[KeyPath, ...] = (_SCAN, ("render", "polarized"))
    if render.engine == "virtual_lights":
        message = "got virtual_lights, which know no polarisation; with render.polarized need auto or path."
        yield Fault(("render", "engine"), message, needs=(*needs, ("render", "engine")))
    if scene.relay_wall is not None and scene.relay_wall.type != "rectangle":
        message = f"got true before a {scene.relay_wall.type} wall; polarised light needs a rectangle relay wall."
        yield Fault(("render", "polarized"), message, needs=(*needs, ("scene", "relay_wall")))
    if capture.laser_spot_radius > 0:
        message = "got true with a laser that has a spot; polarised light needs capture.laser_spot_radius: 0."
        yield Fault(("render", "polarized"), message, needs=(*needs, ("capture", "laser_spot_radius")))


def relay_wall_faults(scene: SceneConfig, capture: CaptureConfig, render: RenderConfig) -> Iterator[Fault]:
    """Yield what a capture of a relay wall lacks, or has too much."""
    if scene.relay_wall is None:
        message = "missing, it is required: the visible surface, told by its type; "
        message += "only scan_type: line_of_sight does without."
        yield Fault(("scene", "relay_wall"), message, needs=(_SCAN,))
    if scene.mitsuba is not None:
        message = "a whole Mitsuba scene is for scan_type: line_of_sight; here its shapes go into hidden_geometry, "
        message += "one by one, as {type: mitsuba, shape: {...}, bsdf: {...}} or {type: mesh, ...}."
        yield Fault(("scene", "mitsuba"), message, "key", (_SCAN, ("scene", "mitsuba")))
    if render.polarized:
        yield from _polarized_faults(scene, capture, render)
    yield from _too_few_bounces(render, _FEWEST_BOUNCES, "3 is the third bounce.")


def _too_few_bounces(render: RenderConfig, fewest: int, advice: str) -> Iterator[Fault]:
    if render.max_bounces is not None and render.max_bounces < fewest:
        message = refusal(render.max_bounces, f"an integer >= {fewest} or null for no limit", advice)
        yield Fault(("render", "max_bounces"), message, needs=(_SCAN, ("render", "max_bounces")))
