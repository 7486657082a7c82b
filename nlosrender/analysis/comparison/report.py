"""A comparison as a plain dict that JSON can hold."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from nlosrender.analysis.comparison.captures import Comparison
from nlosrender.analysis.comparison.differences import LargestDifference, WorstPlaces
from nlosrender.analysis.comparison.z_test import Deviation
from nlosrender.analysis.json_values import finite_or_none


def comparison_report(comparison: Comparison) -> dict[str, Any]:
    """Return everything that a comparison found.

    Grid positions are [row, column]; bounces are named as in ``StoredHeader.bounce_name``; a number is None where the
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
        "relative_l2": differences.relative_l2(),
        "relative_energy": differences.relative_energy(),
        "bounces": [
            {
                "bounce": comparison.header.bounce_name(bounce),
                "energy": float(differences.energy_a[bounce]),
                "reference_energy": float(differences.energy_b[bounce]),
                "relative_energy": differences.relative_energy(bounce),
                "relative_l2": differences.relative_l2(bounce),
            }
            for bounce in differences.lit_bounces
        ],
        "shift_bins": shift.whole(),
        "worst_shift": None if worst_shift is None else {"bins": worst_shift[0], "laser": list(worst_shift[1])},
        "worst": _place(comparison, differences.worst),
        "largest_difference": _place(comparison, differences.largest),
        "z_test": _z_test(comparison),
    }
    return finite_or_none(report)


def _place(comparison: Comparison, found: LargestDifference | WorstPlaces | Deviation | None) -> dict[str, Any] | None:
    return None if found is None else asdict(found) | {"bounce": comparison.header.bounce_name(found.bounce)}


def _z_test(comparison: Comparison) -> dict[str, object] | None:
    test = comparison.test
    if test is None:
        return None
    numbers = {"significance": test.significance, "statements": test.n_statements, "limit": test.limit, "z": test.z}
    return numbers | {"worst": _place(comparison, test.worst)}
