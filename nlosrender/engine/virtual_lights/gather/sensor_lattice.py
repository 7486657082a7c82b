"""Sensor lattice: visibility of patches from every n-th sensor point along rows and columns, bilinear in between.

The visibility of a patch changes slowly across the sensor grid, so that few sensor points, the nodes, need to trace
shadow rays. There are so few that each may trace ``SHADOW_RAYS`` rays to a patch instead of one, for less noise. The
interpolation error grows as the squared step; a pilot measures it: docs/virtual-lights.md, 5.8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.engine.launch.wall_points import sensor_points
from nlosrender.engine.virtual_lights.elements.patches import SHADOW_RAYS
from nlosrender.engine.virtual_lights.gather.device_patches import facing
from nlosrender.engine.virtual_lights.gather.lighting import ROWS, GatherSettings, PackedPatches
from nlosrender.engine.virtual_lights.refinement import Lattice
from nlosrender.engine.virtual_lights.visibility.shadow_rays import is_visible
from nlosrender.scene.build import BuiltScene

# Visible share of a patch over its lit share; above 1 where lit members of a cluster face the node more than others.
MAX_SHARE = 2.0
SHARES = 63  # quantisation of the share: steps from 0 to 1
FRONT = 1 << 7  # bit of a node that lies in front of a patch, above its share
CORNER_BITS = 8  # of a node in the number of a cell
MAX_ENTRIES = 2**23  # pairs of cell and patch that are kept at once: 32 MB


@dataclass(frozen=True, eq=False)
class SensorLattice:
    """Nodes, the sensor points that rays start at, and the cells between four of them, per slice of the patches."""

    nodes: mi.SurfaceInteraction3f
    slices: mi.UInt32  # of the patches that each node looks at
    corners: list[mi.UInt32]  # four nodes of each cell
    of_lane: mi.UInt32  # cell that the lane's sensor point lies in
    weights: list[mi.Float]  # four per lane: of the cell's corners
    n_nodes: int
    n_cells: int
    stride: mi.UInt32  # ``n_cells``, opaque
    rays: int  # from each node to a patch
    lanes_per_node: int  # each traces rays to every n-th patch: nodes alone are too few to occupy all threads

    @classmethod
    def of(
        cls,
        device: DeviceCapture,
        sensors: NDArray[np.int64],
        slices: NDArray[np.integer],
        lattice: Lattice,
        lanes: int,
    ) -> SensorLattice:
        """Return the lattice of lanes with flat sensor indices and ``slices`` (lanes,).

        Nodes are every ``lattice.step``-th point of a row or column from the first one on, and the last one. ``lanes``
        occupy all threads.
        """
        grid, n_sensors = device.capture.sensor_grid, device.capture.n_sensors
        columns, across = _between_nodes(sensors % grid.nx, lattice.step, grid.nx)
        rows, up = _between_nodes(sensors // grid.nx, lattice.step, grid.ny)
        corners = np.array([y * grid.nx + x for y in rows for x in columns]) + slices.astype(np.int64) * n_sensors
        _, first, of_lane = np.unique(corners[0], return_index=True, return_inverse=True)
        cells = corners[:, first]
        nodes, first, places = np.unique(cells.T, return_index=True, return_inverse=True)
        order = np.argsort(first)  # as the lanes are: rays of neighbours stay together
        nodes, places = nodes[order], np.argsort(order)[places].reshape(cells.T.shape).T
        slice_index, index = np.divmod(nodes, n_sensors)
        return cls(
            nodes=sensor_points(device.built, device.capture, device.time_axis, index).interaction,
            slices=on_device(mi.UInt32, slice_index),
            corners=[on_device(mi.UInt32, corner) for corner in places],
            of_lane=on_device(mi.UInt32, of_lane.ravel()),
            weights=[on_device(mi.Float, y * x) for y in (1 - up, up) for x in (1 - across, across)],
            n_nodes=len(nodes),
            n_cells=cells.shape[1],
            stride=dr.opaque(mi.UInt32, cells.shape[1]),
            rays=lattice.rays,
            lanes_per_node=math.ceil(lanes / len(nodes)),
        )

    @property
    def most_steps(self) -> int:
        """Patches of a slice whose visibility may be kept at once."""
        return max(1, MAX_ENTRIES // max(self.n_cells, self.n_nodes))

    def visibility(
        self, settings: GatherSettings, built: BuiltScene, packed: PackedPatches, skipped: mi.UInt32, most: mi.UInt32
    ) -> mi.UInt32:
        """Return what the corners of each cell see of the patches, ``CORNER_BITS`` each.

        One number per patch and cell, patch by patch. ``skipped`` and ``most``: patches of each slice, opaque, as of
        ``gather_third_bounce``.
        """
        n_nodes, n_patches = dr.opaque(mi.UInt32, self.n_nodes), most[0]
        seen = dr.zeros(mi.UInt8, self.n_nodes * n_patches)
        _trace_rays(self, settings, built, packed, skipped, most, n_nodes, seen)
        dr.eval(seen)
        of_cells = dr.zeros(mi.UInt32, self.n_cells * n_patches)
        _join_corners(self, most, n_nodes, seen, of_cells)
        dr.eval(of_cells)
        return of_cells

    def share(self, of_cells: mi.UInt32, entry: mi.UInt32) -> mi.Float:
        """Return the visible share of a patch's light, from ``entry`` of ``visibility``: bilinear.

        Corners behind a one-sided patch trace no rays: interpolation leaves them out.
        """
        bits, seen, front = dr.gather(mi.UInt32, of_cells, entry), mi.Float(0), mi.Float(0)
        for k, weight in enumerate(self.weights):
            corner = bits >> (k * CORNER_BITS)
            seen += weight * mi.Float(corner & (FRONT - 1))
            front += dr.select((corner & FRONT) != 0, weight, 0)
        return dr.select(seen > 0, seen / (SHARES * front), 0)


def _between_nodes(
    places: NDArray[np.int64], step: int, count: int
) -> tuple[list[NDArray[np.int64]], NDArray[np.float64]]:
    """Return the nodes before and after places on an axis of ``count`` points, and how far they are between these."""
    low = places // step * step
    high = np.minimum(low + step, count - 1) if step > 1 else low
    return [low, high], (places - low) / np.maximum(high - low, 1)


@dr.syntax
def _trace_rays(
    lattice: SensorLattice,
    settings: GatherSettings,
    built: BuiltScene,
    packed: PackedPatches,
    skipped: mi.UInt32,
    most: mi.UInt32,
    n_nodes: mi.UInt32,
    seen: mi.UInt8,
) -> None:
    """Store how much of the light of each patch a node sees, and whether it is in front: patch by patch."""
    lane = dr.arange(mi.UInt32, lattice.n_nodes * lattice.lanes_per_node)
    node, number, stride = lane % n_nodes, lane // n_nodes, dr.opaque(mi.UInt32, lattice.lanes_per_node)
    sensor, slice_index = (dr.gather(type(values), values, node) for values in (lattice.nodes, lattice.slices))
    first = dr.gather(mi.UInt32, packed.first, slice_index) + skipped
    end = dr.minimum(first + most, dr.gather(mi.UInt32, packed.first, slice_index + 1))
    patch = first + number
    while dr.hint(
        patch < end, exclude=[lattice, settings, built, packed, n_nodes, seen, sensor, node, first, end, stride]
    ):
        row = dr.gather(mi.Vector4f, packed.packed, patch * ROWS + 3)
        from_sensor = mi.Point3f(row.x, row.y, row.z) - sensor.p
        in_front, is_two_sided = mi.Bool(True), dr.gather(mi.Vector4f, packed.packed, patch * ROWS + 4).w > 0
        if dr.hint(settings.is_diffuse, mode="scalar"):
            in_front = dr.dot(dr.gather(mi.Normal3f, packed.shading, patch), from_sensor) < 0
            in_front |= is_two_sided
        if dr.hint(lattice.rays == 1, mode="scalar"):
            shown, offset = (dr.gather(mi.Vector4f, packed.packed, patch * ROWS + k).xyz for k in (4, 5))
            is_seen = is_visible(built, sensor, from_sensor + shown, offset, in_front)
            share = dr.select(is_seen, mi.Float(1), 0)
        else:
            is_cluster, power, visible, total = row.w > 0, 2 if settings.is_confocal else 1, mi.Float(0), mi.Float(0)
            for k in range(SHADOW_RAYS):
                place, offset = (
                    dr.gather(mi.Vector4f, packed.ends, 2 * (patch * SHADOW_RAYS + k) + part) for part in range(2)
                )
                to_end = from_sensor + place.xyz
                cosine = facing(is_cluster, offset.xyz, to_end, settings.is_diffuse & ~is_two_sided) ** power
                total += offset.w * cosine
                weight = place.w * cosine
                is_seen = is_visible(built, sensor, to_end, offset.xyz, in_front & (weight > 0))
                visible += dr.select(is_seen, weight, 0)
            in_front &= total > 0
            share = dr.minimum(visible / total, MAX_SHARE)
        bits = dr.select(in_front, mi.UInt32(SHARES * share + 0.5) | FRONT, 0)
        dr.scatter(seen, mi.UInt8(bits), (patch - first) * n_nodes + node)
        patch += stride


@dr.syntax
def _join_corners(
    lattice: SensorLattice, most: mi.UInt32, n_nodes: mi.UInt32, seen: mi.UInt8, of_cells: mi.UInt32
) -> None:
    """Store the bits of the four corners of each cell: patch by patch."""
    step, first, entry = mi.UInt32(0), mi.UInt32(0), dr.arange(mi.UInt32, lattice.n_cells)
    while dr.hint(step < most, exclude=[lattice, most, n_nodes, seen, of_cells]):
        bits = mi.UInt32(0)
        for k in range(4):
            bits |= mi.UInt32(dr.gather(mi.UInt8, seen, lattice.corners[k] + first)) << (k * CORNER_BITS)
        dr.scatter(of_cells, bits, entry)
        entry += lattice.stride
        first += n_nodes
        step += 1
