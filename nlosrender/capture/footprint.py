"""The footprint of a sensor point: the area of the wall that it stands for, a disc or a rectangle around it."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Footprint:
    """A disc of diameter ``width`` (equal to ``height``), or a rectangle along the wall's axes."""

    width: float  # m
    height: float  # m
    is_disc: bool

    @property
    def reach(self) -> float:
        """Distance from the point to the farthest place that it stands for [m]."""
        return self.width / 2 if self.is_disc else math.hypot(self.width, self.height) / 2

    @property
    def area(self) -> float:
        """Area of the wall that the point stands for [m^2]."""
        return self.width * self.height * (math.pi / 4 if self.is_disc else 1.0)

    @property
    def in_words(self) -> str:
        """What the file says of it."""
        shape = (
            f"disc of radius {self.width / 2:.9g}" if self.is_disc else f"box of {self.width:.9g} x {self.height:.9g}"
        )
        return f"H is the mean over a {shape} m on the wall around each sensor point, with the leg of each place"
