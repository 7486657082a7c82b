"""``scene.hidden_geometry``: everything that is not the relay wall, as a list of items told apart by ``type``."""

from __future__ import annotations

import string
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo

from nlosrender.config.bsdf import WHITE_DIFFUSE, BsdfMapping
from nlosrender.config.bsdf_table import SHAPE_TYPES
from nlosrender.config.fields import (
    Angles3,
    Checked,
    Direction,
    Flag,
    Length,
    LengthOrZero,
    Name,
    Point3,
    Scale,
    Sizes3,
    Text,
)
from nlosrender.config.frozen import FrozenDict
from nlosrender.config.issues import InvalidValue, invalid_value, mismatch, shown
from nlosrender.config.plugin_check import config_folder, existing_file, plugin_mapping
from nlosrender.config.section import BY_TYPE, ONE_OF, Section, pose_issues
from nlosrender.config.shape_check import check_shape
from nlosrender.errors import ValidationIssue

LETTERS = string.ascii_uppercase + string.digits + " "
MAX_LETTERS = 256
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
_TOWARDS_WALL = (0.0, 0.0, -1.0)  # a default wall looks along +z
_NO_ROTATION = (0.0, 0.0, 0.0)


def _letters(value: object) -> str:
    need = "A-Z, 0-9 and spaces, at least one of them visible"
    if not isinstance(value, str):
        raise invalid_value(value, need, "" if value is None else "Put it in quotes.")
    if len(value) > MAX_LETTERS:
        raise invalid_value(value, f"at most {MAX_LETTERS} characters")
    if value.strip(" ") and all(letter in LETTERS for letter in value):
        return value
    upper = value.upper()
    hint = f"Write it in upper case: {upper}." if value.strip() and all(c in LETTERS for c in upper) else ""
    raise invalid_value(value, need, hint)


def _mesh_file(value: object, validation: ValidationInfo) -> Path:
    if not isinstance(value, str) or not value.lower().endswith(MESH_SUFFIXES):
        raise invalid_value(value, f"the name of a {', '.join(MESH_SUFFIXES[:-1])} or {MESH_SUFFIXES[-1]} file")
    path, problem = existing_file(value, config_folder(validation))
    made_by = validation.data.get("made_by")
    if isinstance(made_by, str) and not path.exists():
        problem = f"got {value}, but there is no file at {path}. It is made by: {made_by}"
    if problem:
        raise InvalidValue(ValidationIssue((), problem))
    return path


_MESH_PATTERN = r"\.([pP][lL][yY]|[oO][bB][jJ]|[sS][tT][lL]|[oO][fF][fF]|[gG][lL][bB])$"
LetterText = Annotated[str, Checked(_letters, {"type": "string", "pattern": "^[A-Z0-9 ]*[A-Z0-9][A-Z0-9 ]*$"})]
MeshFilename = Annotated[Path, Checked(_mesh_file, {"type": "string", "pattern": _MESH_PATTERN}, with_context=True)]
ShapeMapping = Annotated[FrozenDict, plugin_mapping(check_shape, SHAPE_TYPES)]


class _HiddenItem(Section):
    name: Name = ""
    """what the item is called in messages and files; default: its type and its index in the list"""
    bsdf: BsdfMapping = Field(default_factory=lambda: WHITE_DIFFUSE)
    """any Mitsuba BSDF; default {type: diffuse, reflectance: 1.0}"""


class _FacingItem(_HiddenItem):
    center: Point3
    """m, scene coordinates"""
    normal: Direction = _TOWARDS_WALL
    """direction the front side looks in, any length"""
    up: Direction = (0.0, 1.0, 0.0)
    """direction of the item's y axis, made perpendicular to normal"""

    def rule_pose(self) -> Iterator[ValidationIssue]:
        """An up direction is needed."""
        yield from pose_issues(self.normal, self.up)


class RectangleConfig(_FacingItem):
    """A flat rectangle, seen from the side of its normal."""

    type: Literal["rectangle"]
    width: Length
    """m, along the item's x axis (up x normal)"""
    height: Length
    """m, along the item's y axis (up)"""


class LettersConfig(_FacingItem):
    """Generated stroke letters, readable from the side of their normal, centred on ``center``."""

    type: Literal["letters"]
    text: LetterText
    """A-Z, 0-9 and spaces"""
    height: Length
    """m, height of the letters"""
    thickness: LengthOrZero = 0.0
    """m; 0: a sheet, more: a solid"""
    stroke_width: Length | None = None
    """m; null: 0.2 height"""
    spacing: LengthOrZero | None = None
    """m, gap between letters; null: 0.2 height"""

    def rule_strokes(self) -> Iterator[ValidationIssue]:
        """Strokes are narrower than the letter is high."""
        if self.stroke_width is not None and self.stroke_width >= 0.5 * self.height:
            need = f"less than half the height of {self.height} m"
            yield ValidationIssue(("stroke_width",), mismatch(self.stroke_width, need))


