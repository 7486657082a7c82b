"""Scenes of mitransient with a perspective sensor: line of sight, or the points that its pixels see of a hidden scene.

Shapes and camera stay in the XML: scene.mitsuba reads them. Sources: sample_rays of mitsuba.ad.integrators.common, and
prepare and emitter_laser_sample of mitransient's transientnlospath.
"""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from nlosrender.config.mitsuba_xml import DEFAULT_FILM
from nlosrender.config.xml_shapes import placement
from nlosrender.files.importing.light_transport import (
    drop_noise,
    refuse_film,
    say_samples,
    translate_bounces,
    translate_film,
)
from nlosrender.files.importing.scan_geometry import matrix_of
from nlosrender.files.importing.translation import MAX_POINTS, Keys, Translation, plain, rounded
from nlosrender.files.importing.xml_plugins import found_keys, place_in
from nlosrender.scene.pose import Float64

_SCANS = {1: "single", 2: "confocal", 3: "exhaustive"}
FAN = (
    *("integrator.force_equal_illumination_scanning", "integrator.illumination_scan_fov"),
    *("film.laser_scan_width", "film.laser_scan_height"),
)
OF_PROJECTORS = {
    "emitter.fov": "the laser is a point here, as it is there with nlos_laser_sampling",
    **dict.fromkeys(
        ("emitter.irradiance", "emitter.scale"), "capture.laser_energy is 1 J: one factor on H, for each laser point"
    ),
}
_LENGTHS = tuple(
    f"sensor.{name}"
    for name in ("fov", "near_clip", "far_clip", "principal_point_offset_x", "principal_point_offset_y")
)
_OF_CAMERAS = ("sensor.type", "sensor.to_world", "sensor.fov_axis", "sensor.focal_length")
_OF_SCANS = ("film.exhaustive_scan", "film.laser_scan_width", "film.laser_scan_height")
_PIXELS = "a pixel's light is the mean over its area there, and so is it here (capture.footprint: {pixel: true})"
_CORNERS = (
    f"{_PIXELS}; the laser lights the upper left corners of the pixels there, and so does it here "
    "(capture.pixel_point: [0, 1]), which the file's positions are, too"
)


def translate_view(translation: Translation, keys: Keys) -> None:
    """Judge a line-of-sight scene, which stays a Mitsuba scene: scene.mitsuba reads shapes, emitters and camera."""
    path = translation.source
    keys.keep("integrator.type", "capture.scan_type: line_of_sight")
    translation.put("scene.mitsuba", translation.file_name(path.resolve(), is_absolute=False), translation.start)
    translation.put("capture.scan_type", "line_of_sight", translation.start)
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
    translation.put("scene.mitsuba", translation.file_name(path.resolve(), is_absolute=False), translation.start)
    scan = scan_type(keys)
    keys.take("integrator.capture_type", "capture.scan_type", scan)
    is_aimed = _aim(keys, scan, matrix_of(placement(emitters[0]))) if emitters else True
    if laser is not None:
        translation.refuse("--laser", "", list(laser), "is a point of a relay wall; set capture.laser_target instead")
    keys.drop_all(OF_PROJECTORS)
    translation.put("capture.footprint", {"pixel": True}, translation.start)
    if not is_aimed:
        translation.put("capture.pixel_point", [0.0, 1.0], translation.start)
    translation.note(_PIXELS if is_aimed else _CORNERS)
    translate_bounces(keys, of_ytal=False)
    _translate_picture(keys)
    translation.note(f"shapes and camera: read by scene.mitsuba, {path.name}, every time the capture is rendered")


def _aim(keys: Keys, scan: str, to_world: Float64) -> bool:
    """Judge where the projector stands and looks; return whether its points are other ones than the pixels'."""
    translation, equal = keys.translation, FAN[0]
    position = rounded(to_world[:3, 3])
    place = keys.place("emitter.to_world" if "emitter.to_world" in keys else "emitter.type")
    translation.put("capture.laser_position", position, place)
    sides = FAN[2:]
    is_fan = scan == "exhaustive" and not keys.value(equal, True, bool)
    aim = ""
    if scan == "single":
        target = rounded(to_world[:3, 3] + to_world[:3, 2])
        translation.put("capture.laser_target", target, place)
        aim = f", capture.laser_target: {plain(target)}, on its axis"
    elif is_fan:
        targets = rounded(to_world[:3, 3] + fan_of_rays(keys) @ to_world[:3, :3].T)
        translation.put("capture.laser_targets", targets, keys.place(equal))
        say_fan(keys, "capture.laser_targets", len(targets))
    elif scan == "exhaustive":
        for name, pixels, size in zip(sides, ("film.width", "film.height"), DEFAULT_FILM, strict=True):
            count = keys.value(pixels, size, int)
            if keys.value(name, count, int) != count:
                keys.refuse(name, f"need {pixels} ({count}): laser points are the pixels' points")
    keys.drop_all(dict.fromkeys((equal, *sides), "laser points are the pixels' points"))
    keys.drop(FAN[1], "of a fan of rays that is not used")
    keys.keep("emitter.to_world", f"capture.laser_position: {plain(position)}{aim}")
    return scan == "single" or is_fan


def fan_of_rays(keys: Keys) -> Float64:
    """Return the directions (n, 3) of a fan in the projector's frame, row by row from its upper left, at i / N."""
    columns, rows = (keys.value(name, 0, int) for name in FAN[2:])
    if min(columns, rows) < 1 or columns * rows > MAX_POINTS:
        keys.refuse(FAN[2], f"a fan of {columns} x {rows} rays, need 1 to {MAX_POINTS} (and film.laser_scan_height)")
        columns = rows = 1
    opening = math.tan(math.radians(keys.value(FAN[1], 20.0, float)) / 2)
    u, v = np.meshgrid(np.arange(columns) / max(columns, 1), np.arange(rows) / max(rows, 1))
    return np.stack([(1 - 2 * u) * opening, (1 - 2 * v) * opening, np.ones_like(u)], axis=-1).reshape(-1, 3)


def say_fan(keys: Keys, to: str, count: int) -> None:
    """Report on the keys of a fan, which became ``count`` places."""
    for name in FAN:
        keys.change(name, f"{to}: {count} rays of a fan, row by row from its upper left")


def _translate_picture(keys: Keys) -> None:
    """Judge film, sampler and camera, which scene.mitsuba reads."""
    refuse_film(keys)
    translate_film(keys, 2048)
    say_samples(keys, "sampler.sample_count")
    read = f"read by scene.mitsuba, {keys.translation.source.name}"
    for names, kind in ((_LENGTHS, float), (("film.width", "film.height"), int)):
        for name in names:
            keys.value(name, None, kind)
            keys.keep(name, read)
    for name in _OF_CAMERAS:
        keys.keep(name, read)
    keys.drop_all(dict.fromkeys(_OF_SCANS, "of exhaustive scans"))
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
