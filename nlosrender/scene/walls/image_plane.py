"""The image plane of a line-of-sight capture: it stands where other captures have their relay wall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.walls.wall import RectangleWall


@dataclass(frozen=True, eq=False)
class ImagePlane(RectangleWall):
    """The part of a plane that a camera sees; nothing is there, light passes through.

    Its axes point right and up in the picture, its normal at the camera, so that pixels are a grid like any other.
    """

    distance: float = 1.0  # from the camera [m], > 0

    @property
    def default_device_position(self) -> Float64:
        """Where the camera stands: (3,) local frame [m]."""
        return np.array([0.0, 0.0, self.distance])


def image_plane(
    position: ArrayLike, look_at: ArrayLike, up: ArrayLike, fov_deg: float, pixels: tuple[int, int]
) -> ImagePlane:
    """Return the image plane through ``look_at``.

    Parameters
    ----------
    position, look_at, up
        (3,) where the camera stands, what it looks at [m] and which direction is up in the picture; ValueError if
        these span no picture.
    fov_deg
        Horizontal field of view [degrees].
    pixels
        Columns and rows; they are square.
    """
    towards = np.asarray(position, dtype=np.float64) - np.asarray(look_at, dtype=np.float64)
    distance = float(np.linalg.norm(towards))
    width = 2 * distance * float(np.tan(np.radians(fov_deg) / 2))
    pose = Pose.from_normal_up(look_at, towards, up)
    return ImagePlane(pose, width, width * pixels[1] / pixels[0], distance)
