"""THE MAP: a capture from its configuration to its file, as one list of stages. Read this first.

configuration (``config/``) -> scene, capture and plan, engine (``rendering/stages.py``, which lists these stages)
-> work items, one after the other, rendered and written (``rendering/local_executor.py``, or
``dask_executor.py`` on a cluster) -> one file (``files/partial/partial_capture.py``).
Mitsuba and Dr.Jit are imported only when a render starts, after the backend has been chosen.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from nlosrender.capture.part import WHOLE, Selection
from nlosrender.capture.plan import remaining_items, replicas_for
from nlosrender.config.document import Config
from nlosrender.config.load import config_hash, config_to_dict
from nlosrender.config.warnings import config_warnings
from nlosrender.files.atomic_write import check_writable
from nlosrender.files.capture_results import MISSED
from nlosrender.files.file_kinds import CAPTURE
from nlosrender.files.identity import capture_identity, files_read, identity_attributes
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.parts.shards import part_attributes
from nlosrender.files.provenance import provenance_attributes
from nlosrender.rendering.dask_executor import render_on_cluster
from nlosrender.rendering.dask_worker import Job
from nlosrender.rendering.ground_truth import ground_truth
from nlosrender.rendering.item_in_flight import SAVING, SavePolicy
from nlosrender.rendering.local_executor import render_items, resumable
from nlosrender.rendering.outcome import missed_target, missing_light, remarks, summed_capture
from nlosrender.rendering.photon_counts import photon_counts
from nlosrender.rendering.process_layout import ONE_PROCESS
from nlosrender.rendering.render_report import Monitor, Progress, RenderReport, Stopwatch, Warn, Warnings, Watch
from nlosrender.rendering.render_warnings import render_warnings
from nlosrender.rendering.stages import calibrated_budget, set_up_engine, started_backend

if TYPE_CHECKING:
    from nlosrender.rendering.dask_cluster import Cluster


def render_capture(
    config: Config,
    progress: Progress = lambda fraction: None,
    warn: Warn = lambda text: None,
    *,
    selection: Selection = WHOLE,
    resume: bool | None = None,
    cluster: Cluster | None = None,
    watch: Watch = lambda standing: None,
    strict: bool = False,
    saving: SavePolicy = SAVING,
) -> RenderReport:
    """Render one capture, or a part of it, and write its file.

    Parameters
    ----------
    config
        A validated configuration.
    progress
        Called now and then with the share of the work done.
    warn
        Called with every warning, before the first work item.
    selection
        The part that is rendered.
    resume
        None: go on with an unfinished render of the same capture where there is one; True: there has to be one;
        False: start anew.
    cluster
        Who renders the work items; None: this process. The file is the same.
    watch
        Called with how many work items are finished: before the first one, and after each.
    strict
        Refuse to render where light is missing that no technique samples.
    saving
        When the state of the work item in flight is saved.

    Raises
    ------
    ConfigError
        ``strict``, and there are paths that carry light and are not sampled.
        Something only the renderer could find wrong: a mesh that cannot be read, a BSDF that Mitsuba rejects, a
        capture that does not fit the memory, a memory limit below what the program itself takes.
    OptionError
        The capture does not have the part that is selected.
    BackendError
        There is no usable LLVM or GPU, here or on a worker.
    FileError
        The output cannot be written, there is an unfinished render of something else, or a file that is not this
        capture: another capture is replaced when ``resume`` is False, anything else never.
    RenderError
        The result is not finite.
    IncompleteRender, InterruptedRender
        The render stopped half-way; the same call goes on from there.
    """
    stopwatch, warnings = Stopwatch(), Warnings(warn)
    # --- configuration: refuse what can be refused before anything takes time ---
    warnings.emit(config_warnings(config))
    resolved, output = config_to_dict(config), config.output
    with stopwatch.stage("scene"):
        check_writable(output.path, CAPTURE, files_read(resolved))
        backend = started_backend(config)
    processes = ONE_PROCESS if cluster is None else cluster.processes
    replicas = replicas_for(backend.lanes, config.capture.n_sensors)
    identity = capture_identity(resolved, str(selection), backend.variant, replicas)
    with PartialCapture.claim(output.path, identity, resume) as partial:
        # --- scene -> capture and plan -> engine ---
        with stopwatch.stage("scene"):
            plan, engine, header = set_up_engine(config, backend, selection, processes)
            unsampled = missing_light(engine, strict)
            warnings.emit(paths.warning for paths in unsampled)
            warnings.emit(render_warnings(config, backend, plan, engine, header, processes))
        with stopwatch.stage("render"):
            budget = calibrated_budget(config, engine)
        # --- work items -> chunks in the partial capture; an earlier run's are kept ---
        with resumable(partial) as stop:
            provenance = provenance_attributes(
                resolved, config_hash(config), engine=engine.name, seed=config.render.seed, meshes=engine.built.meshes
            )
            with stopwatch.stage("truth") if output.ground_truth else nullcontext():
                truth = ground_truth(config, engine.built, engine.capture)
            attributes = provenance | identity_attributes(identity)
            partial.open(header, attributes, output.compression, output.variance, truth)
            warnings.emit(partial.damage)
            earlier = len(partial.finished.items)
            items = remaining_items(plan, header.confocal, partial.finished.items)
            partial.begin_run(earlier + len(items))
            shown = (lambda standing: watch(replace(standing, error=None))) if unsampled else watch
            monitor = Monitor(stopwatch, progress, lambda text: warnings.emit([text]), shown)
            if cluster is None:
                render_items(items, engine, budget, partial, stop, monitor, saving)
            else:
                job = Job(config, selection, identity, backend.name, processes)
                render_on_cluster(items, job, budget, partial, stop, cluster, monitor)
            # --- ideal histograms -> what a detector counts of them ---
            counted = photon_counts(config, selection, partial, stopwatch, warnings)
            # --- results -> attributes, and the partial capture becomes the file ---
            summed = summed_capture(engine, unsampled, partial.finished.sums)
            missed = missed_target(config.render, summed.stated_error)
            warnings.emit([f"H is zero everywhere: {'; '.join(summed.zero_because)}."] if summed.zero_because else [])
            warnings.emit([missed] if missed else [])
            # the file of an earlier run may say another sensor
            configured = {name: provenance[name] for name in ("config", "config_hash")}
            results = summed.attributes(stopwatch.report()) | configured | counted
            results |= remarks(engine, config, warnings.emitted)
            if selection != WHOLE:
                results |= part_attributes(plan.part, plan.tiling, partial.finished)
            elif missed:
                results[MISSED] = missed
            partial.publish(results)
    return RenderReport(
        output=Path(output.path),
        engine=engine.name,
        reason=engine.reason,
        variant=backend.variant,
        part=None if selection == WHOLE else str(plan.part),
        units=earlier + len(items),
        resumed_units=earlier,
        n_bins=header.n_bins,
        n_triangles=engine.built.n_triangles,
        seconds=stopwatch.report(),
        warnings=tuple(warnings.emitted),
        **summed.results(),
    )
