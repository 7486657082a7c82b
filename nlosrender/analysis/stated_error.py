"""The stated error and the energies of a capture, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeGuard


def stated_error_rows(
    error: float, unsampled: Sequence[str], zero_because: Sequence[str], remark: str = ""
) -> Iterator[tuple[str, str]]:
    """Yield label and text: the stated error, followed by ``remark``, and why it is not known.

    ``error`` is the relative L2 error of H: NaN where it is not known, inf of pure noise; the rest as in RenderReport.
    """
    if unsampled:
        text = f"unknown: {len(unsampled)} class{'' if len(unsampled) == 1 else 'es'} of paths not sampled"
    elif zero_because:
        text = "unknown: H is zero everywhere"
    else:
        text = f"{error:.2%} (relative L2)" if math.isfinite(error) else "unknown: nothing but noise"
    yield "error estimate", text + remark
    yield from (("not sampled", missing) for missing in unsampled)
    yield from (("zero because", reason) for reason in zero_because)


def errors_by_bounce(errors: Mapping[str, object]) -> str:
    """Return the relative errors of bounces: "3: 1.20%, 4: -", a dash where it is not known."""
    return ", ".join(f"{name}: {f'{error:.2%}' if _is_number(error) else '-'}" for name, error in errors.items())


def energies_by_bounce(energies: Mapping[str, object], errors: Mapping[str, object]) -> str:
    """Return energies with their standard errors: "3: 0.364 +- 0.002, 4: 0.0058", without one where it is not known."""
    return ", ".join(f"{name}: {_with_error(energy, errors.get(name))}" for name, energy in energies.items())


def _with_error(energy: object, error: object) -> str:
    shown = f"{energy:.4g}" if _is_number(energy) else str(energy)
    return f"{shown} +- {error:.2g}" if _is_number(energy) and _is_number(error) and error else shown


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, (int, float))
