"""Flat mirrors: the laser's images in them, against a closed form and sums over images by numpy."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import assert_agrees
from support.image_sums import image_sum
from support.rendering import Scene, flat_wall, render
from support.varied_scenes import Stage, plate
from support.wall_meshes import flat, sheet, wavy, write_uv_ply

Array = NDArray[np.float64]
MIRROR: Scene = {"type": "conductor"}
GREY: Scene = {"type": "diffuse", "reflectance": 0.7}
SCREEN = plate((-0.3, 0.2, 0.4), (0.2, 0.1, -1.0), (0.3, 0.5), 0.0)
TILTED = ((0.15, -0.05, 0.9), (0.1, 0.2, -1.0), (1.1, 0.8))
# float32 coordinates of size 1 lie within 6e-8: a term is good to a few times that, a sum of squares to less
ROUNDING = 2e-6
RADIUS = 0.06  # m


def third(stage: Stage) -> Array:
    """Return H of the third bounce (laser, sensor, bin), which the engine states to be exact."""
    from nlosrender.engine.interface import Budget

    result = stage.engine.render(stage.batch, stage.engine.calibrate(Budget(target_error=0.1)))
    assert not result.variance.any()
    return np.asarray(result.mean[0, stage.bounces.slot(3)])


def triangles(stage: Stage, shape: int) -> Array:
    """Return the triangles of a hidden shape [m]."""
    from nlosrender.engine.launch.facing_triangles import triangles_of

    built = stage.engine.built
    return triangles_of(built.hidden_shapes[shape]) * built.metres_per_engine_unit


def expected(stage: Stage, screens: int = 1) -> Array:
    """Return the sum over images in the first hidden shape, the last ``screens`` shapes before it."""
    before = [np.zeros((0, 3, 3)), *(triangles(stage, 1 + k) for k in range(screens))]
    return image_sum(triangles(stage, 0), np.concatenate(before), stage.engine.capture, stage.engine.time_axis)


@pytest.mark.parametrize(
    ("scan", "engine"),
    [("single", "path"), ("confocal", "virtual_lights"), ("exhaustive", "path")]
    + [
        pytest.param(*more, marks=pytest.mark.slow)
        for more in (("single", "virtual_lights"), ("confocal", "path"), ("exhaustive", "virtual_lights"))
    ],
)
def test_a_mirror_mesh_sends_the_light_of_its_images(scan: str, engine: str, tmp_path: Path) -> None:
    """Every facet has an image of every laser point, where nothing hides the way to and fro; legs are counted."""
    name = write_uv_ply(tmp_path / "mirror.ply", *sheet(wavy(1.6, 1.2, 0.05), 9, 7))
    mirror = {"type": "mesh", "filename": name, "translate": [0, 0, 0.9], "normals": "flat"}
    mirror |= {"bsdf": {"type": "twosided", "bsdf": MIRROR}}
    sensors = (7, 5) if scan == "exhaustive" else (17, 13)
    capture = {"account_first_and_last_bounces": True}
    settings: dict[str, Any] = {"bins": (2.0, 0.03, 110), "spp": None, "target_error": 0.1, "engine": engine}
    stage = Stage.of(flat_wall(mirror, SCREEN, scan=scan, sensors=sensors, capture=capture, **settings), tmp_path)
    assert stage.engine.name == engine
    light = expected(stage)
    assert (light > 0).sum() > 30
    assert np.linalg.norm(third(stage) - light) < ROUNDING * np.linalg.norm(light)


@pytest.mark.parametrize("inside", [False, True])
def test_round_walls_see_images(inside: bool) -> None:
    """Cosines are those of the wall at either point; a wall that sees itself keeps its second bounce apart."""
    at = ((0.1, 0.05, -0.3 if inside else 1.6), (0.1, 0.2, -1.0), (1.1, 0.8))
    grid = {"nx": 6, "ny": 5, "width": 1.8, "height": 0.8}  # all of it is seen from the default place of the camera
    capture = {"sensor_grid": grid, "laser_point": [0.22, -0.05]}
    config = flat_wall(plate(*at, {"type": "twosided", "bsdf": MIRROR}), capture=capture, bins=(0.0, 0.02, 400))
    wall = {"type": "sphere", "radius": 0.8, "inside": inside, "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    config["scene"]["relay_wall"] = wall
    stage = Stage.of(config)
    exact = dict(stage.engine.device.exact_light(stage.batch))
    assert (2 in exact and exact[2].any()) == inside
    light = expected(stage, 0)
    assert (light > 0).sum() > 20
    assert np.linalg.norm(exact[3][0, 0, ..., :-1] - light) < ROUNDING * np.linalg.norm(light)


def test_points_on_edges_count_once(tmp_path: Path) -> None:
    """A plate cut into triangles is one mirror, wherever its edges are: image of the laser, once for every point.

    Points of reflection are in the middle between laser and sensor point: on vertices, edges and diagonals here.
    """
    name = write_uv_ply(tmp_path / "plate.ply", *sheet(flat(1.0, 0.8), 10, 8))
    mesh = {"type": "mesh", "filename": name, "translate": [0, 0, 0.9], "rotate_deg": [180, 0, 0], "bsdf": MIRROR}
    capture = {"laser_point": [0, 0], "sensor_grid": {"nx": 17, "ny": 13, "width": 1.7, "height": 1.3}}
    whole = plate((0, 0, 0.9), (0, 0, -1), (1.0, 0.8), MIRROR)
    cut, one = (third(Stage.of(flat_wall(item, capture=capture), tmp_path)) for item in (mesh, whole))
    assert (one.sum(axis=-1) > 0).all()
    np.testing.assert_allclose(cut, one, rtol=ROUNDING)


def fresnel(cosine: Array, eta: float = 1.9) -> Array:
    """Return the reflectance of a smooth dielectric surface for unpolarised light."""
    inner = np.sqrt(1 - (1 - cosine**2) / eta**2)
    s, p = (cosine - eta * inner) / (cosine + eta * inner), (eta * cosine - inner) / (eta * cosine + inner)
    return (s**2 + p**2) / 2


LOBES: dict[str, tuple[Scene, Any]] = {
    "half a mirror": ({"type": "blendbsdf", "weight": 0.25, "a": GREY, "b": MIRROR}, lambda cosine: 0.25),
    "a mirror on the back": ({"type": "twosided", "a": GREY, "b": MIRROR}, lambda cosine: 0.0),
    "a mirror on the front": ({"type": "twosided", "a": MIRROR, "b": GREY}, lambda cosine: 1.0),
    "a coat": ({"type": "plastic", "int_ior": 1.9, "ext_ior": 1.0}, fresnel),
    "glass": ({"type": "dielectric", "int_ior": 1.9, "ext_ior": 1.0}, fresnel),
    "a blend of coats": (
        {
            "type": "blendbsdf",
            "weight": 0.25,
            "a": {"type": "twosided", "bsdf": {"type": "plastic", "int_ior": 1.9, "ext_ior": 1.0}},
            "b": {"type": "conductor", "specular_reflectance": 0.4},
        },
        lambda cosine: 0.75 * fresnel(cosine) + 0.25 * 0.4,
    ),
    "matt": (GREY, lambda cosine: 0.0),
}


@pytest.mark.parametrize("kind", LOBES)
def test_a_lobe_has_its_weight(kind: str) -> None:
    """The light of an image is that in a perfect mirror times the weight of the delta lobe: Fresnel's, a blend's."""
    bsdf, weight = LOBES[kind]
    stages = [Stage.of(flat_wall(plate(*TILTED, kind_of), sensors=(9, 7), spp=16)) for kind_of in (MIRROR, bsdf)]
    exact = [dict(stage.engine.device.exact_light(stage.batch)) for stage in stages]
    perfect, own = (light.get(3, 0 * exact[0][3])[..., :-1] for light in exact)
    rows = perfect[0, 0, 0].sum(axis=-1) > 0
    assert rows.any()
    built, capture = stages[0].engine.built, stages[0].engine.capture
    normal = np.cross(*np.diff(triangles(stages[0], 0)[0], axis=0))
    normal /= np.linalg.norm(normal)
    corner = triangles(stages[0], 0)[0, 0]
    laser, sensors = capture.laser_grid.positions.reshape(-1, 3), capture.sensor_grid.positions.reshape(-1, 3)[rows]
    to_image = laser - 2 * ((laser - corner) @ normal)[:, None] * normal - sensors
    cosine = np.abs(to_image @ normal) / np.linalg.norm(to_image, axis=1)
    assert built.n_triangles == 2
    lit = own[0, 0, 0][rows].sum(axis=-1)
    # Mitsuba's Fresnel terms in float32 cancel to a few 1e-6 of their value
    np.testing.assert_allclose(lit, perfect[0, 0, 0][rows].sum(axis=-1) * weight(cosine), rtol=2e-5)


def test_pictures_are_read_at_the_point_of_reflection() -> None:
    """A mirror of two reflectances, left and right, sends each point the light of one: its point of reflection's."""
    halves = {"type": "checkerboard", "color0": 0.2, "color1": 0.8, "to_uv": [{"scale": [1.0, 0.5, 1.0]}]}
    size = {"sensors": (8, 7), "capture": {"laser_point": [0.0, 0.0]}}
    at = ((0.0, 0.0, 0.9), (0.0, 0.0, -1.0), (1.2, 1.0))
    kinds = (MIRROR, {"type": "conductor", "specular_reflectance": halves})
    plain, board = (third(Stage.of(flat_wall(plate(*at, kind), **size)))[0].sum(axis=-1) for kind in kinds)
    shares = (board / plain).reshape(7, 8)
    one, other = (0.2, 0.8) if shares[0, 0] < 0.5 else (0.8, 0.2)
    np.testing.assert_allclose(shares[:, :4], one, rtol=1e-6)
    np.testing.assert_allclose(shares[:, 4:], other, rtol=1e-6)


