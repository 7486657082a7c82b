"""A comparison of captures as a table for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from nlosrender.cli.capture_table import printable

if TYPE_CHECKING:
    from nlosrender.analysis.comparison.dataset import CheckedFile

INFINITE = "infinite"  # something against nothing in the reference


def comparison_table(report: dict[str, Any]) -> str:
    """Return a report (``analysis.comparison.report.comparison_report``) as lines."""
    lines = [f"capture      {report['file']}", f"reference    {report['reference']}"]
    lines += [printable(f"aligned      {note}") for note in report["aligned"]]
    if report["structure"]:
        lines.append("not comparable, these differ:")
        lines += [
            printable(f"  {difference['name']}: {difference['value']}, reference: {difference['reference']}")
            for difference in report["structure"]
        ]
        return "\n".join(lines)
    verdict = "identical" if report["identical"] else "agrees" if report["agrees"] else "DIFFERS"
    return "\n".join([*lines, *_numbers(report), *_places(report), *_tolerances(report), f"verdict      {verdict}"])


def check_line(file: CheckedFile) -> str:
    """Return the line of one capture of a dataset."""
    numbers = ""
    if file.report and not file.report["structure"]:
        numbers = f"relative L2 {_number(file.report['relative_l2'])}, energy {_signed(file.report['relative_energy'])}"
    reason = printable(file.message) if file.status != "ok" else ""
    return f"{file.status:<11} {file.name}" + "".join(f": {text}" for text in (numbers, reason) if text)


def _numbers(report: dict[str, Any]) -> Iterator[str]:
    yield f"relative L2  {_number(report['relative_l2'])}"
    yield f"energy       {_signed(report['relative_energy'])}"
    if report["shift_bins"] is not None:
        worst = report["worst_shift"]
        more = f", most at laser {_point(worst['laser'])}: {worst['bins']:+.3g}" if worst else ""
        yield f"shift        {report['shift_bins']:+.3g} bins{more}"
    if report["z_test"]:
        test = report["z_test"]
        yield f"Z-test       largest deviation {test['z']:.3g} sigma of {test['statements']} statements"
    yield f"{'bounce':<11}  {'energy':>12} {'reference':>12} {'difference':>11} {'relative L2':>12}"
    for bounce in report["bounces"]:
        yield (
            f"  {bounce['bounce']:<11}{bounce['energy']:>12.5g} {bounce['reference_energy']:>12.5g} "
            f"{_signed(bounce['relative_energy']):>11} {_number(bounce['relative_l2']):>12}"
        )


def _places(report: dict[str, Any]) -> Iterator[str]:
    worst, largest, test = report["worst"], report["largest_difference"], report["z_test"]
    if worst:
        yield (
            f"differs most laser {_point(worst['laser'])}, sensor {_point(worst['sensor'])}, "
            f"bounce {worst['bounce']}, bin {worst['bin']} (each by itself; row, column)"
        )
    if largest:
        yield (
            f"worst sample laser {_point(largest['laser'])}, sensor {_point(largest['sensor'])}, "
            f"bounce {largest['bounce']}, bin {largest['bin']}: {largest['value']:.5g}, "
            f"reference {largest['reference']:.5g}"
        )
    if test and test["worst"]:
        least = test["worst"]
        sensor = "all sensor points" if least["sensor"] is None else f"sensor {_point(least['sensor'])}"
        yield (
            f"least likely laser {_point(least['laser'])}, {sensor}, bounce {least['bounce']}, "
            f"bins {least['first_bin']} to {least['last_bin']}"
        )


def _tolerances(report: dict[str, Any]) -> Iterator[str]:
    for finding in report["tolerances"]:
        value, limit = (
            INFINITE if finding[key] is None else f"{finding[key]:.4g}{finding['unit']}" for key in ("value", "limit")
        )
        state = "EXCEEDS" if finding["exceeds"] else "within"
        yield f"{state:<12} {finding['quantity']}: {value}, tolerance {limit}"


def _number(value: float | None) -> str:
    return INFINITE if value is None else f"{value:.4g}"


def _signed(share: float | None) -> str:
    return INFINITE if share is None else f"{100 * share:+.3g} %"


def _point(index: list[int] | tuple[int, int]) -> str:
    return f"({index[0]}, {index[1]})"
