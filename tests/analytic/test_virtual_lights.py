"""The virtual-light engine against quadrature, against the path engine, and piece by piece."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import assert_agrees, relative_l2
from support.quadrature import (
    Setup,
    clear_of_rectangle,
    confocal_third_bounces,
    grid_points,
    joined,
    rectangle_cells,
    sphere_cells,
    third_bounces,
)
from support.rendering import Rendering, configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

pytestmark = pytest.mark.usefixtures("backend")

PLATE = {
    "type": "rectangle",
    "width": 0.8,
    "height": 0.6,
    "center": [0.15, -0.1, 0.6],
    "normal": [0.2, -0.1, -1.0],
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
SCREEN = {
    "type": "rectangle",
    "width": 0.25,
    "height": 0.3,
    "center": [0.3, 0.0, 0.35],
    "bsdf": {"type": "diffuse", "reflectance": 0.0},
}
BALL = {"type": "sphere", "center": [0.1, -0.1, 0.8], "radius": 0.3, "bsdf": {"type": "diffuse", "reflectance": 0.7}}
TUBE = {
    "type": "cylinder",
    "center": [-0.35, 0.2, 0.7],
    "axis": [0.3, 1.0, 0.2],
    "radius": 0.15,
    "height": 0.5,
    "bsdf": {"type": "diffuse", "reflectance": 0.7},
}
BINS = (0.6, 0.02, 160)
EDGES = 0.6 + 0.02 * np.arange(161)
LASERS = {"single": np.array([[[0.3, -0.2, 0.0]]]), "exhaustive": grid_points(2, 3, 1.5, 1.2)}
SENSORS = grid_points(5, 3, 2.0, 1.6)


def start(config: dict):
    """Return the built scene, the capture, the time axis, the plan and the engine that a configuration leads to."""
    validated = configured(config)
    backend = start_backend("llvm", colored=validated.is_colored)
    built = stages.load_scene(validated)
    capture, time_axis = stages.describe_capture(validated, built.wall, built)
    return built, capture, time_axis, *stages.prepare(validated, backend, built, capture, time_axis)


def gathered(*hidden: dict, scan: str = "single", error: float = 0.01, **more) -> tuple[np.ndarray, float, object]:
    """Return H (ly, lx, sy, sx, bin) of all bounces, the estimated relative error, and the engine that rendered."""
    from nlosrender.engine.interface import Budget

    config = flat_wall(*hidden, scan=scan, bins=BINS, spp=None, target_error=error, engine="virtual_lights", **more)
    _, capture, _, plan, engine = start(config)
    assert engine.name == "virtual_lights"
    (batch,) = plan.batches
    histogram = engine.render(batch, Budget(target_error=error))
    lasers = (1, 1) if scan == "confocal" else (capture.laser_grid.ny, capture.laser_grid.nx)
    shape = (*lasers, capture.sensor_grid.ny, capture.sensor_grid.nx, -1)
    estimate = np.sqrt(histogram.variance.sum() / (histogram.mean**2).sum())
    return histogram.mean.sum(axis=(0, 1)).reshape(shape), float(estimate), engine


def reference(setup: Setup, scan: str) -> np.ndarray:
    """Return the quadrature of a scan."""
    return confocal_third_bounces(setup, SENSORS) if scan == "confocal" else third_bounces(setup, LASERS[scan], SENSORS)


def assert_honest(result: np.ndarray, estimate: float, truth: np.ndarray, *, target: float, floor: float) -> None:
    """The estimate meets the target, and the true error is within twice the estimate, beyond the truth's own error."""
    error = relative_l2(result - truth, truth)
    assert estimate <= target
    assert error <= 2 * estimate + floor, f"true error {error:.4f}, estimated {estimate:.4f}"


# 700 x 700 cells: an iso-delay strip of a 2 cm bin is about 9 cells wide and 700 long; its two edges misplace
# sqrt(2 * 700 / 12) = 11 of 6000 cells, 0.2 %.
QUADRATURE = {"single": 2e-3, "confocal": 2e-3, "exhaustive": 5e-3}  # exhaustive: 350 x 350 cells, for time
CELLS = {"single": 700, "confocal": 700, "exhaustive": 350}


