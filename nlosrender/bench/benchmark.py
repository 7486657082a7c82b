"""The map of a benchmark: curves of every scene, scaling, rates, a whole process; and the facts around them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any

from nlosrender.bench.curve import Curve
from nlosrender.bench.peer import Peer, matched, peer_contenders
from nlosrender.bench.race import FIXED_POINT, Contender, own_contenders, race
from nlosrender.bench.rates import gather_rate, whole_process
from nlosrender.bench.references import Reference, find_reference
from nlosrender.bench.runs import LoadedScene, Timer, load
from nlosrender.bench.scaling import measure_scaling
from nlosrender.bench.scenes import BenchScene
from nlosrender.bench.skips import measure_skips
from nlosrender.files.provenance import package_versions

PARTS = ("curves", "scaling", "rates", "skips", "process")
SHARES = {"curves": 0.72, "scaling": 0.16, "rates": 0.05, "skips": 0.03, "process": 0.04}  # of the time
REFERENCE_SHARE = 0.4  # of a scene's time

Progress = Callable[[str], None]  # told what is being measured


@dataclass(frozen=True)
class SceneResult:
    """All curves of one scene."""

    scene: BenchScene
    reference_origin: str
    reference_error: float
    reference_seconds: float
    reference_energy: float
    n_pairs: int  # histograms that take ``samples`` paths each
    curves: tuple[Curve, ...]

    @property
    def floor(self) -> float:
        """Errors below this say more about the reference than about the contender."""
        return FIXED_POINT * self.reference_error

    def energy_bias(self, curve: Curve) -> float:
        """Return how much more energy a contender finds than it should.

        Ours against the reference; a peer, whose unit is its own, against its unbiased setting.
        """
        unbiased = next((other for other in self.curves if other.name == "mitransient, BSDF sampling"), None)
        if curve.name.startswith("mitransient"):
            return curve.points[-1].energy / unbiased.points[-1].energy - 1 if unbiased else math.nan
        return curve.points[-1].energy / self.reference_energy - 1

    def report(self) -> dict[str, Any]:
        """Return all as plain values; None stands for what is not known or never reached."""
        return {
            "scene": self.scene.name,
            "title": self.scene.title,
            "target": self.scene.target,
            "reference": {
                "origin": self.reference_origin,
                "error": self.reference_error,
                "seconds": self.reference_seconds,
            },
            "curves": [self._curve_report(curve) for curve in self.curves],
        }

    def _curve_report(self, curve: Curve) -> dict[str, Any]:
        seconds, how = curve.time_to(self.scene.target)
        cpu_seconds, _ = curve.time_to(self.scene.target, cpu=True)
        return {
            "name": curve.name,
            "engine": curve.engine,
            "first_seconds": curve.first_seconds,
            "seconds_to_target": seconds if math.isfinite(seconds) else None,
            "cpu_seconds_to_target": cpu_seconds if math.isfinite(cpu_seconds) else None,
            "seconds_to_target_is": how,
            "bias": curve.bias,
            "slope": curve.slope(self.floor),
            "paths_per_second": curve.paths_per_second(self.n_pairs),
            "energy_bias": self.energy_bias(curve),
            "points": [asdict(point) for point in curve.points],
        }


@dataclass
class Benchmark:
    """Everything one run of the benchmark found."""

    facts: dict[str, Any]
    scenes: list[SceneResult] = field(default_factory=list)
    scaling: list[dict[str, Any]] = field(default_factory=list)
    rates: list[dict[str, Any]] = field(default_factory=list)
    skips: list[dict[str, Any]] = field(default_factory=list)
    process: dict[str, Any] | None = None

    def report(self) -> dict[str, Any]:
        """Return all as plain values, ready for JSON."""
        return {
            "facts": self.facts,
            "scenes": [result.report() for result in self.scenes],
            "scaling": self.scaling,
            "rates": self.rates,
            "skips": self.skips,
            "process": self.process,
        }


def run_benchmark(
    scenes: Sequence[BenchScene],
    seconds: float,
    parts: Iterable[str] = PARTS,
    peer_command: str | None = None,
    progress: Progress = lambda what: None,
) -> Benchmark:
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
    benchmark, timer = Benchmark(_facts()), Timer()
    with ExitStack() as stack:
        peer = stack.enter_context(Peer(peer_command)) if peer_command is not None else None
        benchmark.facts["peer"] = peer.title if peer is not None else None
        third = [scene for scene in scenes if scene.max_bounces == 3]
        if "curves" in wanted:
            for scene in scenes:
                progress(f"{scene.name}: {scene.title}")
                benchmark.scenes.append(
                    _scene_result(
                        load(scene), peer, share["curves"] * scene.weight / sum(other.weight for other in scenes)
                    )
                )
        if "scaling" in wanted:
            progress("scaling")
            benchmark.scaling = [scaling.report() for scaling in measure_scaling(share["scaling"])]
        if "rates" in wanted:
            for scene in third:
                progress(f"gather and any-hit rate of {scene.name}")
                benchmark.rates.append(gather_rate(load(scene)).report())
        if "skips" in wanted:
            progress("what skipped work saves")
            benchmark.skips = [saving.report() for saving in measure_skips(third)]
        if "process" in wanted and third:
            progress(f"nlosrender render of {third[0].name}, whole process")
            benchmark.process = whole_process(third[0])
    benchmark.facts |= {"seconds": timer.read()[0], "load_average_at_end": os.getloadavg()}
    return benchmark


def _scene_result(loaded: LoadedScene, peer: Peer | None, seconds: float) -> SceneResult:
    timer = Timer()
    reference: Reference = find_reference(loaded, REFERENCE_SHARE * seconds)
    contenders: list[Contender] = own_contenders(loaded)
    if peer is not None:
        contenders += peer_contenders(peer, loaded)
    curves = race(contenders, reference, max(seconds - timer.read()[0], seconds / 2), loaded.scene.target, matched)
    return SceneResult(
        loaded.scene,
        reference.origin,
        reference.error,
        reference.seconds,
        float(reference.values.sum()),
        loaded.capture.n_sensors,
        tuple(curves),
    )


def _facts() -> dict[str, Any]:
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "processors": os.cpu_count(),
        "load_average_at_start": os.getloadavg(),
        "versions": package_versions(),
    }
