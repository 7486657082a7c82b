"""The map of a benchmark: curves of every scene, scaling, rates, a whole process; and the facts around them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

from nlosrender.bench.counting import counting_rates
from nlosrender.bench.curve import Curve
from nlosrender.bench.factory import factory_rates
from nlosrender.bench.peer import UNBIASED_NAME, Peer, PeerContender, matched, peer_contenders
from nlosrender.bench.race import FIXED_POINT, Contender, own_contenders, race
from nlosrender.bench.rates import gather_rate, whole_process
from nlosrender.bench.references import find_reference
from nlosrender.bench.runs import LoadedScene, Timer, load
from nlosrender.bench.scaling import measure_scaling
from nlosrender.bench.scenes import BenchScene
from nlosrender.bench.skips import measure_skips
from nlosrender.files.provenance import package_versions

PARTS = ("curves", "scaling", "rates", "skips", "process", "measure", "factory")
SHARES = {
    "curves": 0.72,
    "scaling": 0.16,
    "rates": 0.05,
    "skips": 0.03,
    "process": 0.03,
    "measure": 0.01,
    "factory": 1.0,  # minutes for the large grids, so only when it is asked for
}  # of the time
DEFAULT_PARTS = PARTS[:-1]
REFERENCE_SHARE = 0.4  # of a scene's time

Report = dict[str, Any]  # plain values, ready for JSON; None: not known, or never reached
Progress = Callable[[str], None]  # called with what is being measured


def run_benchmark(
    scenes: Sequence[BenchScene],
    seconds: float,
    parts: Iterable[str] = DEFAULT_PARTS,
    peer_command: str | None = None,
    progress: Progress = lambda what: None,
) -> Report:
    """Measure in about ``seconds``.

    Parameters
    ----------
    scenes
        For the curves; the rates take those of them that have the third bounce alone, the process the first of those.
    seconds
        Shared out over ``parts`` and scenes. Compilation comes on top.
    parts
        Some of ``PARTS``.
    peer_command
        Also race this peer, see ``peer.Peer``.
    progress
        Called before each measurement.

    Raises
    ------
    ConfigError
        A scene's mesh cannot be read.
    BackendError
        Nothing on this machine can render, or the peer does not run.
    RenderError
        A render failed.
    """
    wanted = [part for part in PARTS if part in set(parts)]
    share = {part: seconds * SHARES[part] / sum(SHARES[name] for name in wanted) for part in wanted}
    third = [scene for scene in scenes if scene.max_bounces == 3]
    timer = Timer()
    facts: Report = {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "processors": os.cpu_count(),
        "load_average_at_start": os.getloadavg(),
        "versions": package_versions(),
    }
    report: Report = {"facts": facts, "scenes": [], "scaling": [], "rates": [], "skips": [], "process": None}
    report |= {"measure": [], "factory": []}
    with ExitStack() as stack:
        peer = stack.enter_context(Peer(peer_command)) if peer_command is not None else None
        facts["peer"] = peer.title if peer is not None else None
        if "curves" in wanted:
            weights = sum(scene.weight for scene in scenes)
            for scene in scenes:
                progress(f"{scene.name}: {scene.title}")
                report["scenes"].append(scene_curves(load(scene), peer, share["curves"] * scene.weight / weights))
        if "scaling" in wanted:
            progress("scaling")
            report["scaling"] = measure_scaling(share["scaling"])
        if "rates" in wanted:
            for scene in third:
                progress(f"gather and any-hit rate of {scene.name}")
                report["rates"].append(gather_rate(load(scene)))
        if "skips" in wanted:
            progress("what skipped work saves")
            report["skips"] = [saving.report() for saving in measure_skips(third)]
        if "process" in wanted and third:
            progress(f"nlosrender render of {third[0].name}, whole process")
            report["process"] = whole_process(third[0])
        if "measure" in wanted:
            progress("counting photons")
            report["measure"] = counting_rates()
        if "factory" in wanted:
            progress("captures an hour of a data set")
            report["factory"] = factory_rates(share["factory"])
    report["facts"] |= {"seconds": timer.read()[0], "load_average_at_end": os.getloadavg()}
    return report


def scene_curves(loaded: LoadedScene, peer: Peer | None, seconds: float) -> Report:
    """Race all contenders on one scene in about ``seconds``.

    Raises
    ------
    BackendError, RenderError
        As ``run_benchmark``.
    """
    timer, scene = Timer(), loaded.scene
    reference = find_reference(loaded, REFERENCE_SHARE * seconds)
    contenders: list[Contender] = own_contenders(loaded)
    if peer is not None and not any(surface.bsdf["type"] == "retroreflector" for surface in loaded.built.surfaces):
        contenders += peer_contenders(peer, loaded)
    curves = race(contenders, reference, max(seconds - timer.read()[0], seconds / 2), scene.target, matched)
    # the energy of a peer, whose unit is its own, is compared with that of its unbiased setting
    of_peers = {contender.name for contender in contenders if isinstance(contender, PeerContender)}
    unbiased = next((curve.points[-1].energy for curve in curves if curve.name == UNBIASED_NAME), math.nan)
    energy, floor = float(reference.values.sum()), FIXED_POINT * reference.error
    return {
        "scene": scene.name,
        "title": scene.title,
        "target": scene.target,
        "reference": {"origin": reference.origin, "error": reference.error, "seconds": reference.seconds},
        "curves": [
            _curve_report(curve, scene.target, floor, unbiased if curve.name in of_peers else energy, loaded)
            for curve in curves
        ],
    }


def _curve_report(curve: Curve, target: float, floor: float, energy: float, loaded: LoadedScene) -> Report:
    """Return a curve as plain values; ``floor``: errors below it say more about the reference than the contender."""
    (seconds, how), (cpu_seconds, _), last = curve.time_to(target), curve.time_to(target, cpu=True), curve.points[-1]
    return {
        "name": curve.name,
        "engine": curve.engine,
        "first_seconds": curve.first_seconds,
        "seconds_to_target": seconds if math.isfinite(seconds) else None,
        "cpu_seconds_to_target": cpu_seconds if math.isfinite(cpu_seconds) else None,
        "seconds_to_target_is": how,
        "bias": curve.bias,
        "slope": curve.slope(floor),
        "paths_per_second": last.samples * loaded.capture.n_sensors / last.seconds if last.samples else None,
        "energy_bias": last.energy / energy - 1,
        "points": [asdict(point) for point in curve.points],
    }