@pytest.mark.parametrize(
    "scan", ["single", *(pytest.param(scan, marks=pytest.mark.slow) for scan in ("confocal", "exhaustive"))]
)
def test_a_plate_meets_the_target_error_and_says_so(scan: str) -> None:
    """H per bin of a tilted plate, for every scan type, at 1 %."""
    truth = reference(
        Setup(rectangle_cells(0.8, 0.6, PLATE["center"], PLATE["normal"], n=CELLS[scan]), EDGES, rho=0.7), scan
    )
    result, estimate, engine = gathered(PLATE, scan=scan)
    assert_honest(result, estimate, truth, target=0.01, floor=QUADRATURE[scan])
    assert not engine.settings.needs_visibility


@pytest.mark.parametrize("scan", ["single", pytest.param("confocal", marks=pytest.mark.slow)])
def test_a_sphere_is_round(scan: str) -> None:
    """H per bin of a sphere: its patches have the true area and the true normals."""
    truth = reference(Setup(sphere_cells(BALL["center"], 0.3, n=CELLS[scan]), EDGES, rho=0.7), scan)
    result, estimate, _ = gathered(BALL, scan=scan)
    # front-facing quadrature hides the back of a sphere: a convex body needs no visibility test
    assert_honest(result, estimate, truth, target=0.01, floor=2 * QUADRATURE[scan])


@pytest.mark.parametrize(
    "scan", ["single", *(pytest.param(scan, marks=pytest.mark.slow) for scan in ("confocal", "exhaustive"))]
)
def test_shadow_edges_converge(scan: str) -> None:
    """A black screen hides parts of the plate from laser and sensor points; partly hidden patches count in part."""
    cells = rectangle_cells(0.8, 0.6, PLATE["center"], PLATE["normal"], n=CELLS[scan])
    hidden = clear_of_rectangle(SCREEN["center"], (0, 0, -1), 0.25, 0.3)
    truth = reference(Setup(cells, EDGES, rho=0.7, visible=hidden), scan)
    result, estimate, engine = gathered(PLATE, SCREEN, scan=scan, error=0.02)
    assert engine.settings.needs_visibility
    assert_honest(result, estimate, truth, target=0.02, floor=2 * QUADRATURE[scan])
    assert result.sum() == pytest.approx(truth.sum(), rel=5e-3)


def test_two_surfaces_add_up() -> None:
    """Light of separate surfaces that do not hide each other is the sum of theirs."""
    ball = BALL | {"center": [-0.5, 0.3, 0.6], "radius": 0.15}
    cells = joined(
        rectangle_cells(0.8, 0.6, PLATE["center"], PLATE["normal"], n=700), sphere_cells(ball["center"], 0.15, n=300)
    )
    behind = [0.15, -0.1, 0.6]
    truth = reference(Setup(cells, EDGES, rho=0.7), "single")
    result, estimate, _ = gathered(PLATE | {"center": behind}, ball)
    # the ball hides a little of the plate from the outermost sensor points; the energies differ by less than that
    assert result.sum() == pytest.approx(truth.sum(), rel=0.02)
    assert estimate <= 0.01


def test_legs_and_start_shift_the_gather_as_they_shift_paths() -> None:
    """Legs that are no whole number of bins and a window that does not start at 0: both engines agree per bin."""
    capture = {
        "account_first_and_last_bounces": True,
        "laser_position": [-0.5, 0, 0.25],
        "sensor_position": [0.4, 0.3, 1.1],
    }
    config = flat_wall(PLATE, capture=capture, bins=(1.5, 0.04, 100), spp=16384)
    paths = render(config, replicas=32)
    from nlosrender.engine.interface import Budget

    _, _, _, plan, engine = start(config | {"render": {"max_bounces": 3, "engine": "virtual_lights"}})
    histogram = engine.render(plan.batches[0], Budget(target_error=0.002))
    lights = histogram.mean.sum(axis=(0, 1)).reshape(paths.total.shape)
    assert_agrees(paths.total, paths.total_variance, lights, replicas=32, floor=0.01)


