"""The stated error of a render or a merge, in words and for JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence


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


def stated_error_lines(
    error: float, unsampled: Sequence[str], zero_because: Sequence[str], remark: str = ""
) -> Iterator[str]:
    """Yield the lines of a report: the stated error and a remark, and why it is not known; parameters as above."""
    yield f"  error estimate  {error_in_words(error, unsampled, zero_because)}{remark}"
    yield from (f"  not sampled     {missing}" for missing in unsampled)
    yield from (f"  zero because    {reason}" for reason in zero_because)


def errors_by_bounce(errors: Mapping[str, object]) -> str:
    """Return the relative errors of bounces that have one, or whose one is not known: "3: 1.2 %, 4: unknown"."""
    return ", ".join(f"{name}: {_percent(error)}" for name, error in errors.items())


def energies_by_bounce(energies: Mapping[str, object], errors: Mapping[str, object]) -> str:
    """Return energies with their standard errors: "3: 0.364 +- 0.002, 4: 0.0058", without one where it is not known."""
    return ", ".join(f"{name}: {_with_error(energy, errors.get(name))}" for name, energy in energies.items())


def _percent(error: object) -> str:
    return f"{error:.2%}" if isinstance(error, (int, float)) else "-"


def _with_error(energy: object, error: object) -> str:
    if not isinstance(energy, (int, float)):
        return str(energy)
    if not isinstance(error, (int, float)):
        return f"{energy:.4g}"
    return f"{energy:.4g} +- {error:.2g}" if error else f"{energy:.4g}"
