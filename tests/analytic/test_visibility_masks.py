"""Visibility masks: where nothing is said to hide a point, nothing does, whatever lies around it.

Brute force in float64: every triangle against every segment from the wall to the point. What is said holds up to what
rays know: what lies in a plane with the point within RISE does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.rendering import flat_wall
from support.triangle_soup import hits, mesh_of, triangles_of, unit_normals
from support.varied_scenes import Stage

from nlosrender.engine.backend.start import start_backend

Array = NDArray[np.float64]
RECTANGLE = np.array([[-0.5, -0.4, 0.0], [0.5, 0.45, 0.0]])
ROW = np.array([[-0.5, 0.1, 0.0], [0.5, 0.1, 0.0]])
POINT = np.array([[0.1, -0.2, 0.0]])
MANY = 10**6  # sensor points share a mask
N_POINTS = 80
SPREAD, AIMED = 24, 48  # wall points per point: anywhere, and behind points of triangles

start_backend("llvm")


def soup(random: np.random.Generator, count: int = 60, size: float = 0.1, low: float = 0.2) -> Array:
    """Return triangles about as large as ``size``, anywhere over the wall."""
    return random.uniform([-0.6, -0.6, low], [0.6, 0.6, 1], (count, 1, 3)) + size * random.normal(size=(count, 3, 3))


def sheet(height: Callable[[Array, Array], Array], n: int = 6, half: float = 0.4) -> Array:
    """Return a square sheet of 2 n^2 triangles over the wall."""
    x, y = np.meshgrid(*[np.linspace(-half, half, n + 1)] * 2)
    p = np.stack([x, y, height(x, y)], axis=-1)
    a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
    return np.concatenate(
        [np.stack([a, b, c], axis=2).reshape(-1, 3, 3), np.stack([a, c, d], axis=2).reshape(-1, 3, 3)]
    )


def flat(z: float, n: int = 3, half: float = 0.4) -> Array:
    """Return a sheet along the wall."""
    return sheet(lambda x, y: np.full_like(x, z), n, half)


def slivers(random: np.random.Generator, width: float, count: int = 60) -> Array:
    """Return triangles about 0.5 long."""
    triangles = random.uniform([-0.5, -0.5, 0.3], [0.5, 0.5, 0.7], (count, 3, 3))
    triangles[:, 2] = triangles[:, :2].mean(axis=1) + width * random.normal(size=(count, 3))
    return triangles


def no_area(random: np.random.Generator) -> Array:
    """Return triangles among which are lines and points."""
    triangles = soup(random)
    triangles[::3, 2] = triangles[::3, 1]
    triangles[::6, 1:] = triangles[::6, :1]
    return triangles


def at_heights(random: np.random.Generator, heights: Array) -> Array:
    """Return triangles whose corners have ``heights`` (n, 3)."""
    triangles = soup(random, len(heights), 0.15)
    triangles[..., 2] = heights
    return triangles


SCENES: dict[str, Callable[[np.random.Generator], Array]] = {
    "soup": soup,
    "small triangles": lambda random: soup(random, 300, 0.03),
    "huge triangles": lambda random: random.uniform([-1, -1, 0.01], [1, 1, 1], (8, 3, 3)),
    "level with the points": lambda random: flat(0.5) + 0.02 * random.normal(size=(18, 1, 1)) * [0, 0, 1],
    "straddling": lambda random: at_heights(random, 0.5 + 0.05 * random.normal(size=(60, 3))),
    "bent": lambda random: sheet(lambda x, y: 0.8 - 0.9 * np.abs(np.abs(x) - 0.2) + 0.1 * y, 12),
    "waves": lambda random: sheet(lambda x, y: 0.6 + 0.1 * np.sin(14 * x) * np.cos(11 * y), 12),
    "double sheets": lambda random: np.concatenate([flat(0.6), flat(0.599)[:, ::-1], flat(0.60001), flat(0.5999995)]),
    "slivers": lambda random: slivers(random, 1e-3),
    "thinner slivers": lambda random: slivers(random, 3e-5, 20),
    "no area": no_area,
    "down to the wall": lambda random: at_heights(random, np.maximum(random.uniform(-0.2, 0.5, (20, 3)), 0)),
    "close to the wall": lambda random: at_heights(random, 10 ** random.uniform(-7, -0.3, (20, 3))),
    "very close": lambda random: at_heights(random, 10 ** random.uniform(-7, -3, (20, 3))),
    "through the wall": lambda random: at_heights(random, random.uniform(-0.3, 0.5, (12, 3))),
}
FROM_LESS = ("soup", "straddling", "down to the wall")  # scenes seen from less than a rectangle as well


def on_and_behind(triangles: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Return points on triangles, and just behind, all before the wall; and normals that look at it."""
    chosen = random.integers(len(triangles), size=N_POINTS)
    normals = unit_normals(triangles)[chosen]
    normals[~normals.any(axis=1)] = [0, 0, -1]
    normals *= np.where(normals[:, 2] > 0, -1, 1)[:, None]
    points = np.einsum("nk,nkx->nx", random.dirichlet([1, 1, 1], N_POINTS), triangles[chosen])
    behind = np.where(np.arange(N_POINTS) % 2, 10 ** random.uniform(-5.5, -1, N_POINTS), 0)
    points = (points - behind[:, None] * normals).astype(np.float32).astype(np.float64)
    is_before = points[:, 2] > 0
    return points[is_before], normals[is_before].astype(np.float32).astype(np.float64)


