"""Materials: third bounces against quadrature that asks the BSDF itself, and images in mirrors and through glass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.agreement import assert_agrees
from support.quadrature import (
    Array,
    Cells,
    Frame,
    Setup,
    grid_points,
    midpoints,
    rectangle_cells,
    third_bounce,
    third_bounces,
)
from support.rendering import flat_wall, render

from nlosrender.engine.backend.start import start_backend

REPLICAS = 32
QUADRATURE = 2e-3  # as derived in test_plate.py
NORMAL = [0.2, -0.1, -1.0]
PLACE = {"width": 0.8, "height": 0.6, "center": [0.15, -0.1, 0.6], "normal": NORMAL}
CELLS = rectangle_cells(0.8, 0.6, PLACE["center"], NORMAL)
BINS = (0.9, 0.05, 48)
EDGES = 0.9 + 0.05 * np.arange(49)
LASER = np.array([[[0.3, -0.2, 0.0]]])
SENSORS = grid_points(3, 2, 2.0, 1.6)
METAL = {"type": "roughconductor", "alpha": 0.25, "distribution": "ggx", "eta": 1.4, "k": 2.5}
PLASTIC = {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": 0.4, "int_ior": 1.5}


def plate(bsdf: Mapping[str, Any], **place: Any) -> dict:
    return {"type": "rectangle", **PLACE, "bsdf": dict(bsdf), **place}


def scene(hidden: dict, **changes: Any) -> dict:
    return flat_wall(hidden, **({"sensors": (3, 2), "bins": BINS, "spp": 32768} | changes))


def bsdf_values(bsdf: Mapping[str, Any], frame: Frame) -> Callable[[Array, Array, Array], Array]:
    """f(uv, to viewer, to light) of a Mitsuba BSDF on a plane, directions (n, 3) in the scene; grey."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    loaded = mi.load_dict(dict(bsdf))
    axes = np.stack([frame.x, frame.y, frame.normal], axis=-1)

    def evaluate(uv: Array, viewer: Array, light: Array) -> Array:
        si = dr.zeros(mi.SurfaceInteraction3f, len(light))
        viewer, light = (np.broadcast_to(way, light.shape) @ axes for way in (viewer, light))
        si.wi, si.uv = mi.Vector3f(viewer.T), mi.Point2f(np.broadcast_to(uv, (len(light), 2)).T)
        value = np.asarray(loaded.eval(mi.BSDFContext(), si, mi.Vector3f(light.T)), dtype=np.float64).reshape(-1)
        return value / np.maximum(light[:, 2], 1e-6)  # Mitsuba's eval has the cosine in it

    return evaluate


def on_plate(bsdf: Mapping[str, Any]) -> Callable[[Cells, Array, Array], Array]:
    values = bsdf_values(bsdf, Frame.of(NORMAL))
    return lambda cells, to_laser, to_sensor: values(cells.uv, to_sensor, to_laser)


