"""Embree's any-hit rate on the rays of the gather: what remains when all else is taken away."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nlosrender.bench.runs import LoadedScene, Timer

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.third_bounce import ShadowRayTargets

REPEATS = 3
RAYS_PER_LAUNCH = 2**24
SPREAD = 1024  # counters that the lanes share, so that they rarely wait for one another


def trace_any_hit(loaded: LoadedScene, lit: ShadowRayTargets, *, only_asked: bool = False) -> tuple[int, float]:
    """Trace the shadow ray of every pair of sensor point and patch that face each other, and do nothing else.

    The rays are those of the gather, and in its order: neighbouring lanes are neighbouring sensor points looking at
    the same point of the same patch, and neighbouring patches follow each other.

    Parameters
    ----------
    loaded
        Scene and sensor points.
    lit
        Patches of the gather; all sensor points look at them.
    only_asked
        Whether to leave out the rays that the masks of the gather leave out.

    Returns
    -------
    tuple
        Number of rays, and the seconds of the fastest of three rounds.
    """
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.launch.device_arrays import on_device
    from nlosrender.engine.launch.morton import morton_order
    from nlosrender.engine.launch.ray_offsets import WALL_OFFSET
    from nlosrender.engine.virtual_lights.gather.device_patches import to_points

    built, n_sensors = loaded.built, loaded.capture.n_sensors
    points = loaded.capture.sensor_grid.positions.reshape(-1, 3) / built.metres_per_engine_unit
    order = np.argsort(morton_order(points), kind="stable")
    sensors, tiles = to_points(points[order]), on_device(mi.UInt64, lit.tiles[order])
    centres, normals = to_points(lit.positions), to_points(lit.normals)
    masks = on_device(mi.UInt64, lit.mask if only_asked else np.zeros_like(lit.mask))
    step = max(1, RAYS_PER_LAUNCH // n_sensors)
    dr.eval(sensors, centres, normals)

    def trace(first: int) -> int:
        count = min(step, len(lit.positions) - first) * n_sensors
        index = dr.arange(mi.UInt32, count)
        patch = index // n_sensors + dr.opaque(mi.UInt32, first)
        origin = dr.gather(mi.Point3f, sensors, index % n_sensors) + mi.Vector3f(0, 0, WALL_OFFSET)
        towards = dr.gather(mi.Point3f, centres, patch) - origin
        turned = (dr.dot(mi.Vector3f(dr.gather(mi.Point3f, normals, patch)), towards) < 0) & (towards.z > 0)
        known = dr.gather(mi.UInt64, masks, patch)
        turned &= (known & dr.gather(mi.UInt64, tiles, index % n_sensors)) == 0
        ray = mi.Ray3f(origin, towards, mi.Float(1), mi.Float(0), [])
        hit = built.scene.ray_test(ray, coherent=False, active=turned)
        # sums inside the kernel: nothing of the size of the rays is written; hits are summed so that they are asked for
        counts = dr.zeros(mi.UInt32, 2 * SPREAD)
        dr.scatter_add(counts, mi.UInt32(1), (index % SPREAD) * 2, turned)
        dr.scatter_add(counts, mi.UInt32(1), (index % SPREAD) * 2 + 1, hit & turned)
        return int(np.asarray(counts.numpy(), dtype=np.int64)[::2].sum())

    spent, rays = [], 0
    for _ in range(REPEATS):
        timer = Timer()
        rays = sum(trace(first) for first in range(0, len(lit.positions), step))
        spent.append(timer.read()[0])
    return rays, min(spent)