def vectors(kind: Any, values: Array) -> Any:
    """Bring vectors (n, 3) to the device."""
    return kind(np.ascontiguousarray(np.asarray(values, np.float32).T))


def masks_of(
    triangles: Array, points: Array, normals: Array, others: Array, wall_tiles: Any, planar: bool = True
) -> Any:
    """Return the masks (n,) of points."""
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.virtual_lights.visibility.masks import Surface, VisibilityMasks

    built: Any = SimpleNamespace(wall=SimpleNamespace(is_planar=planar), hidden_shapes=(mesh_of(triangles),))
    surface = Surface(vectors(mi.Point3f, points), vectors(mi.Vector3f, normals), vectors(mi.Vector3f, others))
    count = len(points)
    where, active = dr.zeros(mi.UInt32, count), dr.full(mi.Bool, True, count)
    return np.array(VisibilityMasks(built).of(surface, wall_tiles, where, active))


def wall_points(rectangle: Array, points: Array, triangles: Array, random: np.random.Generator) -> Array:
    """Return wall points (n, SPREAD + AIMED, 3): all over a rectangle, and such that something hides the points."""
    low, high = rectangle[:, :2].min(axis=0), rectangle[:, :2].max(axis=0)
    ends = np.zeros((len(points), SPREAD + AIMED, 3))
    ends[:, :, :2] = random.uniform(low, high, (*ends.shape[:2], 2))
    inner = triangles[random.integers(len(triangles), size=(len(points), AIMED))]
    hiding = np.einsum("nmk,nmkx->nmx", random.dirichlet([0.5] * 3, inner.shape[:2]), inner)
    depths = points[:, None, 2] - hiding[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        shadow = points[:, None] + (hiding - points[:, None]) * (points[:, None, 2] / depths)[..., None]
    is_inside = (depths > 0) & (shadow[..., :2] > low).all(axis=-1) & (shadow[..., :2] < high).all(axis=-1)
    ends[:, SPREAD:][is_inside] = shadow[is_inside]
    ends[..., 2] = 0
    return ends.astype(np.float32).astype(np.float64)


def assert_sound(
    triangles: Array,
    points: Array,
    normals: Array,
    masks: NDArray[np.uint64],
    ends: Array,
    bits: NDArray[np.uint64],
) -> tuple[int, int]:
    """Check what masks (n,) say of the ways from ``ends`` (n, m, 3), whose tiles have ``bits``, to the points.

    Returns
    -------
    tuple
        How many of these ways are not free, and how many are said to be.
    """
    from nlosrender.engine.virtual_lights.visibility.masks import MAX_RISE, RISE

    planes, n_hidden, n_open = unit_normals(triangles), 0, 0
    for k, point in enumerate(points):
        is_before = (ends[k] - point) @ normals[k] > 0
        start, is_open = ends[k][is_before], (masks[k] & bits[k][is_before]) > 0
        met = 1 - hits(start, np.broadcast_to(point, start.shape), triangles)
        rise = min(RISE * point[2], MAX_RISE)
        is_near = met * ((start - point) @ normals[k])[:, None] <= rise
        in_plane = np.abs(np.einsum("tx,tx->t", point - triangles[:, 0], planes)) <= rise
        hides = ~np.isnan(met) & ~is_near & ~in_plane
        assert not hides[is_open].any(), f"point {k} at {point}: hidden from an open tile"
        n_hidden += np.count_nonzero(hides.any(axis=1))
        n_open += np.count_nonzero(is_open)
    return n_hidden, n_open


@pytest.mark.parametrize(
    ("name", "rectangle"),
    [(name, RECTANGLE) for name in SCENES] + [(name, small) for name in FROM_LESS for small in (ROW, POINT)],
)
def test_nothing_hides_a_point_from_where_it_is_said_to_be_open(name: str, rectangle: Array) -> None:
    """Whichever planes the point is known to be seen before.

    Many ways are not free, so that a bound that rules out too much would be found.
    """
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.virtual_lights.visibility.masks import WallTiles

    random = np.random.default_rng(7)
    triangles = SCENES[name](random).astype(np.float32).astype(np.float64)
    points, own = on_and_behind(triangles, random)
    turned = own + 0.4 * random.normal(size=own.shape)
    turned = (turned / np.linalg.norm(turned, axis=1)[:, None]).astype(np.float32).astype(np.float64)
    wall_tiles = WallTiles.around([rectangle], MANY)
    n_hidden, n_open = 0, 0
    for normals, others in ((own, own), (own, turned), (turned, own)):  # flat, with shading normals, a cluster
        ends = wall_points(rectangle, points, triangles, random)
        masks = masks_of(triangles, points, normals, others, wall_tiles)
        index = dr.zeros(mi.UInt32, ends[..., 0].size)
        bits = np.array(wall_tiles.tile_bit(index, vectors(mi.Point3f, ends.reshape(-1, 3)))).reshape(ends.shape[:2])
        hidden, open_ = assert_sound(triangles, points, normals, masks, ends, bits)
        n_hidden, n_open = n_hidden + hidden, n_open + open_
    assert n_hidden > 100
    assert n_open > 50


ROUGH = {"type": "diffuse", "reflectance": 0.6}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "normal": [0, 0, -1], "bsdf": ROUGH}
FRONT, BEHIND = PLATE | {"center": [0.3, 0, 0.8]}, PLATE | {"center": [-0.3, 0, 1.0]}
LETTER = {"type": "letters", "text": "E", "height": 0.7, "center": [0.1, 0, 0.9], "normal": [0.3, -0.6, -1]} | {
    "thickness": 0.05,
    "bsdf": ROUGH,
}


