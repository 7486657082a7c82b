"""``nlosrender check``: has any capture of a data set changed?"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nlosrender.cli.compare_command import MaxEnergy, MaxRelL2, MaxShift, Significance, ZTestWanted, tolerances_given
from nlosrender.cli.json_output import OUTPUT
from nlosrender.cli.options import AsJson
from nlosrender.readable import printable

if TYPE_CHECKING:
    from nlosrender.analysis.comparison.dataset import CheckedFile


def check(
    folder: Annotated[
        Path, typer.Argument(metavar="DATASET_DIR", help="Folder with the captures to judge.", readable=False)
    ],
    reference: Annotated[
        Path,
        typer.Option(metavar="DIR", help="Folder with captures of the same names to judge them by.", readable=False),
    ],
    max_rel_l2: MaxRelL2 = None,
    max_energy: MaxEnergy = None,
    max_shift: MaxShift = None,
    z_test: ZTestWanted = False,
    significance: Significance = 0.01,
    tolerances: Annotated[
        Path | None,
        typer.Option(
            metavar="YAML",
            help="Tolerances of single files: names or patterns -> {max_rel_l2: ...}; the options are for the others.",
            readable=False,
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write the result as JUnit XML.", readable=False)
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also write a page with difference pictures.", readable=False)
    ] = None,
    update: Annotated[
        bool, typer.Option("--update", help="Ask, then replace the references of captures beyond a tolerance.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Of --update: do not ask.")] = False,
    as_json: AsJson = False,
) -> None:
    """Compare every capture of a reference folder with its namesake, as `nlosrender compare` does.

    Exit code 0: within all tolerances, or replaced by --update; 4: beyond one, or made of other grids, bins, frame; 3:
    a file that is damaged or no capture. A file missing from DATASET_DIR fails the check, one missing from the
    reference does not.

    Example: nlosrender check out/ --reference tests/reference/ --z-test --html check.html (prints one line per
    capture and creates check.html)
    """
    from dataclasses import asdict

    from nlosrender.analysis.comparison.dataset import check_dataset, replace_references
    from nlosrender.analysis.comparison.tolerance_rules import load_rules
    from nlosrender.cli.comparison_table import check_line
    from nlosrender.errors import ComparisonError, FileError

    def print_line(file: CheckedFile) -> None:
        if not as_json:
            typer.echo(check_line(file))

    _check_update(update, yes)
    _check_reports(junit, html)
    others = tolerances_given(max_rel_l2, max_energy, max_shift, z_test, significance)
    rules = () if tolerances is None else load_rules(tolerances)
    found = check_dataset(folder, reference, others, print_line, rules)
    if junit is not None:
        from nlosrender.analysis.comparison.junit import write_junit

        write_junit(junit, found, folder)
    if html is not None:
        from nlosrender.analysis.pages.check_page import write_check_page

        write_check_page(html, found, folder, reference)
    replaced: tuple[CheckedFile, ...] = ()
    if update and (changed := found.with_status("exceeds")) and (yes or _confirmed(changed, reference)):
        replace_references(changed, folder, reference)
        replaced = changed
    failed = [file for file in found.files if file.status != "ok" and file not in replaced]
    failure = FileError if found.with_status("unreadable") else ComparisonError
    if as_json:
        report = {"agrees": not failed, "files": [asdict(file) for file in found.files], "extra": found.extra}
        updated = {"updated": [file.name for file in replaced]} if update else {}
        OUTPUT.print(report | updated, failure.exit_code if failed else 0)
    else:
        for name in found.extra:
            typer.echo(f"extra       {printable(name)}: not in the reference")
        for file in replaced:
            typer.echo(f"replaced    {reference / file.name}")
        agreeing = len(found.files) - len(failed) - len(replaced)
        typer.echo(f"{agreeing} of {len(found.files)} captures agree with {reference}")
    if failed:
        # what cannot be read is named by its own message
        listed = "\n".join(
            f"{'' if file.status == 'unreadable' else f'{file.name}: '}{file.message}" for file in failed
        )
        raise failure(listed)


def _check_update(update: bool, yes: bool) -> None:
    """Refuse a question that nobody can answer, before the work and not after it."""
    from nlosrender.errors import OptionError

    if yes and not update:
        raise OptionError("--yes: answers the question of --update, which is missing")
    if update and not yes and not sys.stdin.isatty():
        raise OptionError("--update: asks before it replaces references, and stdin is no terminal; add --yes.")


def _check_reports(junit: Path | None, html: Path | None) -> None:
    """Refuse names that the reports cannot have, before the work."""
    from nlosrender.cli.options import refuse_folder
    from nlosrender.errors import OptionError
    from nlosrender.files.atomic_write import check_writable
    from nlosrender.files.file_kinds import JUNIT, PAGE

    targets = []
    for path, kind, example in ((junit, JUNIT, "check.xml"), (html, PAGE, "check.html")):
        if path is not None:
            refuse_folder(path, example)
            targets.append(check_writable(path, kind))
    if len(set(targets)) < len(targets):
        raise OptionError(f"--junit, --html: both name {junit}; need two files")


def _confirmed(changed: Sequence[CheckedFile], reference: Path) -> bool:
    for file in changed:
        typer.echo(f"to replace  {reference / file.name}", err=True)
    return typer.confirm(f"Replace {len(changed)} references by the captures checked?", err=True)