def test_half_matt_half_mirror_is_both() -> None:
    """The third bounce of a blend is its weighted parts, in either engine: no more, no less."""
    from nlosrender.engine.interface import Budget

    blend = {"type": "blendbsdf", "weight": 0.5, "a": GREY, "b": MIRROR}
    energies = {}
    for engine in ("path", "virtual_lights"):
        for name, bsdf in (("blend", blend), ("matt", GREY), ("mirror", MIRROR)):
            stage = Stage.of(flat_wall(plate(*TILTED, bsdf), engine=engine, spp=None, target_error=0.01))
            result = stage.engine.render(stage.batch, stage.engine.calibrate(Budget(target_error=0.01)))
            energies[engine, name] = result.mean.sum()
    mean = (energies["path", "matt"] + energies["virtual_lights", "matt"]) / 2
    for engine in ("path", "virtual_lights"):
        parts = (mean + energies[engine, "mirror"]) / 2
        assert math.isclose(energies[engine, "blend"], parts, rel_tol=0.01)


def test_a_spot_sends_the_light_of_its_points() -> None:
    """The third bounce of a spot is the mean over its points of the light of their images."""
    settings: dict[str, Any] = {"sensors": (7, 5), "bins": (1.5, 0.05, 60), "spp": 2**13}
    config = flat_wall(plate(*TILTED, MIRROR), capture={"laser_spot_radius": RADIUS}, **settings)
    found, stage = render(config, replicas=16), Stage.of(config)
    number = np.arange(2000) + 0.5
    place, turn = RADIUS * np.sqrt(number / 2000), number * math.pi * (3 - math.sqrt(5))
    disc = np.stack([place * np.cos(turn), place * np.sin(turn), 0 * turn], axis=-1)
    grid = found.capture.laser_grid
    points = SimpleNamespace(
        positions=grid.positions.reshape(3) + disc, normals=np.tile(grid.normals.reshape(3), (2000, 1))
    )
    legs = {"laser_legs": np.zeros(2000), "sensor_legs": found.capture.sensor_legs}
    capture: Any = SimpleNamespace(
        scan_type="exhaustive", laser_grid=points, sensor_grid=found.capture.sensor_grid, **legs
    )
    light = image_sum(triangles(stage, 0), np.zeros((0, 3, 3)), capture, found.time_axis).mean(axis=0)
    # 2000 points know the part of a disc that an edge leaves to about 1 / 2000^(3/4)
    assert_agrees(
        found.mean[0, -1, 0, 0].reshape(35, -1),
        found.variance[0, -1, 0, 0].reshape(35, -1),
        light,
        replicas=16,
        floor=0.005,
    )
    assert found.error_estimate < 0.02


