"""Regions of the sensor grid: patches of their own close to the wall change what a capture costs, not what it says."""

from __future__ import annotations

import numpy as np
import pytest
from support.rendering import flat_wall
from support.varied_scenes import Stage

from nlosrender.capture.plan import Batch, Tile

pytestmark = pytest.mark.usefixtures("backend")

ROOM = {"type": "room", "size": [2.0, 1.6, 1.2], "bsdf": {"type": "diffuse", "reflectance": 0.5}}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0, 0, 1.0], "normal": [0, 0, -1]}
TOUCHING = PLATE | {"center": [0.2, 0.1, 0.3], "normal": [1, 0, 0]}  # its edge lies on the wall
SENSORS = (26, 22)


def engine_of(*hidden: dict, scan: str = "single", sensors: tuple[int, int] = SENSORS, **more):
    """Return the virtual-light engine of a scene."""
    return Stage.of(flat_wall(*hidden, scan=scan, sensors=sensors, engine="virtual_lights", spp=None, **more)).engine


def eager(*hidden: dict, **more):
    """Return an engine that makes regions of few sensor points, at no price: grids where they pay take too long."""
    config = flat_wall(*hidden, **({"sensors": SENSORS} | more), engine="virtual_lights", spp=None)
    return Stage.of(config).tuned(min_region_sensors=16, sensors_per_patch_cost=1).engine


def undivided(*hidden: dict, **more):
    """Return an engine without regions."""
    config = flat_wall(*hidden, **({"sensors": SENSORS} | more), engine="virtual_lights", spp=None)
    engine = Stage.of(config).tuned(region_blocks=()).engine
    assert engine.tessellator.regions is None
    return engine


def whole(engine) -> Batch:
    """Return a batch of all sensor points of an engine's capture."""
    grid = engine.capture.sensor_grid
    tile = Tile(0, grid.ny, 0, grid.nx)
    return Batch(tile, tile if engine.capture.scan_type == "confocal" else Tile(0, 1, 0, 1))


@pytest.mark.parametrize(
    ("hidden", "scan"),
    [
        pytest.param((ROOM, TOUCHING), "single", id="room and plate, single"),
        pytest.param((ROOM,), "confocal", id="room, confocal"),
        pytest.param((ROOM,), "single", id="room, single", marks=pytest.mark.slow),
        pytest.param((ROOM, TOUCHING), "confocal", id="room and plate, confocal", marks=pytest.mark.slow),
    ],
)
def test_regions_agree_with_one_set_of_patches(hidden: tuple[dict, ...], scan: str) -> None:
    """Both err by what they state; together by no more than the root of the sum of the squares, times two.

    Two is what a stated error is held to. Light is not lost: the energies, whose errors of patches here and there
    cancel, agree within a tenth of that.
    """
    from nlosrender.engine.virtual_lights.refinement import estimated_error

    divided, one = eager(*hidden, scan=scan), undivided(*hidden, scan=scan)
    assert divided.tessellator.regions is not None
    assert divided.tessellator.count(0.5) < 0.5 * one.tessellator.count(0.5)
    pairs = [engine.third.pair(whole(engine), 0.5) for engine in (divided, one)]
    stated = np.hypot(*(estimated_error(coarse, fine) for coarse, fine in pairs))
    values, reference = (fine.values[..., :-1] for _, fine in pairs)
    assert stated < 0.1
    assert np.linalg.norm(values - reference) < 2 * stated * np.linalg.norm(reference)
    assert values.sum() == pytest.approx(reference.sum(), rel=0.2 * stated)


def test_every_region_covers_every_surface_once() -> None:
    """Shared patches and those of a region add up to the areas of all surfaces, whatever the resolution."""
    engine = eager(ROOM)
    area = (2 * 2.0 * 1.2 + 2 * 1.6 * 1.2 + 2.0 * 1.6) / engine.built.metres_per_engine_unit**2
    count = len(engine.tessellator.regions.near)
    for patch_scale in (1.0, 0.4):
        shared = engine.tessellator.patches(patch_scale)
        found = [
            shared.areas.sum() + patches.areas.sum()
            for _, near in engine.tessellator.regional_patches(patch_scale, range(count))
            for patches in near
        ]
        assert len(found) == count > 1
        assert found == pytest.approx([area] * len(found), rel=1e-6)