def stage_of(*hidden: dict[str, Any], scan: str = "single", **more: Any) -> Stage:
    """Return a scene's engine, with masks however few sensor points there are, and the batch of all its points."""
    sensors = {"sensors": (7, 5)}
    stage = Stage.of(flat_wall(*hidden, scan=scan, engine="virtual_lights", spp=None, **(sensors | more)))
    return stage.tuned(min_mask_sensors=0)


def shadow_ray_targets(stage: Stage) -> Any:
    """Return the patches that the gather goes through."""
    return stage.engine.third.shadow_ray_targets(stage.batch, 0.5)


def sensor_points(stage: Stage) -> Array:
    """Return the sensor points (n, 3) [engine units], as float32 knows them."""
    points = stage.engine.capture.sensor_grid.positions.reshape(-1, 3) / stage.engine.built.metres_per_engine_unit
    return points.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("hidden", [(LETTER,), (FRONT, BEHIND)], ids=["letter", "two plates"])
def test_what_an_engine_says_of_its_patches_is_so(hidden: tuple[dict[str, Any], ...]) -> None:
    """The same of the patches of a scene and the sensor points' own tiles, in the gather's order."""
    stage = stage_of(*hidden, scan="confocal")
    lit, sensors = shadow_ray_targets(stage), sensor_points(stage)
    triangles = np.concatenate([triangles_of(shape) for shape in stage.engine.built.hidden_shapes])
    ends = np.broadcast_to(sensors, (len(lit.positions), *sensors.shape))
    bits = np.broadcast_to(lit.tiles, ends.shape[:2])
    n_hidden, n_open = assert_sound(triangles, lit.positions, lit.normals, lit.mask, ends, bits)
    assert n_hidden > 20
    assert n_open > 20


def is_open(lit: Any) -> NDArray[np.bool_]:
    """Return which patches are open to all tiles."""
    from nlosrender.engine.virtual_lights.visibility.masks import ALL_TILES

    return lit.mask == ALL_TILES


def test_the_foremost_plate_is_open_and_the_hidden_one_is_not() -> None:
    """Of two plates one behind the other."""
    stage = stage_of(FRONT, BEHIND | {"center": [0.3, 0, 1.0]}, scan="confocal")
    lit = shadow_ray_targets(stage)
    is_front = lit.positions[:, 2] * stage.engine.built.metres_per_engine_unit < 0.9
    assert is_open(lit)[is_front].all()
    assert not is_open(lit)[~is_front].any()


