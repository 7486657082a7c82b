"""Polarised captures of a relay wall: what depolarises, what does not, and one path's chain of Mueller matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.agreement import assert_agrees, t_limit, worst_t
from support.rendering import configured, flat_wall, render

from nlosrender.errors import ConfigError
from nlosrender.rendering import stages

METAL = {"type": "roughconductor", "eta": 1.5, "k": 0.1, "alpha": 0.35}  # black glass: it polarises strongly
LASER, SENSOR = np.array([1.8, -0.2, 0.5]), np.array([-1.6, 0.9, 0.5])  # m, at angles that polarise
POINT = np.array([0.3, -0.2, 0.0])  # m, the lit point


def plate(bsdf: dict[str, Any] | None = None, size: float = 0.7) -> dict[str, Any]:
    """A plate that faces the wall askew."""
    item = {"type": "rectangle", "width": size, "height": size, "center": [0.1, 0.05, 0.8], "normal": [0.1, 0.2, -1]}
    return item | {"bsdf": bsdf or {"type": "diffuse", "reflectance": 0.7}}


@pytest.mark.parametrize("technique", [True, False])
def test_matt_scenes_depolarise(technique: bool) -> None:
    """Q = U = V = 0 exactly, and I is what the unpolarised render finds, bounce by bounce."""
    scene = [plate(), plate() | {"center": [-0.6, 0.1, 0.6]}]
    options = {"max_bounces": 4, "spp": 4096, "hidden_geometry_sampling": technique}
    polarised = render(flat_wall(*scene, polarized=True, **options), replicas=16)
    grey = render(flat_wall(*scene, **options, seed=1), replicas=16)
    assert not polarised.mean[1:].any()
    for bounce in (3, 4):
        slot = polarised.bounces.slot(bounce)
        assert_agrees(
            polarised.mean[0, slot],
            polarised.variance[0, slot],
            grey.mean[0, slot],
            reference_variance=grey.variance[0, slot],
            replicas=16,
            share=0.1,
        )


def test_metal_polarises() -> None:
    """A metal plate seen by way of a metal wall: polarised, but never more than wholly, in any bin."""
    wall = {"wall": {"bsdf": METAL}}
    view = render(flat_wall(plate(METAL), **wall, polarized=True, spp=2048))
    stokes = view.mean.sum(axis=1)
    degree = np.linalg.norm(stokes[1:].sum(axis=-1), axis=0) / stokes[0].sum(axis=-1)
    assert degree.max() > 0.05
    assert (np.linalg.norm(stokes[1:], axis=0) <= stokes[0] * (1 + 1e-4) + 1e-9).all()  # float32 Mueller matrices


def interaction(mi: Any, at: np.ndarray, normal: np.ndarray, towards: np.ndarray) -> Any:
    """Return a surface interaction whose wi points to ``towards``."""
    si = mi.SurfaceInteraction3f()
    si.p, si.n = mi.Point3f(at.tolist()), mi.Normal3f(normal.tolist())
    si.sh_frame = mi.Frame3f(mi.Vector3f(normal.tolist()))
    si.wi = si.to_local(mi.Vector3f(((towards - at) / np.linalg.norm(towards - at)).tolist()))
    si.wavelengths, si.t = [], mi.Float(1)
    return si


def step(mi: Any, bsdf: Any, at: np.ndarray, normal: np.ndarray, out: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Return the Mueller matrix (4, 4) of one reflection from ``source`` to ``out``, without any cosine."""
    si = interaction(mi, at, normal, out)
    wo = si.to_local(mi.Vector3f(((source - at) / np.linalg.norm(source - at)).tolist()))
    local = bsdf.eval(mi.BSDFContext(), si, wo)
    cosine = float(np.ravel(mi.Frame3f.cos_theta(wo))[0])
    return np.array(si.to_world_mueller(local, -wo, si.wi))[:, :, 0, 0] / cosine


