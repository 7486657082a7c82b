"""Memory of the batches of a plan, and warnings about render.memory_limit."""

from __future__ import annotations

from collections.abc import Iterator

from nlosrender.capture.plan import Plan
from nlosrender.engine.backend.start import PROCESS_BYTES, batch_memory, physical_memory, scene_memory
from nlosrender.engine.interface import Engine
from nlosrender.engine.launch.cost_pilot import points_of
from nlosrender.errors import ConfigError
from nlosrender.readable import readable_size


def memory_warnings(engine: Engine, plan: Plan, memory_limit: int | None, lanes: int) -> Iterator[str]:
    """Yield warnings about the memory of a render.

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
        A batch, or what all batches share, does not fit the memory.
    RenderError
        A batch has more sums than 32-bit indices reach.
    """
    triangles, physical = engine.built.n_triangles, physical_memory()
    available, scene = batch_memory(memory_limit, triangles), scene_memory(triangles)
    taken = engine.batch_bytes(plan, available)
    bound = physical if memory_limit is None else memory_limit
    if scene + PROCESS_BYTES > bound:
        yield (
            f"render.memory_limit: {triangles} triangles take about {readable_size(scene)} beside the program's "
            f"{readable_size(PROCESS_BYTES)}, more than {readable_size(bound)}."
        )
    if memory_limit is not None and memory_limit > physical:
        limit = readable_size(memory_limit)
        yield f"render.memory_limit: {limit} is more than the machine's {readable_size(physical)}."
    has_rows_beside = taken > plan.bytes_per_batch or not engine.traces_paths
    advice = "the gather needs rows for every processor. Use fewer bins or lasers, or render.engine: path."
    if taken > physical:
        found = f"a batch takes {readable_size(taken)}, more than the machine's {readable_size(physical)}"
        if has_rows_beside:
            raise ConfigError.at("render.engine", f"{found}: {advice}")
        raise ConfigError.at(
            "render.memory_limit", f"{found}. Lower it, or use fewer bins or {points_of(engine.capture)}."
        )
    if taken > available:
        yield f"render.memory_limit: a batch takes {readable_size(taken)}, more than is left for it: {advice}"
    largest = max(batch.sensors.size for batch in plan.batches)
    if len(plan.batches) > 1 and engine.traces_paths and largest * plan.replicas < lanes:
        yield (
            f"render.memory_limit leaves batches of {largest} {points_of(engine.capture)}, too few to keep the machine "
            "busy; a higher limit is faster."
        )
