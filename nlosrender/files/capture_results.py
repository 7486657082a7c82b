"""What a file and a report state of all that was rendered, from the sums over it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nlosrender.capture.bounces import BounceAxis
from nlosrender.files.sums import Sums

UNSAMPLED, ZERO, MISSED = "unsampled_paths", "zero_because", "target_missed"
UNKNOWN_FROM = "unsampled_first_bounce"
WARNINGS, OMITTED = "warnings", "omitted_work"  # of the render: lists of texts


@dataclass(frozen=True, kw_only=True)
class CaptureResults:
    """What the report of a render, or of a merge, says of the capture."""

    samples: int  # paths per sensor point, the least of all work items
    error_estimate: float  # relative L2 error of H over the whole capture; NaN: not known
    energy: dict[str, float]  # H summed over the capture, per bounce [J m^-2 sr^-1]
    out_of_window: float  # the same outside the time window
    unsampled_paths: tuple[str, ...] = ()  # classes of paths whose light is missing
    zero_because: tuple[str, ...] = ()  # why H is zero everywhere; empty where it is not
    error_estimate_per_bounce: Mapping[str, float | None] = field(default_factory=dict)  # None: not known, or no light
    energy_error_per_bounce: Mapping[str, float | None] = field(default_factory=dict)  # standard error; None: not known


@dataclass(frozen=True)
class SummedCapture:
    """Sums over a render, or over several that were put together, and what is missing of it."""

    sums: Sums
    bounces: BounceAxis
    unsampled: tuple[str, ...] = ()  # classes of paths whose light is missing
    zero_because: tuple[str, ...] = ()  # why H is zero everywhere; empty where it is not
    unknown_from: int | None = None  # the lowest bounce that light is missing of; None: of none

    @property
    def stated_error(self) -> float:
        """Relative L2 error of H; NaN where light is missing."""
        return math.nan if self.unsampled else self.sums.error_estimate

    def results(self) -> dict[str, Any]:
        """Return the fields of ``CaptureResults``."""
        sums, bounces = self.sums, self.bounces
        return {
            "samples": sums.samples or 0,
            "error_estimate": self.stated_error,
            "energy": sums.energy_per_bounce(bounces),
            "out_of_window": float(sums.outside),
            "unsampled_paths": self.unsampled,
            "zero_because": self.zero_because,
            "error_estimate_per_bounce": self._known(sums.errors_per_bounce(bounces)),
            "energy_error_per_bounce": self._known(sums.energy_errors(bounces)),
        }

    def attributes(self, seconds: Mapping[str, float]) -> dict[str, object]:
        """Return the results as attributes of the file; ``seconds`` were spent in each stage."""
        results = self.results()
        stated: dict[str, object] = {UNSAMPLED: list(self.unsampled)}
        if self.unknown_from is not None:
            stated[UNKNOWN_FROM] = self.unknown_from
        if self.zero_because:
            stated[ZERO] = list(self.zero_because)
        if self.sums.samples is not None:
            stated["samples"] = self.sums.samples
        return stated | {
            "error_estimate": self.stated_error,
            "seconds": json.dumps({stage: float(spent) for stage, spent in seconds.items()}),
            "out_of_window_energy": results["out_of_window"],
            "energy_error": math.nan if self.unsampled else self.sums.energy_error,
            **{
                name: json.dumps(results[name], allow_nan=name == "energy")
                for name in ("energy", "error_estimate_per_bounce", "energy_error_per_bounce")
            },
        }

    def _known(self, errors: Mapping[str, float]) -> dict[str, float | None]:
        """Return errors by bounce number as JSON holds them: None where there is no number, or light is missing."""
        lowest = self.unknown_from
        first_unknown = len(errors) if lowest is None else self.bounces.slot(max(lowest, self.bounces.first))
        known = (slot < first_unknown and math.isfinite(error) for slot, error in enumerate(errors.values()))
        return {name: errors[name] if is_known else None for name, is_known in zip(errors, known, strict=True)}
