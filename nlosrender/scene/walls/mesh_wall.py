"""A triangle mesh as relay wall: wall coordinates are the file's texture coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nlosrender.config.fields import MAX_LENGTH, MIN_LENGTH
from nlosrender.errors import ConfigError
from nlosrender.scene.bounding_box import Bounds
from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.mesh_file import read_mesh_file
from nlosrender.scene.meshes.mesh_normals import with_normals
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh
from nlosrender.scene.pose import Float64, Pose
from nlosrender.scene.transforms import mesh_matrix
from nlosrender.scene.walls.uv_map import NOWHERE, UvMap
from nlosrender.scene.walls.wall import RelayWall, require_positive

if TYPE_CHECKING:
    from nlosrender.config.relay_wall import MeshWallConfig

MIN_SAME_COSINE = 1 - 1e-5  # between the normals of a face in float32 and float64: 0.26 degrees
FLATNESS = 1e-7  # of the wall's size: what float32 coordinates of a file leave of a plane
MIN_MEAN_NORMAL = 0.1  # of the length it has on a plane: below it the wall closes round, and no side is its front
UV_ROUNDING = 1e-6  # texture coordinates of a few decimals or in float32 may pass 0 and 1 by this


@dataclass(frozen=True, eq=False)
class MeshWall(RelayWall):
    """A mesh as relay wall, lit on the side of its faces' normals; wall coordinates are its texture coordinates.

    Off the wall it raises ConfigError, which names the hole, where other walls raise ValueError.

    Raises
    ------
    ValueError
        A size is not positive, or two faces have the same texture coordinates.
    """

    pose: Pose
    mesh: TriangleMesh  # in the local frame [m], flat faces; texture coordinates within [0, 1]
    width: float  # what u from 0 to 1 is in wall coordinates [m], > 0
    height: float  # what v from 0 to 1 is
    coordinates: Float64 | None = None  # (n, 2) texture coordinates that wall coordinates are made of; None: the mesh's
    read: FileMesh | None = None  # what its file holds; None, if it has none
    file: str = ""  # the file's name
    is_planar: bool = field(init=False)  # all of the mesh lies in z = 0
    _map: UvMap = field(init=False, repr=False)
    _face_normals: Float64 = field(init=False, repr=False)
    _is_lost: NDArray[np.bool_] = field(init=False, repr=False)  # (n,) faces that float32 turns or flattens

    def __post_init__(self) -> None:
        require_positive(width=self.width, height=self.height)
        if self.mesh.uvs is None:
            raise ValueError("the mesh has no texture coordinates")
        coordinates = self.mesh.uvs if self.coordinates is None else self.coordinates
        object.__setattr__(self, "_map", UvMap(np.clip(coordinates, 0, 1)[self.mesh.faces]))
        object.__setattr__(self, "_face_normals", self.mesh.face_normals())
        flat = not self.mesh.vertices[:, 2].any() and bool((self._face_normals[:, 2] > 0).all())
        object.__setattr__(self, "is_planar", flat)
        rounded = TriangleMesh(self.mesh.vertices.astype(np.float32), self.mesh.faces).face_normals()
        cosines = np.einsum("nk,nk->n", rounded, self._face_normals)
        object.__setattr__(self, "_is_lost", (cosines <= MIN_SAME_COSINE) & (not flat))

    @property
    def area(self) -> float:
        return self.mesh.area

    @property
    def default_device_position(self) -> Float64:
        """1 m in front of wall coordinates (0, 0), or of the centroid where the mesh has a hole there: (3,) [m]."""
        faces, weights = self._map.locate(np.array([[0.5, 0.5]]))
        if faces[0] == NOWHERE:
            return np.array([0.0, 0.0, 1.0])
        corners = self.mesh.vertices[self.mesh.faces[faces]]
        return np.einsum("nk,nkx->nx", weights, corners)[0] + self._face_normals[faces[0]]

    def bounds(self) -> Bounds:
        return self.mesh.bounds()

    def shape_description(self) -> TriangleMesh:
        return self.mesh

    def on_wall(self, xy: ArrayLike) -> Float64:
        try:
            return super().on_wall(xy)
        except ValueError as error:
            raise ConfigError.at("capture", str(error)) from error

    def on_edges(self, xy: ArrayLike, share: float = 1e-3) -> NDArray[np.bool_]:
        """Return which points (...,) lie within ``share`` of a triangle's height of one of its edges."""
        xy = self.on_wall(xy)
        return (self._locate(xy)[1].min(axis=1) < share).reshape(xy.shape[:-1])

    def _positions(self, xy: Float64) -> Float64:
        faces, weights = self._locate(xy)
        corners = self.mesh.vertices[self.mesh.faces[faces]]
        return np.einsum("nk,nkx->nx", weights, corners).reshape(*xy.shape[:-1], 3)

    def _normals(self, xy: Float64) -> Float64:
        return self._face_normals[self._locate(xy)[0]].reshape(*xy.shape[:-1], 3)

    def _locate(self, xy: Float64) -> tuple[NDArray[np.int64], Float64]:
        """Return face (n,) and barycentric coordinates (n, 3) of points; ConfigError in a hole or on a sliver."""
        flat = xy.reshape(-1, 2)
        uv = np.clip(flat / self._extent + 0.5, 0, 1)
        faces, weights = self._map.locate(uv)
        for hole in np.flatnonzero(faces == NOWHERE)[:1]:
            (x, y), (u, v) = flat[hole], uv[hole]
            raise ConfigError.at(
                "capture",
                f"the relay wall's mesh has no triangle at wall coordinates ({x:.6g}, {y:.6g}) m, (u, v) = "
                f"({u:.6g}, {v:.6g}); need laser and sensor points on it. Use a smaller grid, or close the hole.",
            )
        for lost in np.flatnonzero(self._is_lost[faces])[:1]:
            (x, y), corners = flat[lost], self.mesh.vertices[self.mesh.faces[faces[lost]]]
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
    ConfigError
        The file cannot be used as a wall.
    """
    kind = Path(config.filename).suffix.lower().lstrip(".")
    try:
        read = read_mesh_file(str(config.filename), kind)
        mesh = with_normals(read.mesh, "flat")[0].transformed(mesh_matrix(config))
        mesh = mesh.turned_round() if config.flip_normals else mesh
        size = float(np.ptp(mesh.bounds(), axis=0).max())
        if not MIN_LENGTH <= size <= MAX_LENGTH:
            raise ValueError(f"it is {size:.4g} m large, need {MIN_LENGTH:g} to {MAX_LENGTH:g} m; check its scale")
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
        raise ConfigError.at("scene.relay_wall.filename", message) from error


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
    """Return dp/du and dp/dv of the faces, each (k, 3), weighted by the faces' share of (u, v), and the area of all."""
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
    weights = (shares / shares.mean())[:, None]  # make a plain mean one over (u, v)
    return tangents[:, 0] * weights, tangents[:, 1] * weights, covered


def _pose(mesh: TriangleMesh, along_v: Float64) -> Pose:
    areas = mesh.areas()
    centroid = np.average(mesh.vertices[mesh.faces].mean(axis=1), axis=0, weights=areas)
    normal = np.average(mesh.face_normals(), axis=0, weights=areas)
    up = along_v.mean(axis=0)
    across = np.cross(up, normal)
    is_open = np.linalg.norm(normal) > MIN_MEAN_NORMAL
    if not is_open or np.linalg.norm(across) < MIN_MEAN_NORMAL * np.linalg.norm(up) * np.linalg.norm(normal):
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
    advice = "Remove slivers or use larger triangles there, or move the laser and sensor points off it."
    return ConfigError.at("scene.relay_wall.filename", f"the relay wall's mesh is too fine at {where}. {advice}")
