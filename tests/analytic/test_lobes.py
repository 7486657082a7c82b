"""Glossy surfaces in the gather: quadrature of a microfacet model of the test's own, and both engines per BSDF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.agreement import assert_agrees, relative_l2
from support.quadrature import (
    Array,
    Cells,
    Setup,
    confocal_third_bounces,
    grid_points,
    rectangle_cells,
    third_bounces,
)
from support.rendering import Rendering, flat_wall, render

from nlosrender.engine.backend.start import start_backend

NORMAL = [0.2, -0.1, -1.0]
PLACE = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0.1, -0.05, 0.6], "normal": NORMAL}
ETA, K = 1.4, 2.5
BINS = (1.0, 0.02, 90)
GRID = {"nx": 4, "ny": 3, "width": 0.5, "height": 0.4}  # around the points that see the lobe's middle
SETUP = {"bins": BINS, "spp": None, "engine": "auto", "color": "grey", "capture": {"sensor_grid": GRID}}
# Of 300 x 300 cells a bin's edges, 300 cells long, misplace sqrt(2 * 300 / 12) = 7 of about 4,500: 0.2 %. The narrowest
# lobe is 8 cells wide.
N_CELLS, QUADRATURE = 300, 2e-3


def ggx(alpha: float) -> Any:
    """Return the BRDF of a rough conductor: Walter et al. 2007, with Smith's shadowing and complex Fresnel terms."""

    def smith(cosine: Array) -> Array:
        return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)))

    def fresnel(cosine: Array) -> Array:
        index = complex(ETA, K)
        inside = np.sqrt(1 - (1 - cosine**2) / index**2)
        across = (cosine - index * inside) / (cosine + index * inside)
        along = (index * cosine - inside) / (index * cosine + inside)
        return (np.abs(across) ** 2 + np.abs(along) ** 2) / 2

    def brdf(cells: Cells, to_laser: Array, to_sensor: Array) -> Array:
        half = to_laser + to_sensor
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        at_laser, at_sensor, tilt = ((way * cells.normals).sum(axis=1) for way in (to_laser, to_sensor, half))
        density = alpha**2 / (np.pi * (tilt**2 * (alpha**2 - 1) + 1) ** 2)
        shadowing = smith(at_laser) * smith(at_sensor)
        return fresnel((half * to_laser).sum(axis=1)) * density * shadowing / (4 * at_laser * at_sensor)

    return brdf


@pytest.mark.parametrize(
    ("alpha", "scan"),
    [(0.02, "single"), (0.1, "confocal")]
    + [pytest.param(*more, marks=pytest.mark.slow) for more in ((0.02, "confocal"), (0.1, "single"), (0.3, "single"))],
)
def test_a_rough_metal_plate_is_gathered_to_its_target(alpha: float, scan: str) -> None:
    """`auto` takes virtual lights, the true error meets the target, and the stated one is within a factor of 2."""
    bsdf = {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "eta": ETA, "k": K}
    result = render(flat_wall(PLACE | {"bsdf": bsdf}, scan=scan, target_error=0.01, **SETUP))
    assert result.samples == 0
    setup = Setup(
        rectangle_cells(0.5, 0.4, PLACE["center"], NORMAL, n=N_CELLS),
        BINS[0] + BINS[1] * np.arange(BINS[2] + 1),
        brdf=ggx(alpha),
    )
    sensors = grid_points(4, 3, 0.5, 0.4)
    if scan == "confocal":
        truth = confocal_third_bounces(setup, sensors)
    else:
        truth = third_bounces(setup, np.array([[[0.3, -0.2, 0.0]]]), sensors)
    error = relative_l2(result.total - truth, truth)
    assert error < 0.01 + QUADRATURE
    assert error < 2 * result.error_estimate + QUADRATURE, (error, result.error_estimate)


LOBES: dict[str, dict[str, Any]] = {
    "rough plastic": {"type": "roughplastic", "alpha": 0.15, "diffuse_reflectance": 0.5},
    "plastic": {"type": "plastic", "diffuse_reflectance": 0.5},
    "principled": {"type": "principled", "base_color": 0.6, "roughness": 0.3, "metallic": 0.5},
    "brushed metal": {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4},
    "blend": {
        "type": "blendbsdf",
        "weight": 0.3,
        "first": {"type": "diffuse", "reflectance": 0.5},
        "second": {"type": "roughconductor", "alpha": 0.2},
    },
    "half a mirror": {
        "type": "blendbsdf",
        "weight": 0.5,
        "first": {"type": "diffuse", "reflectance": 0.5},
        "second": {"type": "conductor"},
    },
    "two sides": {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3}},
}