@pytest.mark.parametrize("max_bounces", [5, pytest.param(None, marks=pytest.mark.slow)])
def test_further_bounces_come_on_top(max_bounces: int | None) -> None:
    """With interreflections both engines agree bounce by bounce."""
    scene = (PLATE, BALL | {"center": [-0.45, 0.2, 0.7], "radius": 0.25})
    config = flat_wall(*scene, bins=(0.6, 0.08, 80), spp=60000, max_bounces=max_bounces)
    paths: Rendering = render(config, replicas=32)
    from dataclasses import replace

    from nlosrender.engine.interface import Budget

    _, _, _, plan, engine = start(config | {"render": {"max_bounces": max_bounces, "engine": "virtual_lights"}})
    # bins share VPLs: their sums err by more than the bins tell, 4 % of bounce 5 in one round
    budget = replace(engine.calibrate(Budget(target_error=0.005)), rounds=64)
    histogram = engine.render(plan.batches[0], budget)
    for bounce in range(3, paths.bounces.n_slots + 2):
        slot = paths.bounces.slot(bounce)
        ours = histogram.mean[0, slot].reshape(paths.bounce(bounce).shape)
        theirs, noise = paths.bounce(bounce), paths.bounce_variance(bounce)
        own_noise = 0.0 if bounce == 3 else histogram.variance[0, slot].reshape(noise.shape)
        assert_agrees(
            theirs,
            noise,
            ours,
            replicas=32,
            reference_variance=own_noise,
            floor=0.01,
            share=0.2,
        )


def test_leaving_out_visibility_rays_changes_nothing() -> None:
    """Before a planar wall nothing hides a convex object from it: with and without rays H is the same."""
    from dataclasses import replace

    from nlosrender.engine.interface import Budget

    config = flat_wall(BALL, bins=BINS, spp=None, target_error=0.02, engine="virtual_lights")
    results = []
    for rays in (False, True):
        _, _, _, plan, engine = start(config)
        engine.settings = replace(engine.settings, needs_visibility=rays)
        results.append(engine.render(plan.batches[0], Budget(target_error=0.02)).mean)
    # grazing rays may be cut by their own surface: 1e-4 of the way is cut off each ray, and weights vanish there
    assert relative_l2(results[1] - results[0], results[0]) < 1e-3


@pytest.mark.parametrize(
    ("hidden", "free"),
    [
        ([PLATE], True),
        ([BALL], True),
        ([{"type": "box", "center": [0, 0, 1], "size": [0.3, 0.2, 0.1], "rotate_deg": [10, 20, 30]}], True),
        ([BALL | {"inside": True}], False),
        ([{"type": "letters", "text": "Z", "height": 0.8, "center": [0, 0, 1]}], True),
        ([{"type": "letters", "text": "Z", "height": 0.8, "thickness": 0.1, "center": [0, 0, 1]}], False),
        ([PLATE, SCREEN], False),
        ([{"type": "room", "size": [2, 2, 2]}], True),
        ([PLATE | {"bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}], False),
    ],
)
def test_rays_are_left_out_exactly_where_nothing_can_hide(hidden: list[dict], free: bool) -> None:
    """One convex object alone: a flat letter is one plane, a thick one hides parts of itself, a room is seen whole."""
    from nlosrender.engine.launch.occlusion import nothing_occludes

    built, *_ = start(flat_wall(*hidden))
    assert nothing_occludes(built) == free


@pytest.mark.parametrize("patch_scale", [1.0, 0.3])
def test_patches_cover_every_surface_once(patch_scale: float) -> None:
    """However fine, the areas of the patches add up to those of the surfaces, and their sizes stay below the limit."""
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator

    built, capture, *_ = start(flat_wall(PLATE, BALL))
    tessellator = Tessellator(built, capture, 0.02 / built.metres_per_engine_unit)
    patches = tessellator.patches(patch_scale)
    assert patches.areas.sum() * built.metres_per_engine_unit**2 == pytest.approx(
        0.8 * 0.6 + 4 * np.pi * 0.3**2, rel=1e-6
    )
    assert len(patches) == tessellator.count(patch_scale)
    edges = np.linalg.norm(patches.corners - np.roll(patches.corners, 1, axis=1), axis=-1).max(axis=1)
    assert (edges <= 1.1 * patch_scale * patches.centres[:, 2]).all()  # 1.1: a sphere's parts are not all alike
    on_ball = patches.primitives == 0
    assert np.linalg.norm(patches.normals, axis=1) == pytest.approx(1.0)
    assert on_ball.any()


# whole blocks of bins, a part of one, more than one; windows that begin after the light or end before it
WINDOWS = [(8, 0), (11, 2), (40, 9), (13, -3), (5, -2), (7, -40), (6, 50)]


def spread_shares(delays: tuple[float, ...], is_cluster: bool | None, n_bins: int, whole: int) -> NDArray[np.float64]:
    """Return the shares of the bins, and what is outside, of a patch with ``delays`` at its corners, times 2."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.launch.histogram import HistogramShape
    from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram
    from nlosrender.engine.virtual_lights.gather.delay_distribution import Delays, PatchDelays, deposit_patch

    histogram = BlockHistogram(HistogramShape(1, 1, 1, 1, 1, n_bins), np.zeros(1, np.int64))
    # opaque: one kernel per window serves all
    corners = [dr.opaque(mi.Float, delay) for delay in (*delays, 0.0)[:4]]
    # a plane far away: the linear delay is right on average
    middle = dr.opaque(mi.Float, float(np.mean(delays[:4] if is_cluster else delays[:3])))
    is_parallelogram = None if is_cluster is None else dr.opaque(mi.Bool, is_cluster)
    covered = Delays.of_patch(PatchDelays(mi.Vector4f(*corners), middle), is_parallelogram)
    zero = mi.UInt32(0)
    deposit_patch(histogram, zero, zero, covered, dr.opaque(mi.Int32, whole), mi.Spectrum(2.0), mi.Bool(True))
    return histogram.on_host().ravel()


def triangle_share_before(time: np.ndarray, delays: tuple[float, ...]) -> np.ndarray:
    """Return the part of a triangle whose delay, linear between its corners', is less than ``time``."""
    a, b, c = sorted(delays)
    if a == c:
        return (time > a).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        rising, falling = (time - a) ** 2 / ((b - a) * (c - a)), 1 - (c - time) ** 2 / ((c - b) * (c - a))
    return np.select([time <= a, time < b, time < c], [0.0, rising, falling], 1.0)


def parallelogram_share_before(time: np.ndarray, delays: tuple[float, ...]) -> np.ndarray:
    """Return the part of a parallelogram whose delay is less than ``time``: the linear one nearest to its corners'.

    The delay is a sum of two uniform numbers, one along each side.
    """
    sides = np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1]])
    base, along, across = np.linalg.lstsq(sides, np.array(delays), rcond=None)[0].round(9)
    time = time - base - min(along, 0) - min(across, 0)
    p, q = abs(along), abs(across)
    if p * q > 0:
        return sum(sign * np.maximum(time - x, 0) ** 2 for sign, x in ((1, 0), (-1, p), (-1, q), (1, p + q))) / (
            2 * p * q
        )
    return np.clip(time / (p + q), 0, 1) if p + q > 0 else (time > 0).astype(float)


