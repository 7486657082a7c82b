"""Physical constants and the few unit conversions the program needs.

Lengths are metres, times are seconds, angles are radians; delays are kept as optical path lengths
(OPL, metres): distance times refractive index, so that the speed of light appears only here.
"""

from __future__ import annotations

SPEED_OF_LIGHT = 299_792_458.0  # m/s, exact by definition of the metre


def opl_to_seconds(opl: float) -> float:
    """Return the time [s] that light in vacuum needs for an optical path length ``opl`` [m]."""
    return opl / SPEED_OF_LIGHT


_DURATIONS = ((100.0, 1.0, "s"), (6000.0, 60.0, "min"), (172_800.0, 3600.0, "h"), (6e7, 86_400.0, "days"))
SECONDS_PER_YEAR = 31_557_600.0  # Julian


def readable_duration(seconds: float) -> str:
    """Return a time [s] with two digits and the unit a person would take: "0.35 s", "4.2 min", "3.1e+13 years"."""
    for bound, size, unit in _DURATIONS:
        if seconds < bound:
            return f"{_two_digits(seconds / size)} {unit}"
    return f"{_two_digits(seconds / SECONDS_PER_YEAR)} years"


def _two_digits(number: float) -> str:
    if 1 <= number < 9.95:
        return f"{number:.1f}"
    return f"{number:.0f}" if 9.95 <= number < 10_000 else f"{number:.2g}"
