"""The retroreflector: its laws as a BSDF, and captures of it against quadrature and closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.agreement import assert_agrees, t_limit
from support.quadrature import (
    Array,
    Cells,
    Setup,
    confocal_third_bounces,
    grid_points,
    midpoints,
    rectangle_cells,
    third_bounces,
    unit,
)
from support.rendering import flat_wall, render
from support.views import REPLICAS, see, view_config

from nlosrender.engine.backend.start import start_backend

VARIANTS = [{}, {"colored": True}, {"polarized": True}]
CONSTANT = 1e-4  # of the albedo: 1.3e-5 by its table, 5e-5 by the quadrature where the horizon cuts cells


def concentration(width: float) -> float:
    """k of a lobe exp(-k (1 - cos)) that is one half at ``width`` degrees."""
    return float(np.log(2) / (1 - np.cos(np.radians(width))))


def retroreflector(width: float, albedo: Any = 0.6, diffuse: Any = 0.3) -> dict[str, Any]:
    return {"type": "retroreflector", "width": width, "albedo": albedo, "diffuse": diffuse}


def elevated(degrees: float) -> Array:
    e = np.radians(degrees)
    return np.array([0.6 * np.cos(e), 0.8 * np.cos(e), np.sin(e)])


def around(axis: Array, width: float, n: int) -> tuple[Array, Array]:
    """n^2 directions (n^2, 3) around an axis with the density of the lobe [1/sr] (n^2,)."""
    k = concentration(width)
    share, turn = (grid.ravel() for grid in np.meshgrid(midpoints(n), 2 * np.pi * midpoints(n)))
    share *= -np.expm1(-2 * k)
    below = -np.log1p(-share) / k  # 1 - cos
    x = unit(np.cross(axis, [0.3, -0.5, 0.8]))
    radius = np.sqrt(below * (2 - below))[:, None]
    sides = radius * (np.cos(turn)[:, None] * x + np.sin(turn)[:, None] * np.cross(axis, x))
    return sides + (1 - below)[:, None] * axis, k * (1 - share) / (2 * np.pi * -np.expm1(-2 * k))


def evaluated(bsdf: dict[str, Any], wi: Array, wo: Array) -> Array:
    """f cos_o (n, channels) of a BSDF, directions (n, 3) or (3,) in its own frame."""
    import drjit as dr
    import mitsuba as mi

    from nlosrender.scene.loading.materials import load_bsdf

    si = dr.zeros(mi.SurfaceInteraction3f, len(wo))
    si.wi = mi.Vector3f(np.broadcast_to(wi, wo.shape).T)
    value = load_bsdf(bsdf, "bsdf").eval(mi.BSDFContext(), si, mi.Vector3f(wo.T))
    return np.asarray(mi.unpolarized_spectrum(value), dtype=np.float64).reshape(-1, len(wo)).T


@pytest.mark.parametrize("width", [0.01, 0.5, 2.0, 10.0, 60.0])
def test_the_directional_albedo_is_the_stated_one_at_every_incidence(width: float) -> None:
    """A furnace: int f cos dwo = albedo + diffuse from the normal to grazing light, where half the lobe is cut off."""
    start_backend("llvm")
    for degrees in (90, 45, 10, min(3 * width, 60), width, width / 3, 1e-3):
        wi = elevated(degrees)
        wo, density = around(wi, width, 512)
        lobe = (evaluated(retroreflector(width, 0.6, 0.0), wi, wo)[:, 0] / density).mean()
        assert lobe == pytest.approx(0.6, rel=CONSTANT), degrees
    assert not evaluated(retroreflector(width), elevated(-50), wo * [1, 1, -1]).any()  # from behind: nothing


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_light_goes_the_other_way_as_well(variant: dict[str, bool]) -> None:
    """f(wi, wo) = f(wo, wi) for any pair and the nearest of pairs, in every variant, also from behind in twosided."""
    start_backend("llvm", **variant)
    rng = np.random.default_rng(1)
    bsdf = retroreflector(3.0, [0.2, 0.5, 0.9] if "colored" in variant else 0.7, 0.1)
    wi = unit(np.abs(rng.normal(size=(4096, 3))) + 1e-3)
    wo = unit(np.abs(wi + np.geomspace(1e-3, 3, 4096)[:, None] * rng.normal(size=wi.shape)) + 1e-3)
    one, other = evaluated(bsdf, wi, wo) / wo[:, 2:], evaluated(bsdf, wo, wi) / wi[:, 2:]
    np.testing.assert_allclose(one, other, rtol=1e-5)  # ten float32 roundings
    behind = np.array([1, 1, -1])
    both = {"type": "twosided", "bsdf": bsdf}
    np.testing.assert_array_equal(evaluated(both, behind * wi, behind * wo), evaluated(bsdf, wi, wo))
    assert (np.ptp(one, axis=1).max() > 0.1) == ("colored" in variant)


@pytest.mark.parametrize(("width", "degrees"), [(8.0, 50.0), (8.0, 3.0), (30.0, 20.0)])
def test_samples_have_their_density(width: float, degrees: float) -> None:
    """A chi-squared test of sample against pdf, far above the horizon and with half of the lobe below it."""
    start_backend("llvm")
    import mitsuba as mi
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    functions = BSDFAdapter("retroreflector", retroreflector(width), wi=mi.ScalarVector3f(elevated(degrees)))
    test = ChiSquareTest(SphericalDomain(), *functions, sample_dim=3, sample_count=400_000, ires=8)
    assert test.run(0.001), test.messages


@pytest.mark.parametrize("width", [0.01, 0.5, 8.0])
@pytest.mark.parametrize("parts", [(0.9, 0.0), (0.0, 0.9), (0.6, 0.3), (0.0, 0.0)])
def test_a_sample_weighs_its_value_over_its_density(width: float, parts: tuple[float, float]) -> None:
    """weight = eval / pdf, its mean is the albedo, and narrow lobes have samples at the stated angles."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    n, rng = 2**16, np.random.default_rng(3)
    bsdf, context = mi.load_dict(retroreflector(width, *parts)), mi.BSDFContext()
    for degrees in (70.0, 2 * width):
        si = dr.zeros(mi.SurfaceInteraction3f, n)
        si.wi = mi.Vector3f(elevated(degrees))
        lobe, x, y = (mi.Float(rng.integers(0, 2**24, n) * 2.0**-24) for _ in range(3))
        bs, weight = bsdf.sample(context, si, lobe, mi.Point2f(x, y))
        value, pdf = (np.ravel(item) for item in bsdf.eval_pdf(context, si, bs.wo))
        weight, wo = np.ravel(weight), np.array(bs.wo).T
        np.testing.assert_allclose(weight * np.ravel(bs.pdf), value, rtol=1e-6)
        np.testing.assert_array_equal(np.ravel(bs.pdf), pdf)
        assert abs(weight.mean() - sum(parts)) <= 5 * weight.std() / np.sqrt(n) + 2e-5
        if parts[1] == 0 and sum(parts) > 0:
            angle = np.linalg.norm(wo - elevated(degrees), axis=1)  # float32: 1e-7 of 1e-4
            inside = (angle < 2 * np.sin(np.radians(width) / 2)).mean()  # half of the lobe, but near the horizon
            assert degrees != 70 or inside == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(n) + 2e-3)


