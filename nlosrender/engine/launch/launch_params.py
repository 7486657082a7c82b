"""What a launch of the path integrator reads and carries on: settings, scene and points, random state."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE, BounceAxis
from nlosrender.engine.launch.device_arrays import WallPoints, on_device
from nlosrender.engine.launch.passes import Snapshot
from nlosrender.engine.launch.surface_sampler import SurfaceSampler
from nlosrender.engine.launch.systematic_sequence import SystematicSequence
from nlosrender.engine.launch.time_gate import TimeGate
from nlosrender.engine.path.hidden_aabb import HiddenAabb
from nlosrender.scene.build import BuiltScene

HIGHEST_SURVIVAL = 0.95  # of the roulette: even a white closed room ends


@dataclass(frozen=True)
class PathSettings:
    """What the integrator computes and how; part of the compiled kernel."""

    bounces: BounceAxis
    first_bounce: int  # lowest bounce that is deposited, >= 3
    p_hidden_sampling: float  # share of wall vertices that sample the hidden geometry; 0 = BSDF only, 1 = hidden only
    laser_sampling: bool
    russian_roulette: bool
    spot_radius: float  # of the laser on the wall [engine units]; 0 = a point
    needs_visibility: bool  # something may lie between a vertex and a laser or sensor point
    has_transmission: bool  # some BSDF refracts: the optical path length needs the medium's index
    is_plain_diffuse: bool  # to the BSDFs: no textures, no anisotropy, no normals of vertices

    @property
    def goes_on(self) -> bool:
        """Whether paths have more than one vertex after the sensor point."""
        return self.last_vertex is None or self.last_vertex > FIRST_BOUNCE + 1

    @property
    def last_vertex(self) -> int | None:
        """Bounce index of the last vertex a path may have: one more than the bounces when rays look for the spot."""
        highest = self.bounces.max_bounces
        return highest + 1 if highest is not None and self.finds_spot else highest

    @property
    def has_time_gate(self) -> bool:
        """Whether few paths go on that can only bring light after the time window."""
        return self.goes_on and self.russian_roulette

    @property
    def has_continuation_roulette(self) -> bool:
        """Whether only some of the paths may go on beyond the third bounce, which all of them deposit."""
        is_first = self.first_bounce == THIRD_BOUNCE and self.laser_sampling
        return self.has_time_gate and is_first and not self.finds_spot

    @property
    def finds_spot(self) -> bool:
        """Whether rays may find the laser's spot by chance."""
        return self.spot_radius > 0


@dataclass(frozen=True, eq=False)
class LaunchParams:
    """Everything a launch reads: scene, points, and the conversion from engine units to bins."""

    built: BuiltScene
    sampler: SurfaceSampler
    sensors: WallPoints  # one per lane
    lasers: WallPoints  # all lasers of the batch
    first_laser: mi.UInt32  # per lane: confocal lanes have their own laser, others start at 0
    lasers_per_lane: int
    n_lasers: mi.UInt32  # opaque copy of ``lasers_per_lane``: its value is not part of the kernel
    bins_per_unit: mi.Float  # engine unit / bin width, opaque
    time_gate: TimeGate | None  # None: all light arrives before the end of the window
    hidden_aabb: HiddenAabb | None  # None: few rays from the wall miss it
    row_of_lane: mi.UInt32  # per lane: which lane's rows of the histogram it adds to
    continuation_period: mi.UInt32  # n of ``roulette``: one path in n goes on after bounce 3; opaque

    def gather_lanes(self, index: mi.UInt32) -> LaunchParams:
        """Return what the lanes at ``index`` read."""
        sensors, first_laser = self.sensors.gather(index), dr.gather(mi.UInt32, self.first_laser, index)
        row_of_lane = dr.gather(mi.UInt32, self.row_of_lane, index)
        dr.eval(sensors.interaction, sensors.delay_bins, sensors.delay_fraction, first_laser, row_of_lane)
        return replace(self, sensors=sensors, first_laser=first_laser, row_of_lane=row_of_lane)


@dataclass(frozen=True, eq=False)
class LaneRandomness:
    """Random state of every lane; carried from launch to launch, so that splitting a render changes no bit."""

    generator: mi.PCG32
    sequence: list[mi.UInt32]  # low-discrepancy state, three dimensions
    phase: mi.UInt32 | None = None  # paths until the next one that goes on beyond the third bounce
    systematic: SystematicSequence | None = None  # of the stage of paths that is under way

    def snapshot(self) -> Snapshot:
        """Return the state as arrays on the host."""
        arrays = {"state": self.generator.state, "inc": self.generator.inc}
        arrays |= {f"sequence{k}": state for k, state in enumerate(self.sequence)}
        numbers: dict[str, object] = {}
        if self.phase is not None:
            arrays["turn"] = self.phase
        if self.systematic is not None:
            arrays["at"] = self.systematic.at
            numbers["stage"] = [self.systematic.stage.start, self.systematic.stage.stop]
        return Snapshot({name: np.asarray(values.numpy()) for name, values in arrays.items()}, numbers)

    @classmethod
    def restored(cls, snapshot: Snapshot) -> LaneRandomness:
        """Undo ``snapshot``."""
        arrays = snapshot.arrays
        generator = mi.PCG32(len(arrays["state"]))
        generator.state, generator.inc = (on_device(mi.UInt64, arrays[name]) for name in ("state", "inc"))
        sequence = [on_device(mi.UInt32, arrays[f"sequence{k}"]) for k in range(3)]
        phase = on_device(mi.UInt32, arrays["turn"]) if "turn" in arrays else None
        systematic = None
        if "at" in arrays:
            systematic = SystematicSequence.at_position(
                range(*snapshot.numbers["stage"]), on_device(mi.UInt64, arrays["at"])
            )
        return cls(generator, sequence, phase, systematic)

    @classmethod
    def seeded(cls, seed: int, lane_key: mi.UInt32) -> LaneRandomness:
        """Seed every lane from the render's seed and the lane's identity, never from its place in a batch."""
        state_high, state_low = mi.sample_tea_32(mi.UInt32(seed), lane_key, 8)
        key_high, key_low = mi.sample_tea_32(lane_key, mi.UInt32(seed ^ 0x9E3779B9), 8)
        wide = mi.UInt64(2**32)
        generator = mi.PCG32(
            initstate=mi.UInt64(state_high) * wide + mi.UInt64(state_low),
            initseq=mi.UInt64(key_high) * wide + mi.UInt64(key_low),
        )
        starts = [generator.next_uint32() for _ in range(3)]
        dr.eval(generator, starts)
        return cls(generator, starts)
