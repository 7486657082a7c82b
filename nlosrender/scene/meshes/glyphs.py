"""The centre lines of the letters A-Z and the digits 0-9.

A glyph is drawn in a unit box: x from 0 (left) to 1 (right), y from 0 (baseline) to 1 (cap height). A stroke whose
first and last points are the same is closed. A slanted stroke that ends at y = 0 or y = 1 is cut off there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Point = tuple[float, float]
Stroke = tuple[Point, ...]

_QUARTER_SEGMENTS = 10  # straight pieces per quarter turn: at most 0.3 % of the radius off a true ellipse


@dataclass(frozen=True)
class Glyph:
    """The centre lines of one character in the unit box."""

    width: float  # of the box, relative to the cap height, stroke included
    strokes: tuple[Stroke, ...]
    cut_sides: bool = False  # cut off at the box's left and right, too: else the corners of a Z stick out


def glyph_table() -> dict[str, Glyph]:
    """Return the glyph of every letter and digit by its character."""
    return {**_straight_letters(), **_round_letters(), **_digits()}


def _straight_letters() -> dict[str, Glyph]:
    return {
        "A": Glyph(0.9, (((0, 0), (0.5, 1), (1, 0)), ((0.2, 0.27), (0.8, 0.27)))),
        "E": Glyph(0.62, (((1, 1), (0, 1), (0, 0), (1, 0)), ((0, 0.5), (0.88, 0.5)))),
        "F": Glyph(0.6, (((1, 1), (0, 1), (0, 0)), ((0, 0.5), (0.85, 0.5)))),
        "H": Glyph(0.74, (((0, 0), (0, 1)), ((1, 0), (1, 1)), ((0, 0.5), (1, 0.5)))),
        "I": Glyph(0.0, (((0, 0), (0, 1)),)),
        "K": Glyph(0.78, (((0, 0), (0, 1)), ((1, 1), (0, 0.33)), ((0.38, 0.58), (1, 0)))),
        "L": Glyph(0.6, (((0, 1), (0, 0), (1, 0)),)),
        "M": Glyph(0.95, (((0, 0), (0, 1), (0.5, 0.1), (1, 1), (1, 0)),)),
        "N": Glyph(0.78, (((0, 0), (0, 1), (1, 0), (1, 1)),)),
        "T": Glyph(0.74, (((0, 1), (1, 1)), ((0.5, 0), (0.5, 1)))),
        "V": Glyph(0.88, (((0, 1), (0.5, 0), (1, 1)),)),
        "W": Glyph(1.25, (((0, 1), (0.25, 0), (0.5, 1), (0.75, 0), (1, 1)),)),
        "X": Glyph(0.8, (((0, 0), (1, 1)), ((0, 1), (1, 0)))),
        "Y": Glyph(0.82, (((0, 1), (0.5, 0.45), (1, 1)), ((0.5, 0), (0.5, 0.45)))),
        "Z": Glyph(0.74, (((0, 1), (1, 1), (0, 0), (1, 0)),), cut_sides=True),
    }


def _round_letters() -> dict[str, Glyph]:
    upper_bowl: Stroke = ((0, 1), *_arc((0.5, 0.75), (0.42, 0.25), 90, -90), (0, 0.5))
    lower_bowl: Stroke = ((0, 0.5), *_arc((0.5, 0.25), (0.5, 0.25), 90, -90), (0, 0))
    wide_bowl: Stroke = ((0, 1), *_arc((0.45, 0.72), (0.55, 0.28), 90, -90), (0, 0.44))
    s_curve = (
        *_arc((0.5, 0.75), (0.47, 0.25), 25, 270),
        *_arc((0.5, 0.25), (0.5, 0.25), 90, -155)[1:],
    )
    whole = ((0.5, 0.5), (0.5, 0.5))
    return {
        "B": Glyph(0.7, (((0, 0), (0, 1)), upper_bowl, lower_bowl)),
        "C": Glyph(0.8, (_arc(*whole, 48, 312),)),
        "D": Glyph(0.76, (((0, 0), (0, 1), *_arc((0.4, 0.5), (0.6, 0.5), 90, -90), (0, 0)),)),
        "G": Glyph(0.86, ((*_arc(*whole, 48, 345), (1, 0.46), (0.58, 0.46)),)),
        "J": Glyph(0.58, (((1, 1), *_arc((0.5, 0.32), (0.5, 0.32), 0, -165)),)),
        "O": Glyph(0.9, (_loop(*whole),)),
        "P": Glyph(0.68, (((0, 0), (0, 1)), wide_bowl)),
        "Q": Glyph(0.9, (_loop(*whole), ((0.58, 0.36), (0.92, 0)))),
        "R": Glyph(0.72, (((0, 0), (0, 1)), wide_bowl, ((0.5, 0.44), (1, 0)))),
        "S": Glyph(0.68, (s_curve,)),
        "U": Glyph(0.74, (((0, 1), *_arc((0.5, 0.38), (0.5, 0.38), 180, 360), (1, 1)),)),
    }


def _digits() -> dict[str, Glyph]:
    three_upper = _arc((0.46, 0.75), (0.46, 0.25), 150, -90)
    three_lower = _arc((0.48, 0.25), (0.52, 0.25), 90, -150)
    two: Stroke = (*_arc((0.5, 0.7), (0.5, 0.3), 160, -35), (0, 0), (1, 0))
    six: Sequence[Stroke] = (_loop((0.5, 0.29), (0.5, 0.29)), (*_arc((0.55, 0.33), (0.55, 0.67), 180, 68),))
    five = (((0.92, 1), (0.08, 1), (0.08, 0.52)), _arc((0.48, 0.3), (0.52, 0.3), 137, -150))
    return {
        "0": Glyph(0.64, (_loop((0.5, 0.5), (0.5, 0.5)),)),
        "1": Glyph(0.5, (((0.5, 0), (0.5, 1), (-0.1, 0.72)), ((0, 0), (1, 0)))),
        "2": Glyph(0.66, (two,), cut_sides=True),
        "3": Glyph(0.66, (three_upper, three_lower)),
        "4": Glyph(0.76, (((0.72, 0), (0.72, 1), (0, 0.27), (1, 0.27)),), cut_sides=True),
        "5": Glyph(0.66, five),
        "6": Glyph(0.68, tuple(six)),
        "7": Glyph(0.66, (((0, 1), (1, 1), (0.3, 0)),), cut_sides=True),
        "8": Glyph(0.68, (_loop((0.5, 0.75), (0.44, 0.25)), _loop((0.5, 0.27), (0.5, 0.27)))),
        "9": Glyph(0.68, _turned(six)),
    }


def _arc(center: Point, radii: Point, start_deg: float, end_deg: float) -> Stroke:
    """Return points of an elliptic arc; every multiple of 90 degrees on it is one of them."""
    step = 90.0 / _QUARTER_SEGMENTS
    low, high = sorted((float(start_deg), float(end_deg)))
    inner = np.arange(np.floor(low / step + 1e-9) + 1, np.ceil(high / step - 1e-9)) * step
    angles = np.radians(np.concatenate([[low], inner, [high]]))
    if start_deg > end_deg:
        angles = angles[::-1]
    x = center[0] + radii[0] * np.cos(angles)
    y = center[1] + radii[1] * np.sin(angles)
    # 12 digits: the arc's extreme points lie on the box exactly
    return tuple((round(float(a), 12), round(float(b), 12)) for a, b in zip(x, y, strict=True))


def _loop(center: Point, radii: Point) -> Stroke:
    points = _arc(center, radii, 0.0, 360.0)
    return (*points[:-1], points[0])


def _turned(strokes: Sequence[Stroke]) -> tuple[Stroke, ...]:
    return tuple(tuple((1.0 - x, 1.0 - y) for x, y in stroke) for stroke in strokes)