class FromFile(Section):
    """What is read from a mesh file, and where it is put."""

    # no part of the capture, so no part of its hash either; before filename, whose check wants to know it
    made_by: Text | None = Field(default=None, exclude=True)
    """the command that makes the file, told when it is missing"""
    filename: MeshFilename
    """a .ply, .obj, .stl, .off or .glb file; relative names start at the YAML's folder"""
    scale: Scale = 1.0
    """m per unit of the file; [x, y, z]: along its axes; negative: mirrored, and its front stays its front"""
    rotate_deg: Angles3 = _NO_ROTATION
    """degrees about x, y, z, in this order"""
    translate: Point3 = (0.0, 0.0, 0.0)
    """m, scene coordinates"""


class FitConfig(Section):
    """A size for a mesh of any unit and origin."""

    largest: Length
    """m, the largest edge of the mesh's bounding box after scale and before the rotation"""


class MeshConfig(FromFile, _HiddenItem):
    """A triangle mesh from a file: scaled, then rotated about x, then y, then z, then translated."""

    type: Literal["mesh"]
    fit: FitConfig | None = None
    """{largest: 0.8}: brought to this size, its bounding box centred on translate; null: as the file has it"""
    normals: Annotated[Literal["auto", "file", "flat", "smooth"], ONE_OF] = "auto"
    """auto: the file's vertex normals where it has some, else flat faces; file: it has to have them; flat: none;
    smooth: averaged from the faces around each vertex"""
    face_normals: Flag | None = None
    """as Mitsuba has it: true is normals: flat, false the file's or smooth ones; null: normals decides"""

    def rule_normals(self) -> Iterator[ValidationIssue]:
        """The two keys do not contradict each other."""
        if self.face_normals is not None and self.normals != "auto" and self.face_normals != (self.normals == "flat"):
            message = f"face_normals is {shown(self.face_normals)}, normals is {self.normals}. Remove one of the two."
            yield ValidationIssue(("normals",), message)

    @property
    def shading_normals(self) -> Literal["auto", "file", "flat", "smooth", "mitsuba"]:
        """What ``normals`` and ``face_normals`` say together (``scene.mesh_normals.Normals``)."""
        if self.face_normals is None or self.normals != "auto":
            return self.normals
        return "flat" if self.face_normals else "mitsuba"


class BoxConfig(_HiddenItem):
    """A closed box, seen from outside."""

    type: Literal["box"]
    center: Point3
    """m, scene coordinates"""
    size: Sizes3
    """m, edge lengths along x, y, z before the rotation"""
    rotate_deg: Angles3 = _NO_ROTATION
    """degrees about x, y, z, in this order"""


class SphereConfig(_HiddenItem):
    """A sphere, by default seen from outside."""

    type: Literal["sphere"]
    center: Point3
    """m, scene coordinates"""
    radius: Length
    """m"""
    inside: Flag = False
    """true: the surface seen from within"""


class CylinderConfig(_HiddenItem):
    """An open tube, by default seen from outside."""

    type: Literal["cylinder"]
    center: Point3
    """m, scene coordinates, the middle of the axis"""
    axis: Direction = (0.0, 1.0, 0.0)
    """direction of the axis, any length"""
    radius: Length
    """m"""
    height: Length
    """m, along the axis"""
    inside: Flag = False
    """true: the surface seen from within"""


class RoomConfig(_HiddenItem):
    """Five sides of a box seen from within, open towards the relay wall and centred on it."""

    type: Literal["room"]
    size: Sizes3
    """m, width and height along the wall's axes, depth along its normal"""


class MitsubaConfig(_HiddenItem):
    """Any Mitsuba shape as a dictionary, in scene coordinates."""

    type: Literal["mitsuba"]
    shape: ShapeMapping
    """the shape's parameters; to_world: a 4x4 matrix or a list of translate, rotate, scale, applied in order"""


HiddenItemConfig = Annotated[
    RectangleConfig
    | MeshConfig
    | LettersConfig
    | BoxConfig
    | SphereConfig
    | CylinderConfig
    | RoomConfig
    | MitsubaConfig,
    Field(discriminator="type"),
    BY_TYPE,
]
