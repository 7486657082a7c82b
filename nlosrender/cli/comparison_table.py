"""A comparison of captures as a table for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from nlosrender.cli.tables import print_table
from nlosrender.readable import printable

if TYPE_CHECKING:
    from nlosrender.analysis.comparison.dataset import CheckedFile

INFINITE = "infinite"  # something against nothing in the reference


def print_comparison(report: dict[str, Any]) -> None:
    """Print a report (``analysis.comparison.report.comparison_report``)."""
    rows = [("capture", report["file"]), ("reference", report["reference"])]
    rows += [("aligned", printable(note)) for note in report["aligned"]]
    if report["structure"]:
        rows.append(("not comparable", "these differ:"))
        rows += [
            ("", printable(f"{d['name']}: {d['value']}, reference: {d['reference']}")) for d in report["structure"]
        ]
        print_table(rows)
        return
    print_table([*rows, *_totals(report)])
    columns = ("energy", "reference_energy", "relative_energy", "relative_l2")
    formats = ("{:.5g}".format, "{:.5g}".format, _signed, _number)
    print_table(
        [
            (bounce["bounce"], *(shown(bounce[column]) for column, shown in zip(columns, formats, strict=True)))
            for bounce in report["bounces"]
        ],
        header=("bounce", "energy", "reference", "difference", "relative L2"),
    )
    verdict = "identical" if report["identical"] else "agrees" if report["agrees"] else "DIFFERS"
    print_table([*_places(report), *_tolerances(report), ("verdict", verdict)])


def check_line(file: CheckedFile) -> str:
    """Return the line of one capture of a dataset."""
    numbers = ""
    if file.report and not file.report["structure"]:
        numbers = f"relative L2 {_number(file.report['relative_l2'])}, energy {_signed(file.report['relative_energy'])}"
    reason = printable(file.message) if file.status != "ok" else ""
    return f"{file.status:<11} {printable(file.name)}" + "".join(f": {text}" for text in (numbers, reason) if text)


def _totals(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "relative L2", _number(report["relative_l2"])
    yield "energy", _signed(report["relative_energy"])
    if report["shift_bins"] is not None:
        worst = report["worst_shift"]
        more = f", most at laser {_point(worst['laser'])}: {worst['bins']:+.3g}" if worst else ""
        yield "shift", f"{report['shift_bins']:+.3g} bins{more}"
    if test := report["z_test"]:
        yield "Z-test", f"largest deviation {test['z']:.3g} sigma of {test['statements']} statements"


def _places(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if worst := report["worst"]:
        yield "differs most", f"{_place(worst)}, bin {worst['bin']} (each by itself; row, column)"
    if largest := report["largest_difference"]:
        values = f"{largest['value']:.5g}, reference {largest['reference']:.5g}"
        yield "worst sample", f"{_place(largest)}, bin {largest['bin']}: {values}"
    if report["z_test"] and (least := report["z_test"]["worst"]):
        yield "least likely", f"{_place(least)}, bins {least['first_bin']} to {least['last_bin']}"


def _tolerances(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for finding in report["tolerances"]:
        value, limit = (
            INFINITE if finding[key] is None else f"{finding[key]:.4g}{finding['unit']}" for key in ("value", "limit")
        )
        yield "EXCEEDS" if finding["exceeds"] else "within", f"{finding['quantity']}: {value}, tolerance {limit}"


def _place(found: dict[str, Any]) -> str:
    sensor = "all sensor points" if found["sensor"] is None else f"sensor {_point(found['sensor'])}"
    return f"laser {_point(found['laser'])}, {sensor}, bounce {found['bounce']}"


def _number(value: float | None) -> str:
    return INFINITE if value is None else f"{value:.4g}"


def _signed(share: float | None) -> str:
    return INFINITE if share is None else f"{100 * share:+.3g} %"


def _point(index: list[int] | tuple[int, int]) -> str:
    return f"({index[0]}, {index[1]})"
