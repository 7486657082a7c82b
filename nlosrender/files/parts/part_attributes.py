"""Attributes of a file that holds a part of a capture."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from typing import Any

from nlosrender.capture.part import Part, Tiling
from nlosrender.capture.tile import joined
from nlosrender.files.partial.work_item_log import RenderState
from nlosrender.files.sums import Sums

PART, SUMS, CHECKSUMS, NOTE = "part", "part_sums", "part_checksums", "incomplete"


@dataclass(frozen=True)
class StoredPart:
    """Which part of a capture a file holds, its sums and checksums."""

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


def part_attributes(part: Part, tiling: Tiling, finished: RenderState) -> dict[str, object]:
    """Return the attributes of a file that holds a part of a capture."""
    tiles = joined(tiling.cells(part.strips), tiling.ny * tiling.nx)
    shown: dict[str, Any] = part.as_json() | {"sensor_tiles": [list(astuple(tile)) for tile in tiles]}
    return {
        PART: json.dumps(shown),
        SUMS: json.dumps(finished.sums.as_json()),
        CHECKSUMS: json.dumps(finished.checksum),
        NOTE: "a part of a capture: laser points [first, last) counted row by row, and sensor tiles "
        "[y0, y1, x0, x1) as in the attribute part; everything else is zero. nlosrender merge puts parts together",
    }
