"""``scene.emitters``: what lights a line-of-sight capture, as a list of items told apart by ``type``.

All of them flash once, at t = 0: a surface of radiance L sends out what a steady lamp of that radiance does, in one
pulse, so that the sum over time is the steady picture.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from nlosrender.config.bsdf import BsdfMapping
from nlosrender.config.fields import Brightness, FieldOfView, Name, Point3
from nlosrender.config.frozen import FrozenDict
from nlosrender.config.hidden_geometry import (
    BoxConfig,
    CylinderConfig,
    LettersConfig,
    MeshConfig,
    MitsubaConfig,
    RectangleConfig,
    SphereConfig,
)
from nlosrender.config.issues import mismatch, shown
from nlosrender.config.section import BY_TYPE, Section
from nlosrender.errors import ValidationIssue

BLACK_DIFFUSE = FrozenDict(type="diffuse", reflectance=0.0)


class _Lamp(Section):
    radiance: Brightness
    """W m^-2 sr^-1, of the front side; a number or [r, g, b]"""
    bsdf: BsdfMapping = Field(default_factory=lambda: BLACK_DIFFUSE)
    """what the surface reflects; default nothing"""


class RectangleLamp(_Lamp, RectangleConfig):
    """A flat rectangle that shines in the direction of its normal."""


class MeshLamp(_Lamp, MeshConfig):
    """A mesh whose faces shine on their front side."""


class LettersLamp(_Lamp, LettersConfig):
    """Shining letters."""


class BoxLamp(_Lamp, BoxConfig):
    """A box that shines outwards."""


class SphereLamp(_Lamp, SphereConfig):
    """A sphere that shines outwards, or inwards with ``inside``."""


class CylinderLamp(_Lamp, CylinderConfig):
    """A tube that shines outwards, or inwards with ``inside``."""


class MitsubaLamp(_Lamp, MitsubaConfig):
    """Any Mitsuba shape that shines."""


class PointLamp(Section):
    """A point that shines equally in all directions."""

    type: Literal["point"]
    name: Name = ""
    """what the item is called in messages; default: its type and its index in the list"""
    position: Point3
    """m, scene coordinates"""
    intensity: Brightness
    """W sr^-1; a number or [r, g, b]"""


class SpotLamp(Section):
    """A point that shines into a cone."""

    type: Literal["spot"]
    name: Name = ""
    """what the item is called in messages; default: its type and its index in the list"""
    position: Point3
    """m, scene coordinates"""
    look_at: Point3
    """m, a point on the cone's axis"""
    intensity: Brightness
    """W sr^-1 on the axis; a number or [r, g, b]"""
    cutoff_deg: FieldOfView = 20.0
    """degrees from the axis beyond which there is no light"""
    beam_deg: FieldOfView | None = None
    """degrees from the axis up to which there is all of it; null: 3/4 of cutoff_deg"""

    def rule_direction(self) -> Iterator[ValidationIssue]:
        """The spot shines somewhere."""
        if self.position == self.look_at:
            message = f"got {shown(self.look_at)}, the spot's position, need another point."
            yield ValidationIssue(("look_at",), message)

    def rule_cone(self) -> Iterator[ValidationIssue]:
        """The cone is one, and as wide as the beam in it."""
        if self.cutoff_deg >= 90:
            yield ValidationIssue(("cutoff_deg",), mismatch(self.cutoff_deg, "less than 90"))
        if self.beam_deg is not None and self.beam_deg >= self.cutoff_deg:
            need = f"less than cutoff_deg, {self.cutoff_deg:g}"
            yield ValidationIssue(("beam_deg",), mismatch(self.beam_deg, need))


ShapedLamp = RectangleLamp | MeshLamp | LettersLamp | BoxLamp | SphereLamp | CylinderLamp | MitsubaLamp
EmitterConfig = Annotated[ShapedLamp | PointLamp | SpotLamp, Field(discriminator="type"), BY_TYPE]
