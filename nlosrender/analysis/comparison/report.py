"""A comparison as a plain dict that JSON can hold."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from nlosrender.analysis.comparison.captures import Comparison


def comparison_report(comparison: Comparison) -> dict[str, Any]:
    """Return everything that a comparison found.

    Grid positions are [row, column]; bounces are named as in ``Comparison.bounce_name``; a number is None where the
    quotient is infinite: something against nothing.
    """
    report: dict[str, object] = {
        "file": str(comparison.path),
        "reference": str(comparison.reference),
        "agrees": not comparison.failures,
        "failures": list(comparison.failures),
        "structure": [asdict(difference) for difference in comparison.structure],
        "aligned": list(comparison.aligned),
    }
    if comparison.structure:
        return report
    differences, shift = comparison.differences, comparison.shift
    worst_shift = shift.worst()
    report |= {
        "tolerances": [asdict(finding) | {"exceeds": finding.exceeds} for finding in comparison.findings],
        "identical": differences.largest is None,
        "relative_l2": differences.relative_l2,
        "relative_energy": differences.relative_energy,
        "bounces": [
            {
                "bounce": comparison.bounce_name(bounce),
                "energy": float(differences.energy_a[bounce]),
                "reference_energy": float(differences.energy_b[bounce]),
                "relative_energy": differences.relative_energy_of(bounce),
                "relative_l2": differences.relative_l2_of(bounce),
            }
            for bounce in differences.lit_bounces
        ],
        "shift_bins": shift.whole(),
        "worst_shift": None if worst_shift is None else {"bins": worst_shift[0], "laser": list(worst_shift[1])},
        "worst": _worst(comparison),
        "largest_difference": _largest(comparison),
        "z_test": _z_test(comparison),
    }
    return {key: _finite(value) for key, value in report.items()}


def _worst(comparison: Comparison) -> dict[str, object] | None:
    worst = comparison.differences.worst
    return None if worst is None else asdict(worst) | {"bounce": comparison.bounce_name(worst.bounce)}


def _largest(comparison: Comparison) -> dict[str, object] | None:
    largest = comparison.differences.largest
    return None if largest is None else asdict(largest) | {"bounce": comparison.bounce_name(largest.bounce)}


def _z_test(comparison: Comparison) -> dict[str, object] | None:
    test = comparison.test
    if test is None:
        return None
    worst = test.worst
    named = None if worst is None else asdict(worst) | {"bounce": comparison.bounce_name(worst.bounce)}
    return {
        "significance": test.significance,
        "statements": test.n_statements,
        "limit": test.limit,
        "z": test.z,
        "worst": named,
    }


def _finite(value: object) -> object:
    """Replace numbers that JSON cannot hold by None."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return value
