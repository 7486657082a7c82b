"""Base of the frozen dataclasses that hold one array per property, one row per item."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class StructOfArrays:
    """Items (n,); every field is an array of n rows."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def select(self, chosen: NDArray[np.integer | np.bool_]) -> Self:
        """Return the items at indices, or where a mask (n,) holds."""
        if chosen.dtype == bool and chosen.all():
            return self
        return type(self)(*(getattr(self, item.name)[chosen] for item in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the items of all parts, at least one, in their order."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(cls)))