def engines(item: dict[str, Any], folder: Path | None = None) -> tuple[Rendering, Rendering]:
    """Render both ways: virtual lights at 0.2 %, and paths."""
    common = {"sensors": (3, 2), "bins": (1.0, 0.06, 30), "color": "grey"}
    lights = render(flat_wall(item, spp=None, engine="auto", target_error=0.002, **common), folder=folder)
    return lights, render(flat_wall(item, spp=2**15, **common), replicas=32, folder=folder)


def assert_engines_agree(lights: Rendering, paths: Rendering) -> None:
    """The third bounce per bin, per sensor point and in total: within the noise of paths and what lights state."""
    assert lights.samples == 0
    stated = lights.total_variance
    assert_agrees(paths.total, paths.total_variance, lights.total, replicas=32, reference_variance=stated, floor=0.01)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "blend" else pytest.mark.slow) for name in LOBES]
)
def test_both_engines_agree_on_every_lobe(name: str) -> None:
    """The third bounce per bin, per sensor point and in total, against the noise of paths."""
    lights, paths = engines(PLACE | {"bsdf": LOBES[name]})
    assert_engines_agree(lights, paths)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["normalmap", "bumpmap"])
def test_lobes_turn_with_a_map_of_normals(kind: str, tmp_path: Path) -> None:
    """A relief of waves turns the lobe from place to place."""
    start_backend("llvm")
    import mitsuba as mi

    waves = 0.1 * np.sin(2 * np.pi * np.arange(64) / 32)
    if kind == "normalmap":
        texels = np.stack([np.broadcast_to(0.5 + waves, (64, 64)), np.full((64, 64), 0.5), np.ones((64, 64))], axis=-1)
    else:
        texels = np.broadcast_to(0.2 * (waves + 0.1), (64, 64))[..., None]
    mi.Bitmap(np.ascontiguousarray(texels, np.float32)).write(str(tmp_path / "relief.exr"))
    relief = {"type": "bitmap", "filename": "relief.exr", "raw": True}
    nested = {"type": "roughconductor", "alpha": 0.3}
    bsdf = {"type": kind, ("normalmap" if kind == "normalmap" else "arbitrary"): relief, "bsdf": nested}
    lights, paths = engines(PLACE | {"bsdf": bsdf}, tmp_path)
    assert_engines_agree(lights, paths)


def test_lobes_follow_averaged_normals(tmp_path: Path) -> None:
    """A coarse bowl with normals of its own at the corners: the lobe turns across each facet."""
    grid = np.linspace(-0.25, 0.25, 5)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    lines = [f"v {a} {b} {1.5 * (a * a + b * b):.6f}" for a, b in zip(x, y, strict=True)]
    lines += [f"vn {3 * a} {3 * b} -1" for a, b in zip(x, y, strict=True)]
    for row in range(4):
        for column in range(4):
            k = 5 * row + column + 1
            lines += [f"f {i}//{i} {j}//{j} {m}//{m}" for i, j, m in ((k, k + 6, k + 1), (k, k + 5, k + 6))]
    (tmp_path / "bowl.obj").write_text("\n".join(lines) + "\n")
    item = {"type": "mesh", "filename": "bowl.obj", "translate": [0, 0, 0.7]}
    lights, paths = engines(item | {"bsdf": {"type": "roughconductor", "alpha": 0.15}}, tmp_path)
    assert_engines_agree(lights, paths)


def facing_plates(bsdf: dict[str, Any], *, turned: bool) -> tuple[dict[str, Any], ...]:
    """Return two plates that light each other; the first may turn its back to the wall."""
    normal = np.array([-0.7, 0.1, -0.7]) * (-1 if turned else 1)
    first = {"width": 0.6, "height": 0.5, "center": [0.25, 0, 0.6], "normal": normal.tolist()}
    second = {"width": 0.5, "height": 0.6, "center": [-0.25, 0.05, 0.55], "normal": [0.8, 0, -0.6]}
    return tuple({"type": "rectangle", "bsdf": bsdf} | place for place in (first, second))


FURTHER = [("plastic", "single", False)]
FURTHER_SLOWLY = [
    ("two sides", "confocal", True),
    ("principled", "single", False),
    ("two sides", "single", True),
    ("half a mirror", "confocal", False),
    ("half a mirror", "exhaustive", False),
    ("brushed metal", "confocal", False),
    ("blend", "exhaustive", False),
    ("rough plastic", "exhaustive", False),
]


