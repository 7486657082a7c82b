"""Captures in the formats of other programs.

- ``tal``: HDF5_TAL, what y-tal writes and reads (Royo et al.);
- ``fk``: the .mat files of f-k migration (Lindell et al. 2019), ``meas`` and ``tofgrid``;
- ``lct``: the .mat files of the light-cone transform (O'Toole et al. 2018), ``rect_data`` and ``width``;
- ``phasor_mat``: the .mat files of phasor-field diffraction (Liu et al. 2020), ``rect_data``, ``ts``,
  ``sampling_spacing`` and ``SPAD_index``.

None of them has a bounce axis, colours or a variance: bounces are summed and colours averaged. What a format cannot
hold is refused where the result would be wrong, and else reported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nlosrender.capture.bounces import FIRST_BOUNCE
from nlosrender.errors import OptionError
from nlosrender.files.exports_mat import write_fk, write_lct, write_phasor_mat
from nlosrender.files.exports_tal import write_tal
from nlosrender.files.layout import STOKES
from nlosrender.files.reader import StoredCapture, open_capture
from nlosrender.files.replacement import check_writable, explained_write, partial_path, publish
from nlosrender.files.scan import Scan, chosen_bounces, read_scan

# each writes (path, capture, scan, bounce indices) and returns what the format does not hold
Write = Callable[[Path, StoredCapture, Scan, tuple[int, ...]], list[str]]
WRITERS: dict[str, Write] = {"tal": write_tal, "fk": write_fk, "lct": write_lct, "phasor_mat": write_phasor_mat}
FORMATS = tuple(WRITERS)
SUFFIXES = {"tal": ".hdf5", "fk": ".mat", "lct": ".mat", "phasor_mat": ".mat"}


@dataclass(frozen=True)
class ExportReport:
    """What an export wrote and what it left out."""

    path: Path
    losses: tuple[str, ...]  # one sentence each


def export_capture(path: str | Path, output: str | Path, file_format: str, bounces: str | None = "all") -> ExportReport:
    """Write a capture in another program's format; the file appears whole or not at all.

    Parameters
    ----------
    path
        Capture file.
    output
        File to write; an existing one is replaced.
    file_format
        One of ``FORMATS``.
    bounces
        ``all`` (their sum) or ``3``.

    Raises
    ------
    FileError
        The format cannot hold this capture, or a file cannot be read or written.
    OptionError
        There is no such format.
    """
    suffix_of(file_format)  # refuses a format that there is not
    target = check_writable(output, source=path)
    partial = partial_path(target)
    with open_capture(path) as capture:
        scan, indices = read_scan(capture), chosen_bounces(capture.header, bounces)
        losses = _general_losses(capture, indices)
        with explained_write(output):
            try:
                losses += WRITERS[file_format](partial, capture, scan, indices)
                publish(partial, target)
            finally:
                partial.unlink(missing_ok=True)
    return ExportReport(Path(output), tuple(losses))


def suffix_of(file_format: str) -> str:
    """Return how the name of a file in a format ends.

    Raises
    ------
    OptionError
        There is no such format.
    """
    if file_format not in WRITERS:
        raise OptionError(f"--format: got {file_format!r}, need one of {', '.join(FORMATS)}")
    return SUFFIXES[file_format]


def _general_losses(capture: StoredCapture, indices: tuple[int, ...]) -> list[str]:
    header, losses = capture.header, []
    if len(indices) > 1:
        numbers = ", ".join(str(index + FIRST_BOUNCE) for index in indices)
        losses.append(f"bounces {numbers} are summed: the format does not keep them apart")
    if header.sizes["channel"] > 1:
        stokes = header.attributes.get("channels") == STOKES
        kept = "of the Stokes components the intensity alone is kept"
        losses.append(kept if stokes else f"the {header.sizes['channel']} channels are averaged")
    if header.has_variance:
        losses.append("the variance is left out")
    return losses