def test_both_techniques_agree() -> None:
    """Directions from the metal's lobes or towards the plate: the same Stokes vectors."""
    config = flat_wall(plate(METAL), wall={"bsdf": METAL}, polarized=True, spp=16384, max_bounces=4)
    sums, variances = [], []
    for hidden in (True, False):
        config["render"] |= {"hidden_geometry_sampling": hidden, "seed": int(hidden)}
        view = render(config, replicas=16)
        sums.append(view.mean.sum(axis=(1, 2, 3, 6)))
        variances.append(view.variance.sum(axis=(1, 2, 3, 6)))
    assert (np.abs(sums[0][1:3]) / sums[0][0]).max() > 0.02
    lit = sums[0][0] > 0.05 * sums[0][0].max()  # what few lobes reach is not normally distributed
    t, n = worst_t(sums[0][:, lit], (variances[0] + variances[1])[:, lit], sums[1][:, lit])
    assert t <= t_limit(n, 15), f"|t| = {t:.2f} over {n} components"


def test_one_path_is_a_chain_of_mueller_matrices() -> None:
    """Wall, small plate, wall, all of rough metal: M M M (1, 0, 0, 0) E G G, turned to the sensor's horizontal.

    Both legs' geometry factors G and every matrix are computed here for one path; the laser's comes from the BSDF the
    other way round. H is for one joule on the laser point, whatever the angle it comes in at.
    """
    size = 0.004  # m
    devices = {"laser_position": LASER.tolist(), "sensor_position": SENSOR.tolist(), "laser_point": [0.3, -0.2]}
    capture = {"capture": devices, "wall": {"bsdf": METAL}, "sensors": (3, 2)}
    found = render(flat_wall(plate(METAL, size), **capture, polarized=True, spp=64), replicas=16)
    import mitsuba as mi

    bsdf = mi.load_dict(METAL)
    grid = found.capture.sensor_grid.positions.reshape(-1, 3)
    center, normal = np.array([0.1, 0.05, 0.8]), np.array([0.1, 0.2, -1]) / np.linalg.norm([0.1, 0.2, -1])
    up = np.array([0.0, 0, 1])
    for index, point in enumerate(grid):
        first, last = center - POINT, point - center
        geometry = (first[2] * -(first @ normal) / (first @ first) ** 2) * (
            (last @ normal) * -last[2] / (last @ last) ** 2
        )
        chain = step(mi, bsdf, point, up, SENSOR, center)
        chain = chain @ step(mi, bsdf, center, normal, point, POINT)
        chain = chain @ step(mi, bsdf, POINT, up, center, LASER)
        out = (SENSOR - point) / np.linalg.norm(SENSOR - point)
        across = np.cross(-out, [0, 1, 0])
        forward = mi.Vector3f(out.tolist())
        turn = mi.mueller.rotate_stokes_basis(
            forward, mi.mueller.stokes_basis(forward), mi.Vector3f((across / np.linalg.norm(across)).tolist())
        )
        expected = (np.array(turn).reshape(4, 4) @ chain)[:, 0] * geometry * size**2
        sums = found.mean[:, :, 0, 0].sum(axis=(1, 4)).reshape(4, -1)[:, index]
        noise = np.sqrt(found.variance[:, :, 0, 0].sum(axis=(1, 4)).reshape(4, -1)[:, index])
        tolerance = 0.01 * expected[0] + 5 * noise  # 4 mm at 0.8 m: angles differ by 0.5 %, and lobes with them
        assert (np.abs(sums - expected) <= tolerance).all(), (sums / expected[0], expected / expected[0])


@pytest.mark.parametrize(
    ("changes", "key", "message"),
    [
        ({"color": "rgb"}, "render.polarized", "rendered in grey"),
        ({"engine": "virtual_lights"}, "render.engine", "know no polarisation"),
        ({"capture": {"laser_spot_radius": 0.01}}, "render.polarized", "laser_spot_radius: 0"),
    ],
)
def test_what_cannot_be_polarised(changes: dict[str, Any], key: str, message: str) -> None:
    """Impossible combinations are told in the configuration."""
    with pytest.raises(ConfigError, match=message) as caught:
        configured(flat_wall(plate(), polarized=True, **changes))
    assert caught.value.issues[0].key == key


def test_only_paths_carry_polarised_light() -> None:
    """The planner says why it takes the path engine."""
    config = configured(flat_wall(plate(), polarized=True, engine="auto", spp=None, target_error=0.1))
    backend = stages.started_backend(config)
    _, engine, header = stages.set_up_engine(config, backend)
    assert (backend.variant, engine.name, engine.reason) == (
        "llvm_ad_mono_polarized",
        "path",
        "only paths carry polarised light",
    )
    assert header.n_channels == 4
