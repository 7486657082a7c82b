"""``nlosrender compare``: have two captures anything that differs? The options are those of ``check`` too."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson

if TYPE_CHECKING:
    from nlosrender.analysis.comparison.captures import Tolerances


def _tolerance(text: str, metavar: str = "X") -> Any:
    return typer.Option(metavar=metavar, min=0, help=text, show_default=False)


MaxRelL2 = Annotated[float | None, _tolerance("Largest relative L2 of the difference, such as 0.01.")]
MaxEnergy = Annotated[
    float | None, _tolerance("Largest relative difference of the energy, in total and of every bounce.")
]
MaxShift = Annotated[
    float | None, _tolerance("Largest shift in time, in total and of every laser point, such as 0.1.", "BINS")
]
ZTestWanted = Annotated[
    bool, typer.Option("--z-test", help="Allow what noise explains, by the stored variances (of one file or of both).")
]
Significance = Annotated[
    float, typer.Option(metavar="P", help="Chance that the Z-test raises an alarm where both files show the same.")
]


def compare(
    capture: Annotated[Path, typer.Argument(metavar="A", help="Capture to judge.", readable=False)],
    reference: Annotated[Path, typer.Argument(metavar="B", help="Capture to judge it by.", readable=False)],
    max_rel_l2: MaxRelL2 = None,
    max_energy: MaxEnergy = None,
    max_shift: MaxShift = None,
    z_test: ZTestWanted = False,
    significance: Significance = 0.01,
    as_json: AsJson = False,
) -> None:
    """Compare two captures; fail when they differ by more than the tolerances allow.

    Without any tolerance they have to be equal up to rounding (relative L2 at most 1e-6), as two renders with the
    same seed, version and machine are. Relative numbers are relative to B. Points in another order, and bins that begin
    elsewhere by whole bins, are aligned first.

    Exit code 0: within all tolerances; 4: beyond one, or made of other grids, bins, frame; 3: a file that is damaged
    or no capture.

    Example: nlosrender compare new.hdf5 old.hdf5 --max-rel-l2 0.02 --max-shift 0.1 (creates nothing; prints what
    differs and where most)
    """
    from nlosrender.analysis.comparison.captures import compare_captures
    from nlosrender.analysis.comparison.report import comparison_report
    from nlosrender.cli.comparison_table import print_comparison
    from nlosrender.errors import EXIT_COMPARISON_EXCEEDED, EXIT_OK, ComparisonError

    tolerances = tolerances_given(max_rel_l2, max_energy, max_shift, z_test, significance)
    comparison = compare_captures(capture, reference, tolerances)
    report = comparison_report(comparison)
    if as_json:
        OUTPUT.print(report, EXIT_COMPARISON_EXCEEDED if comparison.failures else EXIT_OK)
    else:
        print_comparison(report)
    if comparison.failures:
        listed = "\n".join(f"{capture}: {failure}" for failure in comparison.failures)
        raise ComparisonError(listed)


def tolerances_given(
    max_rel_l2: float | None, max_energy: float | None, max_shift: float | None, z_test: bool, significance: float
) -> Tolerances:
    """Return the tolerances that the options give.

    Raises
    ------
    BadParameter
        One of them is none.
    """
    from nlosrender.analysis.comparison.captures import Tolerances

    try:
        # the significance is checked even where it is not used: a typing error in it is one all the same
        Tolerances(significance=significance)
        return Tolerances(max_rel_l2, max_energy, max_shift, significance if z_test else None)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
