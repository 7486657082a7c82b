"""What the batches of a plan take in memory, and whether the limit for it makes sense."""

from __future__ import annotations

from collections.abc import Iterator

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.capture.grids import Capture
from nlosrender.capture.plan import BYTES_PER_SUM, MAX_SUMS, Batch, Plan
from nlosrender.engine.backend.start import PROCESS_BYTES, batch_memory, physical_memory, scene_memory
from nlosrender.engine.engines import Engine
from nlosrender.engine.preflight.omitted_work import traces_paths
from nlosrender.engine.virtual_lights.engine import VirtualLightEngine
from nlosrender.engine.virtual_lights.gather.block_histogram import BlockHistogram
from nlosrender.engine.virtual_lights.third_bounce import COARSEST_SCALE, REFINEMENT
from nlosrender.errors import ConfigError, RenderError

PATCH_BYTES = 400  # float64 on the host, while they are cut and joined, and float32 on the device


def batch_bytes(engine: Engine, plan: Plan) -> int:
    """Return the memory of the largest batch [bytes]: histograms, their statistics and copies.

    Raises
    ------
    RenderError
        A batch has more sums than 32-bit indices reach.
    """
    largest = max(plan.batches, key=lambda batch: n_pairs(engine.capture, batch))
    paths = engine.paths if isinstance(engine, VirtualLightEngine) else engine
    entries = paths.shape(largest, paths.n_slots).size
    gathered = 0
    if isinstance(engine, VirtualLightEngine):
        gathered = BlockHistogram.entries(engine.third.shape(largest))
    if max(entries, gathered) > MAX_SUMS:
        raise RenderError(
            f"a batch of {max(entries, gathered):.2e} sums is more than 32-bit indices reach; lower render.memory_limit"
        )
    return max(plan.bytes_per_batch, gathered * BYTES_PER_SUM)


def memory_warnings(engine: Engine, plan: Plan, memory_limit: int | None, lanes: int) -> Iterator[str]:
    """Yield what is surprising about the memory of a render.

    Parameters
    ----------
    engine, plan
        As set up for the capture.
    memory_limit
        The user's limit for the process [bytes]; None: none given.
    lanes
        Lanes that keep the backend busy.

    Raises
    ------
    ConfigError
        A batch or the gather's patches do not fit the memory.
    RenderError
        As ``batch_bytes``.
    """
    taken, physical = batch_bytes(engine, plan), physical_memory()
    available, scene = batch_memory(memory_limit, engine.built.n_triangles), scene_memory(engine.built.n_triangles)
    if isinstance(engine, VirtualLightEngine):
        _refuse_patches(engine, available)
    bound = physical if memory_limit is None else memory_limit
    if scene + PROCESS_BYTES > bound:
        yield (
            f"render.memory_limit: {engine.built.n_triangles} triangles take about {_size(scene)} beside the program's "
            f"{_size(PROCESS_BYTES)}, more than {_size(bound)}."
        )
    if memory_limit is not None and memory_limit > physical:
        yield f"render.memory_limit: {_size(memory_limit)} is more than the machine's {_size(physical)}."
    if taken > physical:
        raise ConfigError.at(*_too_large(engine, taken, physical))
    if taken > available:
        yield (
            f"render.memory_limit: a batch takes {_size(taken)}, more than is left for it: the gather needs rows for "
            "every processor. Use fewer bins or lasers, or render.engine: path."
        )
    largest = max(batch.sensors.size for batch in plan.batches)
    if len(plan.batches) > 1 and traces_paths(engine) and largest * plan.replicas < lanes:
        yield (
            f"render.memory_limit leaves batches of {largest} {_points(engine)}, too few to keep the machine busy; "
            "a higher limit is faster."
        )


def _too_large(engine: Engine, taken: int, physical: int) -> tuple[str, str]:
    """Return the key to change and the message for a batch that does not fit the machine."""
    found = f"a batch takes {_size(taken)}, more than the machine's {_size(physical)}"
    if isinstance(engine, VirtualLightEngine):
        advice = "the gather needs rows for every processor. Use fewer bins or lasers, or render.engine: path."
        return "render.engine", f"{found}: {advice}"
    return "render.memory_limit", f"{found}. Lower it, or use fewer bins or {_points(engine)}."


def _points(engine: Engine) -> str:
    return "pixels" if engine.capture.scan_type == LINE_OF_SIGHT else "sensor points"


def _refuse_patches(engine: VirtualLightEngine, memory_limit: int) -> None:
    needed = engine.tessellator.count(COARSEST_SCALE) * REFINEMENT
    if needed * PATCH_BYTES > memory_limit:
        message = (
            f"bins of {engine.time_axis.bin_width_opl:.3g} m need {needed:.1e} patches of the hidden geometry, "
            f"{_size(needed * PATCH_BYTES)}, but render.memory_limit leaves {_size(memory_limit)}. Use wider bins, or "
            "render.engine: path."
        )
        raise ConfigError.at("time_axis.bin_width_opl", message)


def n_pairs(capture: Capture, batch: Batch) -> int:
    """Return the pairs of laser and sensor points in a batch."""
    return batch.sensors.size * (batch.lasers.size if capture.scan_type == "exhaustive" else 1)


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 1e9:.3g} GB"
