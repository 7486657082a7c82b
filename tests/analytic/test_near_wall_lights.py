"""Virtual lights before surfaces almost on the wall: half of H is between them and a laser point, half at the sensor's.

Before an endless parallel plate at h, with d the distance from laser to sensor point, H is about h^2 / d^4: light has
to leave or to arrive at grazing incidence. Paths do not find the spot of size h before the laser point.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import relative_l2
from support.rendering import Rendering, configured, flat_wall, render

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

TARGET = 0.01
CENTER = (0.05, 0.05)
GRIDS: dict[str, dict[str, Any]] = {
    "single": {"laser_point": [0.07, -0.03]},
    "exhaustive": {"laser_grid": {"nx": 2, "ny": 1, "width": 0.3, "height": 0.4}},
    "confocal": {},
}
SLOPE = 0.2  # [rad] of tilted plates
TILTED = {"normal": [float(np.sin(SLOPE)), 0.0, float(-np.cos(SLOPE))]}
TWO_SIDED = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": 1.0}}
BLACK = {"type": "diffuse", "reflectance": 0.0}
ON_THE_WALL = {
    "tilted": {"center": [0.05, 0.0, 0.5 * float(np.sin(SLOPE))], **TILTED},
    "standing": {"type": "box", "center": [0.1, 0.05, 0.15], "size": [0.3, 0.3, 0.3]},
    "crossing": {"center": [0.033, 0.0, 0.0], "normal": [-1, 0, -0.3], "bsdf": TWO_SIDED},
}


def plate(height: float, **changes: Any) -> dict[str, Any]:
    """A plate of 1 m whose middle is at ``height`` over ``CENTER``."""
    return {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [*CENTER, height], **changes}


def scene(*items: dict[str, Any], scan: str, grid: dict[str, Any] | None = None, **goal: Any) -> dict[str, Any]:
    """A capture of 3 x 2 sensor points under the plate, or of the ``grid``."""
    grid = grid or {"sensor_grid": {"nx": 3, "ny": 2, "width": 0.6, "height": 0.4}, **GRIDS[scan]}
    config = flat_wall(*items, scan=scan, bins=(0.0, 0.02, 100), capture=grid)
    config["render"] = {"max_bounces": 3, **({"target_error": TARGET} | goal)}
    return config


def set_up(config: dict[str, Any]) -> Any:
    """Return the engine that a configuration leads to."""
    validated = configured(config)
    backend = start_backend("llvm")
    built = stages.load_scene(validated)
    capture, time_axis = stages.describe_capture(validated, built.wall, built)
    return stages.prepare(validated, backend, built, capture, time_axis)[1]


def before_plate(laser: NDArray, sensor: NDArray, height: float) -> float:
    """Return H of all times, by midpoints of rings that grow from the laser and the sensor point.

    Each point's rings take the share of the plate that the squared distances divide smoothly between the two.
    """
    edges = np.linspace(np.log(1e-3 * height), np.log(1.5), 1001)  # 1e-5 of H, as are the angles
    radii = np.exp((edges[1:] + edges[:-1]) / 2)[:, None]
    angles = (np.arange(256) + 0.5) * (2 * np.pi / 256)
    total = 0.0
    for own, other in ((laser, sensor), (sensor, laser)):
        x, y = radii * np.cos(angles), radii * np.sin(angles)
        on_plate = (np.abs(own[0] + x - CENTER[0]) < 0.5) & (np.abs(own[1] + y - CENTER[1]) < 0.5)
        near = radii**2 + height**2
        far = (x + own[0] - other[0]) ** 2 + (y + own[1] - other[1]) ** 2 + height**2
        share = far / (near + far) * on_plate
        total += float((share * height**4 / (np.pi**3 * near**2 * far**2) * radii**2).sum())
    return total * (edges[1] - edges[0]) * 2 * np.pi / 256


def expected(result: Rendering, height: float, *, confocal: bool) -> NDArray:
    """Return ``before_plate`` of every pair, shaped as the sums over the bins."""
    sensors = result.capture.sensor_grid.positions.reshape(-1, 3)
    lasers = sensors if confocal else result.capture.laser_grid.positions.reshape(-1, 3)
    pairs = (
        zip(lasers, sensors, strict=True) if confocal else ((laser, sensor) for laser in lasers for sensor in sensors)
    )
    values = np.array([before_plate(laser, sensor, height) for laser, sensor in pairs])
    return values.reshape(result.total.shape[:-1])


@pytest.mark.parametrize(
    ("scan", "height"),
    [
        ("single", 1e-4),
        ("single", 1e-7),
        ("confocal", 1e-7),
        ("exhaustive", 1e-6),
        pytest.param("single", 1e-3, marks=pytest.mark.slow),
        pytest.param("single", 1e-5, marks=pytest.mark.slow),
        pytest.param("single", 1e-6, marks=pytest.mark.slow),
        pytest.param("confocal", 1e-4, marks=pytest.mark.slow),
        pytest.param("confocal", 1e-5, marks=pytest.mark.slow),
        pytest.param("confocal", 1e-6, marks=pytest.mark.slow),
        pytest.param("exhaustive", 1e-4, marks=pytest.mark.slow),
        pytest.param("exhaustive", 1e-5, marks=pytest.mark.slow),
        pytest.param("exhaustive", 1e-7, marks=pytest.mark.slow),
    ],
)
def test_a_parallel_plate_has_its_integral(scan: str, height: float) -> None:
    """At any height, every pair has the integral over the plate, to the error asked for; so has the stated error."""
    result = render(scene(plate(height), scan=scan, engine="virtual_lights"))
    truth = expected(result, height, confocal=scan == "confocal")
    error = relative_l2(result.total.sum(axis=-1) - truth, truth)
    assert error < TARGET
    # two resolutions differ by the finer's error where that falls with the number of patches: a rough law for a dozen
    assert error / 4 < result.error_estimate < 1.5 * TARGET


@pytest.mark.parametrize("height", [1e-4, 3e-6])
def test_a_blind_half_way_to_a_plate_stops_half_of_its_light(height: float) -> None:
    """What a black half-plane at h / 2 leaves of a confocal point on its edge's foot is one half."""
    foot = 0.2  # x of the last column of sensor points
    blind = plate(height / 2, center=[foot + 0.5, CENTER[1], height / 2], bsdf=BLACK)
    result = render(scene(plate(height), blind, scan="confocal", engine="virtual_lights"))
    # rays know where edges of a triangle 1 m long are to 1.2e-7 m: of the angle to the edge, 2 / pi are lost or added
    shift = 2 / np.pi * 1.2e-7 / (height / 2)
    last = result.total[0, 0, :, 2].sum(axis=-1) * 3 * np.pi**2 * height**2
    assert last == pytest.approx(0.5, abs=2 * TARGET + shift)
    first = result.total[0, 0, :, :2].sum(axis=-1) * 3 * np.pi**2 * height**2
    assert first == pytest.approx(1.0, abs=2 * TARGET)  # nothing is between the other points and the plate


