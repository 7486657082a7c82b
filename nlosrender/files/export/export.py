"""Captures in the formats of other programs.

- ``tal``: HDF5_TAL, what y-tal writes and reads (Royo et al.);
- ``fk``: the .mat files of f-k migration (Lindell et al. 2019), ``meas`` and ``tofgrid``;
- ``lct``: the .mat files of the light-cone transform (O'Toole et al. 2018), ``rect_data`` and ``width``;
- ``phasor_mat``: the .mat files of phasor-field diffraction (Liu et al. 2020), ``rect_data``, ``ts``,
  ``sampling_spacing``, ``aperturefullsize`` and ``SPAD_index``;
- ``learned``: one variable of 512 bins of 32 ps, which networks trained on f-k migration's captures take.

None of them has a bounce axis, colours or a variance: bounces are summed and colours averaged. What a format cannot
hold is refused where the result would be wrong, and else reported. Points are sorted by their place on the wall, so
that the order of a capture's rows does not show.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nlosrender.errors import OptionError
from nlosrender.files.atomic_write import replacing
from nlosrender.files.export.mat_formats import write_fk, write_lct, write_learned, write_phasor_mat
from nlosrender.files.export.tal_format import write_tal
from nlosrender.files.export.wall_order import ordered_capture
from nlosrender.files.file_kinds import MAT, TAL, FileKind
from nlosrender.files.layout import STOKES
from nlosrender.files.reading.reader import StoredCapture, open_capture
from nlosrender.files.reading.scan import chosen_bounces, read_scan


@dataclass(frozen=True)
class ExportFormat:
    """A program's format; a wall is seen with x to the right, y up and the hidden scene behind it."""

    suffix: str  # of a file's name
    kind: FileKind
    write: Callable[..., list[str]]  # (path, capture, option), the option where there is one; returns what is lost
    y_descends: bool = False  # whether the first row is the top one
    x_descends: bool = False  # whether the first column is the right one


PROGRAMS = {
    "tal": ExportFormat(".hdf5", TAL, write_tal),
    "fk": ExportFormat(".mat", MAT, write_fk, y_descends=True, x_descends=True),
    "lct": ExportFormat(".mat", MAT, write_lct, y_descends=True),
    "phasor_mat": ExportFormat(".mat", MAT, write_phasor_mat, y_descends=True),
    "learned": ExportFormat(".mat", MAT, write_learned, y_descends=True, x_descends=True),
}
FORMATS = tuple(PROGRAMS)
LEGS = ("remove", "keep")
DEFAULT_KEY = "measlr"  # NLOSFeatureEmbeddings


@dataclass(frozen=True)
class ExportReport:
    """What an export wrote and what it left out."""

    path: Path
    losses: tuple[str, ...]  # one sentence each


def export_capture(
    path: str | Path,
    output: str | Path,
    file_format: str,
    bounces: str | None = "all",
    *,
    legs: str | None = None,
    key: str | None = None,
) -> ExportReport:
    """Write a capture in another program's format; the file appears whole or not at all.

    Parameters
    ----------
    path
        Capture file.
    output
        File to write; an existing one of the same format is replaced.
    file_format
        One of ``FORMATS``.
    bounces
        ``all`` (their sum) or ``3``.
    legs
        Of ``tal``: ``remove`` (None) counts time from the wall, ``keep`` leaves it as in the capture.
    key
        Of ``learned``: name of the variable; None for ``measlr``.

    Raises
    ------
    FileError
        The format cannot hold this capture, or a file cannot be read or written.
    OptionError
        There is no such format, or an option does not belong to it.
    """
    suffix_of(file_format)  # refuses a format that there is not
    option = _option(file_format, legs, key)
    program = PROGRAMS[file_format]
    order = {"x_descends": program.x_descends, "y_descends": program.y_descends}
    with open_capture(path) as capture, replacing(output, program.kind, [path]) as partial:
        capture.header.refuse_spots(f"the format {file_format}")
        indices = chosen_bounces(capture.header, bounces)
        ordered = ordered_capture(capture, read_scan(capture), indices, **order)
        losses = _general_losses(capture, indices) + program.write(partial, ordered, *option)
    return ExportReport(Path(output), tuple(losses))


def suffix_of(file_format: str) -> str:
    """Return how the name of a file in a format ends.

    Raises
    ------
    OptionError
        There is no such format.
    """
    if file_format not in FORMATS:
        raise OptionError(f"--format: got {file_format!r}, need one of {', '.join(FORMATS)}")
    return PROGRAMS[file_format].suffix


def _option(file_format: str, legs: str | None, key: str | None) -> tuple[bool | str, ...]:
    """Return the option of a format, where it has one; refuse those of others."""
    if legs is not None and legs not in LEGS:
        raise OptionError(f"--legs: got {legs!r}, need one of {', '.join(LEGS)}")
    if legs is not None and file_format != "tal":
        raise OptionError(f"--legs: belongs to --format tal; {file_format} counts time from the wall. Leave it out.")
    if key is not None and file_format != "learned":
        raise OptionError(f"--key: belongs to --format learned; {file_format} has names of its own. Leave it out.")
    options: dict[str, tuple[bool | str, ...]] = {"tal": (legs == "keep",), "learned": (key or DEFAULT_KEY,)}
    return options.get(file_format, ())


def _general_losses(capture: StoredCapture, indices: tuple[int, ...]) -> list[str]:
    header, losses = capture.header, []
    if len(indices) > 1:
        numbers = ", ".join(str(index + header.first_bounce) for index in indices)
        losses.append(f"bounces {numbers} are summed: the format does not keep them apart")
    if header.sizes["channel"] > 1:
        stokes = header.attributes.get("channels") == STOKES
        kept = "of the Stokes components the intensity alone is kept"
        losses.append(kept if stokes else f"the {header.sizes['channel']} channels are averaged")
    if header.footprint is not None:
        losses.append(f"{header.footprint[0]}: the format takes it for the light of the point")
    if header.has_variance:
        losses.append("the variance is left out")
    return losses
