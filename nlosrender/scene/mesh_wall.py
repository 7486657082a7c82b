"""A triangle mesh as relay wall: laser and sensor points are named by the file's texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.config.fields import LONGEST, SHORTEST
from nlosrender.errors import ConfigError
from nlosrender.scene.hidden_geometry import mesh_matrix
from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.mesh_file import read_mesh_file
from nlosrender.scene.meshes.mesh_normals import with_normals
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.uv_map import NOWHERE, Indices, UvMap
from nlosrender.scene.wall_coordinates import on_wall, require_positive

if TYPE_CHECKING:
    from nlosrender.config.relay_wall import MeshWallConfig

SAME_FACE = 1 - 1e-5  # least cosine between the normals of a face in float32 and float64
FLATNESS = 1e-7  # of the wall's size: what float32 coordinates of a file leave of a plane
LEAST_MEAN_NORMAL = 0.1  # of the length it has on a plane: below it the wall closes round, and no side is its front
UV_ROUNDING = 1e-6  # texture coordinates may pass 0 and 1 by so much


@dataclass(frozen=True, eq=False)
class MeshWall:
    """A mesh as relay wall, lit on the side of its faces' normals; wall coordinates are its texture coordinates.

    Parameters
    ----------
    pose
        Pose of the local frame in the scene.
    mesh
        The wall in its local frame [m], flat faces; texture coordinates within [0, 1].
    width, height
        What u and v from 0 to 1 are in wall coordinates [m], > 0.
    coordinates
        (n, 2) texture coordinates of the vertices that wall coordinates are made of; None: those of ``mesh``.
    read, file
        What its file holds, and the file's name; None, if it has none.

    Raises
    ------
    ValueError
        A size is not positive, or two faces have the same texture coordinates.
    """

    pose: Pose
    mesh: TriangleMesh
    width: float
    height: float
    coordinates: Float64 | None = None
    read: FileMesh | None = None
    file: str = ""
    _map: UvMap = field(init=False, repr=False)
    _face_normals: Float64 = field(init=False, repr=False)
    _is_planar: bool = field(init=False, repr=False)
    _is_lost: NDArray[np.bool_] = field(init=False, repr=False)  # (n,) faces that float32 turns or flattens

    def __post_init__(self) -> None:
        require_positive("relay wall", width=self.width, height=self.height)
        if self.mesh.uvs is None:
            raise ValueError("the mesh has no texture coordinates")
        coordinates = self.mesh.uvs if self.coordinates is None else self.coordinates
        object.__setattr__(self, "_map", UvMap(np.clip(coordinates, 0, 1)[self.mesh.faces]))
        object.__setattr__(self, "_face_normals", self.mesh.face_normals())
        flat = not self.mesh.vertices[:, 2].any() and bool((self._face_normals[:, 2] > 0).all())
        object.__setattr__(self, "_is_planar", flat)
        rounded = TriangleMesh(self.mesh.vertices.astype(np.float32), self.mesh.faces).face_normals()
        cosines = np.einsum("nk,nk->n", rounded, self._face_normals)
        object.__setattr__(self, "_is_lost", ~flat & (cosines <= SAME_FACE))

    @property
    def is_planar(self) -> bool:
        """Whether all of the mesh lies in z = 0."""
        return self._is_planar

    @property
    def area(self) -> float:
        """Area of the lit side [m^2]."""
        return self.mesh.area

    @property
    def default_device_position(self) -> Float64:
        """1 m in front of wall coordinates (0, 0), or of the centroid where the mesh has a hole there: (3,) [m]."""
        faces, weights = self._map.locate(np.array([[0.5, 0.5]]))
        if faces[0] == NOWHERE:
            return np.array([0.0, 0.0, 1.0])
        return self._interpolated(self.mesh.vertices, faces, weights)[0] + self._face_normals[faces[0]]

    def positions(self, xy: ArrayLike) -> Float64:
        """Return the points (..., 3) [m, local frame] at wall coordinates (..., 2) [m]; ConfigError off the wall."""
        return self._at(xy, self.mesh.vertices)

    def normals(self, xy: ArrayLike) -> Float64:
        """Return unit normals (..., 3) of the faces at wall coordinates (..., 2) [m]; ConfigError off the wall."""
        faces, _ = self._locate(xy)
        return self._face_normals[faces].reshape(*np.shape(xy)[:-1], 3)

    def uv(self, xy: ArrayLike) -> Float64:
        """Return texture coordinates (..., 2) as Mitsuba has them; ConfigError off the wall."""
        return self._at(xy, self.mesh.uvs)

    def on_edges(self, xy: ArrayLike, share: float = 1e-3) -> NDArray[np.bool_]:
        """Return which points (...,) lie within ``share`` of a triangle's height of one of its edges."""
        _, weights = self._locate(xy)
        return (weights.min(axis=1) < share).reshape(np.shape(xy)[:-1])

    def bounds(self) -> tuple[Float64, Float64]:
        """Return the smallest and largest coordinates of the wall, (3,) and (3,) [m, local frame]."""
        return self.mesh.bounds()

    def shape_description(self) -> TriangleMesh:
        """Return the mesh in the local frame."""
        return self.mesh

    def _at(self, xy: ArrayLike, per_vertex: Float64 | None) -> Float64:
        faces, weights = self._locate(xy)
        values = self._interpolated(np.asarray(per_vertex), faces, weights)
        return values.reshape(*np.shape(xy)[:-1], values.shape[-1])

    def _interpolated(self, per_vertex: Float64, faces: Indices, weights: Float64) -> Float64:
        return np.einsum("nk,nkx->nx", weights, per_vertex[self.mesh.faces[faces]])

    def _locate(self, xy: ArrayLike) -> tuple[Indices, Float64]:
        try:
            flat = on_wall(self, xy).reshape(-1, 2)
        except ValueError as error:
            raise _refused(str(error)) from error
        uv = np.clip(flat / [self.width, self.height] + 0.5, 0, 1)
        faces, weights = self._map.locate(uv)
        holes = np.flatnonzero(faces == NOWHERE)
        if len(holes):
            (x, y), (u, v) = flat[holes[0]], uv[holes[0]]
            raise _refused(
                f"the relay wall's mesh has no triangle at wall coordinates ({x:.6g}, {y:.6g}) m, (u, v) = "
                f"({u:.6g}, {v:.6g}); need laser and sensor points on it. Use a smaller grid, or close the hole."
            )
        lost = np.flatnonzero(self._is_lost[faces])
        if len(lost):
            (x, y), corners = flat[lost[0]], self.mesh.vertices[self.mesh.faces[faces[lost[0]]]]
            raise too_fine(
                f"wall coordinates ({x:.6g}, {y:.6g}) m: the triangle there, of {np.ptp(corners, axis=0).max():.3g} m, "
                "is a sliver whose normal float32 does not keep"
            )
        return faces, weights