def test_a_two_sided_plate_is_open_in_front() -> None:
    """What lies behind its plane is no matter to wall points before it."""
    two_sided = {"type": "twosided", "nested": {"type": "diffuse"}}
    stage = stage_of(FRONT | {"bsdf": two_sided}, BEHIND)
    lit = shadow_ray_targets(stage)
    is_front = lit.positions[:, 2] * stage.engine.built.metres_per_engine_unit < 0.9
    assert is_front.any()
    assert is_open(lit)[is_front].all()


def test_a_convex_body_is_open_where_no_other_is_in_the_way() -> None:
    """The faces of two boxes beside one another that look at the wall; not all of those that look at each other."""
    box = {"type": "box", "size": [0.3, 0.4, 0.8], "bsdf": ROUGH}
    stage = stage_of(box | {"center": [-0.4, 0, 0.6]}, box | {"center": [0.4, 0, 0.6]}, scan="confocal")
    lit = shadow_ray_targets(stage)
    faces_wall = lit.normals[:, 2] < -0.9
    inner = lit.normals[:, 0] * lit.positions[:, 0] < -0.1
    assert is_open(lit)[faces_wall].all()
    assert inner.any()
    assert not is_open(lit)[inner].all()


def test_a_sphere_counts_by_its_box() -> None:
    """A plate before a sphere is open; behind a box that reaches over its plane it is not, and nor is the sphere."""
    for z, expected in ((1.2, True), (0.75, False)):
        stage = stage_of(FRONT | {"width": 0.3}, {"type": "sphere", "center": [0.0, 0, z], "radius": 0.2})
        lit = shadow_ray_targets(stage)
        in_plane = (
            np.abs(lit.positions[:, 2] * stage.engine.built.metres_per_engine_unit - 0.8) < 5e-6
        )  # rays end at an offset
        plate = in_plane & (lit.normals[:, 2] < -0.999)
        assert plate.any()
        assert is_open(lit)[plate].all() == expected


def test_a_screen_leaves_the_tiles_beside_its_shadow_open() -> None:
    """A screen over the left half of the way hides the point from the left tiles of the wall only."""
    from nlosrender.engine.virtual_lights.visibility.masks import COLUMN_TILES, TILES, WallTiles

    # from (0, 0, 1) the screen at half the height, from x = -0.3 to -0.02, hides x from -0.6 to -0.04
    screen = np.array([[[-0.3, -0.5, 0.5], [-0.02, -0.5, 0.5], [-0.02, 0.5, 0.5]]])
    screen = np.concatenate([screen, [[[-0.3, -0.5, 0.5], [-0.02, 0.5, 0.5], [-0.3, 0.5, 0.5]]]])
    down = np.array([[0.0, 0, -1]])
    wall_tiles = WallTiles.around([np.array([[-0.5, -0.4, 0], [0.5, 0.4, 0]])], MANY)
    beside = sum(COLUMN_TILES << column for column in range(TILES // 2, TILES))
    assert masks_of(screen, np.array([[0.0, 0, 1]]), down, down, wall_tiles)[0] == beside


def test_before_a_curved_wall_and_to_few_points_nothing_is_known() -> None:
    """All rays are traced, all the way."""
    from nlosrender.engine.virtual_lights.tuning import DEFAULT_TUNING
    from nlosrender.engine.virtual_lights.visibility.masks import ALL_TILES, WallTiles

    point, down = np.array([[0.0, 0, 0.5]]), np.array([[0.0, 0, -1]])
    far = flat(0.9)
    least = DEFAULT_TUNING.min_mask_sensors
    many, few = (WallTiles.around([RECTANGLE], count) for count in (least, least - 1))
    assert masks_of(far, point, down, down, many)[0] == ALL_TILES
    assert not masks_of(far, point, down, down, many, planar=False).any()
    assert not masks_of(far, point, down, down, few).any()


def test_nothing_is_known_of_points_behind_the_wall_or_in_it() -> None:
    """Rays find the wall itself there."""
    from nlosrender.engine.virtual_lights.visibility.masks import WallTiles

    points, down = np.array([[0.0, 0, -0.1], [0, 0, 0]]), np.array([[0.0, 0, -1], [0, 0, -1]])
    assert not masks_of(flat(0.9), points, down, down, WallTiles.around([RECTANGLE], MANY)).any()
