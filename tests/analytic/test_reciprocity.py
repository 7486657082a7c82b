"""Half of an exhaustive capture says all of it where H(l, s) = H(s, l)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.rendering import configured, flat_wall

from nlosrender.engine.backend.start import start_backend
from nlosrender.rendering import stages

GREY = {"type": "diffuse", "reflectance": 0.6}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0, 1.0], "normal": [0, 0, -1], "bsdf": GREY}
BEFORE = PLATE | {"width": 0.3, "height": 0.4, "center": [0.3, 0.1, 0.6], "normal": [0.2, 0.1, -1]}
GRID = {"nx": 5, "ny": 3, "width": 1.5, "height": 1.2}
SMOOTH_MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 -1\nvn 0.6 0 -0.8\nvn 0 0.6 -0.8\nf 1//1 3//3 2//2\n"


def engine_of(
    *hidden: dict, folder: Path | None = None, lasers: dict | None = None, wall: dict | None = None, **capture
):
    """Return the virtual-light engine of an exhaustive capture, and its only batch."""
    config = flat_wall(*hidden, scan="exhaustive", engine="virtual_lights", spp=None, wall=wall or {})
    config["capture"] |= {"sensor_grid": GRID, "laser_grid": GRID | (lasers or {}), **capture}
    validated = configured(config, folder=folder)
    backend = start_backend("llvm")
    built = stages.load_scene(validated)
    described, time_axis = stages.describe_capture(validated, built.wall, built)
    plan, engine = stages.prepare(validated, backend, built, described, time_axis)
    return engine, plan.batches[0]


@pytest.mark.parametrize(
    ("hidden", "occluded"), [((PLATE,), False), ((PLATE, BEFORE), True)], ids=["plate", "one before the other"]
)
def test_half_of_the_pairs_say_all(hidden: tuple[dict, ...], occluded: bool) -> None:
    """Gathering the other half changes the order of float32 products only: 1e-5 of the peak.

    With shadows the points that stand for a patch are others from either side: both err by what is stated, and no more
    than twice the root of the sum of its squares apart.
    """
    engine, batch = engine_of(*hidden)
    from nlosrender.engine.virtual_lights.refinement import estimated_error

    assert engine.third.is_reciprocal
    assert engine.settings.needs_visibility == occluded
    coarse, half = engine.third.pair(batch, 0.2)
    engine.third.is_reciprocal = False
    whole = engine.third.gather(batch, 0.2).values
    values = half.values
    np.testing.assert_array_equal(values, values.swapaxes(2, 3))  # (channel, 1, laser, sensor, row)
    assert not np.array_equal(whole, whole.swapaxes(2, 3))
    assert values.sum() > 0
    if occluded:
        limit = 2 * np.sqrt(2) * estimated_error(coarse, half)
        assert limit < 0.2
        assert np.linalg.norm(values - whole) < limit * np.linalg.norm(whole)
    else:
        np.testing.assert_allclose(values, whole, rtol=0, atol=1e-5 * whole.max())


@pytest.mark.parametrize(
    ("hidden", "more"),
    [
        pytest.param(PLATE, {"lasers": GRID | {"width": 1.4}}, id="other laser points"),
        pytest.param(
            PLATE,
            {"account_first_and_last_bounces": True, "laser_position": [1, 0, 1], "sensor_position": [-1, 0, 1]},
            id="other legs",
        ),
        pytest.param(PLATE | {"bsdf": {"type": "roughplastic", "alpha": 0.3}}, {}, id="not Lambertian"),
        pytest.param(PLATE, {"wall": {"bsdf": {"type": "roughplastic", "alpha": 0.3}}}, id="wall not Lambertian"),
        pytest.param({"type": "mesh", "filename": "m.obj", "translate": [0, 0, 1]}, {}, id="interpolated normals"),
    ],
)
def test_all_pairs_where_the_halves_may_differ(tmp_path: Path, hidden: dict, more: dict) -> None:
    """Nothing is taken from the other half where exchanging laser and sensor point may change something."""
    (tmp_path / "m.obj").write_text(SMOOTH_MESH)
    engine, _ = engine_of(hidden, folder=tmp_path, **more)
    assert not engine.third.is_reciprocal


@pytest.mark.parametrize("hidden", [(PLATE,), (PLATE, BEFORE)], ids=["plate", "one before the other"])
def test_how_a_capture_is_cut_does_not_show(hidden: tuple[dict, ...]) -> None:
    """Batches of some lasers, of one, or of some sensor points, have the bits of the whole capture in either half."""
    from nlosrender.capture.plan import Batch, Tile

    engine, whole = engine_of(*hidden)
    values = engine.third.gather(whole, 0.3).values
    everything, one = Tile(0, 3, 0, 5), Tile(1, 2, 2, 3)
    pairs = ((everything, Tile(1, 2, 2, 4)), (Tile(0, 2, 0, 3), Tile(1, 3, 1, 5)), (everything, one), (one, everything))
    for sensors, lasers in pairs:
        part = engine.third.gather(Batch(sensors, lasers), 0.3).values
        expected = values[:, :, lasers.flat_indices(5)][:, :, :, sensors.flat_indices(5)]
        assert expected.any()
        np.testing.assert_array_equal(part, expected)


def test_large_captures_gather_all_pairs() -> None:
    """Captures of many batches would gain nothing: each has few of the other halves of its pairs."""
    start_backend("llvm")
    from nlosrender.engine.virtual_lights.reciprocity import is_reciprocal
    from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning

    engine, _ = engine_of(PLATE)
    n_bins, n_points = engine.time_axis.n_bins, engine.capture.n_sensors
    for max_sums in (n_points**2 * n_bins, n_points**2 * n_bins - 1):
        tuning = VirtualLightTuning(max_reciprocal_sums=max_sums)
        found = is_reciprocal(engine.built, engine.capture, n_bins, is_lambertian=True, tuning=tuning)
        assert found == (max_sums == n_points**2 * n_bins)


def test_legs_that_are_the_same_may_count() -> None:
    """A laser beside the sensor has the same legs to the same points."""
    place = {"laser_position": [0.2, 0, 1], "sensor_position": [0.2, 0, 1]}
    engine, _ = engine_of(PLATE, account_first_and_last_bounces=True, **place)
    assert engine.third.is_reciprocal