def mesh_wall_from_config(config: MeshWallConfig) -> MeshWall:
    """Read the mesh of a configuration and place it.

    The local frame has the mesh's centroid as origin, its mean normal as z and the direction of growing v as y; where
    the mean normal vanishes, as on a closed surface, the scene's axes.

    Raises
    ------
    ValueError
        The file cannot be used as a wall; the message begins with the key.
    """
    kind = Path(config.filename).suffix.lower().lstrip(".")
    try:
        read = read_mesh_file(str(config.filename), kind)
        mesh = with_normals(read.mesh, "flat")[0].transformed(mesh_matrix(config))
        mesh = mesh.turned_round() if config.flip_normals else mesh
        size = float(np.ptp(mesh.bounds(), axis=0).max())
        if not SHORTEST <= size <= LONGEST:
            raise ValueError(f"it is {size:.4g} m large, need {SHORTEST:g} to {LONGEST:g} m; check its scale")
        coordinates = _checked_uvs(mesh, read.no_uvs)
        if kind == "obj":  # reading one turns v round, as Mitsuba's textures need it
            coordinates = coordinates * [1.0, -1.0] + [0.0, 1.0]
        along_u, along_v, covered = _mean_tangents(mesh, coordinates)
        pose = _pose(mesh, along_v)
        mesh = _flattened(mesh.transformed(pose.inverse_matrix()))
        lengths = [float(np.linalg.norm(tangents, axis=1).mean()) for tangents in (along_u, along_v)]
        scale = np.sqrt(mesh.area / covered / (lengths[0] * lengths[1]))
        width, height = (
            float(given or scale * mean) for given, mean in zip((config.width, config.height), lengths, strict=True)
        )
        return MeshWall(pose, mesh, width, height, coordinates, read, Path(config.filename).name)
    except ValueError as error:
        message = f"{config.filename} cannot be the relay wall: {str(error).rstrip('.')}."
        raise ValueError(f"scene.relay_wall.filename: {message}") from error


