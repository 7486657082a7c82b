"""``scene``: the relay wall and the hidden geometry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cached_property
from typing import Annotated, Any

from pydantic import ValidationInfo

from nlosrender.config.bsdf import is_colored
from nlosrender.config.emitters import EmitterConfig, PointLamp, SpotLamp
from nlosrender.config.hidden_geometry import HiddenItemConfig
from nlosrender.config.issues import WrongValueRead
from nlosrender.config.mitsuba_xml import MitsubaXml, is_colored_xml, read_mitsuba_xml
from nlosrender.config.relay_wall import RelayWallConfig
from nlosrender.config.section import LIST, Section
from nlosrender.errors import ValidationIssue


class SceneConfig(Section):
    """What is rendered; coordinates in metres, right-handed."""

    relay_wall: RelayWallConfig | None = None
    """the visible surface, told by its type; captures without a camera need it"""
    hidden_geometry: Annotated[tuple[HiddenItemConfig, ...], LIST] = ()
    """a list of items, told apart by their types; empty: H is zero"""
    emitters: Annotated[tuple[EmitterConfig, ...], LIST] = ()
    """line_of_sight: what flashes at t = 0, a list of items told apart by their types"""
    mitsuba: MitsubaXml | None = None
    """captures with a camera: a Mitsuba scene as .xml, in m; its shapes, camera and, for line_of_sight, emitters join
    what is given here"""

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Name the items."""
        lists = {key: raw[key] for key in ("hidden_geometry", "emitters") if isinstance(raw.get(key), (list, tuple))}
        return raw | {key: [_named(item, index) for index, item in enumerate(lists[key])] for key in lists}

    def rule_names(self) -> Iterator[ValidationIssue]:
        """Every item has a name of its own."""
        first_use: dict[str, int] = {}
        for index, item in enumerate(self.hidden_geometry):
            with suppress(WrongValueRead):
                first = first_use.setdefault(item.name, index)
                if first != index:
                    message = f"got {item.name}, the name of hidden_geometry.{first} as well, need a name of its own."
                    yield ValidationIssue(("hidden_geometry", index, "name"), message)

    def rule_rooms(self) -> Iterator[ValidationIssue]:
        """Rooms are open towards a rectangle."""
        wall = "no" if self.relay_wall is None else f"a {self.relay_wall.type}"
        for index, item in enumerate(self.hidden_geometry if wall != "a rectangle" else ()):
            with suppress(WrongValueRead):
                if item.type == "room":
                    message = f"got a room in front of {wall} wall; a room needs a rectangle relay wall."
                    yield ValidationIssue(("hidden_geometry", index, "type"), message)

    @cached_property  # a Mitsuba scene is read for it
    def is_colored(self) -> bool:
        """Whether a BSDF differs between colour channels, or may: textures and measured spectra count as coloured."""
        if self.relay_wall is not None and is_colored(self.relay_wall.bsdf):
            return True
        if self.mitsuba is not None and is_colored_xml(read_mitsuba_xml(self.mitsuba)[0]):
            return True
        shaped = [item for _, item in self.shining_surfaces]
        lights = [
            item.intensity if isinstance(item, (PointLamp, SpotLamp)) else item.radiance for item in self.emitters
        ]
        if any(isinstance(light, tuple) and len(set(light)) > 1 for light in lights):
            return True
        return any(is_colored(item.bsdf) for item in (*self.hidden_geometry, *shaped))

    @property
    def shining_surfaces(self) -> tuple[tuple[int, Any], ...]:
        """Those of ``emitters`` that have a shape, with their places in the list."""
        return tuple(
            (place, item) for place, item in enumerate(self.emitters) if not isinstance(item, (PointLamp, SpotLamp))
        )

    @property
    def has_mesh_files(self) -> bool:
        """Whether .ply or .obj files have to be read, those of ``mitsuba`` aside."""
        items = [self.relay_wall, *self.hidden_geometry, *(item for _, item in self.shining_surfaces)]
        shapes = [item.shape["type"] for item in items if item is not None and item.type == "mitsuba"]
        return any(item is not None and item.type == "mesh" for item in items) or bool({"ply", "obj"} & set(shapes))

    @property
    def wall(self) -> RelayWallConfig:
        """The relay wall of a scene that needs one.

        Raises
        ------
        ValueError
            There is none: a capture with a camera.
        """
        if self.relay_wall is None:
            raise ValueError("scene.relay_wall: a capture with a camera needs none")
        return self.relay_wall


def _named(item: Any, index: int) -> Any:
    """Give an item its default name."""
    if isinstance(item, Mapping) and isinstance(item.get("type"), str):
        return {"name": f"{item['type']}-{index}", **item}
    return item
