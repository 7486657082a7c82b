"""Reports one line per mesh: what has been read of its file, and warnings about likely mistakes in it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.bounding_box import bounds_of
from nlosrender.scene.meshes.file_mesh import FileMesh, some_of
from nlosrender.scene.meshes.mesh_normals import normal_cosines
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh, equal_columns
from nlosrender.scene.pose import Float64

_NORMALS = {"flat": "flat", "file": "normals of the file", "smoothed": "smoothed normals"}
MAX_LINES = 20  # of a scene: some have thousands of meshes
MIN_CONTRADICTING_SHARE = 0.01  # below, the few normals along seams that are averaged over sharp edges


@dataclass(frozen=True)
class MeshReport:
    """What ``plan``, ``validate`` and ``info`` print of a mesh."""

    key: str  # where it is configured
    name: str
    file: str
    triangles: int
    area: float  # m^2
    extent: tuple[float, ...]  # along the relay wall's axes [m]
    facing_share: float | None  # of the area whose front some point of the relay wall may see; None without a wall
    normals: str  # flat, file or smoothed
    largest_angle_deg: float  # between a vertex normal and its face's
    contradicting_share: float  # of the area whose vertex normals point to the back of its faces
    edges: int  # of two faces
    disagreeing_edges: int  # of these, whose faces disagree which side is the front
    has_uvs: bool
    materials: tuple[str, ...] = ()  # names of the file's materials, which are not read
    dropped: tuple[str, ...] = ()  # what else of the file is not read

    def line(self) -> str:
        """Return all of it as one line."""
        parts = [f"{self.triangles} triangles", f"{self.area:.4g} m^2"]
        parts.append(" x ".join(f"{extent:.3g}" for extent in self.extent) + " m")
        if self.facing_share is not None:
            parts.append(f"{100 * self.facing_share:.3g} % of its area faces the wall")
        is_flat = self.normals == "flat"
        away = "" if is_flat else f" (up to {self.largest_angle_deg:.3g} degrees from the faces')"
        parts.append(_NORMALS.get(self.normals, self.normals) + away)
        if self.disagreeing_edges:
            parts.append(f"faces disagree at {self.disagreeing_edges} of {self.edges} edges")
        parts.append("texture coordinates" if self.has_uvs else "no texture coordinates")
        if self.materials:
            parts.append(f"materials not read: {some_of(self.materials)}")
        if self.dropped:
            parts.append(f"left out: {some_of(self.dropped)}")
        return f"{self.name} ({self.file}): {', '.join(parts)}"

    def warnings(self, read: FileMesh, *, has_two_sides: bool) -> Iterator[str]:
        """Yield a sentence for each likely mistake of the file; ``has_two_sides``: its back reflects, too."""
        where = f"{self.key} ({self.name})"
        yield from (f"{where}: {doubt}" for doubt in read.doubts)
        if len(self.materials) > 1:
            yield (
                f"{where}: its faces have {len(self.materials)} materials ({some_of(self.materials)}), which are not "
                "read: the item's bsdf is taken for all. Split the file into one item per material."
            )
        if self.disagreeing_edges and not has_two_sides:
            yield (
                f"{where}: at {self.disagreeing_edges} of its {self.edges} edges the two faces disagree which side is "
                "the front: what shows its back is black. Make the winding consistent (mesh programs: recalculate "
                "normals, outside), or wrap its bsdf in {type: twosided}."
            )
        if self.contradicting_share > MIN_CONTRADICTING_SHARE:
            yield (
                f"{where}: the file's normals contradict its faces on {100 * self.contradicting_share:.3g} % of its "
                "area. Light goes by the normals. Use normals: flat to go by the order of the faces' corners, or write "
                "the file anew with both alike."
            )


def mesh_lines(meshes: Sequence[MeshReport]) -> Iterator[str]:
    """Yield the lines of the first meshes, and how many more there are."""
    yield from (mesh.line() for mesh in meshes[:MAX_LINES])
    if len(meshes) > MAX_LINES:
        yield f"and {len(meshes) - MAX_LINES} more, which --json has"


def mesh_report(
    key: str, name: str, file: str, read: FileMesh, placed: TriangleMesh, normals: str, wall_corners: Float64 | None
) -> MeshReport:
    """Return the report of a mesh.

    Parameters
    ----------
    key, name, file, normals
        As in ``MeshReport``.
    read
        As its file has it.
    placed
        In the relay wall's frame [m], with the normals that are rendered.
    wall_corners
        (8, 3) of a box around the wall [m]; None: there is none.
    """
    cosines, areas = normal_cosines(placed), placed.areas()
    low, high = placed.bounds()
    edges, disagreeing = edge_counts(equal_columns(read.mesh.vertices.T)[read.mesh.faces])
    total = float(areas.sum())
    return MeshReport(
        key=key,
        name=name,
        file=file,
        triangles=len(placed.faces),
        area=total,
        extent=tuple((high - low).tolist()),
        facing_share=None if wall_corners is None else float(areas[_faces_wall(placed, wall_corners)].sum()) / total,
        normals=normals,
        largest_angle_deg=float(np.degrees(np.arccos(np.clip(cosines.min(), -1, 1)))),
        contradicting_share=float(areas[cosines.sum(axis=1) < 0].sum()) / total,
        edges=edges,
        disagreeing_edges=disagreeing,
        has_uvs=placed.uvs is not None,
        materials=read.materials,
        dropped=read.dropped,
    )


def edge_counts(faces: NDArray[np.int64]) -> tuple[int, int]:
    """Return how many edges have two faces (m, 3), and how many of these are run through the same way by both.

    Faces agree which side is the front when they run through their common edge in opposite ways.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    _, edge, counts = np.unique(keys, return_inverse=True, return_counts=True)
    is_pair, n_forwards = counts == 2, np.bincount(edge, start < end)
    return int(is_pair.sum()), int((is_pair & (n_forwards != 1)).sum())


def _faces_wall(mesh: TriangleMesh, wall_corners: Float64) -> NDArray[np.bool_]:
    """Return which faces turn their front, by the normals that are rendered, to some point of the wall's box."""
    normals = mesh.face_normals() if mesh.normals is None else mesh.normals[mesh.faces].mean(axis=1)
    low, high = bounds_of(wall_corners)
    corners = mesh.vertices[mesh.faces]
    farthest = np.where(normals > 0, high, low) - corners.mean(axis=1)
    is_above = corners[..., 2].max(axis=1) > low[2]
    return is_above & (np.einsum("mx,mx->m", farthest, normals) > 0)
