"""Arguments and options that several commands share, and the reading of their values."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

# readable=False: the readers of files explain what is wrong with one better than the option's own check
CaptureFile = Annotated[
    Path, typer.Argument(metavar="FILE", help="Capture in Z-NLOS HDF5, by any writer.", readable=False)
]
CameraFile = Annotated[Path, typer.Argument(metavar="FILE", help="Capture of scan type line_of_sight.", readable=False)]
ConfigFile = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="The YAML file that describes the capture.", readable=False)
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one key; may be repeated.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no report; warnings stay.")]


def beside(file: Path, ending: str) -> Path:
    """Return a name beside ``file``: its own without suffix, then ``ending``.

    Raises
    ------
    FileError
        ``file`` is missing or a folder, whose name may be none, such as ``.``
    """
    from nlosrender.files.reading.reader import check_regular

    check_regular(file)
    return file.with_name(file.stem + ending)


def refuse_folder(output: Path, example: str) -> None:
    """Refuse ``.``, ``..`` and the like as the name of a file.

    Raises
    ------
    FileError
        ``output`` has no name; ``example`` is one.
    """
    from nlosrender.errors import FileError

    if output.name in ("", ".."):
        raise FileError(f"{output}: is a folder. Name a file in it, such as {output / example}")


def two_numbers(text: str | None, separator: str, option: str, need: str) -> tuple[int, int] | None:
    """Return the two counts in the value of an option; None without a value.

    Raises
    ------
    BadParameter
        There are not two; ``need`` says what is needed.
    """
    if text is None:
        return None
    match = re.fullmatch(rf"\s*([0-9]{{1,9}})\s*{separator}\s*([0-9]{{1,9}})\s*", text, re.ASCII)
    if match is None:
        raise typer.BadParameter(f"got {text!r}, need {need}", param_hint=option)
    return int(match[1]), int(match[2])


def one_of(name: str, known: Iterable[str], option: str, remark: str = "") -> str:
    """Return ``name``, the value of an option.

    Raises
    ------
    BadParameter
        It is not one of ``known``; ``remark`` is added to the message.
    """
    from nlosrender.errors import did_you_mean

    names = list(known)
    if name not in names:
        needed = f"got {name!r}, need one of {', '.join(names)}. {did_you_mean(name, names)}".rstrip()
        raise typer.BadParameter(f"{needed}{remark}", param_hint=option)
    return name
