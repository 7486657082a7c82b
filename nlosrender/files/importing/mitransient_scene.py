"""A scene of mitransient in Mitsuba's XML -> a configuration.

Elements are read, included and checked by the same code as a ``scene.mitsuba`` (config/mitsuba_xml.py); integrator,
film, sensor and laser, which that leaves out, are judged here key by key.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from nlosrender.config.mitsuba_xml import DEFAULT_FILM, read_mitsuba_xml
from nlosrender.config.xml_expansion import Expansion
from nlosrender.config.xml_shapes import placement, shape_parameters
from nlosrender.errors import did_you_mean
from nlosrender.files.importing.camera_scenes import (
    FAN,
    OF_PROJECTORS,
    fan_of_rays,
    refuse_other_emitters,
    say_fan,
    scan_type,
    translate_pixels,
    translate_view,
)
from nlosrender.files.importing.light_transport import refuse_film, say_samples, translate_bounces, translate_film
from nlosrender.files.importing.scan_geometry import FlatWall, matrix_of, to_world_of
from nlosrender.files.importing.translation import Keys, Translation, plain, rounded
from nlosrender.files.importing.xml_plugins import DEFAULT_DIFFUSE, found_keys, mistakes, place_in, plugin_of
from nlosrender.scene.pose import Float64

NLOS = "transient_nlos_path"
_CAMERAS = ("transient_path", "transient_prbvolpath")
_METER = "nlos_capture_meter"
_PLACED = re.compile(r"(?:(?P<file>[^\n]*?), )?line (?P<line>\d+): (?P<message>.*)", re.DOTALL)
_SAY_LASER = "say it with --laser X,Y (m on the wall, from its centre), as programs that aim the laser do in code"


def translate_xml(translation: Translation, laser: tuple[float, float] | None) -> None:
    """Judge every key of a scene, and set those of the configuration.

    Parameters
    ----------
    translation
        Of the XML file; changed in place.
    laser
        Where the laser hits, wall coordinates (x, y) [m], instead of where the file's looks; None: as the file says.
    """
    path = translation.source
    try:
        root = Expansion(path).read()
    except ValueError as error:
        _refuse_error(translation, error)
        return
    for item in root.iter("boolean"):
        item.set("value", item.get("value", "").lower())
    integrators, sensors = root.findall("integrator"), list(root.iter("sensor"))
    integrator = _only(translation, integrators, "integrator", (NLOS, *_CAMERAS))
    kept = [sensor for sensor in sensors if sensor.get("type") == _METER] or sensors
    sensor = _only(translation, kept, "sensor", (_METER, "perspective"))
    for other in sensors if len(kept) == 1 else ():
        if other is not kept[0]:
            translation.line(place_in(path, other), "sensor", other.get("type"), "dropped", "another camera")
    try:
        checked, _ = read_mitsuba_xml(path)
    except ValueError as error:
        _refuse_error(translation, error)
        checked = None
    if integrator is None or sensor is None:
        return
    parts = (part for part in root if part.tag != "sensor" or part is sensor)  # other cameras are not read
    for element, why in mistakes(element for part in parts for element in part.iter()):
        translation.refuse(place_in(path, element), element.get("name") or element.tag, "", why)
    if sensor.get("type") == "perspective" and integrator.get("type") == NLOS:
        translate_pixels(translation, root, [integrator, sensor], laser)
    elif sensor.get("type") == "perspective":
        translate_view(translation, Keys(translation, dict(found_keys(path, [integrator, sensor]))))
    elif integrator.get("type") != NLOS:
        translation.refuse(place_in(path, sensor), "sensor", _METER, f"needs the integrator {NLOS}")
    elif checked is not None:
        _NlosScene(translation, root, checked, [integrator, sensor]).translate(laser)


class _NlosScene:
    """One scene with a relay wall: elements as they are written, and those that are checked, with absolute names."""

    def __init__(self, translation: Translation, root: Element, checked: Element, parts: list[Element]):
        self.translation, self.path, self.checked = translation, translation.source, checked
        self.emitters = list(root.iter("emitter"))
        self.pixels: dict[str, int] = {}  # by the axes of the sensor grid
        one = self.emitters[:1] if len(self.emitters) == 1 else []
        self.keys = Keys(translation, dict(found_keys(self.path, [*parts, *one])))
        self.with_id = {part.get("id", ""): part for part in checked.iter() if part.tag in ("bsdf", "texture")}
        # nothing is taken out of shapes that are checked, so that both trees have them in the same order
        pairs = list(zip(root.iter("shape"), checked.iter("shape"), strict=True))
        self.wall = next((shape for written, shape in pairs if parts[1] in list(written)), None)
        self.hidden = [shape for _, shape in pairs if shape is not self.wall]
        self.wall_place = place_in(self.path, parts[1] if self.wall is None else self.wall)
        absolute = (item.get("value", "") for item in root.iter("string") if item.get("name") == "filename")
        self.absolute = {str(Path(name).resolve()) for name in absolute if Path(name).is_absolute()}

    def translate(self, laser: tuple[float, float] | None) -> None:
        """Judge everything."""
        keys, wall = self.keys, self._relay_wall()
        for part, what in (("integrator", "scene of a relay wall"), ("sensor", "relay_wall"), ("emitter", "the laser")):
            keys.keep(f"{part}.type", what)
        for shape in self.hidden:
            self._hidden_item(place_in(self.path, shape), shape)
        scan = self._scan()
        self._laser(wall, scan, laser)
        translate_bounces(keys, of_ytal=False)
        refuse_film(keys)
        translate_film(keys, 2048)
        say_samples(keys, "sampler.sample_count")
        origin = keys.value("sensor.sensor_origin", [0.0, 0.0, 0.0])
        keys.take("sensor.sensor_origin", "capture.sensor_position", origin)
        for unread in ("sensor.laser_origin", "sensor.laser_lookat_pixel"):
            keys.drop(unread, "of older versions: the projector's to_world decides")
        keys.finish()

    def _relay_wall(self) -> FlatWall | None:
        translation, where, shape = self.translation, self.wall_place, self.wall
        kind = "" if shape is None else shape.get("type", "")
        if shape is None or kind != "rectangle":
            why = "points lie at (u, v) of its shape, which are a regular grid here on a rectangle alone"
            translation.refuse(where, "sensor", _METER, f"is in {f'a {kind}' if kind else 'no shape'}; {why}")
            return None
        item = self._item(where, shape, "relay_wall")
        transform = placement(shape)
        try:
            wall = FlatWall.of(matrix_of(transform), flip_normals=item.pop("flip_normals", False))
        except ValueError as error:
            translation.refuse(where, "relay_wall.to_world", plain(to_world_of(transform)), str(error))
            return None
        wall.put(translation, where)
        bsdf = item["bsdf"]
        if bsdf["type"] == "twosided":  # the side that is lit decides, and both engines take it without the wrapper
            bsdf = next(part for part in bsdf.values() if isinstance(part, dict))
        translation.put("scene.relay_wall.bsdf", bsdf, where)
        return wall

    def _hidden_item(self, place: str, shape: Element) -> None:
        name = shape.get("id") or shape.get("name") or ""
        item = self._item(place, shape, name or shape.get("type", ""))
        bsdf = item.pop("bsdf")
        plugin = {"type": shape.get("type"), **item, "to_world": to_world_of(placement(shape))}
        self.translation.add_item(name, plugin, bsdf, place)

    def _item(self, place: str, shape: Element, name: str) -> dict[str, Any]:
        """Report on a shape, and return its parameters and its BSDF."""
        parameters = {key: value for key, value in shape_parameters(shape).items() if key != "type"}
        if "filename" in parameters:
            parameters["filename"] = self._file(parameters["filename"])
        bsdf = None
        for child in shape:
            key, at = child.get("name") or child.tag, place_in(self.path, child)
            if child.tag in ("bsdf", "ref"):
                bsdf = plugin_of(child, self.with_id, self._file)
                self.translation.line(at, f"{name}.bsdf", plain(bsdf), "taken", "bsdf")
            elif child.tag == "transform":
                self.translation.line(at, f"{name}.to_world", to_world_of(placement(shape)), "taken", "its place")
            elif key in parameters:
                self.translation.line(at, f"{name}.{key}", parameters[key], "taken", key)
            else:
                self.translation.refuse(at, f"{name}.{key}", child.get("type", ""), "is not known in a shape here")
        if bsdf is None:
            bsdf = DEFAULT_DIFFUSE
            self.translation.line("default", f"{name}.bsdf", plain(bsdf), "taken", f"bsdf, at {place}")
        return {**parameters, "bsdf": bsdf}

    def _file(self, name: str) -> str:
        return self.translation.file_name(Path(name), is_absolute=name in self.absolute)

    def _scan(self) -> str:
        """Judge the kind of scan and its grids; return the kind."""
        keys = self.keys
        scan = scan_type(keys)
        by_point = "sensor.original_film_width" in keys and "sensor.original_film_height" in keys
        if by_point or keys.value("sensor.confocal", False, bool):
            scan = "confocal"
            for name in ("sensor.confocal", "integrator.capture_type"):
                keys.change(name, "capture.scan_type: confocal, all points in one capture")
            self.translation.put("capture.scan_type", scan, self.translation.start)
        keys.drop("sensor.confocal", "capture_type decides")
        keys.take("integrator.capture_type", "capture.scan_type", scan)
        for axis, key, size in (("width", "nx", DEFAULT_FILM[0]), ("height", "ny", DEFAULT_FILM[1])):
            name = f"sensor.original_film_{axis}" if by_point else f"film.{axis}"
            self.pixels[key] = keys.value(name, size, int)
            keys.take(name, f"capture.sensor_grid.{key}", self.pixels[key])
            keys.drop(f"film.{axis}", "one point at a time there; original_film decides")
            if not self._is_fan(scan):
                self._lasers(scan, f"film.laser_scan_{axis}", f"film.{axis}", key)
        if not self._is_fan(scan):
            keys.drop_all(dict.fromkeys(FAN, "laser points are the sensor points"))
        keys.drop("film.exhaustive_scan", "capture_type decides")
        return str(scan)

    def _is_fan(self, scan: str) -> bool:
        """Return whether laser points are where a fan of rays meets the wall, no grid on it."""
        return scan == "exhaustive" and not self.keys.value(FAN[0], True, bool)

    def _fan(self, wall: FlatWall, matrix: Float64) -> None:
        """Set the laser points to where a fan of rays meets the wall."""
        keys = self.keys
        points = [wall.hit(matrix[:3, 3], matrix[:3, :3] @ ray) for ray in fan_of_rays(keys)]
        if None in points:
            why = f"{points.count(None)} of the {len(points)} rays of its fan miss the wall; make the fan narrower"
            keys.refuse(FAN[1] if FAN[1] in keys else FAN[0], why)
        self.translation.put("capture.laser_points", points, keys.place(FAN[0]))
        say_fan(keys, "capture.laser_points", len(points))

    def _lasers(self, scan: object, name: str, sensors: str, key: str) -> None:
        """Judge one side of the laser grid."""
        keys = self.keys
        if scan != "exhaustive":
            keys.drop(name, "of exhaustive captures")
            return
        n_sensors = self.pixels[key]
        count = keys.value(name, n_sensors, int)
        if count != n_sensors:
            keys.refuse(name, f"got {count}, need {sensors} ({n_sensors}): laser points are the sensor points")
        keys.take(name, f"capture.laser_grid.{key}", count)

    def _laser(self, wall: FlatWall | None, scan: str, given: tuple[float, float] | None) -> None:
        """Judge the laser: where it stands, and which point of a single scan it lights."""
        keys, translation = self.keys, self.translation
        refuse_other_emitters(keys, self.emitters, self.checked)
        matrix = matrix_of(placement(self.emitters[0])) if self.emitters else np.eye(4)
        position = rounded(matrix[:3, 3])
        if "emitter.to_world" in keys:
            translation.put("capture.laser_position", position, keys.place("emitter.to_world"))
        elif "sensor.laser_origin" in keys:
            keys.take("sensor.laser_origin", "capture.laser_position", keys.value("sensor.laser_origin", None))
        else:
            remark = (
                "capture.laser_position: null, 1 m in front of the wall, since it says nothing of the laser's place"
            )
            translation.line("default", "emitter.to_world", None, "changed", remark)
        aim = self._laser_point(wall, matrix, given) if scan == "single" and wall is not None else ""
        if self._is_fan(scan) and wall is not None:
            self._fan(wall, matrix)
        keys.keep("emitter.to_world", f"capture.laser_position: {plain(position)}{aim}")
        keys.drop_all(OF_PROJECTORS)

    def _laser_point(self, wall: FlatWall, matrix: Float64, given: tuple[float, float] | None) -> str:
        """Set the point that the laser lights, and return what of it comes from the projector's transform."""
        keys, translation = self.keys, self.translation
        hit = wall.hit(matrix[:3, 3], matrix[:3, 2]) if "emitter.to_world" in keys else None
        pixel = keys.value("sensor.laser_lookat_pixel", None)
        if given is not None:
            translation.put_laser(given)
        elif hit is not None:
            translation.put("capture.laser_point", hit, keys.place("emitter.to_world"))
            return f", capture.laser_point: {plain(hit)}, where its axis meets the wall"
        elif isinstance(pixel, list):
            point = wall.at_uv(pixel[0] / max(self.pixels["nx"], 1), pixel[1] / max(self.pixels["ny"], 1))
            keys.take("sensor.laser_lookat_pixel", "capture.laser_point", point, "m", changed=True)
        else:
            why = f"the laser does not look at the relay wall; {_SAY_LASER}"
            if "emitter.to_world" in keys:
                keys.refuse("emitter.to_world", why)
            else:
                translation.refuse(keys.place("emitter.type"), "emitter.to_world", "", why)
        return ""


def _only(translation: Translation, elements: list[Element], tag: str, known: tuple[str, ...]) -> Element | None:
    """Return the one element of a kind; refuse none, several and unknown plugins."""
    for element in elements:
        kind = element.get("type", "")
        if kind not in known:
            hint = did_you_mean(kind, known)
            why = f"is not known here; need {' or '.join(known)}" + (f". {hint}" if hint else "")
            translation.refuse(place_in(translation.source, element), tag, kind, why)
    if len(elements) != 1:
        place = place_in(translation.source, elements[1]) if elements else translation.start
        translation.refuse(place, tag, "", f"the scene has {len(elements)} of them, need one")
        return None
    return elements[0] if elements[0].get("type") in known else None


def _refuse_error(translation: Translation, error: ValueError) -> None:
    """Refuse what the reader of XML scenes does."""
    path = translation.source
    placed = _PLACED.fullmatch(str(error))
    if placed is None:
        translation.refuse(translation.start, "", "", str(error))
        return
    file = path.parent / placed["file"] if placed["file"] else path
    translation.refuse(f"{file}:{placed['line']}", "", "", placed["message"].rstrip("."))
