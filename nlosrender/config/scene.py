"""``scene``: the relay wall and the hidden geometry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import model_validator

from nlosrender.config.bsdf import is_colored
from nlosrender.config.hidden_geometry import HiddenItemConfig
from nlosrender.config.refusal import Fault
from nlosrender.config.relay_wall import RelayWallConfig
from nlosrender.config.section import Section


class SceneConfig(Section):
    """What is rendered; coordinates in metres, right-handed."""

    relay_wall: RelayWallConfig
    """the visible surface, told by its type"""
    hidden_geometry: tuple[HiddenItemConfig, ...] = ()
    """a list of items, told apart by their types; empty: H is zero"""

    @model_validator(mode="before")
    @classmethod
    def _name_items(cls, raw: Any) -> Any:
        items = raw.get("hidden_geometry") if isinstance(raw, Mapping) else None
        if not isinstance(items, (list, tuple)):
            return raw
        named = [
            {"name": f"{item['type']}-{index}", **item}
            if isinstance(item, Mapping) and isinstance(item.get("type"), str)
            else item
            for index, item in enumerate(items)
        ]
        return {**raw, "hidden_geometry": named}

    def rules(self) -> Iterator[Fault]:
        """Yield the faults between items, and between items and the wall."""
        first_use: dict[str, int] = {}
        for index, item in enumerate(self.hidden_geometry):
            first = first_use.setdefault(item.name, index)
            path = ("hidden_geometry", index)
            if first != index:
                message = f"got {item.name}, the name of hidden_geometry.{first} as well, need a name of its own."
                yield Fault((*path, "name"), message, needs=((*path, "name"), ("hidden_geometry", first, "name")))
            if item.type == "room" and self.relay_wall.type != "rectangle":
                message = f"got a room in front of a {self.relay_wall.type} wall; a room needs a rectangle relay wall."
                yield Fault((*path, "type"), message, needs=(path, ("relay_wall", "type")))

    @property
    def is_colored(self) -> bool:
        """Whether a BSDF differs between colour channels, or may: textures and measured spectra count as coloured."""
        return is_colored(self.relay_wall.bsdf) or any(is_colored(item.bsdf) for item in self.hidden_geometry)
