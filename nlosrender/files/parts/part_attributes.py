"""What a file says about the part of a capture it holds, and about everything that was summed up over it."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.part import Part, Tiling
from nlosrender.capture.tile import joined
from nlosrender.files.partial.work_item_log import RenderState
from nlosrender.files.provenance import result_attributes
from nlosrender.files.sums import Sums

PART, SUMS, CHECKSUMS, NOTE = "part", "part_sums", "part_checksums", "incomplete"
UNSAMPLED, ZERO, MISSED = "unsampled_paths", "zero_because", "target_missed"
UNKNOWN_FROM = "unsampled_first_bounce"


@dataclass(frozen=True)
class StoredPart:
    """A part of a capture, as its file tells it."""

    part: Part
    sums: Sums
    checksum: Mapping[str, int]  # per dataset

    @classmethod
    def from_attributes(cls, attributes: Mapping[str, object]) -> StoredPart | None:
        """Read it; None for a file that does not say that it is a part.

        Raises
        ------
        ValueError
            The attributes are damaged.
        """
        if PART not in attributes:
            return None
        try:
            part, sums, checksum = (json.loads(str(attributes[name])) for name in (PART, SUMS, CHECKSUMS))
            return cls(Part.from_json(part), Sums.from_json(sums), {str(k): int(v) for k, v in checksum.items()})
        except (KeyError, TypeError, AttributeError, RecursionError) as error:
            raise ValueError(f"the attributes {PART}, {SUMS}, {CHECKSUMS} are damaged: {error!r}") from error


def part_attributes(part: Part, tiling: Tiling, tally: RenderState) -> dict[str, object]:
    """Return the attributes of a file that holds a part of a capture.

    Parameters
    ----------
    part, tiling
        What it holds.
    tally
        What was rendered.
    """
    tiles = joined(tiling.cells(part.strips), tiling.ny * tiling.nx)
    shown: dict[str, Any] = part.as_json() | {"sensor_tiles": [list(astuple(tile)) for tile in tiles]}
    return {
        PART: json.dumps(shown),
        SUMS: json.dumps(tally.sums.as_json()),
        CHECKSUMS: json.dumps(tally.checksum),
        NOTE: "a part of a capture: laser points [first, last) counted row by row, and sensor tiles "
        "[y0, y1, x0, x1) as in the attribute part; everything else is zero. nlosrender merge puts parts together",
    }


def summed_attributes(
    sums: Sums,
    bounces: BounceAxis,
    seconds: Mapping[str, float],
    unsampled: Sequence[str] = (),
    zero_because: Sequence[str] = (),
    unknown_from: int | None = None,
) -> dict[str, object]:
    """Return the results of a render, or of several that were put together.

    Parameters
    ----------
    sums
        Over all that was rendered.
    bounces
        Names of the bounces.
    seconds
        Time spent in each stage [s].
    unsampled
        Classes of paths whose light is missing.
    zero_because
        Why H is zero everywhere; empty where it is not.
    unknown_from
        The lowest bounce that light is missing of; None: of none.
    """
    known: dict[str, object] = {UNSAMPLED: list(unsampled)}
    if unknown_from is not None:
        known[UNKNOWN_FROM] = unknown_from
    if zero_because:
        known[ZERO] = list(zero_because)
    return known | result_attributes(
        samples=sums.samples,
        error_estimate=sums.stated_error(unsampled),
        seconds=seconds,
        out_of_window_energy=float(sums.outside),
        energy=sums.energy_per_bounce(bounces),
        error_estimate_per_bounce=known_of(sums.errors_per_bounce(bounces), bounces, unknown_from),
        energy_error_per_bounce=known_of(sums.energy_errors(bounces), bounces, unknown_from),
        energy_error=math.nan if unsampled else sums.energy_error,
    )


def known_of(errors: Mapping[str, float], bounces: BounceAxis, unknown_from: int | None) -> dict[str, float | None]:
    """Return errors by bounce number as JSON holds them: None where there is no number, or light is missing."""
    first_unknown = len(errors) if unknown_from is None else bounces.slot(max(unknown_from, bounces.first))
    known = (slot < first_unknown and math.isfinite(error) for slot, error in enumerate(errors.values()))
    return {name: errors[name] if is_known else None for name, is_known in zip(errors, known, strict=True)}


def text_list(attributes: Mapping[str, object], name: str) -> tuple[str, ...]:
    """Return an attribute that holds a list of texts as JSON; an empty one where it is missing or does not."""
    try:
        found = json.loads(str(attributes.get(name, "[]")))
    except (ValueError, RecursionError):
        return ()
    return tuple(str(text) for text in found) if isinstance(found, list) else ()


def json_object(text: object) -> dict[str, Any]:
    """Return the mapping in an attribute that should hold one as JSON; an empty one where it does not."""
    try:
        found = json.loads(str(text))
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
