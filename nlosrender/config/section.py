"""What every section of the config has in common: frozen, no unknown keys, rules over several keys."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from pydantic import BaseModel, ConfigDict, model_validator

from nlosrender.config.refusal import Fault, raise_faults, shown
from nlosrender.config.vectors import parallel


class Section(BaseModel):
    """A mapping of the YAML; attribute names are its keys."""

    # Attribute docstrings feed the JSON Schema and the messages about missing keys: one text, one place.
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    def rules(self) -> Iterator[Fault]:
        """Yield what is wrong in the combination of this section's values."""
        yield from ()

    @model_validator(mode="after")
    def _obey_rules(self) -> Self:
        raise_faults(type(self).__name__, self.rules())
        return self


def pose_faults(normal: tuple[float, ...], up: tuple[float, ...]) -> Iterator[Fault]:
    """Yield the fault of an ``up`` that does not tell the pose's y axis."""
    if parallel(normal, up):
        message = f"up {shown(up)} is parallel to normal {shown(normal)}, need two directions that span a plane."
        yield Fault(("up",), message, needs=(("normal",), ("up",)))