@pytest.mark.parametrize("hidden_geometry_sampling", [True, False])
def test_a_rough_metal_plate_is_its_bsdf(hidden_geometry_sampling: bool) -> None:
    """A glossy plate: the BSDF's value between the directions to laser and sensor, in every bin."""
    config = scene(plate(METAL), spp=32768, hidden_geometry_sampling=hidden_geometry_sampling)
    result = render(config, replicas=REPLICAS)
    reference = third_bounces(Setup(CELLS, EDGES, brdf=on_plate(METAL)), LASER, SENSORS)
    lambertian = third_bounces(Setup(CELLS, EDGES), LASER, SENSORS)
    ratio = reference.sum(axis=-1) / lambertian.sum(axis=-1)
    assert np.ptp(ratio) > 0.4 * ratio.mean()  # glossy: far from a scaled Lambertian
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_a_two_sided_plate_reflects_from_its_back() -> None:
    """Turned away from the wall and two-sided, a plate is the plate that faces it."""
    grey = {"type": "diffuse", "reflectance": 0.7}
    away = plate({"type": "twosided", "bsdf": grey}, normal=[-x for x in NORMAL])
    result = render(scene(away), replicas=REPLICAS)
    reference = third_bounces(Setup(CELLS, EDGES, rho=0.7), LASER, SENSORS)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_a_texture_lies_on_the_plate_as_its_coordinates_say(tmp_path: Path) -> None:
    """Columns run along the plate's x axis (up x normal), rows against its y axis; each texel reflects by its value."""
    start_backend("llvm")
    import mitsuba as mi

    texels = np.array([[0.1, 0.9, 0.3], [0.6, 0.2, 0.8]], dtype=np.float32)  # not symmetric in any way
    filename = tmp_path / "texels.exr"
    mi.Bitmap(texels[..., None]).write(str(filename))
    texture = {"type": "bitmap", "filename": str(filename), "filter_type": "nearest", "raw": True}
    bsdf = {"type": "diffuse", "reflectance": texture}
    result = render(scene(plate(bsdf), color="grey"), replicas=REPLICAS)
    assert result.mean.shape[0] == 1
    rho = texels[((1 - CELLS.uv[:, 1]) * 2).astype(int), (CELLS.uv[:, 0] * 3).astype(int)]
    reference = third_bounces(Setup(CELLS, EDGES, brdf=lambda *_: rho / np.pi), LASER, SENSORS)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_a_glossy_relay_wall_reflects_by_where_laser_and_sensor_stand() -> None:
    """A rough plastic wall: the BSDF between laser and plate at x_l, between plate and sensor at x_s."""
    devices = {"laser_position": np.array([-0.8, 0.1, 0.4]), "sensor_position": np.array([0.9, 0.5, 0.6])}
    config = scene(
        plate({"type": "diffuse", "reflectance": 0.7}),
        wall={"bsdf": PLASTIC},
        capture={key: value.tolist() for key, value in devices.items()},
        spp=65536,
    )
    result = render(config, replicas=REPLICAS)
    values = bsdf_values(PLASTIC, Frame.of([0, 0, 1]))

    def wall_from(device: Array) -> Callable[[Array, Array], Array]:
        def brdf(point: Array, ways: Array) -> Array:
            viewer = (device - point) / np.linalg.norm(device - point)
            return values(np.zeros(2), np.broadcast_to(viewer, ways.shape), ways)

        return brdf

    setup = Setup(
        CELLS,
        EDGES,
        rho=0.7,
        laser_brdf=wall_from(devices["laser_position"]),
        sensor_brdf=wall_from(devices["sensor_position"]),
    )
    reference = third_bounces(setup, LASER, SENSORS)
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=QUADRATURE)


def test_colours_are_grey_renders_side_by_side() -> None:
    """Each channel of [r, g, b] is the grey render with that reflectance, sample for sample."""
    rgb, wall_rgb = [0.2, 0.5, 0.9], [1.0, 0.6, 0.3]
    # Third bounces only: no roulette, whose survival depends on the brightest channel.
    colored, *greys = (
        render(
            scene(
                plate({"type": "diffuse", "reflectance": rho}),
                wall={"bsdf": {"type": "diffuse", "reflectance": rho_wall}},
                spp=512,
                max_bounces=3,
            ),
            replicas=8,
        )
        for rho, rho_wall in [(rgb, wall_rgb), *zip(rgb, wall_rgb, strict=True)]
    )
    assert colored.mean.shape[0] == 3
    for channel, grey in enumerate(greys):
        # float32 products in another order: 1e-6
        np.testing.assert_allclose(colored.mean[channel], grey.mean[0], rtol=1e-5, atol=1e-12)


def test_colours_of_interreflections_are_those_of_grey_renders() -> None:
    """Roulette follows the brightest channel: every channel's mean stays that of its grey render."""
    rgb, side = [0.1, 0.5, 0.9], {"width": 0.5, "center": [-0.5, 0.1, 0.6], "normal": [1.0, 0.0, -0.3]}
    colored, *greys = (
        render(
            flat_wall(
                plate({"type": "diffuse", "reflectance": rho}),
                plate({"type": "diffuse", "reflectance": rho}, **side),
                wall={"bsdf": {"type": "diffuse", "reflectance": rho}},
                sensors=(3, 2),
                bins=(0.9, 0.2, 20),
                max_bounces=5,
                split_bounces=False,
                spp=65536,
                seed=seed,
            ),
            replicas=REPLICAS,
        )
        for seed, rho in enumerate((rgb, *rgb))
    )
    for channel, grey in enumerate(greys):
        assert_agrees(
            colored.mean[channel],
            colored.variance[channel],
            grey.mean[0],
            reference_variance=grey.variance[0],
            replicas=REPLICAS,
            share=0.05,
        )


def test_a_colour_does_not_leak_into_other_channels() -> None:
    """Interreflections of a red plate and a blue wall: green stays black, five bounces and roulette included."""
    config = scene(
        plate({"type": "diffuse", "reflectance": [0.9, 0.0, 0.5]}),
        wall={"bsdf": {"type": "diffuse", "reflectance": [0.5, 0.0, 0.9]}},
        max_bounces=5,
        spp=4096,
    )
    result = render(config)
    assert result.mean[1].sum() == 0
    assert (result.mean[[0, 2]].sum(axis=(2, 3, 4, 5, 6))[:, 1] > 0).all()


