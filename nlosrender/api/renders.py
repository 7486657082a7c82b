"""Rendering from Python and by the command line: a capture or a sweep, with its data set."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nlosrender.api.configuration import Configuration, Source, load
from nlosrender.api.opened_capture import Capture
from nlosrender.api.progress_bar import Wanted, reported, warn_caller
from nlosrender.config.mapping_load import Changes, change_texts
from nlosrender.errors import OptionError, RenderError
from nlosrender.files.atomic_write import refuse_sources
from nlosrender.files.packages.package import pack
from nlosrender.files.path_argument import path_argument
from nlosrender.pipeline import render_capture
from nlosrender.rendering.sweep_render import SweepReport, render_sweep

if TYPE_CHECKING:
    from nlosrender.config.document import Config
    from nlosrender.rendering.dask_cluster import Cluster
    from nlosrender.rendering.render_report import Progress, RenderReport, Warn, Watch


def render(
    source: Source,
    out: str | os.PathLike[str] | None = None,
    changes: Changes | Iterable[str] = (),
    *,
    progress: Wanted = False,
    overwrite: bool = False,
    resume: bool = False,
    strict: bool = False,
    cluster: Cluster | None = None,
) -> Capture:
    """Render one capture, write its file and open it.

    Options named in messages, such as ``--overwrite``, are the parameters of these names. Warnings are
    :class:`NlosWarning`. Ctrl-C keeps what is finished: the same call goes on from there.

    Parameters
    ----------
    source, changes
        As of :func:`load`.
    out
        File to write; None: where ``output.path`` says.
    progress
        True: show a bar; a function: call it with the share of the work done, in [0, 1].
    overwrite
        Throw an unfinished render away, and replace another capture. Without it, one of the same configuration is
        replaced, no other.
    resume
        Demand an unfinished render to go on with.
    strict
        Refuse to render where light is missing that no technique samples.
    cluster
        Who renders the work items; None: this process.

    Raises
    ------
    ConfigError
        The configuration has mistakes, or is a sweep (:func:`render_all`), or ``strict``.
    OptionError
        ``overwrite`` and ``resume`` exclude each other, or an argument is of another type.
    BackendError, FileError, RenderError, IncompleteRender, InterruptedRender
        As ``nlosrender render`` ends.
    """
    configuration = load(source, [*change_texts(changes), *_output(out)])
    wanted = _resuming(overwrite, resume)
    with reported(progress, "render") as told:
        report = render_single(configuration, told, warn_caller, resume=wanted, strict=strict, cluster=cluster)
    return Capture(report.output, report)


def render_single(
    configuration: Configuration, progress: Progress, warn: Warn, *, resume: bool | None, **how: Any
) -> RenderReport:
    """Render the capture of a configuration; ``how`` and the errors are those of ``pipeline.render_capture``."""
    config = configuration.config
    refuse_sources(config.output.path, [] if configuration.file is None else [configuration.file])
    with configuration.document.placing_issues():
        return render_capture(config, progress, warn, resume=resume, **how)


def render_all(
    source: Source,
    changes: Changes | Iterable[str] = (),
    *,
    progress: Wanted = False,
    overwrite: bool = False,
    resume: bool = False,
) -> list[Capture]:
    """Render the captures of a sweep that are not there yet, with their index, and open them in their order.

    Parameters and errors as of :func:`render`; files go where ``output.path`` says.

    Raises
    ------
    OptionError
        The configuration has no sweep.
    RenderError
        Some captures failed; the others were rendered.
    """
    configuration = load(source, changes)
    wanted = _resuming(overwrite, resume)
    with reported(progress, "sweep") as told:
        report, _ = render_captures(configuration, told, warn_caller, resume=wanted)
    refuse_failed(report)
    return [Capture(path) for path in configuration.paths]


def render_captures(
    configuration: Configuration,
    progress: Progress,
    warn: Warn,
    *,
    resume: bool | None,
    shard: tuple[int, int] | None = None,
    watch: Watch = lambda standing: None,
    **how: Any,
) -> tuple[SweepReport, dict[str, Any] | None]:
    """Render the captures of a configuration's sweep, and pack them where it says so.

    Parameters
    ----------
    configuration
        It has a sweep.
    progress, warn, resume, shard, watch
        As of ``render_sweep``.
    how
        As of ``pipeline.render_capture``, for each capture.

    Returns
    -------
    tuple
        The report, and what ``pack`` has packed; None: nothing.
    """
    sweep = configuration.sweep
    if sweep is None:
        raise OptionError(f"{configuration.document.source}: has no sweep; use render.")

    def render_one(config: Config, progress: Progress, warn: Warn, resume: bool | None) -> RenderReport:
        with configuration.document.placing_issues():  # a capture that fails is reported by the sweep
            return render_capture(config, progress, warn, resume=resume, watch=watch, **how)

    report = render_sweep(sweep, render_one, shard=shard, resume=resume, progress=progress, warn=warn, watch=watch)
    # a shard does not know whether the others are done
    is_packed = sweep.dataset.format != "znlos" and shard is None and len(report.failed) < report.captures
    return report, pack(sweep.output_folder) if is_packed else None


def refuse_failed(report: SweepReport) -> None:
    """Raise RenderError where captures of a sweep have failed, with what each said."""
    if report.failed:
        listed = "\n".join(f"{entry.file}: {entry.message}" for entry in report.failed)
        raise RenderError(f"{listed}\n{len(report.failed)} of {report.captures} captures failed.")


def _output(out: str | os.PathLike[str] | None) -> Iterable[str]:
    return () if out is None else output_change(path_argument("out", out))


def output_change(output: Path) -> Iterable[str]:
    """Yield the change that makes ``output`` the file to write."""
    yield f"output.path={json.dumps(str(output))}"  # JSON is YAML: "1e3" or "yes" stay text


def _resuming(overwrite: bool, resume: bool) -> bool | None:
    if overwrite and resume:
        raise OptionError("overwrite and resume exclude each other: give one of them")
    return False if overwrite else True if resume else None