@pytest.mark.parametrize("kinds", [("matt", "mirror"), ("pane", "matt"), ("mirror", "pane")])
def test_blends_of_white_bsdfs_are_white(kinds: tuple[str, str]) -> None:
    """Every sample of a blend of BSDFs that lose no light has weight 1; its parts come up as often as they weigh."""
    white = {"matt": {"type": "diffuse", "reflectance": 1.0}, "mirror": MIRROR, "pane": {"type": "thindielectric"}}
    parts = dict(zip("ab", (white[kind] for kind in kinds), strict=True))
    stage = Stage.of(flat_wall(plate(*TILTED, {"type": "blendbsdf", "weight": 0.3, **parts}), engine="path"))
    import drjit as dr
    import mitsuba as mi

    si, n = dr.zeros(mi.SurfaceInteraction3f), 1000
    si.wi = mi.Vector3f(0.6, 0, 0.8)
    number = (dr.arange(mi.Float, n) + 0.5) / n
    bsdf = stage.engine.built.hidden_shapes[0].bsdf()
    bs, weight = bsdf.sample(mi.BSDFContext(), si, number, mi.Point2f(0.3, 0.4))
    np.testing.assert_allclose(np.array(weight), 1, rtol=1e-5)
    second = int(bsdf.component_count() - (2 if kinds[1] == "pane" else 1))
    assert math.isclose((np.array(bs.sampled_component) >= second).mean(), 0.3, abs_tol=1.5 / n)


