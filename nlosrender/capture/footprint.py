"""The footprint of a sensor point, the area that it stands for: a disc or a rectangle of the wall, or a pixel."""

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


@dataclass(frozen=True)
class PixelFootprint:
    """All that a camera's pixel sees, on any surfaces: directions uniform over the pixel's area in the picture."""

    reach: float  # distance from the point to the farthest place that it stands for [m], as far as a few rays find it
    area: None = None  # of the surfaces: it depends on what each pixel sees
    in_words = (
        "H is the mean over each pixel of the camera, uniform by the pixel's area in the picture, with the leg of each "
        "place; the sensor point is one of these places, and the laser lights points"
    )
