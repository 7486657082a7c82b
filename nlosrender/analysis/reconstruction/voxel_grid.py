"""Where to look for the hidden scene: a box of cubic voxels along the relay wall's axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nlosrender.errors import FileError, OptionError
from nlosrender.files.layout import Float64
from nlosrender.files.reading.scan import Scan
from nlosrender.scene.bounding_box import Bounds

DEFAULT_VOXELS = 128  # along the longest edge
MARGIN = 0.15  # of the longest edge of the hidden geometry's box, on every side
MARGIN_WAVELENGTHS = 1.5  # but at least this: a flat object is as deep as the pulse is long
MIN_WALL_DISTANCE = 0.5  # wavelengths between the wall and the nearest voxels of a default box
MAX_VOXELS = 2**27  # 1 GiB of complex numbers


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """Centres of the voxels along each axis of the wall's frame [m], ascending."""

    x: Float64  # along the wall
    y: Float64  # along the wall, upwards
    z: Float64  # away from the wall, > 0
    voxel_size: float  # m

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of voxels in the order of a volume's axes (z, y, x)."""
        return len(self.z), len(self.y), len(self.x)

    @property
    def z_extent(self) -> float:
        """Depth of the box [m]."""
        return len(self.z) * self.voxel_size

    @property
    def bounds(self) -> Bounds:
        """Lowest and highest voxel centre, (3,) and (3,) [m]."""
        axes = (self.x, self.y, self.z)
        return np.array([axis[0] for axis in axes]), np.array([axis[-1] for axis in axes])


def voxel_grid(
    scan: Scan,
    wavelength: float,
    center: Sequence[float] | None = None,
    size: Sequence[float] | None = None,
    voxels: int | None = None,
    voxel_size: float | None = None,
) -> VoxelGrid:
    """Return the voxels of a box, by default the one around the hidden geometry with a margin.

    Parameters
    ----------
    scan, wavelength
        The capture; shortest length to be resolved [m], which the default margin follows.
    center, size
        (3,) middle and edges of the box [m], wall's frame; each by default the hidden geometry's.
    voxels, voxel_size
        Number of voxels along the longest edge, or edge of a voxel [m].

    Raises
    ------
    FileError
        The file does not say where the hidden geometry is and no box is given.
    OptionError
        The box is not in front of the wall, or would hold more than 2^27 voxels.
    """
    if center is None or size is None:
        low, high = _default_box(scan, wavelength)
    middle = (low + high) / 2 if center is None else np.asarray(center, dtype=np.float64)
    edges = high - low if size is None else np.broadcast_to(np.asarray(size, dtype=np.float64), 3)
    edge = float(edges.max()) / (voxels or DEFAULT_VOXELS) if voxel_size is None else voxel_size
    counts = np.maximum(np.ceil(edges / edge - 1e-6), 1)
    if counts.prod() > MAX_VOXELS:
        raise OptionError(
            f"volume of {' x '.join(f'{n:.0f}' for n in counts)} voxels: need at most {MAX_VOXELS:.2g}. "
            "Take larger voxels (--voxel-size) or a smaller volume (--volume-size)."
        )
    x, y, z = (c + (np.arange(int(n)) - (n - 1) / 2) * edge for c, n in zip(middle, counts, strict=True))
    if scan.planar and z[0] <= 0:
        raise OptionError(
            f"volume: its nearest voxels lie at z = {z[0]:.3g} m, need z > 0 (in front of the wall). "
            "Move it (--volume-center) or make it less deep (--volume-size)."
        )
    return VoxelGrid(x, y, z, edge)


def expected_box(
    scan: Scan, center: Sequence[float] | None = None, size: Sequence[float] | None = None
) -> Bounds | None:
    """Return the box of ``voxel_grid`` before a wavelength is known; None when the file does not say where it is."""
    if center is None or size is None:
        if scan.hidden_aabb is None:
            return None
        margin = MARGIN * float(np.ptp(scan.hidden_aabb, axis=0).max())
        low, high = scan.hidden_aabb[0] - margin, scan.hidden_aabb[1] + margin
    middle = (low + high) / 2 if center is None else np.asarray(center, dtype=np.float64)
    half = (high - low) / 2 if size is None else np.broadcast_to(np.asarray(size, dtype=np.float64), 3) / 2
    return middle - half, middle + half


def _default_box(scan: Scan, wavelength: float) -> Bounds:
    box = expected_box(scan)
    if box is None or scan.hidden_aabb is None:
        raise FileError(
            "the file does not say where the hidden scene is: give --volume-center X,Y,Z and --volume-size W,H,D "
            "(m; x and y along the wall, z away from it, from the wall's centre)"
        )
    edge = float(np.ptp(scan.hidden_aabb, axis=0).max())
    margin = min(MARGIN_WAVELENGTHS * wavelength, edge)  # waves longer than the scene show nothing of it
    low = np.minimum(box[0], scan.hidden_aabb[0] - margin)
    high = np.maximum(box[1], scan.hidden_aabb[1] + margin)
    if scan.planar:
        low[2] = max(low[2], min(MIN_WALL_DISTANCE * wavelength, high[2] / 2))
    return low, high