def test_textures_and_parts_of_it() -> None:
    """Albedo and diffuse share follow textures, diffuse giving way above 1; a context may ask for one of them."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    board = {"type": "checkerboard", "color0": 0.2, "color1": 0.9}
    bsdf = mi.load_dict(retroreflector(5.0, board, 0.4))
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.wi, si.uv = mi.Vector3f(0, 0, 1), mi.Point2f([0.25, 0.75], [0.25, 0.25])
    lobe, rest = (
        np.ravel(bsdf.eval(mi.BSDFContext(mi.TransportMode.Radiance, int(kind), part), si, mi.Vector3f(0, 0, 1)))
        for part, kind in enumerate((mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection))
    )
    assert lobe[1] / lobe[0] == pytest.approx(4.5, rel=1e-6)
    np.testing.assert_allclose(rest * np.pi, [0.4, 0.1], rtol=1e-6)


# Captures


def plate(width: float, size: float = 0.01, z: float = 1.0) -> dict[str, Any]:
    bsdf = retroreflector(width, 0.8, 0.1)
    return {"type": "rectangle", "width": size, "height": size, "center": [0, 0, z], "normal": [0, 0, -1], "bsdf": bsdf}


def brdf(width: float) -> Callable[[Cells, Array, Array], Array]:
    """f of that plate away from grazing light: h is its expansion, which is right to 2e-4 for 10 degrees."""
    k = concentration(width)

    def evaluate(cells: Cells, to_laser: Array, to_sensor: Array) -> Array:
        lobe = k / (2 * np.pi) * np.exp(-k / 2 * ((to_laser - to_sensor) ** 2).sum(axis=-1))
        for way in (to_laser, to_sensor):
            cosine = np.einsum("ij,ij->i", way, cells.normals)
            lobe = lobe * (1 + 3 / (16 * k) + 1 / (16 * k * cosine**2)) / np.sqrt(cosine)
        return 0.8 * lobe + 0.1 / np.pi

    return evaluate


IN_SHORT = [("single", 0.5, "virtual_lights"), ("confocal", 2.0, "virtual_lights"), ("single", 10.0, "path")]
AT_LENGTH = [(s, w, e) for s in ("single", "confocal") for w in (0.5, 2.0, 10.0) for e in ("path", "virtual_lights")]


@pytest.mark.parametrize(
    ("scan", "width", "engine"),
    [*IN_SHORT, *(pytest.param(*case, marks=pytest.mark.slow) for case in AT_LENGTH if case not in IN_SHORT)],
)
def test_a_plate_is_that_of_quadrature(scan: str, width: float, engine: str) -> None:
    """H per bin of a large plate, its laser in the middle and sensors up to two lobes away from it."""
    size = float(4 * np.radians(width))
    effort = {"spp": 8192} if engine == "path" else {"spp": None, "target_error": 3e-3}
    at = {"laser_point": [0.0, 0.0]} if scan == "single" else {}
    config = flat_wall(
        plate(width, 0.8), scan=scan, sensors=(3, 2), bins=(1.95, 0.05, 16), capture=at, engine=engine, **effort
    )
    config["capture"]["sensor_grid"] |= {"width": size, "height": size}
    result = render(config, **({"replicas": 32} if engine == "path" else {}))
    setup = Setup(rectangle_cells(0.8, 0.8, [0, 0, 1.0], [0, 0, -1.0]), 1.95 + 0.05 * np.arange(17), brdf=brdf(width))
    points = grid_points(3, 2, size, size)
    reference = (
        confocal_third_bounces(setup, points)
        if scan == "confocal"
        else third_bounces(setup, np.zeros((1, 1, 3)), points)
    )
    if engine == "path":
        assert_agrees(result.total, result.total_variance, reference, replicas=32, floor=2e-3)  # test_plate.py
    else:
        error = np.linalg.norm(result.total - reference) / np.linalg.norm(reference)
        assert error < 5e-3  # 3e-3 asked for, 2e-3 of the quadrature's own


def at_distances(width: float, radius: float) -> tuple[Array, Array, Array]:
    """Distances [m] of the small plate, energies of its bounce, their standard deviations."""
    distances = np.array([0.5, 1.0, 2.0])
    results = [
        render(
            flat_wall(
                plate(width, z=float(z)),
                scan="confocal",
                sensors=(1, 1),
                bins=(2 * float(z) - 0.1, 0.2, 1),
                capture={"laser_spot_radius": radius},
                spp=4096,
            ),
            replicas=32,
        )
        for z in distances
    ]
    variance = np.array([result.total_variance.sum() for result in results])
    return distances, np.array([result.total.sum() for result in results]), np.sqrt(variance)


def test_a_point_s_own_light_falls_with_the_fourth_power() -> None:
    """Laser and sensor a point, a small plate: H r^4 / A = f(w, w) / pi^2, a constant factor above a matt plate's.

    The lobe's footprint on the wall grows with r^2, and the point gets its share of that.
    """
    distances, energy, _ = at_distances(2.0, 0.0)
    k = concentration(2.0)
    peak = 0.8 * k / (2 * np.pi) * (1 + 1 / (4 * k)) ** 2 + 0.1 / np.pi
    # over 1 cm at 0.5 m: cos^3 / r^4 is less by 7/2 theta^2, of theta^2 = (0.01 / 0.5)^2 / 6 in the mean: 2.3e-4
    np.testing.assert_allclose(energy * distances**4, 1e-4 * peak / np.pi**2, rtol=4e-4)


def test_a_spot_s_own_light_falls_with_the_square() -> None:
    """A spot larger than the lobe's footprint gets back all that the plate sends: H = albedo A / (pi^3 R^2 r^2).

    H is the mean of A f / (pi^2 r^4) over the spot, and f over the spot is r^2 albedo (1 - exp(-k (1 - cos(R / r)))),
    beside the diffuse share's R^2. A matt plate's light falls with the fourth power, spot or no spot.
    """
    radius, width = 0.1, 0.5
    distances, energy, sigma = at_distances(width, radius)
    inside = 1 - np.exp(-concentration(width) * (1 - np.cos(np.arctan(radius / distances))))
    expected = 1e-4 / (np.pi**3 * radius**2 * distances**2) * (0.8 * inside + 0.1 * (radius / distances) ** 2)
    # cosines in the spot's diffuse light: 2 (R / r)^2 of its share of 0.125 (R / r)^2, 4e-4 at 0.5 m; the plate: 2.3e-4
    assert (np.abs(energy - expected) < 4.2 * sigma + 8e-4 * expected).all()  # t of 31 degrees of freedom: 2e-4
    assert (inside > 0.99).all()
    assert (sigma < 0.01 * energy).all()


def test_a_ball_lit_from_the_camera_is_a_flat_disc(tmp_path: Path) -> None:
    """From a Mitsuba scene: radiance I f cos / d^2 = I albedo k / (2 pi d^2) (1 + 3/(8k) + 1/(8k cos^2))."""
    width, eye, n = 2.0, 4.0, 64
    ball = """<scene version="3.0.0"><shape type="sphere"><bsdf type="twosided"><bsdf type="retroreflector">
        <float name="width" value="2"/><rgb name="albedo" value="0.4 0.4 0.8"/></bsdf></bsdf></shape></scene>"""
    (tmp_path / "ball.xml").write_text(ball, encoding="utf-8")
    lamp = {"type": "point", "position": [0, 0, eye], "intensity": 3.0}
    seen = {"scene": {"mitsuba": "ball.xml"}, "camera": {"fov_deg": 20}}
    config = view_config(emitters=[lamp], **seen, max_bounces=1, spp=4096)
    picture = see(config, folder=tmp_path).steady
    half = np.tan(np.radians(10))
    x, y = np.meshgrid(half * (2 * midpoints(5 * n) - 1), half * (2 * midpoints(3 * n) - 1) * 0.6)
    way = unit(np.stack([x, y, -np.ones_like(x)], axis=-1))
    closest = -eye * way[..., 2]
    d = closest - np.sqrt(1 - eye**2 + closest**2)
    cosine = -np.einsum("ijk,ijk->ij", way, np.array([0, 0, eye]) + d[..., None] * way)
    k = concentration(width)
    radiance = 3 * 0.4 * k / (2 * np.pi * d**2) * (1 + 3 / (8 * k) + 1 / (8 * k * cosine**2))
    expected = radiance.reshape(3, n, 5, n).mean(axis=(1, 3))
    assert np.ptp(cosine) > 0.3
    # 4096 samples of radiances within 10 % in a pixel deviate by 0.1 / sqrt(12 x 4096) = 4.5e-4; the expansion: 1e-5
    np.testing.assert_allclose(picture, expected * np.array([1, 1, 2])[:, None, None], rtol=2.3e-3)


def test_a_box_of_shining_retroreflectors_keeps_its_light() -> None:
    """Within walls of radiance 1 every bounce k has the radiance (albedo + diffuse)^k, in whatever direction."""
    shape = {"type": "cube", "flip_normals": True, "to_world": [{"scale": [5, 4, 6]}]}
    walls = {"type": "mitsuba", "shape": shape, "radiance": 1.0, "bsdf": retroreflector(5.0)}
    view = see(view_config(emitters=[walls], max_bounces=4, bins=(0.0, 100.0, 1), spp=16384))
    mean, variance = view.mean[0, ..., 0], view.variance[0, ..., 0]
    expected = 0.9 ** np.arange(5)[:, None, None]
    limit = t_limit(mean.size, REPLICAS - 1) * np.sqrt(variance) + 2e-5  # float32, and the table of h
    assert (np.abs(mean - expected) < limit).all()
    assert np.sqrt(variance.mean()) < 5e-3
