"""A laser flash: a cone of light from the laser onto the relay wall."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nlosrender.scene.pose import Float64

EDGE_RAYS = 256  # of the cone, that bound what it lights


@dataclass(frozen=True)
class Flash:
    """A cone of full angle ``angle`` [rad] with equal energy per solid angle; its axis goes to the laser point."""

    angle: float
    reach: float  # m, bound on the distance of what it lights on the wall from the laser point

    @classmethod
    def onto(cls, angle: float, laser: Float64, target: Float64, wall: tuple[float, float]) -> Flash:
        """Return the flash from ``laser`` (3,) to ``target`` (3,) on a rectangle (width, height) in z = 0 [m]."""
        corners = np.array([[x, y, 0.0] for x in (-wall[0] / 2, wall[0] / 2) for y in (-wall[1] / 2, wall[1] / 2)])
        farthest = float(np.linalg.norm(corners - target, axis=1).max())
        axis = (target - laser) / np.linalg.norm(target - laser)
        across = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
        across /= np.linalg.norm(across)
        turn = np.linspace(0, 2 * math.pi, EDGE_RAYS, endpoint=False)[:, None]
        around = np.cos(turn) * across + np.sin(turn) * np.cross(axis, across)
        edge = math.cos(angle / 2) * axis + math.sin(angle / 2) * around
        if (edge[:, 2] >= 0).any():  # beside the wall's plane, too
            return cls(angle, farthest)
        lit = laser - edge * (laser[2] / edge[:, 2:])
        widest = float(np.linalg.norm(lit - target, axis=1).max()) / math.cos(math.pi / EDGE_RAYS)
        return cls(angle, min(farthest, widest))

    @property
    def in_words(self) -> str:
        """What the file says of it."""
        return (
            f"a flash: a cone of {math.degrees(self.angle):.9g} degrees (full angle) from laserPosition around "
            "laserGridPositions, equal energy per solid angle; what misses the wall is lost"
        )
