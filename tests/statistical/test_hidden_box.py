"""Rays from the wall that miss the box around all hidden geometry are not traced: not a bit of the result changes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.rendering import flat_wall
from support.varied_scenes import Stage

from nlosrender.engine.backend.start import start_backend

Item = dict[str, Any]
DIFFUSE = {"type": "diffuse", "reflectance": 0.7}
PLATE = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [0.1, 0, 0.9], "normal": [0, 0.3, -1]}
LETTER = {"type": "letters", "text": "E", "height": 0.5, "center": [-0.2, 0, 0.8], "normal": [0.3, 0, -1]}
BALL = {"type": "sphere", "center": [0.3, 0.2, 0.7], "radius": 0.2, "bsdf": {"type": "roughconductor", "alpha": 0.3}}
TUBE = {"type": "cylinder", "center": [0, 0, 0.7], "axis": [1, 0, 0], "radius": 0.1, "height": 0.5}
MIRROR = PLATE | {"center": [0.3, 0, 0.6], "normal": [-1, 0, -0.4], "bsdf": {"type": "conductor"}}
GLASS = BALL | {"bsdf": {"type": "dielectric"}}
TOUCHING = PLATE | {"center": [0.2, 0.1, 0.1], "normal": [1, 0, 0]}
ROOM = {"type": "room", "size": [2.0, 1.6, 1.2], "bsdf": DIFFUSE}
SCENES: dict[str, tuple[Item, ...]] = {
    "plate": (PLATE,),
    "letter and ball": (LETTER, BALL),
    "tube": (TUBE,),
    "mirror": (MIRROR, PLATE),
    "glass before a plate": (GLASS, PLATE),
    "through the wall": (TOUCHING,),
}
SPP = 48


def stage_of(*hidden: Item, **more: Any) -> Stage:
    """Return a scene's path engine with BSDF sampling alone."""
    keys = {"sensors": (6, 5), "lasers": (2, 3), "hidden_geometry_sampling": False, "engine": "path", "spp": SPP}
    return Stage.of(flat_wall(*hidden, **(keys | more)))


def before_a_cylinder() -> Stage:
    """Return the path engine of a plate in a hollow cylinder that is the wall."""
    config = flat_wall(PLATE, hidden_geometry_sampling=False, engine="path", spp=SPP)
    wall = {"type": "cylinder", "center": [0, 0, 0], "axis": [0, 1, 0], "radius": 1.0, "height": 2.0, "inside": True}
    config["scene"]["relay_wall"] = wall
    return Stage.of(config)


def rendered(engine: Any, batch: Any, spp: int = SPP) -> Any:
    """Return mean and variance of a batch."""
    from nlosrender.engine.interface import Budget

    histogram = engine.render(batch, Budget(spp=spp))
    return np.stack([histogram.mean, histogram.variance])


# every scene with every scan, and every scene and every scan with either limit: kernels are compiled for each case;
# in the quick suite every scene once, and every scan with either limit
CASES = [
    pytest.param(name, scan, (3, None)[(i + j) % 2], marks=[] if i % 3 == j else pytest.mark.slow)
    for i, name in enumerate(SCENES)
    for j, scan in enumerate(("single", "confocal", "exhaustive"))
]


@pytest.mark.parametrize(("name", "scan", "max_bounces"), CASES)
def test_no_bit_changes(name: str, scan: str, max_bounces: int | None) -> None:
    """Whatever the surfaces, the scan and the bounces: a path that misses everything carries nothing."""
    stage = stage_of(*SCENES[name], scan=scan, max_bounces=max_bounces)
    engine, traced = stage.engine, stage.seeded(stage.engine.options.seed)
    assert engine.hidden_aabb is not None
    traced.hidden_aabb = None
    one, other = (rendered(each, stage.batch) for each in (engine, traced))
    np.testing.assert_array_equal(one, other)
    assert one.any()


def test_nor_how_many_paths_are_asked_for() -> None:
    """A lane whose paths all miss ends like any other, and the number of paths is the one asked for."""
    stage = stage_of(PLATE | {"width": 0.02, "height": 0.02})
    engine, traced = stage.engine, stage.seeded(stage.engine.options.seed)
    traced.hidden_aabb = None
    for spp in (2, 6, 20, 2000):
        one, other = (rendered(each, stage.batch, spp) for each in (engine, traced))
        np.testing.assert_array_equal(one, other)
    assert one.any()


def test_nothing_lies_outside_the_box() -> None:
    """Rays from the wall in all directions that meet something meet the box, and most rays meet neither."""
    stage = stage_of(LETTER, BALL, PLATE, TOUCHING)
    import drjit as dr
    import mitsuba as mi

    built, box, random = stage.engine.built, stage.engine.hidden_aabb, np.random.default_rng(5)
    n = 200_000
    origins = np.stack([*random.uniform(-0.5, 0.5, (2, n)), np.full(n, 1e-9)]).astype(np.float32)
    directions = random.normal(size=(3, n)).astype(np.float32)
    directions[2] = np.abs(directions[2])
    ray = mi.Ray3f(mi.Point3f(origins), dr.normalize(mi.Vector3f(directions)))
    is_met, in_box = np.array(built.scene.ray_test(ray)), ~np.array(box.is_missed(ray))
    assert is_met.sum() > n / 100
    assert in_box[is_met].all()
    assert not in_box.all()


def test_rays_along_the_sides_count_as_meeting_it() -> None:
    """Parallel to two axes, inside, outside and in the plane of a side: nothing that may be met is left out."""
    start_backend("llvm")
    import mitsuba as mi

    from nlosrender.engine.launch.hidden_aabb import HiddenAabb

    box = HiddenAabb.of(np.array([-0.5, -0.5, 0.5]), np.array([0.5, 0.5, 1.0]))
    x = np.array([0.0, 0.5, -0.5, 0.6, -0.6], np.float32)
    ray = mi.Ray3f(mi.Point3f(x, 0, 0), mi.Vector3f(0, 0, 1))
    np.testing.assert_array_equal(np.array(box.is_missed(ray)), [False, False, False, True, True])


@pytest.mark.parametrize(
    "stage",
    [
        pytest.param(lambda: stage_of(ROOM), id="around the wall"),
        pytest.param(lambda: stage_of(PLATE, hidden_geometry_sampling=True), id="rays are aimed"),
        pytest.param(lambda: before_a_cylinder(), id="curved wall"),
        pytest.param(lambda: stage_of(), id="nothing hidden"),
    ],
)
def test_no_box_where_it_saves_nothing(stage: Any) -> None:
    """Asking takes time: few rays miss it, or none that is traced."""
    start_backend("llvm")
    assert stage().engine.hidden_aabb is None


def test_the_box_is_no_part_of_the_kernel() -> None:
    """Captures of a sweep share kernels."""
    stage = stage_of(PLATE, max_bounces=3)
    import drjit as dr

    from nlosrender.engine.launch.hidden_aabb import HiddenAabb

    hashes = []
    for size in (1.0, 2.0):
        engine = stage.seeded(1)
        assert engine.hidden_aabb is not None
        engine.hidden_aabb = HiddenAabb.of(np.array([-size, -size, 0.1]), np.array([size, size, 1]))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            rendered(engine, stage.batch)
            hashes.append({kernel["hash"] for kernel in dr.kernel_history((dr.KernelType.JIT,))})
    assert hashes[0]
    assert hashes[0] == hashes[1]
