"""``scene.relay_wall``: the visible surface that laser and sensor points lie on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Annotated, Literal

from pydantic import Field

from nlosrender.config.bsdf import WHITE_DIFFUSE, BsdfMapping
from nlosrender.config.fields import Direction, Flag, Length, Point3
from nlosrender.config.hidden_geometry import FromFile, MeshFilename
from nlosrender.config.issues import WrongValueRead, shown
from nlosrender.config.section import BY_TYPE, Section, pose_issues
from nlosrender.config.vectors import height_above
from nlosrender.errors import ValidationIssue

EDGE_TOLERANCE = 1e-9  # relative: a decimal such as 0.1 * 3 may pass the edge by its rounding


class _Wall(Section):
    center: Point3 = (0.0, 0.0, 0.0)
    """m, scene coordinates; the origin of the wall coordinates"""
    bsdf: BsdfMapping = Field(default_factory=lambda: WHITE_DIFFUSE)
    """any Mitsuba BSDF; default {type: diffuse, reflectance: 1.0}"""


class RectangleWallConfig(_Wall):
    """A flat wall; hidden geometry lies on the side of its normal."""

    type: Literal["rectangle"]
    width: Length
    """m, along the wall's x axis (up x normal)"""
    height: Length
    """m, along the wall's y axis (up)"""
    normal: Direction = (0.0, 0.0, 1.0)
    """direction the lit side looks in, any length"""
    up: Direction = (0.0, 1.0, 0.0)
    """direction of the wall's y axis, made perpendicular to normal"""

    def rule_pose(self) -> Iterator[ValidationIssue]:
        """An up direction is needed."""
        yield from pose_issues(self.normal, self.up)

    @property
    def extent(self) -> tuple[float, float]:
        """Extent of the wall coordinates (x, y) [m]."""
        return self.width, self.height

    def height_above(self, point: tuple[float, float, float]) -> float:
        """Return how far a scene point [m] lies in front of the wall's plane; negative behind it."""
        return height_above(point, self.center, self.normal)


class SphereWallConfig(_Wall):
    """A sphere, by default lit from within; wall coordinates are its equal-area cylindrical projection."""

    type: Literal["sphere"]
    radius: Length
    """m"""
    inside: Flag = True
    """true: laser and sensor points lie on the surface seen from within"""
    width: Length | None = None
    """m, default width of the grids along the equator; null: the whole circumference 2 pi radius"""
    height: Length | None = None
    """m, default height of the grids along the polar axis; null: the whole diameter"""

    def rule_extent(self) -> Iterator[ValidationIssue]:
        """The default extent of the grids is on the sphere."""
        for key, largest in zip(("width", "height"), self.extent, strict=True):
            with suppress(WrongValueRead):
                given = getattr(self, key)
                if given is not None and given > largest * (1 + EDGE_TOLERANCE):
                    message = f"got {shown(given)}, need at most {largest:.6g} m, the whole sphere's."
                    yield ValidationIssue((key,), message)

    @property
    def extent(self) -> tuple[float, float]:
        """Extent of the wall coordinates (x, y) [m]: circumference and diameter."""
        return 2 * math.pi * self.radius, 2 * self.radius


class CylinderWallConfig(_Wall):
    """An open tube, by default lit from within; wall coordinates are arc length and position along the axis."""

    type: Literal["cylinder"]
    axis: Direction = (0.0, 1.0, 0.0)
    """direction of the wall's y axis, any length"""
    radius: Length
    """m"""
    height: Length
    """m, along the axis"""
    inside: Flag = True
    """true: laser and sensor points lie on the surface seen from within"""

    @property
    def extent(self) -> tuple[float, float]:
        """Extent of the wall coordinates (x, y) [m]: circumference and height."""
        return 2 * math.pi * self.radius, self.height


class MeshWallConfig(FromFile):
    """A mesh from a file, lit on the side of its faces' normals; wall coordinates are its (u, v) in metres."""

    type: Literal["mesh"]
    filename: MeshFilename
    """a .ply or .obj file with texture coordinates (u, v) from 0 to 1; relative names start at the YAML's folder"""
    flip_normals: Flag = False
    """true: the wall is lit on the other side"""
    width: Length | None = None
    """m, what u from 0 to 1 is in wall coordinates; null: the mesh's mean extent along u"""
    height: Length | None = None
    """m, what v from 0 to 1 is in wall coordinates; null: the mesh's mean extent along v"""
    bsdf: BsdfMapping = Field(default_factory=lambda: WHITE_DIFFUSE)
    """any Mitsuba BSDF; default {type: diffuse, reflectance: 1.0}"""

    @property
    def extent(self) -> tuple[float, float]:
        """Extent of the wall coordinates (x, y) [m]; infinite where only the file tells."""
        return self.width or math.inf, self.height or math.inf


RelayWallConfig = Annotated[
    RectangleWallConfig | SphereWallConfig | CylinderWallConfig | MeshWallConfig, Field(discriminator="type"), BY_TYPE
]
