"""Scenes of mitransient with a perspective sensor: line of sight, or the points that its pixels see of a hidden scene.

Shapes and camera stay in the XML: scene.mitsuba reads them. Sources: sample_rays of mitsuba.ad.integrators.common, and
prepare and emitter_laser_sample of mitransient's transientnlospath.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element

from nlosrender.config.xml_shapes import placement
from nlosrender.files.importing.light_transport import (
    drop_noise,
    refuse_film,
    say_samples,
    translate_bounces,
    translate_film,
)
from nlosrender.files.importing.scan_geometry import matrix_of
from nlosrender.files.importing.translation import Keys, Translation, plain, rounded
from nlosrender.files.importing.xml_plugins import found_keys, place_in

_SCANS = {1: "single", 2: "confocal", 3: "exhaustive"}
OF_PROJECTORS = {
    "emitter.fov": "the laser is a point here, as it is there with nlos_laser_sampling",
    **dict.fromkeys(
        ("emitter.irradiance", "emitter.scale"), "capture.laser_energy is 1 J: one factor on H, for each laser point"
    ),
}
_PIXELS = (
    "a pixel's light is the mean over its area there, and its centre's here: a camera with more pixels, summed in "
    "blocks, comes as near as wanted"
)
_CORNERS = (
    "the laser lights the upper left corners of the pixels there, and so does it here (capture.pixel_point: [0, 1]), "
    "with the sensor point in the same place; there a pixel's light is the mean over its area"
)
_FAN = (
    "the points are where a fan of rays meets the scene; say them as capture.laser_targets, or make it true: then they "
    "are the pixels' points"
)


def translate_view(translation: Translation, keys: Keys) -> None:
    """Judge a line-of-sight scene, which stays a Mitsuba scene: scene.mitsuba reads shapes, emitters and camera."""
    path = translation.source
    keys.keep("integrator.type", "capture.scan_type: line_of_sight")
    translation.put("scene.mitsuba", translation.file_name(path.resolve(), is_absolute=False), str(path))
    translation.put("capture.scan_type", "line_of_sight", str(path))
    unwarped = keys.value("integrator.camera_unwarp", False, bool)
    keys.take("integrator.camera_unwarp", "capture.account_first_and_last_bounces", not unwarped, changed=True)
    depth = keys.value("integrator.max_depth", 6, int)
    bounces = None if depth == -1 else depth - 1
    keys.take("integrator.max_depth", "render.max_bounces", bounces, "0 is what emitters show of themselves")
    keys.drop("integrator.discard_direct_light", "bounces have indices of their own in the file")
    drop_noise(keys)
    _translate_picture(keys)
    translation.note(f"shapes and emitters: read by scene.mitsuba, {path.name}, every time the capture is rendered")


def translate_pixels(
    translation: Translation, root: Element, parts: list[Element], laser: tuple[float, float] | None
) -> None:
    """Judge a hidden scene before a camera: the points are what its pixels see first.

    Parameters
    ----------
    translation, root
        Of the XML file; its elements.
    parts
        Integrator and sensor.
    laser
        Of --laser, which is for relay walls: refused.
    """
    path, emitters = translation.source, list(root.iter("emitter"))
    keys = Keys(translation, dict(found_keys(path, [*parts, *(emitters if len(emitters) == 1 else [])])))
    refuse_other_emitters(keys, emitters, root)
    keys.keep("integrator.type", "a scan whose points a camera sees")
    keys.keep("emitter.type", "the laser")
    translation.put("scene.mitsuba", translation.file_name(path.resolve(), is_absolute=False), str(path))
    scan = scan_type(keys)
    keys.take("integrator.capture_type", "capture.scan_type", scan)
    if scan == "exhaustive" and not keys.value("integrator.force_equal_illumination_scanning", True, bool):
        keys.refuse("integrator.force_equal_illumination_scanning", _FAN)
    keys.drop("integrator.force_equal_illumination_scanning", "laser points are the pixels' points")
    keys.drop("integrator.illumination_scan_fov", "of a fan of rays that is not used")
    matrix = matrix_of(placement(emitters[0])) if emitters else None
    if matrix is not None:
        position, target = rounded(matrix[:3, 3]), rounded(matrix[:3, 3] + matrix[:3, 2])
        place = keys.place("emitter.to_world" if "emitter.to_world" in keys else "emitter.type")
        translation.put("capture.laser_position", position, place)
        aim = ""
        if scan == "single":
            translation.put("capture.laser_target", target, place)
            aim = f", capture.laser_target: {plain(target)}, on its axis"
        keys.keep("emitter.to_world", f"capture.laser_position: {plain(position)}{aim}")
    if laser is not None:
        translation.refuse("--laser", "", list(laser), "is a point of a relay wall; set capture.laser_target instead")
    keys.drop_all(OF_PROJECTORS)
    if scan != "single":
        translation.put("capture.pixel_point", [0.0, 1.0], str(path))
    translation.note(_PIXELS if scan == "single" else _CORNERS)
    translate_bounces(keys, of_ytal=False)
    _translate_picture(keys)
    translation.note(f"shapes and camera: read by scene.mitsuba, {path.name}, every time the capture is rendered")


def _translate_picture(keys: Keys) -> None:
    """Judge film, sampler and camera, which scene.mitsuba reads."""
    refuse_film(keys)
    translate_film(keys, 2048)
    say_samples(keys, "sampler.sample_count")
    for name in [name for name in keys.found if name.startswith(("sensor.", "film."))]:
        keys.keep(name, f"read by scene.mitsuba, {keys.translation.source.name}")
    keys.finish()


def scan_type(keys: Keys) -> str:
    """Return the kind of scan that an NLOS integrator asks for; refuse others."""
    kind = keys.value("integrator.capture_type", 1)
    scan = _SCANS.get(kind) if isinstance(kind, int) else str(kind).lower()
    if scan not in _SCANS.values():
        keys.refuse("integrator.capture_type", f"need one of {', '.join(_SCANS.values())} or 1, 2, 3")
    return str(scan)


def refuse_other_emitters(keys: Keys, emitters: list[Element], scene: Element) -> None:
    """Refuse all but one projector of one colour."""
    path = keys.translation.source
    if [emitter.get("type") for emitter in emitters] != ["projector"]:
        for emitter in emitters[-1:] or [scene]:
            why = f"an NLOS scene is lit by one <emitter type='projector'>; it has {len(emitters)} emitters"
            keys.translation.refuse(place_in(path, emitter), "emitter", emitter.get("type"), why)
    if any(emitter.find("texture") is not None for emitter in emitters):
        keys.refuse("emitter.irradiance", "a projected picture lights many points, need an <rgb>")
