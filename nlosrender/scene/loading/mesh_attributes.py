"""Attributes of meshes in textures: the colours of a .ply file's vertices as a reflectance.

Values count as linear reflectances from 0 to 1, as Mitsuba takes them; whole numbers of 8 bits stand for 0 to 255.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

VERTEX_COLOR = "vertex_color"  # the name Mitsuba has for them
ROUNDING = 1e-6  # ten times that of float32: values may pass 1 by it


@dataclass(frozen=True)
class AttributeUse:
    """A texture that reads an attribute of a mesh."""

    parameter: str  # of the BSDF that the texture sets
    name: str
    scale: float = 1.0

    def check(self, attributes: Mapping[str, NDArray[Any]]) -> None:
        """Raise ValueError for an attribute that is not there, or has values that the parameter cannot have."""
        if self.name not in attributes:
            there = ", ".join(attributes) or "none"
            raise ValueError(f"{self.parameter}: the surface has no attribute {self.name} (it has: {there})")
        values = np.ravel(attributes[self.name]) * self.scale
        is_share = "reflectance" in self.parameter or "transmittance" in self.parameter or "color" in self.parameter
        most = 1.0 if is_share else np.inf
        wrong = ~((values >= 0) & (values <= most + ROUNDING) & np.isfinite(values))
        if wrong.any():
            need = "from 0 to 1, linear" if is_share else "finite and not negative"
            raise ValueError(
                f"{self.parameter}: {int(wrong.sum())} of {values.size} values of {self.name}, such as "
                f"{values[wrong][0]:g}, are not {need}; set its scale (0.00392157 for 8 bits), or write other "
                "values into the mesh"
            )


def attribute_uses(bsdf: Mapping[str, object], parameter: str = "") -> Iterator[AttributeUse]:
    """Yield the textures in a BSDF dictionary that read attributes of their surface."""
    if bsdf.get("type") == "mesh_attribute":
        scale = bsdf.get("scale", 1.0)
        yield AttributeUse(parameter, str(bsdf.get("name")), float(scale) if isinstance(scale, (int, float)) else 1.0)
    for key, part in bsdf.items():
        if isinstance(part, Mapping):
            yield from attribute_uses(part, key)