def test_blended_mirrors_have_their_share_before_and_after_what_is_matt() -> None:
    """Half a mirror over black halves the light that meets it once, whether on its way to a plate or back."""
    black = {"type": "diffuse", "reflectance": 0.0}
    half = {"type": "blendbsdf", "weight": 0.5, "a": black, "b": MIRROR}
    lit, at = (
        plate((-0.5, 0.0, 1.2), (0.3, 0.0, -1.0), (1.0, 1.0), 0.7),
        ((0.6, 0.0, 0.9), (-1.0, 0.0, -0.4), (0.9, 0.9)),
    )
    settings: dict[str, Any] = {"max_bounces": 4, "spp": 2**13, "bins": (0.0, 0.2, 40)}
    whole, part = (render(flat_wall(lit, plate(*at, kind), **settings), replicas=16) for kind in (MIRROR, half))
    energies, variances = (
        [values(one).sum() for one in (whole, part)]
        for values in (lambda one: one.bounce(4), lambda one: one.bounce_variance(4))
    )
    deviation = math.sqrt(variances[0] / 4 + variances[1])
    assert abs(energies[1] - energies[0] / 2) < 5 * deviation
    assert deviation < 0.01 * energies[1]


def box(length: float, end: Any) -> list[Scene]:
    """Return a room of 2 x 2 m and a ``length`` before the wall, from x = -1; its far end is made of ``end``."""
    x = length / 2 - 1
    sides = [plate((x, y, 1), (0, -y, 0), (2, length), 0.5) for y in (-1, 1)]
    sides += [plate((x, 0, 2), (0, 0, -1), (length, 2), 0.5), plate((-1, 0, 1), (1, 0, 0), (2, 2), 0.5)]
    return [*sides, plate((length - 1, 0, 1), (-1, 0, 0), (2, 2), end)]


POINTS = 4  # sensor points along each side of a room
ROOM = {"bins": (0.0, 0.2, 60), "max_bounces": None, "split_bounces": False}
SIDE = {"height": 2.0, "bsdf": {"type": "diffuse", "reflectance": 0.5}}


def mirror_room(**render: Any) -> Scene:
    """Return a room with a mirror wall, with light of all bounces."""
    own = {"sensors": (POINTS, POINTS), "wall": {**SIDE, "width": 2.0}, "capture": {"laser_point": [0.25, 0.0]}}
    return flat_wall(*box(2, MIRROR), **own, **ROOM, **render)


@cache
def unfolded_room() -> tuple[Array, Array]:
    """Return H (sensor y, x, bin) of it and its variance: the room and its image in one, lit by laser and image."""
    lasers = {"laser_grid": {"nx": 2, "ny": 1, "width": 3.0, "height": 2.0}}  # x = 1 - 0.75, 1 + 0.75
    both = {"scan": "exhaustive", "sensors": (2 * POINTS, POINTS), "wall": {**SIDE, "width": 4.0, "center": [1, 0, 0]}}
    unfolded = render(flat_wall(*box(4, 0.5), **both, capture=lasers, **ROOM, spp=20_000), replicas=16)
    mean, variance = (values[0, 0, 0, :, :, :POINTS].sum(axis=0) for values in (unfolded.mean, unfolded.variance))
    return mean, 2 * variance  # lasers share paths