def test_elements_are_no_longer_than_their_distance_from_the_region() -> None:
    """What a region sees is cut as finely as its own sensor points need, and no finer than its neighbour needs."""
    engine = eager(ROOM)
    grid, unit = engine.capture.sensor_grid, engine.built.metres_per_engine_unit
    regions = engine.tessellator.regions
    points = grid.positions.reshape(-1, 3) / unit
    laser = engine.capture.laser_grid.positions.reshape(-1, 3) / unit
    for label, near in enumerate(regions.near):
        own = np.concatenate([points[regions.labels == label], laser])
        for elements in (near.elements, regions.shared.elements):
            centres = elements.corners.mean(axis=1)
            distances = np.linalg.norm(centres[:, None] - own, axis=2).min(axis=1)
            assert (elements.sizes <= np.maximum(distances, 1e-3) * (1 + 1e-6)).all()


def test_elements_that_are_small_enough_are_quartered_by_nobody() -> None:
    """Partitioned first, then quartered: as many elements, of the same sizes and distances, as quartered at once."""
    engine = engine_of(ROOM, PLATE)
    from nlosrender.engine.virtual_lights.elements.subdivision import (
        Elements,
        elements_of_mesh,
        partition_by_size,
        subdivide,
    )

    distance, shapes = engine.tessellator.distance, engine.built.hidden_shapes
    once = subdivide(
        Elements.joined([elements_of_mesh(engine.built, 1, shape) for shape in shapes]), distance, None, 0.3
    )
    small, large = partition_by_size(once, distance, None)
    assert len(small.sizes) > 0 < len(large.sizes)
    assert (small.sizes <= small.distances).all()
    for least in (0.0, 0.2):
        all_elements = subdivide(once, distance, None, least)
        joined = Elements.joined([small, subdivide(large, distance, None, least)])
        for found, expected in ((joined.sizes, all_elements.sizes), (joined.distances, all_elements.distances)):
            np.testing.assert_array_equal(np.sort(found), np.sort(expected))


def test_a_batch_says_what_the_whole_capture_says() -> None:
    """Regions belong to the capture: a part of its sensor points gathers the same bits alone."""
    engine = eager(ROOM)
    part = Batch(Tile(3, 17, 5, 22), Tile(0, 1, 0, 1))
    all_values = engine.third.gather(whole(engine), 0.6).values
    columns = engine.capture.sensor_grid.nx
    chosen = part.sensors.flat_indices(columns)
    np.testing.assert_array_equal(engine.third.gather(part, 0.6).values, all_values[..., chosen, :])
    assert all_values.any()


@pytest.mark.parametrize(
    ("hidden", "scan", "sensors"),
    [
        pytest.param((PLATE,), "single", SENSORS, id="far from the wall"),
        pytest.param((ROOM,), "exhaustive", SENSORS, id="laser points all over the wall"),
        pytest.param((ROOM,), "single", (7, 8), id="few sensor points"),
    ],
)
def test_one_set_of_patches_where_regions_save_nothing(
    hidden: tuple[dict, ...], scan: str, sensors: tuple[int, int]
) -> None:
    """Regions cost patches: there are none where a set for all does as well."""
    assert eager(*hidden, scan=scan, sensors=sensors).tessellator.regions is None


def test_regions_have_a_price() -> None:
    """Cutting and lighting patches for every region costs more than it saves where few sensor points gather them."""
    assert engine_of(ROOM, sensors=(18, 16)).tessellator.regions is None
    assert engine_of(ROOM, sensors=(64, 64)).tessellator.regions is not None