@pytest.mark.parametrize(
    ("name", "scan", "turned"), FURTHER + [pytest.param(*more, marks=pytest.mark.slow) for more in FURTHER_SLOWLY]
)
def test_further_bounces_agree_on_every_lobe(name: str, scan: str, turned: bool) -> None:
    """VPLs and paths, bounce by bounce, in every sensor point's energy and in all of it."""
    plates = facing_plates(LOBES[name], turned=turned)
    common = {"scan": scan, "sensors": (3, 2), "bins": (0.8, 0.2, 20), "color": "grey", "max_bounces": 5}
    lights = render(flat_wall(*plates, spp=None, engine="auto", target_error=0.06, **common))
    paths = render(flat_wall(*plates, spp=2**13, **common))
    assert lights.samples > 0
    for bounce in (4, 5):
        energies = [result.bounce(bounce).sum(axis=-1) for result in (lights, paths)]
        sigma = np.sqrt(sum(result.bounce_variance(bounce).sum(axis=-1) for result in (lights, paths)))
        assert energies[1].sum() > 0
        assert (np.abs(energies[0] - energies[1]) <= 5 * sigma).all()
        # sensor points share VPLs: their errors may all have one sign
        assert abs(energies[0].sum() - energies[1].sum()) <= 4 * sigma.sum()


def test_laser_and_sensor_points_may_be_exchanged() -> None:
    """H(l, s) = H(s, l) per bin, to what is stated: neither cubature nor VPLs are the same from either side."""
    bsdf = {"type": "roughconductor", "alpha": 0.15}
    grid = {"nx": 3, "ny": 3, "width": 0.8, "height": 0.8}
    common = {"scan": "exhaustive", "bins": (1.0, 0.1, 20), "color": "grey", "spp": None, "target_error": 0.01}
    capture = {"sensor_grid": grid, "laser_grid": grid}
    result = render(flat_wall(PLACE | {"bsdf": bsdf}, engine="virtual_lights", capture=capture, **common))
    pairs = result.total.reshape(9, 9, -1)
    error = relative_l2(pairs - pairs.swapaxes(0, 1), pairs)
    assert 1e-6 < error < 2 * np.sqrt(2) * result.error_estimate


def test_linear_light_is_spread_over_bins_as_over_the_triangle() -> None:
    """Shares of light per bin where light is linear over a triangle, in any order of the corners, against cells."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.virtual_lights.gather.block_histogram import BLOCK
    from nlosrender.engine.virtual_lights.gather.delay_distribution import Delays, _DelayCdf

    n = 600
    u, v = ((np.stack(np.meshgrid(np.arange(n), np.arange(n))).reshape(2, -1)) + 0.5) / n
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)  # the square's other half, onto the triangle
    weights = np.stack([1 - u - v, u, v])
    light = [0.2, 1.9, 0.9]
    for delays in (
        [0.4, 2.7, 6.1],
        [6.1, 0.4, 2.7],
        [2.7, 6.1, 0.4],
        [1.5, 1.5, 3.2],
        [3.2, 1.0, 3.2],
        [2.7, 0.4, 6.1],
    ):
        shares = (
            np.bincount((np.array(delays) @ weights).astype(int), weights=np.array(light) @ weights, minlength=BLOCK)
            / n**2
        )
        cdf = _DelayCdf(Delays.of_triangle(mi.Vector3f(delays), mi.Vector3f(light)))
        fractions, end = cdf.bin_fractions(mi.Float(0))
        # a line of equal delay misplaces less than 2 n of n^2 / 2 cells by its cells' halves
        np.testing.assert_allclose([fraction[0] for fraction in fractions], shares, atol=2e-3)
        assert float(dr.slice(end)) == pytest.approx(1, abs=1e-5)


def test_the_mean_delay_of_a_patch_is_right_and_none_is_before_the_shortest_way() -> None:
    """Without the centre the mean is h^2 / (4 d) late."""
    start_backend("llvm")
    import mitsuba as mi

    from nlosrender.engine.virtual_lights.gather.delay_distribution import Delays, PatchDelays

    rng = np.random.default_rng(3)
    weights = rng.dirichlet([1, 1, 1], 400_000)
    corners = np.array([[-0.3, -0.2, 1.0], [0.3, -0.2, 0.9], [0.0, 0.4, 1.1]])
    centre = corners.mean(axis=0)
    for point in ([0.9, 0.1, 0.0], [0.0, 0.0, 0.0], [-0.2, -2.0, 0.0]):
        for size, share in ((1.0, 0.05), (0.5, 0.02)):
            ends = centre + size * (corners - centre)
            true, at_corners = (np.linalg.norm(points - point, axis=1) for points in (weights @ ends, ends))
            late = (weights @ at_corners - true).mean()
            on_device = [mi.Point3f(values) for values in (point, centre, *ends)]
            legs = PatchDelays.from_point(on_device[0], on_device[1], tuple(on_device[2:]), mi.Float(1))
            delays = Delays.of_patch(legs, None)
            mean = (delays.t0[0] + delays.t1[0] + delays.t3[0]) / 3
            assert abs(mean - true.mean()) < share * late
            assert delays.first[0] >= min(true.min(), at_corners.min()) - 1e-6
