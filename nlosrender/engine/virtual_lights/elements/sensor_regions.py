"""Regions of the sensor grid with patches of their own close to the wall.

A surface that touches the wall is cut as finely as its nearest sensor point needs. To sensor points elsewhere on the
wall the same surface is far away, and coarser patches of it suffice: what lies near the wall is cut for every region
apart, the rest once for all. docs/virtual-lights.md, 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.engine.virtual_lights.elements.size_field import SizedElements
from nlosrender.engine.virtual_lights.elements.subdivision import Elements, WallDistance, partition_by_size, subdivide


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of the sensor grid, and the elements close to the wall as each of them needs them."""

    labels: NDArray[np.int64]  # (sensors,) region of each sensor point
    near: tuple[SizedElements, ...]  # per region
    shared: SizedElements  # farther away

    def counts(self, patch_scale: float) -> tuple[int, int]:
        """Return how many patches of hidden surfaces and of the wall one sensor point gathers, on average."""
        shares = np.bincount(self.labels, minlength=len(self.near)) / len(self.labels)
        near = shares @ np.array([elements.counts(patch_scale) for elements in self.near])
        hidden, wall = (int(count) for count in near + self.shared.counts(patch_scale))
        return hidden, wall

    def total(self, patch_scale: float) -> int:
        """Return how many patches of all regions there are."""
        return sum(sum(elements.counts(patch_scale)) for elements in (self.shared, *self.near))


def regions_of(
    capture: Capture, unit: float, distance: WallDistance, triangles: Elements, whole: SizedElements
) -> Regions | None:
    """Return the regions that make the gather cheaper, or None where one set of patches, of ``whole``, suffices.

    ``distance`` is that from all points, ``triangles`` are those of the meshes before subdivision, ``unit`` is metres
    per engine unit.
    """
    if capture.n_lasers > 1 and capture.scan_type != "confocal":
        return None  # what is near to a laser point has to be fine for all
    size_field, grid = whole.size_field, capture.sensor_grid.lattice
    tuning, wall_index = size_field.tuning, size_field.wall_index
    fitting = (n for n in tuning.region_blocks if capture.n_sensors >= n**2 * tuning.min_region_sensors)
    blocks = next(fitting, 1)
    # Beyond its own size a region sees about what its neighbours see: there elements of all points do.
    reach = max(grid.size) / blocks / unit
    small: Elements | None = None
    while blocks > 1 and whole.share_if_far(reach / 2) <= tuning.max_region_cost:
        if small is None:  # may be many, and are the same whatever the reach
            small, large = partition_by_size(triangles, distance, wall_index)
        parts = (small, subdivide(large, distance, wall_index, reach / 2))
        n_close = sum(np.count_nonzero(elements.distances < reach) for elements in parts)
        if n_close * blocks**2 <= tuning.max_region_elements:
            break
        reach /= 2  # what is nearest is cut finest
    else:
        return None  # too little to save
    close, far = (
        Elements.joined([elements.select((elements.distances < reach) == is_near) for elements in parts])
        for is_near in (True, False)
    )
    labels, point_sets = _blocks(grid, blocks)
    distances = (WallDistance(_with_points(capture, part), unit) for part in point_sets)
    near = [SizedElements(subdivide(close, distance, wall_index), size_field) for distance in distances]
    regions = Regions(labels, tuple(near), SizedElements(far, size_field))
    lighting = tuning.sensors_per_patch_cost
    cost = sum(regions.counts(1.0)) * capture.n_sensors + regions.total(1.0) * lighting
    cost_of_one = sum(whole.counts(1.0)) * (capture.n_sensors + lighting)
    return regions if cost < tuning.max_region_cost * cost_of_one else None


def _blocks(grid: PointGrid, blocks: int) -> tuple[NDArray[np.int64], list[PointGrid]]:
    """Return the block (points,) of each point of ``blocks`` x ``blocks``, and the points of each that has any."""
    if grid.is_list:
        at = np.minimum((grid.places * blocks).astype(np.int64), blocks - 1)
        found, labels = np.unique(at @ [1, blocks], return_inverse=True)
        return labels, [_part(grid, (slice(None), labels == label)) for label in range(len(found))]
    rows, columns = (np.arange(n) * blocks // n for n in (grid.ny, grid.nx))
    labels = (rows[:, None] * blocks + columns).reshape(-1)
    return labels, [_part(grid, np.ix_(rows == row, columns == column)) for row, column in np.ndindex(blocks, blocks)]


def _part(grid: PointGrid, chosen: Any) -> PointGrid:
    return replace(grid, **{name: getattr(grid, name)[chosen] for name in ("wall_coordinates", "positions", "normals")})


def _with_points(capture: Capture, part: PointGrid) -> Capture:
    """Return the capture with other sensor points, and laser points where they are the same."""
    is_same = capture.laser_grid is capture.sensor_grid
    return replace(capture, sensor_grid=part, laser_grid=part if is_same else capture.laser_grid)