@pytest.mark.parametrize("among_clusters", [False, True])
@pytest.mark.parametrize(
    "delays",
    [(3.2, 3.4, 3.9), (2.0, 2.0, 6.5), (0.7, 5.1, 5.1), (4.25, 4.25, 4.25), (0.1, 2.9, 7.3), (1.5, 9.0, 26.5)],
)
@pytest.mark.parametrize(("n_bins", "whole"), WINDOWS)
def test_a_triangle_is_spread_over_its_bins_by_area(
    delays: tuple[float, float, float], n_bins: int, whole: int, among_clusters: bool
) -> None:
    """The share of each bin is the part of the triangle whose (linear) delay falls into it; the rest is outside."""
    corners = (delays[1], delays[0], delays[2])
    if among_clusters:
        shares = spread_shares((*corners, 99.0), False, n_bins, whole)
    else:
        shares = spread_shares(corners, None, n_bins, whole)
    expected = np.diff(triangle_share_before(np.arange(n_bins + 1.0) - whole, delays))
    assert shares[:-1] == pytest.approx(2 * expected, abs=1e-5)  # float32
    assert shares.sum() == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize(
    "delays",
    [
        (3.2, 3.4, 3.9, 3.7),
        (2.0, 6.5, 6.5, 2.0),  # the delay varies along one side only
        (4.25, 4.25, 4.25, 4.25),
        (9.5, 1.5, 18.5, 26.5),
        (5.0, 2.0, 5.0, 8.0),  # both sides alike: no flat part
        (1.0, 3.1, 8.0, 5.0),  # not linear: the best linear function is
    ],
)
@pytest.mark.parametrize(("n_bins", "whole"), WINDOWS)
def test_a_parallelogram_is_spread_over_its_bins_by_area(
    delays: tuple[float, float, float, float], n_bins: int, whole: int
) -> None:
    """The share of each bin is the part whose delay falls into it: the linear one nearest to the corners' delays."""
    shares = spread_shares(delays, True, n_bins, whole)
    expected = np.diff(parallelogram_share_before(np.arange(n_bins + 1.0) - whole, delays))
    assert shares[:-1] == pytest.approx(2 * expected, abs=1e-5)  # float32
    assert shares.sum() == pytest.approx(2.0, rel=1e-6)


