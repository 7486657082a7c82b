"""``compare_captures``: reads two files block by block and holds their differences against tolerances."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from nlosrender.analysis.comparison.alignment import Alignment, align
from nlosrender.analysis.comparison.blocks import BLOCK_SAMPLES, OpenCapture, blocks, open_for_comparison
from nlosrender.analysis.comparison.differences import Differences
from nlosrender.analysis.comparison.shift import TimeShift
from nlosrender.analysis.comparison.structure import StructureDifference, structure_differences
from nlosrender.analysis.comparison.z_test import ZTest
from nlosrender.errors import FileError
from nlosrender.files.reading.stored_header import StoredHeader

EQUAL_REL_L2 = 1e-6  # of captures that are equal up to rounding: float32 leaves 6e-8 per sample


@dataclass(frozen=True)
class Tolerances:
    """What may differ, and by how much; None: anything goes.

    Without any of them the samples have to be equal up to rounding (relative L2 at most 1e-6).

    Raises
    ------
    ValueError
        A tolerance is negative, or the significance not between 0 and 1.
    """

    max_rel_l2: float | None = None  # relative L2 of the difference over everything
    max_energy: float | None = None  # relative difference of the energy, of every bounce and in total
    max_shift: float | None = None  # bins, of every laser point and in total
    significance: float | None = None  # of the Z-test: chance of an alarm where both show the same

    def __post_init__(self) -> None:
        for name in ("max_rel_l2", "max_energy", "max_shift"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"{name}: got {value}, need a number >= 0")
        if self.significance is not None and not 0 < self.significance < 1:
            raise ValueError(f"significance: got {self.significance}, need a number between 0 and 1")
        if all(value is None for value in vars(self).values()):
            object.__setattr__(self, "max_rel_l2", EQUAL_REL_L2)


@dataclass(frozen=True)
class Finding:
    """One number that was held against a tolerance."""

    quantity: str  # in words, such as "energy of bounce 3"
    value: float  # inf: something against nothing
    limit: float
    unit: str = ""

    @property
    def exceeds(self) -> bool:
        """Whether the number is beyond its tolerance."""
        return not abs(self.value) <= self.limit

    def __str__(self) -> str:
        return f"{self.quantity}: {self.value:.4g}{self.unit}, tolerance {self.limit:.4g}{self.unit}"


@dataclass(frozen=True, eq=False)
class Comparison:
    """What came out of a comparison. When the structure differs, no sample has been looked at."""

    path: Path
    reference: Path
    structure: tuple[StructureDifference, ...]
    aligned: tuple[str, ...]  # what was in another order or at another time, in sentences
    header: StoredHeader  # of the reference, with a time axis that both fit into
    differences: Differences
    shift: TimeShift
    test: ZTest | None
    findings: tuple[Finding, ...]

    @property
    def failures(self) -> tuple[str, ...]:
        """Everything that is beyond its tolerance, in words."""
        exceeding = (str(finding) for finding in self.findings if finding.exceeds)
        return (*(str(difference) for difference in self.structure), *exceeding)


def compare_captures(
    path: str | Path, reference: str | Path, tolerances: Tolerances, block_samples: int = BLOCK_SAMPLES
) -> Comparison:
    """Compare a capture with a reference, about ``block_samples`` samples at a time.

    Raises
    ------
    FileError
        One of them is missing, damaged or not a capture, or the Z-test finds no variance in either.
    """
    with open_aligned(path, reference) as pair:
        a, b, header = pair.a, pair.b, pair.alignment.header
        differences, shift = Differences(header), TimeShift(header)
        test, findings = None, ()  # type: ZTest | None, tuple[Finding, ...]
        if not pair.structure:
            test = None if tolerances.significance is None else _z_test(a, b, header, tolerances.significance)
            for block in blocks(a, b, with_variance=test is not None, block_samples=block_samples):
                for sums in (differences, shift, test):
                    if sums is not None:
                        sums.add(block)
            if test is not None:
                test.finish()
            findings = tuple(_findings(header, differences, shift, test, tolerances))
        notes = pair.alignment.notes
        return Comparison(a.path, b.path, pair.structure, notes, header, differences, shift, test, findings)


@dataclass(frozen=True, eq=False)
class AlignedPair:
    """Two open captures, aligned where their structure is the same."""

    a: OpenCapture
    b: OpenCapture
    alignment: Alignment
    structure: tuple[StructureDifference, ...]


@contextmanager
def open_aligned(path: str | Path, reference: str | Path) -> Iterator[AlignedPair]:
    """Open a capture and a reference for :func:`blocks`.

    Raises
    ------
    FileError
        One of them is missing, damaged or not a capture.
    """
    with open_for_comparison(Path(path)) as a, open_for_comparison(Path(reference)) as b:
        alignment = align(a.capture, b.capture)
        structure = structure_differences(a.capture, b.capture, alignment)
        if not structure:
            a.align(alignment.sensors, alignment.lasers, alignment.lead, alignment.header.n_bins)
            b.align(b.sensors, b.lasers, alignment.reference_lead, alignment.header.n_bins)
        yield AlignedPair(a, b, alignment, structure)


def _z_test(a: OpenCapture, b: OpenCapture, header: StoredHeader, significance: float) -> ZTest:
    if not (a.header.has_variance or b.header.has_variance):
        raise FileError(
            f"{a.path}: neither it nor {b.path} has a dataset variance, which the Z-test needs. "
            "Render with output.variance: true (the default)."
        )
    return ZTest(a.header, header, significance)


def _findings(
    header: StoredHeader, differences: Differences, shift: TimeShift, test: ZTest | None, tolerances: Tolerances
) -> Iterator[Finding]:
    """Hold every number that has a tolerance against it."""
    if tolerances.max_rel_l2 is not None:
        yield Finding("relative L2", differences.relative_l2(), tolerances.max_rel_l2)
    if tolerances.max_energy is not None:
        for bounce in differences.lit_bounces:
            energy = differences.relative_energy(bounce)
            yield Finding(f"energy of bounce {header.bounce_name(bounce)}", energy, tolerances.max_energy)
        yield Finding("energy", differences.relative_energy(), tolerances.max_energy)
    if tolerances.max_shift is not None:
        worst = shift.worst()
        if worst is not None:
            name = f"shift of laser ({worst[1][0]}, {worst[1][1]})"
            yield Finding(name, worst[0], tolerances.max_shift, " bins")
        yield Finding("shift", shift.whole() or 0.0, tolerances.max_shift, " bins")
    if test is not None:
        yield Finding("largest deviation", test.z, test.limit, " sigma")
