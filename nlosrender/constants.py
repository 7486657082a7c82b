"""The speed of light, and the one conversion by it.

Lengths are metres, times are seconds, angles are radians; delays are kept as optical path lengths
(OPL, metres): distance times refractive index, so that the speed of light appears only here.
"""

from __future__ import annotations

SPEED_OF_LIGHT = 299_792_458.0  # m/s, exact by definition of the metre


def opl_to_seconds(opl: float) -> float:
    """Return the time [s] that light in vacuum needs for an optical path length ``opl`` [m]."""
    return opl / SPEED_OF_LIGHT
