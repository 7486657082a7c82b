"""A ledger of what the stress suite finds: a table of laws and the counts of hostile inputs, after a run of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from containment import Containment


@dataclass
class Entry:
    """One law, over all its cases."""

    tolerance: float
    cases: int = 0
    worst: float = 0.0
    held: bool = True


@dataclass
class Ledger:
    """Deviations per law, and inputs per kind of hostile input."""

    laws: dict[str, Entry] = field(default_factory=dict)
    inputs: dict[str, tuple[int, int, int]] = field(default_factory=dict)  # how many, refused, faults

    def check(self, law: str, deviation: float, tolerance: float) -> None:
        """Note one case of a law, and fail when it deviates by more than its tolerance (or by NaN)."""
        entry = self.laws.setdefault(law, Entry(tolerance))
        entry.cases += 1
        held = deviation <= tolerance
        if not held or deviation / max(tolerance, 1e-300) >= entry.worst / max(entry.tolerance, 1e-300):
            entry.worst, entry.tolerance = deviation, tolerance
        entry.held &= held
        assert held, f"{law}: deviation {deviation:.3g}, tolerance {tolerance:.3g}"

    def count(self, kind: str, *, refused: bool, fault: str) -> None:
        """Note one hostile input."""
        total, refusals, faults = self.inputs.get(kind, (0, 0, 0))
        self.inputs[kind] = total + 1, refusals + refused, faults + bool(fault)

    def lines(self) -> Iterator[str]:
        """Yield the table."""
        yield f"{'law':<76} {'cases':>5} {'worst':>10} {'tolerance':>10}  verdict"
        for law, entry in sorted(self.laws.items()):
            verdict = "holds" if entry.held else "BROKEN"
            yield f"{law:<76} {entry.cases:>5} {entry.worst:>10.2g} {entry.tolerance:>10.2g}  {verdict}"
        yield ""
        yield f"{'hostile input':<76} {'cases':>5} {'refused':>10} {'faults':>10}"
        for kind, (total, refusals, faults) in sorted(self.inputs.items()):
            yield f"{kind:<76} {total:>5} {refusals:>10} {faults:>10}"


LEDGER = pytest.StashKey[Ledger]()


def pytest_configure(config: pytest.Config) -> None:
    """Open the ledger."""
    config.stash[LEDGER] = Ledger()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the ledger, unless the stress tests were left out."""
    ledger = config.stash[LEDGER]
    if "not stress" in config.option.markexpr or not (ledger.laws or ledger.inputs):
        return
    terminalreporter.section("stress")
    for line in ledger.lines():
        terminalreporter.write_line(line)
    terminalreporter.write_line("")
    terminalreporter.write_line(
        "Further laws are held by tests/analytic (closed forms, quadrature, furnaces, occlusion)"
    )
    terminalreporter.write_line("and tests/statistical (samplers by chi-square, mixes of techniques, error estimates).")


@pytest.fixture(scope="session")
def ledger(pytestconfig: pytest.Config) -> Ledger:
    """Where a test notes its deviations and its tolerance."""
    return pytestconfig.stash[LEDGER]


@pytest.fixture(scope="session")
def contained() -> Iterator[Containment]:
    """Runs command lines in a process of their own, with bounds on memory and time."""
    with Containment() as containment:
        yield containment