@pytest.mark.parametrize(
    ("hidden", "render_keys", "engine"),
    [
        ([PLATE], {}, "virtual_lights"),
        ([PLATE], {"engine": "path"}, "path"),
        ([PLATE], {"spp": 64}, "path"),
        ([PLATE], {"hidden_geometry_sampling": False}, "path"),
        ([PLATE], {"max_bounces": 2}, "path"),
        ([], {}, "path"),
        ([PLATE | {"bsdf": {"type": "conductor"}}], {"engine": "virtual_lights"}, "virtual_lights"),
        ([PLATE | {"bsdf": {"type": "dielectric"}}], {"engine": "virtual_lights"}, "path"),
        ([PLATE | {"bsdf": {"type": "roughconductor", "alpha": 0.4}}], {}, "virtual_lights"),
        ([{"type": "room", "size": [2, 2, 2]}], {}, "virtual_lights"),
        ([PLATE | {"center": [0.0, 0.0, 0.0], "normal": [1, 0, 0]}], {}, "virtual_lights"),
        ([BALL | {"center": [0.0, 0.0, 0.3]}], {}, "path"),
        ([PLATE], {"engine": "virtual_lights", "wall": {"type": "plastic"}}, "path"),
        ([TUBE], {}, "virtual_lights"),
        ([{"type": "mitsuba", "shape": {"type": "disk"}}], {}, "path"),
    ],
)
def test_auto_takes_the_cheapest_engine_that_is_right(hidden: list[dict], render_keys: dict, engine: str) -> None:
    """What the gather cannot do goes to the path engine, also when the gather was asked for."""
    config = flat_wall(*hidden)
    wall = render_keys.get("wall", {"type": "diffuse"})
    config["scene"]["relay_wall"]["bsdf"] = wall
    config["render"] = {"max_bounces": 3} | {key: value for key, value in render_keys.items() if key != "wall"}
    assert start(config)[-1].name == engine


@pytest.mark.parametrize(
    ("scan", "inside"),
    [("single", True), ("confocal", False)]
    + [pytest.param(*more, marks=pytest.mark.slow) for more in (("single", False), ("confocal", True))],
)
def test_a_cylinder_is_round(scan: str, inside: bool) -> None:
    """A tilted cylinder without caps before a plate, seen from outside or through its ends: both engines agree."""
    scene = (PLATE | {"center": [0.15, -0.1, 0.9]}, TUBE | {"inside": inside})
    keys = {"bins": (0.6, 0.08, 80)}
    paths = render(flat_wall(*scene, scan=scan, spp=30000, **keys), replicas=32)
    lights = render(flat_wall(*scene, scan=scan, spp=None, engine="virtual_lights", target_error=0.003, **keys))
    # 0.01 of the peak: three times the error asked for, concentrated in one bin
    assert_agrees(paths.total, paths.total_variance, lights.total, replicas=32, floor=0.01)


def test_a_time_limit_that_the_gather_uses_up_still_gives_all_bounces() -> None:
    """What is left of the time may be nothing: the further bounces then get their shortest run."""
    from nlosrender.engine.interface import Budget
    from nlosrender.engine.launch.passes import Passes

    config = flat_wall(PLATE, BALL) | {"render": {"max_bounces": 5, "engine": "virtual_lights", "time_limit_s": 1e-6}}
    _, _, _, plan, engine = start(config)
    shares: list[float] = []
    histogram = engine.render(plan.batches[0], Budget(time_limit_s=1e-6), Passes(shares.append))
    assert (histogram.mean.sum(axis=(0, 2, 3, 4))[1:] > 0).all()
    assert all(0 <= share <= 1 for share in shares)


def test_what_the_wall_cannot_see_sends_nothing() -> None:
    """A plate behind the wall, and one that faces away from it: bounces 3 to 5 and their variances are zero."""
    plate = {"type": "rectangle", "width": 1.0, "height": 0.8, "normal": [0, 0, 1]}
    for depth in (-0.5, 0.5):
        shown = render(
            flat_wall(
                plate | {"center": [0, 0, depth]}, engine="virtual_lights", max_bounces=5, spp=None, target_error=0.05
            )
        )
        assert not shown.mean.any()
        assert not shown.variance.any()
