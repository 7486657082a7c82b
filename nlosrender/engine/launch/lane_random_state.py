"""Random state of every lane, carried from launch to launch: how a render is cut into launches changes no bit."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from nlosrender.engine.launch.device_arrays import on_device
from nlosrender.engine.launch.passes import Snapshot
from nlosrender.engine.launch.sequences import SystematicSequence


@dataclass(frozen=True, eq=False)
class LaneRandomness:
    """Generator and low-discrepancy state of every lane, one lane per sensor point and replica."""

    generator: mi.PCG32
    sequence: list[mi.UInt32]  # low-discrepancy state, three dimensions
    phase: mi.UInt32 | None = None  # paths until the next one that continues after bounce 3 (Russian roulette)
    systematic: SystematicSequence | None = None  # position in the block of paths under way

    def snapshot(self) -> Snapshot:
        """Return the state as arrays on the host."""
        arrays = {"state": self.generator.state, "inc": self.generator.inc}
        arrays |= {f"sequence{k}": state for k, state in enumerate(self.sequence)}
        numbers: dict[str, object] = {}
        if self.phase is not None:
            arrays["phase"] = self.phase
        if self.systematic is not None:
            arrays["position"] = self.systematic.position
            numbers["block"] = [self.systematic.block.start, self.systematic.block.stop]
        return Snapshot({name: np.asarray(values.numpy()) for name, values in arrays.items()}, numbers)

    @classmethod
    def restored(cls, snapshot: Snapshot) -> LaneRandomness:
        """Undo ``snapshot``."""
        arrays = snapshot.arrays
        generator = mi.PCG32(len(arrays["state"]))
        generator.state, generator.inc = (on_device(mi.UInt64, arrays[name]) for name in ("state", "inc"))
        sequence = [on_device(mi.UInt32, arrays[f"sequence{k}"]) for k in range(3)]
        phase = on_device(mi.UInt32, arrays["phase"]) if "phase" in arrays else None
        systematic = None
        if "position" in arrays:
            systematic = SystematicSequence.at_position(
                range(*snapshot.numbers["block"]), on_device(mi.UInt64, arrays["position"])
            )
        return cls(generator, sequence, phase, systematic)

    @classmethod
    def seeded(cls, seed: int, lane_key: mi.UInt32) -> LaneRandomness:
        """Seed every lane from the render's seed and ``lane_key``, its identity in the capture: batches do not show."""
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