@pytest.mark.parametrize("height", [1e-5, 1e-6])
def test_a_tilted_plate_is_right_to_float32(height: float) -> None:
    """The same plate a thousand times farther away, where float32 does not matter, gives the same H h^2."""
    # in front of the plate, where it hides nothing that counts, but has visibility asked for
    aside = plate(0.05, center=[0.9, -0.7, 0.05], bsdf=BLACK) | {"width": 0.05, "height": 0.05}
    energies = []
    for h in (height, 1000 * height):
        item = plate(h, center=[0.2, 0.1, h], **TILTED)  # over the last sensor point
        result = render(scene(item, aside, scan="confocal", engine="virtual_lights"))
        energies.append(float(result.total[0, 0, 1, 2].sum()) * h**2)
    # heights are good to 6e-8 m, which enter twice; both errors asked for
    assert energies[0] == pytest.approx(energies[1], rel=2 * 6e-8 / height + 2 * TARGET)


@pytest.mark.slow
@pytest.mark.parametrize("scan", ["single", "confocal"])
@pytest.mark.parametrize("kind", ON_THE_WALL)
def test_what_touches_or_crosses_the_wall_agrees_with_paths(kind: str, scan: str) -> None:
    """No edge of these surfaces is above a laser point, so paths find all light."""
    item = ON_THE_WALL[kind] if "type" in ON_THE_WALL[kind] else {**plate(0.0), **ON_THE_WALL[kind]}
    grid: dict[str, Any] = {"sensor_grid": {"nx": 5, "ny": 3, "width": 1.25, "height": 1.2}}
    if scan == "single":
        grid["laser_point"] = [-0.3, 0.04]
    gathered = render(scene(item, scan=scan, grid=grid, engine="virtual_lights"))
    traced = render(scene(item, scan=scan, grid=grid, engine="path", spp=2**17, target_error=None))
    assert relative_l2(gathered.total - traced.total, traced.total) < TARGET + 4 * traced.error_estimate


@pytest.mark.parametrize(
    ("item", "scan", "engine"),
    [
        (plate(1e-6), "single", "virtual_lights"),
        (plate(1e-6), "exhaustive", "virtual_lights"),
        (plate(1e-6), "confocal", "path"),
        ({"type": "sphere", "radius": 0.1, "center": [0.07, -0.03, 0.1 + 1e-5]}, "single", "path"),
    ],
)
def test_auto_knows_which_engine_is_right_near_the_wall(item: dict[str, Any], scan: str, engine: str) -> None:
    """Paths are right, and cheaper, for confocal points; near other laser points only graded patches are."""
    assert set_up(scene(item, scan=scan)).name == engine


def test_what_goes_to_and_fro_before_a_laser_point_is_not_taken_for_known() -> None:
    """Neither engine finds bounce 5 there: the stated error is thrice what is found, and a warning says so."""
    config = scene(plate(1e-4), scan="single", max_bounces=5, target_error=0.1, engine="virtual_lights")
    result = render(config)
    fifth = result.bounce(5)
    assert fifth.sum() > 0
    assert np.all(np.sqrt(result.bounce_variance(5)) >= 2.9 * fifth)
    from nlosrender.engine.preflight.scene_warnings import scene_warnings

    for max_bounces, is_told in ((5, True), (3, False)):
        said = scene_warnings(set_up(scene(plate(1e-4), scan="single", max_bounces=max_bounces)))
        assert any("most of the light that goes to and fro" in text for text in said) == is_told
