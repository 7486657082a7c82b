"""The third bounce of a batch: patches of the hidden geometry, lit by the lasers and gathered by the sensor points."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import THIRD_BOUNCE
from nlosrender.capture.plan import REPLICA_LIMIT, Batch
from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.device_capture import DeviceCapture
from nlosrender.engine.launch.flat_mirrors import FlatMirrors
from nlosrender.engine.launch.histogram import HistogramShape
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.passes import Passes, Snapshot
from nlosrender.engine.launch.pilot_points import Pilot
from nlosrender.engine.virtual_lights.elements.patches import Patches
from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram
from nlosrender.engine.virtual_lights.gather.device_patches import PatchRegions, upload_patches
from nlosrender.engine.virtual_lights.gather.kernel import GatherPasses
from nlosrender.engine.virtual_lights.gather.lighting import (
    ROWS,
    GatherSettings,
    LitPatches,
    MaskQuery,
    PackedPatches,
    light_patches,
    pack_patches,
)
from nlosrender.engine.virtual_lights.gather.sensor_lattice import SensorLattice
from nlosrender.engine.virtual_lights.refinement import Gathered, Lattice, coarser_scale
from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning
from nlosrender.engine.virtual_lights.visibility.masks import (
    VisibilityMasks,
    WallTiles,
    count_sensors,
    footprint_margin,
)

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator


@dataclass(frozen=True, eq=False)
class ShadowRayTargets:
    """Patches that some laser point lights [engine units], and what is known of the rays that sensor points ask for."""

    positions: NDArray[np.float64]  # (n, 3) where rays from sensor points end
    normals: NDArray[np.float64]  # (n, 3)
    mask: NDArray[np.uint64]  # (n,) see ``VisibilityMasks.of``
    tiles: NDArray[np.uint64]  # (sensors,) bit of the tile that each sensor point lies in, numbered as in the batch


@dataclass(frozen=True, eq=False)
class _Lanes:
    """One lane per sensor point and slice of the patches, neighbours together."""

    params: LaunchParams  # what they read
    index: mi.UInt32
    slice_index: mi.UInt32  # of the patches that all sensor points share
    sensors: NDArray[np.int64]  # (lanes,) flat index in the sensor grid
    order: NDArray[np.int64]  # (sensors,) the sensor point of each lane of a slice, numbered as in the batch
    regions: NDArray[np.int64]  # (lanes,)


class ThirdBounce:
    """Gathers the third bounce.

    Parameters
    ----------
    device
        The capture on the device.
    tessellator
        Cuts the hidden geometry.
    settings
        What the gather's kernel does.
    lanes
        Lanes that keep the backend busy.
    is_reciprocal
        Whether exchanging laser and sensor point changes nothing, see ``reciprocity.is_reciprocal``: then no two
        points are gathered from twice in one batch.
    mirror
        The scene's only mirror: patches are lit and seen by reflection in it, too, bounces 4 and 5. None: no mirror.
    """

    def __init__(
        self,
        device: DeviceCapture,
        tessellator: Tessellator,
        settings: GatherSettings,
        lanes: int,
        is_reciprocal: bool = False,
        mirror: FlatMirrors | None = None,
    ):
        self.mirror = mirror
        self.device, self.tessellator, self.settings, self.lanes = device, tessellator, settings, lanes
        self.is_reciprocal = is_reciprocal
        self.masks = VisibilityMasks(device.built, tessellator.tuning)
        self.footprint_places = self.tuning.footprint_places[1]  # as ``Budget.footprint_places``
        self._saved: dict[tuple[float, bool], LitPatches] = {}  # per patch scale, and whether lit by mirror

    def gather(
        self, batch: Batch | Pilot, patch_scale: float, passes: Passes | None = None, lattice: Lattice | None = None
    ) -> Gathered:
        """Gather a batch at one resolution; ``lattice``: that visibility is interpolated on."""
        passes = passes or Passes()
        patches = self.tessellator.patches(patch_scale)  # made here once: the tessellator keeps small resolutions only
        deviation = None
        if (earlier := passes.resumed("values")) is not None:
            values, deviation = earlier.arrays["values"], earlier.arrays.get("deviation")
        elif self.device.footprint is not None:
            one, other = (
                self._sums(
                    batch, patch_scale, patches, passes.stage(f"half {half}", half / 2, (half + 1) / 2), half=half
                )
                for half in range(2)
            )
            halves = [2 / self.footprint_places * sums.on_host() for sums in (one, other)]
            values, deviation = (halves[0] + halves[1]) / 2, (halves[0] - halves[1]) / 2
        elif self.is_reciprocal and isinstance(batch, Batch):
            values = self._by_reciprocity(batch, patch_scale, patches, passes)
        else:
            stage = passes.stage("sums", 0, 0.25 if self.mirror else 1)
            values = self._sums(batch, patch_scale, patches, stage, lattice=lattice).on_host()
            if self.mirror is not None:
                mirrored = self._mirrored(batch, patch_scale, patches, passes)
                values = np.concatenate([values, *mirrored], axis=1)
                if not self.device.options.bounces.split:
                    values = values.sum(axis=1, keepdims=True)
        passes.finish(Snapshot({"values": values} | ({} if deviation is None else {"deviation": deviation})))
        count = len(patches) if self.tessellator.regions is None else self.tessellator.count(patch_scale)
        return Gathered(values, max(count, 1), patch_scale, deviation)  # 1: nothing may face the wall

    def _mirrored(
        self, batch: Batch | Pilot, patch_scale: float, patches: Patches, passes: Passes
    ) -> Iterator[NDArray[np.float64]]:
        """Yield bounces 4 and 5: what laser, sensor point, or both of them see by way of the mirror."""

        def sums(part: int, lit_by_mirror: bool, seen_by_mirror: bool) -> NDArray[np.float64]:
            stage, way = passes.stage(f"by mirror {part}", part / 4, (part + 1) / 4), (lit_by_mirror, seen_by_mirror)
            return self._sums(batch, patch_scale, patches, stage, way=way).on_host()

        yield sums(1, False, True) + sums(2, True, False)
        highest = self.device.options.bounces.max_bounces
        if highest is None or highest > THIRD_BOUNCE + 1:
            yield sums(3, True, True)

    @property
    def tuning(self) -> VirtualLightTuning:
        """Numbers of the engine: those that the tessellator has."""
        return self.tessellator.tuning

    def forget(self) -> None:
        """Light patches anew from now on, as an engine would that has gathered nothing yet."""
        self._saved = {}

    def _by_reciprocity(
        self, batch: Batch, patch_scale: float, patches: Patches, passes: Passes
    ) -> NDArray[np.float64]:
        """Gather from every two points once: the one with the higher index stands for the sensor point.

        Whatever the batch, so that how a capture is cut does not show. A batch of other lasers than sensor points is
        gathered in two parts, the second with their roles exchanged.
        """
        sensors, lasers = self.device.sensor_indices(batch), self.device.laser_indices(batch)
        is_symmetric = np.array_equal(sensors, lasers)
        one = passes.stage("one way", 0, 1 if is_symmetric else 0.5)
        if (earlier := one.resumed("values")) is not None:
            values = earlier.arrays["values"]
        else:
            sums = self._sums(batch, patch_scale, patches, one, np.searchsorted(lasers, sensors, side="right"))
            if is_symmetric:
                return sums.on_host(is_symmetric=True)
            values = sums.on_host()
        one.finish(Snapshot({"values": values}))
        exchanged = Batch(sensors=batch.lasers, lasers=batch.sensors)
        other = passes.stage("other way", 0.5, 1)
        others = self._sums(exchanged, patch_scale, patches, other, np.searchsorted(sensors, lasers))
        values += others.on_host().swapaxes(2, 3)
        return values

    def _sums(
        self,
        batch: Batch | Pilot,
        patch_scale: float,
        patches: Patches,
        passes: Passes,
        lasers: NDArray[np.int64] | None = None,
        way: tuple[bool, bool] = (False, False),
        half: int = 0,
        lattice: Lattice | None = None,
    ) -> BlockHistogram:
        """Gather the ``patches`` that all sensor points share, then what regions have of their own.

        ``lasers`` (sensors,) tells of how many lasers each sensor point gathers the light, the first ones; None: all.
        ``way``: whether lasers, and sensor points, see the patches by way of the mirror. ``half``: of the places in a
        footprint the even or the odd ones, whose light is added up.
        """
        shape, footprint = self.shape(batch), self.device.footprint
        lanes = self._lanes(batch, shape, lasers)
        histogram = BlockHistogram(shape, lanes.order)
        work = GatherPasses(self.settings, histogram, passes, self.device.options.schedule.first_gather_pairs)
        if footprint is None:
            self._gather_from(lanes, batch, shape, patch_scale, patches, work, way, lattice)
            return histogram
        places = footprint.turned_places(range(half, self.footprint_places // 4, 2))
        for some in places.reshape(-1, shape.replicas, 2):
            x, y = (on_device(mi.Float, np.repeat(column, shape.sensors)) for column in some.T)
            moved = replace(lanes, params=lanes.params.at_place(mi.Point2f(x, y)))
            self._gather_from(moved, batch, shape, patch_scale, patches, work, way)
        return histogram

    def _gather_from(
        self,
        lanes: _Lanes,
        batch: Batch | Pilot,
        shape: HistogramShape,
        patch_scale: float,
        patches: Patches,
        work: GatherPasses,
        way: tuple[bool, bool],
        lattice: Lattice | None = None,
    ) -> None:
        """Add what the sensor points of ``lanes`` gather; parameters as of ``_sums``."""
        lit_by, seen_by = (self.mirror if by_mirror else None for by_mirror in way)
        if len(patches):
            wall_tiles = self._wall_tiles(batch)
            packed = self._shared_lights(lanes.params, shape, patch_scale, patches, wall_tiles, lit_by, lattice)
            tile = wall_tiles.tile_bit(mi.UInt32(0), lanes.params.sensors.interaction.p)
            nodes = self._nodes(lattice, lanes.sensors, lanes.slice_index.numpy())
            work.gather(lanes.params, packed, lanes.index, lanes.slice_index, tile, seen_by, nodes)
        for labels, near in self.tessellator.regional_patches(patch_scale, np.unique(lanes.regions).tolist()):
            places = PatchRegions.of([len(one) for one in near])
            if not len(places.numbers):  # nothing is close to the wall there
                continue
            chosen = np.flatnonzero(np.isin(lanes.regions, labels))
            slices = self._slices(shape)
            slice_index = np.searchsorted(labels, lanes.regions[chosen]) * slices + chosen // shape.sensors % slices
            index = on_device(mi.UInt32, chosen)
            some, wall_tiles = lanes.params.gather_lanes(index), self._wall_tiles(batch, labels)
            lit_patches = self._light_by_lasers(some, shape, Patches.joined(near), places, wall_tiles, lit_by, lattice)
            packed = pack_patches(self.settings, some, lit_patches, slices, some.lasers_per_lane, lit_by, lattice)
            tile = wall_tiles.tile_bit(on_device(mi.UInt32, slice_index // slices), some.sensors.interaction.p)
            nodes = self._nodes(lattice, lanes.sensors[chosen], slice_index)
            work.gather(some, packed, index, on_device(mi.UInt32, slice_index), tile, seen_by, nodes)

    def _nodes(
        self, lattice: Lattice | None, sensors: NDArray[np.int64], slices: NDArray[np.integer]
    ) -> SensorLattice | None:
        """Return the lattice of lanes with ``sensors`` and ``slices`` (lanes,); None: every point sends rays."""
        return None if lattice is None else SensorLattice.of(self.device, sensors, slices, lattice, self.lanes)

    @property
    def lattices(self) -> tuple[Lattice, ...]:
        """Lattices that visibility may be interpolated on, the widest first, one ray from each node to a patch.

        None where neighbours in the grid need not see alike (lists, a camera's pixels), in footprints and by way of a
        mirror, and where a ray serves many laser points.
        """
        built, grid, settings = self.device.built, self.device.capture.sensor_grid, self.settings
        if not settings.needs_visibility or not (settings.is_confocal or settings.has_one_laser) or grid.is_list:
            return ()
        if self.mirror is not None or self.device.footprint is not None or built.pixels is not None:
            return ()
        widest = min(grid.nx, grid.ny) // self.tuning.min_lattice
        return tuple(Lattice(step, 1) for step in self.tuning.visibility_steps if step <= widest)

    def shadow_ray_targets(self, batch: Batch | Pilot, patch_scale: float) -> ShadowRayTargets:
        """Return the patches that the gather of a batch goes through, in its order; those all sensor points share."""
        shape = self.shape(batch)
        lanes, patches, wall_tiles = (
            self._lanes(batch, shape),
            self.tessellator.patches(patch_scale),
            self._wall_tiles(batch),
        )
        packed = self._shared_lights(lanes.params, shape, patch_scale, patches, wall_tiles, None)
        rows = np.array(packed.packed, np.float32).reshape(-1, ROWS, 4)
        ends, normals = (rows[:, 3] + rows[:, 4] + rows[:, 5])[:, :3], np.array(packed.interaction.n, np.float64).T
        tiles = np.empty(shape.sensors, np.uint64)
        bits = np.array(wall_tiles.tile_bit(mi.UInt32(0), lanes.params.sensors.interaction.p))
        tiles[lanes.order] = bits[: shape.sensors]
        return ShadowRayTargets(ends.astype(np.float64), normals, np.array(packed.mask), tiles)

    def _shared_lights(
        self,
        params: LaunchParams,
        shape: HistogramShape,
        patch_scale: float,
        patches: Patches,
        wall_tiles: WallTiles,
        lit_by: FlatMirrors | None,
        lattice: Lattice | None = None,
    ) -> PackedPatches:
        """Return what all sensor points gather; lit patches are saved where other batches have the same lasers."""
        key = patch_scale, lit_by is not None
        lit_patches = self._saved.get(key)
        if lit_patches is None:
            places = PatchRegions.of([len(patches)])
            lit_patches = self._light_by_lasers(params, shape, patches, places, wall_tiles, lit_by, lattice)
        elif self.settings.needs_visibility and not lattice and not lit_patches.is_cleared:
            # saved by a pilot, whose points were too few for masks
            lit_patches = lit_patches.cleared(MaskQuery(self.masks, wall_tiles))
        if self.settings.lights_once and len(patches) <= self.tuning.max_kept_patches:
            # a batch gathers two resolutions
            others = [(other, lit) for other, lit in self._saved.items() if other != key]
            self._saved = dict([*others, (key, lit_patches)][-2 if self.mirror is None else -4 :])
        slices = self._slices(shape)
        return pack_patches(self.settings, params, lit_patches, slices, params.lasers_per_lane, lit_by, lattice)

    def _light_by_lasers(
        self,
        params: LaunchParams,
        shape: HistogramShape,
        patches: Patches,
        places: PatchRegions,
        wall_tiles: WallTiles,
        lit_by: FlatMirrors | None,
        lattice: Lattice | None,
    ) -> LitPatches:
        is_near = self.tessellator.nearest < self.tuning.near_distance
        on_device = upload_patches(
            self.device.built, patches, places, self.device.options.seed, is_near, self.settings.is_diffuse, self.tuning
        )
        if lattice is not None:  # its few nodes send rays without masks
            wall_tiles = replace(wall_tiles, n_points=0)
        masks = MaskQuery(self.masks, wall_tiles)
        return light_patches(self.settings, params, on_device, masks, params.lasers_per_lane, lit_by)

    def _wall_tiles(self, batch: Batch | Pilot, regions: list[int] | None = None) -> WallTiles:
        """Return what patches are seen from: all points, or the sensor points of some regions."""
        built, capture = self.device.built, self.device.capture
        if regions is None or self.tessellator.regions is None:
            return WallTiles.of(built, capture, batch, with_lasers=not self.settings.has_one_laser)
        labels = self.tessellator.regions.labels
        points = capture.sensor_grid.positions.reshape(-1, 3) / built.metres_per_engine_unit
        groups = [points[labels == label] for label in regions]
        n_points = count_sensors(capture, batch) // len(self.tessellator.regions.near)
        return WallTiles.around(groups, n_points, footprint_margin(built, capture))

    def pair(
        self, batch: Batch | Pilot, patch_scale: float, passes: Passes | None = None, lattice: Lattice | None = None
    ) -> tuple[Gathered, Gathered]:
        """Gather a batch at ``patch_scale`` and at the coarser resolution it is compared with; see ``gather``."""
        passes, coarser = passes or Passes(), coarser_scale(self.tessellator, patch_scale)
        share = 1 / (1 + self.tuning.refinement)
        coarse = self.gather(batch, coarser, passes.stage("coarse", 0, share), lattice)
        return coarse, self.gather(batch, patch_scale, passes.stage("fine", share, 1), lattice)

    def shape(self, batch: Batch | Pilot) -> HistogramShape:
        """Return the histogram's shape; its ``replicas`` are slices: lanes that share the patches of a sensor point, or
        places in its footprint.

        As many as the capture needs, not the batch: how a capture is cut must not show in the result. No more than
        the replicas that the plan has counted memory for.
        """
        most = self.device.options.replicas if isinstance(batch, Batch) else REPLICA_LIMIT
        points = self.device.capture.n_sensors if isinstance(batch, Batch) else batch.sensors.size
        replicas = max(1, min(math.ceil(self.lanes / points), most))
        if self.device.footprint is not None:  # a power of two, as the number of places is
            replicas = min(1 << (replicas.bit_length() - 1), self.footprint_places // 2)
        return replace(self.device.shape(batch, 1), replicas=replicas)

    def _slices(self, shape: HistogramShape) -> int:
        """Return how many lanes share the patches of a sensor point; in a footprint each is at a place of its own."""
        return shape.replicas if self.device.footprint is None else 1

    def _lanes(self, batch: Batch | Pilot, shape: HistogramShape, lasers: NDArray[np.int64] | None = None) -> _Lanes:
        params = self.device.launch_params(batch, replace(shape, replicas=1))
        indices, order = self.device.sensor_indices(batch), self.device.lane_order(batch)
        lane = dr.arange(mi.UInt32, shape.lanes)
        params = params.gather_lanes(dr.gather(mi.UInt32, on_device(mi.UInt32, order), lane % shape.sensors))
        slice_index = lane // shape.sensors % self._slices(shape)
        dr.eval(lane, slice_index)
        if lasers is not None:
            params = replace(params, n_lasers=on_device(mi.UInt32, np.tile(lasers[order], shape.replicas)))
        sensors, regions = np.tile(indices[order].astype(np.int64), shape.replicas), np.zeros(shape.lanes, np.int64)
        if self.tessellator.regions is not None:
            regions = self.tessellator.regions.labels[sensors]
        return _Lanes(params, lane, slice_index, sensors, order, regions)