@pytest.mark.parametrize("p_hidden_sampling", [0.5, 1.0])
def test_a_room_with_a_mirror_wall_is_one_of_twice_the_length(p_hidden_sampling: float) -> None:
    """Light of all bounces is that of the unfolded room, by either loop of the path engine."""
    folded = render(mirror_room(spp=20_000), p_hidden_sampling=p_hidden_sampling, replicas=16)
    (mean, variance), (light, own) = unfolded_room(), (folded.mean[0, 0, 0, 0], folded.variance[0, 0, 0, 0])
    assert_agrees(light, own, mean, replicas=16, reference_variance=variance, share=0.1)
    assert math.sqrt(own.sum() + variance.sum()) < 0.003 * mean.sum()


def test_virtual_lights_in_a_mirror_are_those_of_twice_the_length() -> None:
    """Patches, VPLs and their subpaths by way of a mirror give what the unfolded room does, bin by bin and in all."""
    settings: dict[str, Any] = {"engine": "virtual_lights", "spp": None, "target_error": 0.04}
    stage = Stage.of(mirror_room(**settings))
    assert stage.engine.further is not None
    from nlosrender.engine.interface import Budget

    lights = stage.repeated(stage.engine.calibrate(Budget(target_error=0.04)), range(6)).means[:, 0, 0, 0]
    mean, variance = (values.reshape(POINTS**2, -1) for values in unfolded_room())
    own = lights.var(axis=0, ddof=1) / 6
    # all points share patches, VPLs, and their errors: each alone
    for sums in (
        lambda values: values.sum(axis=(-1, -2)),
        lambda values: values.sum(axis=-2).reshape(*values.shape[:-2], 10, 6).sum(axis=-1),
    ):
        seeds, expected = sums(lights), sums(mean)
        deviation = np.sqrt(seeds.var(axis=0, ddof=1) / 6 + sums(variance))
        assert (np.abs(seeds.mean(axis=0) - expected) <= 6 * deviation + 0.002 * expected).all()
    assert np.sqrt(own.sum()) < 0.03 * np.linalg.norm(mean)


@pytest.mark.parametrize("grid", [0.0, 0.3])
def test_the_index_has_every_mirror_that_may_reflect(grid: float, tmp_path: Path) -> None:
    """Of 300 triangles all that the quick test allows, for points anywhere and lasers of a point or of a grid."""
    draw = np.random.default_rng(7)
    centres = draw.uniform([-0.8, -0.8, 0.3], [0.8, 0.8, 1.2], (300, 3))
    vertices = (centres[:, None] + draw.normal(0, 0.05, (300, 3, 3))).reshape(-1, 3)
    vertices = np.concatenate([vertices, [[0, 0, 0.05], [0.01, 0, 0.05], [0, 0.01, 0.05]]])  # at the laser, and open
    faces = np.arange(len(vertices)).reshape(-1, 3)
    name = write_uv_ply(tmp_path / "mirrors.ply", vertices, None, faces)
    mesh = {"type": "mesh", "filename": name, "normals": "flat", "bsdf": {"type": "twosided", "bsdf": MIRROR}}
    lasers = {"laser_grid": {"nx": 3, "ny": 2, "width": grid, "height": grid}} if grid else {}
    stage = Stage.of(flat_wall(mesh, scan="exhaustive" if grid else "single", capture=lasers), tmp_path)

    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.launch.flat_mirrors import FlatMirrors
    from nlosrender.engine.launch.mirror_index import lit_sphere

    built, capture = stage.engine.built, stage.engine.capture
    mirrors = FlatMirrors.of(built, lit_sphere(built, capture))
    box = built.scene.bbox()
    points = draw.uniform(np.ravel(box.min), np.ravel(box.max), (400, 3))
    begin, count = (np.array(x, dtype=int) for x in mirrors.index.near(mi.Point3f(points.T), mi.Bool(True)))
    listed = np.array(mirrors.index.mirrors)
    near = np.zeros((len(points), mirrors.n_mirrors), bool)
    for row, start, n in zip(near, begin, count, strict=True):
        row[listed[start : start + n]] = True
    pair = dr.arange(mi.UInt32, near.size)
    point = dr.gather(mi.Point3f, mi.Point3f(points.T), pair // mirrors.n_mirrors)
    found = 0
    for laser in capture.laser_grid.positions.reshape(-1, 3) / built.metres_per_engine_unit:
        may = np.array(mirrors.may_reflect(pair % mirrors.n_mirrors, point, mi.Point3f(*laser.tolist())))
        may = may.reshape(near.shape)
        assert not (may & ~near).any()
        found += may.sum()
    assert found > 100
    assert near.mean() < (0.9 if grid else 0.1)
