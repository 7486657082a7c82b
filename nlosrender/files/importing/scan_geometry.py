"""The relay wall and the laser of an imported scene, from their ``to_world`` transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from nlosrender.config.relay_wall import EDGE_TOLERANCE
from nlosrender.files.importing.translation import Translation, rounded
from nlosrender.scene.pose import Float64
from nlosrender.scene.transforms import transform_matrix

_NOTHING = ({"scale": [1.0, 1.0, 1.0]}, {"translate": [0.0, 0.0, 0.0]})
_SQUARE = 1e-6  # cosine between the edges of a rectangle, rounded as files are


@dataclass(frozen=True)
class FlatWall:
    """Mitsuba's rectangle [-1, 1] x [-1, 1] in z = 0, moved: where its (u, v) are in our wall coordinates."""

    center: Float64
    x_edge: Float64  # from the centre, along u
    y_edge: Float64  # along v
    normal: Float64

    @classmethod
    def of(cls, to_world: Float64, *, flip_normals: bool = False) -> FlatWall:
        """Return the wall of a (4, 4) transform; ValueError for one that is sheared or flattened."""
        x_edge, y_edge = to_world[:3, 0], to_world[:3, 1]
        lengths = np.linalg.norm(x_edge), np.linalg.norm(y_edge)
        determinant = np.linalg.det(to_world[:3, :3])
        if min(lengths) == 0 or determinant == 0:
            raise ValueError("it flattens the wall, need a rectangle")
        if abs(x_edge @ y_edge) > _SQUARE * lengths[0] * lengths[1]:
            raise ValueError("it shears the wall, need a rectangle")
        side = np.sign(determinant) * (-1 if flip_normals else 1)  # normals go by the inverse transpose
        return cls(to_world[:3, 3], x_edge, y_edge, side * np.cross(x_edge, y_edge))

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return 2 * float(np.linalg.norm(self.x_edge)), 2 * float(np.linalg.norm(self.y_edge))

    @property
    def is_mirrored(self) -> bool:
        """Whether u grows against our x axis, which is up x normal."""
        return float(np.cross(self.y_edge, self.normal) @ self.x_edge) < 0

    def put(self, translation: Translation, place: str) -> None:
        """Set the keys of the relay wall's shape."""
        width, height = self.size
        normal = self.normal / np.linalg.norm(self.normal)
        values = {"type": "rectangle", "width": rounded(width), "height": rounded(height)}
        values |= {"center": rounded(self.center), "normal": rounded(normal)}
        values |= {"up": rounded(self.y_edge / np.linalg.norm(self.y_edge))}
        for key, value in values.items():
            translation.put(f"scene.relay_wall.{key}", value, place)
        if self.is_mirrored:
            translation.note(
                "the relay wall is mirrored: columns of the sensor grid run the other way here; Mitsuba 3.9 renders it "
                "black, since its geometric and shading normals contradict each other"
            )

    def at_uv(self, u: float, v: float) -> list[float]:
        """Return the wall coordinates (x, y) [m] of a texture coordinate."""
        width, height = self.size
        return [rounded((u - 0.5) * width * (-1 if self.is_mirrored else 1)), rounded((v - 0.5) * height)]

    def cells(self, ranges: Sequence[tuple[float, float]], counts: tuple[int, int]) -> list[list[float]]:
        """Return the cell centres of a part of the wall, from (u, v) ranges, row by row, as wall coordinates [m]."""
        us, vs = (
            [low + (index + 0.5) / count * (high - low) for index in range(count)]
            for (low, high), count in zip(ranges, counts, strict=True)
        )
        return [self.at_uv(u, v) for v in vs for u in us]

    def hit(self, origin: Float64, direction: Float64) -> list[float] | None:
        """Return the wall coordinates (x, y) [m] that a ray meets; None where it misses the wall."""
        along = float(direction @ self.normal)
        distance = float((self.center - origin) @ self.normal) / along if along else -1.0
        if distance <= 0:
            return None
        offset = origin + distance * direction - self.center
        uv = [float(offset @ edge) / float(edge @ edge) for edge in (self.x_edge, self.y_edge)]  # -1 to 1
        if max(map(abs, uv)) > 1 + EDGE_TOLERANCE:
            return None
        return self.at_uv((uv[0] + 1) / 2, (uv[1] + 1) / 2)


def matrix_of(steps: Sequence[Any]) -> Float64:
    """Return the (4, 4) matrix of ``to_world`` steps, the first applied first."""
    return reduce(lambda matrix, step: transform_matrix(step) @ matrix, steps, np.eye(4))


def to_world_of(steps: Sequence[Any]) -> Any:
    """Return steps as one ``to_world`` of a configuration: those that do something, or a matrix where one is."""
    if all(isinstance(step[0], dict) for step in steps):
        return [
            operation for step in steps for operation in step if operation not in _NOTHING and not _is_still(operation)
        ]
    return rounded(matrix_of(steps))


def _is_still(operation: dict[str, Any]) -> bool:
    return "rotate" in operation and operation["rotate"]["angle_deg"] == 0
