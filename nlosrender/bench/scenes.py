"""The built-in scenes of the benchmark, as configurations like any user's."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from nlosrender.bench.paper.room_meshes import write_furniture
from nlosrender.config.document import Config
from nlosrender.config.load import parse_config

# (bounces, error whose time is reported, BSDF); ``material: none`` is a metal that absorbs nothing
SHINY: Mapping[str, tuple[int, float, Mapping[str, Any]]] = {
    "ggx-0.2": (3, 0.01, {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.2}),
    "ggx-0.05": (3, 0.01, {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": 0.05}),
    "plastic": (5, 0.02, {"type": "plastic", "diffuse_reflectance": 0.6}),
    "principled": (5, 0.02, {"type": "principled", "base_color": 0.6, "roughness": 0.3, "metallic": 0.5}),
    "mirror": (3, 0.01, {"type": "conductor", "material": "none"}),
    "retroreflector": (3, 0.01, {"type": "retroreflector", "width": 2.0, "albedo": 0.5, "diffuse": 0.2}),
}

Truth = Literal["quadrature", "refined", "long run"]

WALL_SIZE = 2.0  # m, of every relay wall
PLATE_SIZE = 0.8  # m
PLATE_DISTANCE = 1.0  # m
PLATE_REFLECTANCE = 0.7


@dataclass(frozen=True, eq=False)
class BenchScene:
    """A capture to be rendered by every contender, and how its truth is found.

    ``truth``: ``quadrature`` in float64; ``refined``: the third bounce gathered much finer than any contender does;
    ``long run``: the same third bounce and a long unbiased run for the rest.
    """

    name: str
    title: str
    target: float  # relative L2 error whose time is reported
    truth: Truth
    sections: Mapping[str, Any]  # scene, capture, time_axis
    max_bounces: int | None = 3
    weight: float = 1.0  # its share of the time is in proportion
    write_mesh: Callable[[], None] | None = None  # called before the first configuration

    def config(self, **render: Any) -> Config:
        """Return the configuration; ``render`` are keys of its ``render`` section.

        Raises
        ------
        ConfigError
            A mesh is missing, or a key of ``render`` is wrong.
        """
        if self.write_mesh is not None:
            self.write_mesh()
        text = yaml.safe_dump({**self.sections, "render": {"max_bounces": self.max_bounces, **render}})
        return parse_config(text, f"{self.name}.yaml", Path.cwd())


def built_in_scenes(mesh: Path | None = None, folder: Path = Path("out")) -> dict[str, BenchScene]:
    """Return the scenes by name.

    Parameters
    ----------
    mesh
        A mesh about 0.8 m high, y up, centred at its origin, such as the Stanford bunny; without one its scenes
        are left out.
    folder
        Where the furniture of a room is written, when that scene is first loaded.
    """
    scenes = [plate(), letters()]
    if mesh is not None:
        scenes += [bunny(mesh), bunny(mesh, "confocal"), bunny(mesh, max_bounces=None)]
        scenes += [shiny_bunny(mesh, name) for name in SHINY]
    scenes += [closed_room(), mirror_room(), furnished_room(folder / "bench-furniture.ply")]
    return {scene.name: scene for scene in scenes}


def plate(n: int = 64, n_bins: int = 320) -> BenchScene:
    """A square in front of the wall: no occlusion, truth by quadrature; 320 bins of 3 mm, or as many in the window."""
    item = _item("rectangle", width=PLATE_SIZE, height=PLATE_SIZE, center=[0.0, 0.0, PLATE_DISTANCE])
    item |= {"normal": [0, 0, -1], "bsdf": _diffuse(PLATE_REFLECTANCE)}
    sections = _sections([item], n, bins=(2.0, 0.96 / n_bins, n_bins))
    title = f"square of 0.8 m at 1 m, third bounce, {n} x {n} sensor points, {n_bins} bins"
    return BenchScene("plate", title, 0.01, "quadrature", sections, weight=0.7)


def letters() -> BenchScene:
    """Thick letters, which hide parts of themselves."""
    item = _item("letters", text="NLOS", height=0.6, thickness=0.02, center=[0.0, 0.0, 0.8], normal=[0, 0, -1])
    item["bsdf"] = _diffuse(0.8)
    title = "letters NLOS, 2 cm thick, at 0.8 m, third bounce, 64 x 64 sensor points, 400 bins of 3 mm"
    return BenchScene("letters", title, 0.01, "refined", _sections([item], 64, bins=(1.5, 0.003, 400)))


def bunny(mesh: Path, scan: str = "single", max_bounces: int | None = 3) -> BenchScene:
    """A mesh at 1 m: third bounce, single or confocal; or all bounces."""
    sections = _bunny_sections(mesh, _diffuse(0.8), scan)
    what = "third bounce" if max_bounces == 3 else "all bounces"
    title = f"{mesh.stem} at 1 m, {scan}, {what}, 64 x 64 sensor points, 700 bins of 3 mm"
    if max_bounces is None:
        return BenchScene("bunny-all", title, 0.02, "long run", sections, None, weight=2.0)
    return BenchScene("bunny" if scan == "single" else "bunny-confocal", title, 0.01, "refined", sections)


def shiny_bunny(mesh: Path, name: str) -> BenchScene:
    """The mesh at 1 m with a BSDF of ``SHINY``; a retroreflector confocal, where it sends its light."""
    max_bounces, target, bsdf = SHINY[name]
    scan = "confocal" if name == "retroreflector" else "single"
    sections = _bunny_sections(mesh, bsdf, scan)
    title = f"{mesh.stem} at 1 m, {name}, {scan}, {max_bounces} bounces, 64 x 64 sensor points, 700 bins of 3 mm"
    truth: Truth = "refined" if max_bounces == 3 else "long run"
    return BenchScene(f"bunny-{name}", title, target, truth, sections, max_bounces)


def _bunny_sections(mesh: Path, bsdf: Mapping[str, Any], scan: str) -> dict[str, Any]:
    item = _item("mesh", filename=str(mesh.absolute()), translate=[0.0, 0.0, 1.0], face_normals=True, bsdf=dict(bsdf))
    return _sections([item], 64, bins=(1.3, 0.003, 700), scan=scan)


def closed_room(n: int = 32, max_bounces: int | None = None) -> BenchScene:
    """A closed cube of 2 m, the relay wall one of its sides, albedo 0.5 everywhere: light goes on for long."""
    item = _item("room", size=[2.0, 2.0, 2.0], bsdf=_diffuse(0.5))
    sections = _sections([item], n, bins=(0.0, 0.03, 500), wall_reflectance=0.5)
    title = f"closed room of 2 m, albedo 0.5, all bounces, {n} x {n} sensor points, 500 bins of 3 cm"
    return BenchScene("room", title, 0.03, "long run", sections, max_bounces, weight=1.5)


def mirror_room(n: int = 32) -> BenchScene:
    """The closed room with a mirror before one of its sides; light that meets it twice in a row is not sampled."""
    mirror = _item("rectangle", name="mirror", width=1.9, height=1.9, center=[0.98, 0.0, 1.0], normal=[-1, 0, 0])
    mirror["bsdf"] = dict(SHINY["mirror"][2])
    item = _item("room", size=[2.0, 2.0, 2.0], bsdf=_diffuse(0.5))
    sections = _sections([item, mirror], n, bins=(0.0, 0.03, 500), wall_reflectance=0.5)
    title = f"closed room of 2 m, one side a mirror, all bounces, {n} x {n} sensor points, 500 bins of 3 cm"
    return BenchScene("room-mirror", title, 0.03, "long run", sections, None, weight=1.5)


def furnished_room(mesh: Path, n: int = 64) -> BenchScene:
    """A closed room with furniture of 1.2 million triangles, which is written to ``mesh``."""

    def write() -> None:
        if not mesh.is_file():
            mesh.parent.mkdir(parents=True, exist_ok=True)
            write_furniture(mesh, 1_200_000)

    furniture = _item("mesh", name="furniture", filename=str(mesh.absolute()), face_normals=True, bsdf=_diffuse(0.6))
    item = _item("room", size=[2.0, 2.0, 2.2], bsdf=_diffuse(0.5))
    sections = _sections([item, furniture], n, bins=(0.0, 0.03, 400), wall_reflectance=0.5)
    title = f"room of 2 m, furniture of 1.2 million triangles, all bounces, {n} x {n} sensor points, 400 bins of 3 cm"
    return BenchScene("room-furnished", title, 0.05, "long run", sections, None, weight=3.0, write_mesh=write)


def wavy_sheet(mesh: Path, n: int = 32) -> BenchScene:
    """A generated mesh at 1 m, third bounce, for the cost of triangles."""
    item = _item("mesh", filename=str(mesh.absolute()), translate=[0.0, 0.0, 1.0], bsdf=_diffuse(0.8))
    sections = _sections([item], n, bins=(1.3, 0.003, 700))
    return BenchScene("sheet", "wavy sheet", 0.02, "refined", sections)


def many_lasers(n_lasers: int, n: int = 16, width: float = 1.5) -> BenchScene:
    """The plate scanned exhaustively by ``n_lasers`` x ``n_lasers`` laser points over ``width`` squared."""
    base = plate(n).sections
    capture = {**base["capture"], "scan_type": "exhaustive"}
    capture["laser_grid"] = {"nx": n_lasers, "ny": n_lasers, "width": width, "height": width}
    return BenchScene("lasers", "exhaustive", 0.02, "refined", {**base, "capture": capture})


def _item(kind: str, **keys: Any) -> dict[str, Any]:
    return {"name": "hidden", "type": kind, **keys}


def _diffuse(reflectance: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": reflectance}


def _sections(
    items: list[dict[str, Any]],
    n: int,
    *,
    bins: tuple[float, float, int],
    scan: str = "single",
    wall_reflectance: float = 1.0,
) -> dict[str, Any]:
    """Return scene, capture and time axis: a wall of 2 m, legs not counted, the laser at its centre."""
    wall = {"type": "rectangle", "width": WALL_SIZE, "height": WALL_SIZE, "bsdf": _diffuse(wall_reflectance)}
    capture = {"scan_type": scan, "sensor_grid": {"nx": n, "ny": n}, "account_first_and_last_bounces": False}
    return {
        "scene": {"relay_wall": wall, "hidden_geometry": items},
        "capture": capture,
        "time_axis": dict(zip(("start_opl", "bin_width_opl", "n_bins"), bins, strict=True)),
    }
