"""The stated error of a render or a merge, in words and for JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence


def error_in_words(error: float, unsampled: Sequence[str], zero_because: Sequence[str]) -> str:
    """Return the stated error as people read it.

    Parameters
    ----------
    error
        Relative L2 error of H; NaN: not known; inf: pure noise.
    unsampled, zero_because
        As in the report of a render.
    """
    if unsampled:
        return f"unknown: {len(unsampled)} class{'' if len(unsampled) == 1 else 'es'} of paths not sampled"
    if zero_because:
        return "unknown: H is zero everywhere"
    return f"{error:.2%} (relative L2)" if math.isfinite(error) else "unknown: nothing but noise"