def _checked_uvs(mesh: TriangleMesh, no_uvs: str) -> Float64:
    if mesh.uvs is None:
        raise ValueError(f"{no_uvs} (u, v), which name the points of a mesh wall")
    low, high = mesh.uvs.min(axis=0), mesh.uvs.max(axis=0)
    if low.min() < -UV_ROUNDING or high.max() > 1 + UV_ROUNDING:
        raise ValueError(
            f"its texture coordinates run from ({low[0]:.4g}, {low[1]:.4g}) to ({high[0]:.4g}, {high[1]:.4g}), "
            "need (u, v) from 0 to 1"
        )
    return np.clip(mesh.uvs, 0, 1)


def _mean_tangents(mesh: TriangleMesh, coordinates: Float64) -> tuple[Float64, Float64, float]:
    """Return dp/du and dp/dv at points spread evenly over (u, v), each (k, 3), and the area covered there.

    Faces count by their share of (u, v): the tangents are those of the faces, repeated.
    """
    corners, uv = mesh.vertices[mesh.faces], coordinates[mesh.faces]
    edges, steps = corners[:, 1:] - corners[:, :1], uv[:, 1:] - uv[:, :1]
    determinant = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
    covered = float(np.abs(determinant).sum()) / 2
    real = np.abs(determinant) > 1e-12 * max(float(np.abs(determinant).max(initial=0.0)), 1e-300)
    if not real.any():
        raise ValueError("its texture coordinates lie on a line or point, need an area")
    inverse = np.linalg.inv(steps[real])  # rows of edges = steps @ [dp/du, dp/dv]
    tangents = np.einsum("nij,njx->nix", inverse, edges[real])
    shares = np.abs(determinant[real])
    return tangents[:, 0] * _weights(shares), tangents[:, 1] * _weights(shares), covered


def _weights(shares: Float64) -> Float64:
    """Return factors (n, 1) that make a plain mean one weighted by ``shares``."""
    return (shares / shares.mean())[:, None]


def _pose(mesh: TriangleMesh, along_v: Float64) -> Pose:
    areas = mesh.areas()
    centroid = np.average(mesh.vertices[mesh.faces].mean(axis=1), axis=0, weights=areas)
    normal = np.average(mesh.face_normals(), axis=0, weights=areas)
    up = along_v.mean(axis=0)
    across = np.cross(up, normal)
    is_open = np.linalg.norm(normal) > LEAST_MEAN_NORMAL
    if not is_open or np.linalg.norm(across) < LEAST_MEAN_NORMAL * np.linalg.norm(up) * np.linalg.norm(normal):
        return Pose(np.eye(3), centroid)
    return Pose.from_normal_up(centroid, normal, up)


def _flattened(mesh: TriangleMesh) -> TriangleMesh:
    """Return the mesh with z = 0 exactly where it is a plane: engines then know that no point sees another one."""
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if float(np.abs(mesh.vertices[:, 2]).max()) > FLATNESS * size:
        return mesh
    return replace(mesh, vertices=mesh.vertices * [1.0, 1.0, 0.0])


def too_fine(where: str) -> ConfigError:
    """Return the error about a laser or sensor point on a triangle that the renderer cannot find."""
    message = f"the relay wall's mesh is too fine at {where}. Remove slivers or use larger triangles there, or move the"
    return ConfigError.at("scene.relay_wall.filename", f"{message} laser and sensor points off it.")


def _refused(message: str) -> ConfigError:
    return ConfigError.at("capture", message)