@pytest.mark.parametrize("laser_sampling", [True, False])
@pytest.mark.parametrize("p_hidden_sampling", [0.0, 0.5, 1.0])
def test_a_mirror_shows_the_image_of_the_laser_s_spot(laser_sampling: bool, p_hidden_sampling: float) -> None:
    """A perfect mirror at z = h shows the spot at depth 2 h: H = (1/pi)^2 mean of cos^2 / d^2 over the spot.

    A point cannot be connected through a mirror; a spot is found by the ray that left the mirror.
    """
    h, radius, laser = 0.6, 0.1, np.array([0.05, -0.05, 0.0])
    mirror = plate({"type": "conductor"}, center=[0, 0, h], normal=[0, 0, -1], width=1.8, height=1.6)
    config = scene(
        mirror,
        capture={"laser_spot_radius": radius, "laser_point": laser[:2].tolist()},
        laser_sampling=laser_sampling,
        spp=131072,
    )
    config["capture"]["sensor_grid"] |= {"width": 1.2, "height": 1.0}
    result = render(config, replicas=REPLICAS, p_hidden_sampling=p_hidden_sampling)
    sensors = grid_points(3, 2, 1.2, 1.0)
    r, angle = np.meshgrid(radius * np.sqrt(midpoints(60)), 2 * np.pi * midpoints(90))
    image = laser + np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(r, 2 * h)], axis=-1).reshape(-1, 3)
    way = image - sensors[..., None, :]
    d = np.linalg.norm(way, axis=-1)
    value = (way[..., 2] / d) ** 2 / d**2 / np.pi**2 / len(image)
    n_bins = len(EDGES) - 1
    index = np.floor((d - EDGES[0]) / (EDGES[1] - EDGES[0])).astype(int)
    reference = np.zeros((1, 1, *sensors.shape[:2], n_bins))
    for j, i in np.ndindex(sensors.shape[:2]):
        reference[0, 0, j, i] = np.bincount(index[j, i], weights=value[j, i], minlength=n_bins)
    # 5400 points of the spot: a rim of a bin has about sqrt(5400) of them
    assert_agrees(result.total, result.total_variance, reference, replicas=REPLICAS, floor=5e-3)


def test_glass_delays_by_its_index() -> None:
    """A slab of glass (n = 1.5, t = 10 cm) before a mirror at z: later by 2 (n - 1) t, nearer by 2 (1 - 1/n) t.

    At normal incidence each of four passages through a surface keeps 1 - ((n - 1) / (n + 1))^2 = 0.96 (Fresnel), and
    the spot's image seems at the reduced distance D = 2 (z - t + t / n): H = 0.96^4 / pi^2 / D^2. That is bounce 7: the
    slab's surfaces count. The spot is seen under angles of up to 0.1 / D = 0.07, which change any of this by their
    square, 0.5 %.
    """
    z, t, n, radius = 0.8, 0.1, 1.5, 0.1
    slab = {
        "type": "box",
        "center": [0, 0, 0.4],
        "size": [1.0, 1.0, t],
        "bsdf": {"type": "dielectric", "int_ior": n, "ext_ior": 1.0},
    }
    mirror = plate({"type": "conductor"}, width=0.8, height=0.8, center=[0, 0, z], normal=[0, 0, -1])
    config = flat_wall(
        slab,
        mirror,
        sensors=(1, 1),
        capture={"laser_spot_radius": radius, "laser_point": [0.0, 0.0]},
        max_bounces=7,
        bins=(1.6, 0.05, 8),
        spp=2**20,
        russian_roulette=False,
    )
    result = render(config, replicas=64, p_hidden_sampling=0.0)
    seventh = result.bounce(7)[0, 0, 0, 0]
    distance = 2 * (z - t + t / n)
    expected = 0.96**4 / np.pi**2 / distance**2
    sigma = float(np.sqrt(result.bounce_variance(7).sum()))
    assert sigma < 0.02 * expected
    arrival = int((2 * z + 2 * (n - 1) * t - 1.6) / 0.05 + 1e-6)  # 1.700 m to 1.708 m; later: by way of the relay wall
    assert abs(seventh[arrival] - expected) < 4 * sigma + 0.005 * expected
    assert seventh[:arrival].sum() == 0


def test_legs_and_third_bounce_of_one_pair_are_those_of_the_formula() -> None:
    """The helper used above agrees with itself when f is the Lambertian constant: a check of the reference."""
    constant = on_plate({"type": "diffuse", "reflectance": 0.7})
    a = third_bounce(Setup(CELLS, EDGES, brdf=constant), LASER[0, 0], SENSORS[0, 0])
    b = third_bounce(Setup(CELLS, EDGES, rho=0.7), LASER[0, 0], SENSORS[0, 0])
    np.testing.assert_allclose(a, b, rtol=1e-5)
