"""Parts of the sensor grid that have patches of their own close to the wall.

A surface that touches the wall is cut as finely as its nearest sensor point needs. To sensor points elsewhere on the
wall the same surface is far away, and coarser patches of it serve: what lies near the wall is cut for every region
apart, the rest once for all.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture, PointGrid
from nlosrender.engine.virtual_lights.elements.size_field import SizedElements
from nlosrender.engine.virtual_lights.elements.subdivision import Elements, WallDistance, partition_by_size, subdivide

BLOCKS = (8, 4, 2)  # regions along each side of the sensor grid, the first that leaves enough points in each
LEAST_POINTS = 256  # of a region
MOST_CELLS = 1_000_000  # close to the wall, of all regions together: 0.5 GB, and some seconds
# Cutting and lighting a patch takes as long as gathering it by so many sensor points.
POINTS_PER_PATCH = 500
WORTH = 0.7  # of the cost without regions: what they have to save to be worth while


@dataclass(frozen=True, eq=False)
class Regions:
    """Parts of the sensor grid, and the cells close to the wall as each of them needs them."""

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
    """Return the regions that make the gather cheaper, or None where one set of patches does for all.

    Parameters
    ----------
    capture, unit
        Where the points are, and metres per engine unit.
    distance
        Distance from all of them.
    triangles
        Triangles of the meshes as cells, not quartered yet.
    whole
        The cells cut for all points at once.
    """
    if capture.n_lasers > 1 and capture.scan_type != "confocal":
        return None  # what is near to a laser point has to be fine for all
    blocks = next((blocks for blocks in BLOCKS if capture.n_sensors >= blocks**2 * LEAST_POINTS), 1)
    # Beyond its own size a region sees about what its neighbours see: there cells of all points do.
    reach = max(capture.sensor_grid.size) / blocks / unit
    wall_index = whole.size_field.wall_index
    small: Elements | None = None
    while blocks > 1 and whole.share_if_far(reach / 2) <= WORTH:
        if small is None:  # may be many, and are the same whatever the reach
            small, large = partition_by_size(triangles, distance, wall_index)
        parts = (small, subdivide(large, distance, wall_index, reach / 2))
        if sum(np.count_nonzero(elements.distances < reach) for elements in parts) * blocks**2 <= MOST_CELLS:
            break
        reach /= 2  # what is nearest is cut finest
    else:
        return None  # too little to save
    close, far = (
        Elements.joined([elements.at((elements.distances < reach) == is_near) for elements in parts])
        for is_near in (True, False)
    )
    grid = capture.sensor_grid
    rows, columns = (np.arange(n) * blocks // n for n in (grid.ny, grid.nx))
    near = []
    for row, column in np.ndindex(blocks, blocks):
        part = _part_of(capture, np.ix_(rows == row, columns == column))
        own = subdivide(close, WallDistance(part, unit), wall_index)
        near.append(SizedElements(own, whole.size_field))
    labels = (rows[:, None] * blocks + columns).reshape(-1)
    regions = Regions(labels, tuple(near), SizedElements(far, whole.size_field))
    cost = sum(regions.counts(1.0)) * capture.n_sensors + regions.total(1.0) * POINTS_PER_PATCH
    without = sum(whole.counts(1.0)) * (capture.n_sensors + POINTS_PER_PATCH)
    return regions if cost < WORTH * without else None


def _part_of(capture: Capture, chosen: tuple[NDArray[np.intp], ...]) -> Capture:
    """Return the capture with a part of its sensor points, and of its laser points where they are the same."""
    grid = capture.sensor_grid
    part = PointGrid(
        grid.wall_coordinates[chosen], grid.positions[chosen], grid.normals[chosen], grid.uvs[chosen], grid.size
    )
    lasers = part if capture.laser_grid is grid else capture.laser_grid
    return replace(capture, sensor_grid=part, laser_grid=lasers)
