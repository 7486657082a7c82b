"""A scene of y-tal in YAML -> a configuration.

y-tal writes a scene for mitransient from it: its settings are mitransient's under other names, with other defaults.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nlosrender.config.issues import shown
from nlosrender.config.mitsuba_xml import checked_bsdf
from nlosrender.config.yaml_tree import Document
from nlosrender.errors import KeyPath
from nlosrender.files.importing.light_transport import say_samples, translate_bounces, translate_film
from nlosrender.files.importing.scan_geometry import FlatWall, matrix_of, to_world_of
from nlosrender.files.importing.translation import MAX_POINTS, Found, Keys, Translation, as_yaml_11, plain, rounded
from nlosrender.files.importing.xml_plugins import plugin_of

_INTEGRATOR = (
    *("max_depth", "filter_bounces", "discard_direct_paths", "nlos_laser_sampling", "nlos_hidden_geometry_sampling"),
    *(f"nlos_hidden_geometry_sampling_{name}" for name in ("do_rroulette", "includes_relay_wall")),
    *("force_equal_illumination_scanning", "illumination_scan_fov"),
)
_NAMES = {
    **{f"integrator.{name}": f"integrator_{name}" for name in _INTEGRATOR},
    "integrator.account_first_and_last_bounces": "account_first_and_last_bounces",
    "film.temporal_bins": "num_bins",
    "film.bin_width_opl": "bin_width_opl",
    "film.start_opl": "start_opl",
}
_POSITION = (-0.5, 0.0, 0.25)  # of laser and sensor where the file does not say
_GRID = "y-tal states a grid of laser_width x laser_height in the aperture, which is taken"
_CENTRED = 1e-9  # of the wall


def translate_yaml(
    translation: Translation, document: Document, laser: tuple[float, float] | None, folders: Sequence[Path]
) -> None:
    """Judge every key of a scene, and set those of the configuration.

    Parameters
    ----------
    translation
        Of the YAML file; changed in place.
    document
        What it holds.
    laser
        Where the laser hits, wall coordinates (x, y) [m], instead of where the file's looks; None: as the file says.
    folders
        Where names of meshes may start, the first that has the file.
    """
    _YtalScene(translation, document, folders).translate(laser)


class _YtalScene:
    def __init__(self, translation: Translation, document: Document, folders: Sequence[Path]):
        self.translation, self.document, self.folders = translation, document, folders
        self.keys = Keys(translation, self._found(document.tree, ()), _NAMES)

    def _found(self, mapping: Mapping[str, Any], path: KeyPath) -> dict[str, Found]:
        return {key: Found(as_yaml_11(value), self.document.place((*path, key))) for key, value in mapping.items()}

    def translate(self, laser: tuple[float, float] | None) -> None:
        """Judge everything."""
        keys = self.keys
        name = keys.value("name", None)
        if name is not None:
            keys.take("name", "name", name)
        self._variant()
        wall = self._geometry()
        self._scan(wall, laser)
        for device in ("laser", "sensor"):
            names = [f"{device}_{axis}" for axis in "xyz"]
            position = [float(keys.value(name, default, float)) for name, default in zip(names, _POSITION, strict=True)]
            for name in names:
                keys.take(name, f"capture.{device}_position", position)
        translate_bounces(keys, of_ytal=True)
        if keys.value("histogram_mode", "time", str) != "time":
            keys.refuse("histogram_mode", "stores frequencies, which are not written yet; use time")
        translate_film(keys, 4096)
        say_samples(keys, "sample_count", 1_000_000)
        keys.drop_all(
            {
                "histogram_mode": "a histogram for each point",
                "wl_mean": "of frequencies",
                "wl_sigma": "of frequencies",
                "auto_detect_bins": "mitransient ignores it; num_bins is taken",
                "simultaneous_scan": "memory is planned here",
                "laser_emission": "capture.laser_energy is 1 J: one factor on H",
                "laser_emission_mode": "capture.laser_energy is 1 J: one factor on H",
                "integrator.illumination_scan_fov": _GRID,
                "integrator.force_equal_illumination_scanning": _GRID,
            }
        )
        keys.finish()

    def _variant(self) -> None:
        keys = self.keys
        variant = str(keys.value("mitsuba_variant", ""))
        if "spectral" in variant:
            keys.refuse("mitsuba_variant", "renders spectra; need mono, rgb or mono_polarized")
        elif "polarized" in variant:
            keys.take("mitsuba_variant", "render.polarized", True, changed=True)
        elif "mono" in variant:
            keys.take("mitsuba_variant", "render.color", "grey", "backend: auto", changed=True)
        keys.drop("mitsuba_variant", "render.color and backend: auto")

    def _geometry(self) -> FlatWall | None:
        keys, wall = self.keys, None
        items = keys.enter("geometry", list, "a list of items, each with a name and a mesh") or []
        name = keys.value("relay_wall", "relay_wall")
        items = [item if isinstance(item, Mapping) else {} for item in items]
        for index, item in enumerate(items):
            path: KeyPath = ("geometry", index)
            prefix = f"geometry.{item.get('name', index)}."
            item_keys = Keys(self.translation, self._found(item, path), None, prefix, self.document.place(path))
            if item.get("name") == name:
                wall = self._relay_wall(item_keys, index)
            else:
                self._hidden_item(item_keys, index)
            item_keys.keep("name", "the relay wall" if item.get("name") == name else "its name here")
            item_keys.drop("description", "for readers")
            item_keys.finish()
        if name not in [item.get("name") for item in items]:
            keys.refuse("relay_wall", "is none of the names in geometry")
        keys.keep("relay_wall", "scene.relay_wall")
        return wall

    def _relay_wall(self, keys: Keys, index: int) -> FlatWall | None:
        kind, _ = self._mesh(keys, index)
        steps = self._steps(keys)
        bsdf = self._material(keys, index)
        place = self.document.place(("geometry", index))
        if kind != "rectangle":
            why = "points lie at (u, v) of its shape, a regular grid here on a rectangle alone"
            self.translation.refuse(place, f"{keys.prefix}mesh.type", kind, why)
            return None
        wall = FlatWall.of(matrix_of(steps))
        wall.put(self.translation, place)
        self.translation.put("scene.relay_wall.bsdf", bsdf, place)
        return wall

    def _hidden_item(self, keys: Keys, index: int) -> None:
        kind, file = self._mesh(keys, index)
        shape = {"type": kind} | ({"filename": file} if file else {}) | {"to_world": to_world_of(self._steps(keys))}
        place = self.document.place(("geometry", index))
        self.translation.add_item(str(keys.value("name", "")), shape, self._material(keys, index), place)

    def _part(self, keys: Keys, index: int, name: str, example: str) -> Keys:
        """Return the keys of a mapping in an item."""
        values = keys.enter(name, dict, f"a mapping such as {example}") or {}
        found = self._found(values, ("geometry", index, name))
        return Keys(self.translation, found, None, f"{keys.prefix}{name}.", keys.place(name))

    def _mesh(self, keys: Keys, index: int) -> tuple[str, str]:
        """Return the kind of a shape and, for a mesh, how its file is named from the configuration."""
        found = self._part(keys, index, "mesh", "{type: rectangle}")
        kind, file = found.value("type", ""), ""
        if kind not in ("obj", "rectangle", "sphere"):
            found.refuse("type", "need obj, rectangle or sphere")
        if kind == "obj":
            file = self._file(found)
        found.keep("type", f"shape.type: {kind}")
        found.drop("filename", "of a shape without a file")
        found.finish()
        return str(kind), file

    def _file(self, found: Keys) -> str:
        """Return how the configuration names a mesh; y-tal's names start at whatever folder it was started in."""
        name = str(found.value("filename", ""))
        tried = list(dict.fromkeys((folder / name).resolve() for folder in self.folders))
        file = next((path for path in tried if path.is_file()), None)
        if file is None or not name:
            where = ", ".join(map(str, tried)) if name else "nothing"
            found.refuse("filename", f"is not there; looked for {where}. Say where names start with --meshes FOLDER")
            return name
        written = self.translation.file_name(file, is_absolute=Path(name).is_absolute())
        found.keep("filename", f"shape.filename: {written}")
        return written

    def _steps(self, keys: Keys) -> list[Any]:
        """Return scale, rotations about x, y, z and displacement as ``to_world`` steps."""
        names = [[f"{what}_{axis}" for axis in "xyz"] for what in ("scale", "rot_degrees", "displacement")]
        scale, angles, move = (
            [float(keys.value(name, default, float)) or default for name in group]  # 0 is no value there
            for group, default in zip(names, (1.0, 0.0, 0.0), strict=True)
        )
        for name in (name for group in names for name in group):
            keys.keep(name, "its place")
        axes = [[float(axis == index) for index in range(3)] for axis in range(3)]
        turns = [{"rotate": {"axis": axis, "angle_deg": angle}} for axis, angle in zip(axes, angles, strict=True)]
        return [[{"scale": scale}, *turns, {"translate": move}]]

    def _material(self, keys: Keys, index: int) -> dict[str, Any]:
        found = self._part(keys, index, "material", "{id: white}")
        kind = found.value("id", None)
        bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": 1.0}
        if kind == "copper":
            bsdf = {"type": "roughconductor", "material": "Cu", "distribution": "beckmann"}
            try:
                bsdf["alpha"] = float(str(found.value("alpha", None)))  # text there, as it goes into XML
                found.keep("alpha", "bsdf.alpha")
            except ValueError:
                found.refuse("alpha", "copper needs it, a number from 0 to 1")
        elif kind == "custom":
            try:
                bsdf = self._custom(str(found.value("text", "")))
                found.keep("text", "bsdf")
            except ValueError as error:
                found.refuse("text", str(error).rstrip("."))
        elif kind != "white":
            found.refuse("id", f"got {shown(kind)}, need white, copper or custom")
        found.keep("id", f"bsdf.type: {bsdf['type']}")
        found.finish()
        return bsdf

    def _custom(self, text: str) -> dict[str, Any]:
        """Return the BSDF of a piece of Mitsuba's XML."""
        element = checked_bsdf(text, self.folders[0])
        return plugin_of(element, {}, lambda name: self.translation.file_name(Path(name), is_absolute=False))

    def _scan(self, wall: FlatWall | None, laser: tuple[float, float] | None) -> None:
        keys = self.keys
        scan = keys.value("scan_type", "single", str)
        if scan not in ("single", "confocal", "exhaustive"):
            keys.refuse("scan_type", "need single, confocal or exhaustive")
        keys.take("scan_type", "capture.scan_type", scan)
        sizes = {}
        for axis, key in (("width", "nx"), ("height", "ny")):
            size = keys.value(f"sensor_{axis}", 256, int)
            sizes[axis] = max(size, 1)
            keys.take(f"sensor_{axis}", f"capture.sensor_grid.{key}", size)
            if scan == "exhaustive":
                keys.take(f"laser_{axis}", f"capture.laser_grid.{key}", keys.value(f"laser_{axis}", 32, int))
            keys.drop(f"laser_{axis}", "of exhaustive captures")
        is_stepped = scan == "confocal" and not keys.value("simultaneous_scan", True, bool)
        if scan == "exhaustive" or is_stepped:
            self._aperture(wall, "laser_grid" if scan == "exhaustive" else "sensor_grid")
        for name in _ends("x") + _ends("y"):
            keys.drop(name, "the whole wall, as y-tal has it for this scan")
        if scan == "single" and wall is not None:
            self._laser_point(wall, list(sizes.values()), laser)
        for axis in "xy":
            keys.drop(f"laser_lookat_{axis}", "of single captures")

    def _laser_point(self, wall: FlatWall, sizes: Sequence[int], given: tuple[float, float] | None) -> None:
        keys, translation = self.keys, self.translation
        names = [f"laser_lookat_{axis}" for axis in "xy"]
        # 0 is no value there, as null is none: the middle
        pixel = [keys.value(name, 0.0, float) or size / 2 for name, size in zip(names, sizes, strict=True)]
        point = wall.at_uv(*(at / size for at, size in zip(pixel, sizes, strict=True)))
        if given is not None:
            translation.put_laser(given)
            keys.drop_all(dict.fromkeys(names, "--laser decides"))
            return
        translation.put("capture.laser_point", point, keys.place(names[0]))
        for name in names:
            keys.change(name, f"capture.laser_point: {plain(point)}")
        if not any(name in keys for name in names):
            translation.line("default", "laser_lookat", "the middle", "taken", f"capture.laser_point: {plain(point)}")

    def _aperture(self, wall: FlatWall | None, grid: str) -> None:
        """Set the part of the wall that the laser scans: the extent of a grid, or a list where it is not centred."""
        if wall is None:
            return
        ranges, counts = [], self.translation.config["capture"][grid]
        for axis in "xy":
            names = _ends(axis)
            low, high = (self.keys.value(name, default, float) for name, default in zip(names, (0.0, 1.0), strict=True))
            if not 0 <= low < high <= 1:
                name = next((name for name in names if name in self.keys), names[0])
                self.keys.refuse(name, f"from {low:g} to {high:g}, need 0 <= start < end <= 1, shares of the wall")
                return
            ranges.append((low, high))
        if all(abs(low + high - 1) < _CENTRED for low, high in ranges):
            for axis, key, (low, high), size in zip("xy", ("width", "height"), ranges, wall.size, strict=True):
                to, length, names = f"capture.{grid}.{key}", rounded((high - low) * size), _ends(axis)
                if high - low < 1:
                    self.translation.put(to, length, self.keys.place(names[0]))
                for name in names:
                    self.keys.change(name, f"{to}: {length:g}")
            return
        to, place = f"capture.{grid.replace('grid', 'points')}", self.keys.place(_ends("x")[0])
        nx, ny = counts["nx"], counts["ny"]
        if not 1 <= nx * ny <= MAX_POINTS:
            self.translation.refuse(place, _ends("x")[0], nx * ny, f"a list of points has at most {MAX_POINTS}")
            return
        del self.translation.config["capture"][grid]
        self.translation.put(to, wall.cells(ranges, (nx, ny)), place)
        for name in _ends("x") + _ends("y"):
            self.keys.change(name, f"{to}: the grid's points as a list, since its middle is not the wall's")


def _ends(axis: str) -> list[str]:
    return [f"laser_aperture_{end}_{axis}" for end in ("start", "end")]
