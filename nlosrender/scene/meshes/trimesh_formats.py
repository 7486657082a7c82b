"""Reads .stl, .off and .glb meshes by the package trimesh: triangles alone, in float64."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from nlosrender.scene.meshes.file_mesh import FileMesh
from nlosrender.scene.meshes.triangle_mesh import TriangleMesh

FORMATS = ("stl", "off", "glb")


def reader_of(kind: str) -> Callable[[bytes], FileMesh]:
    """Return the reader of one of ``FORMATS``; it raises ValueError, as those of .ply and .obj do."""

    def read(content: bytes) -> FileMesh:
        import trimesh  # takes a third of a second: most scenes have none of these files

        try:
            scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, process=False)
            parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
        except Exception as error:  # of a damaged file trimesh raises whatever its parts do
            raise ValueError(f"it is no .{kind} file: {type(error).__name__}: {str(error)[:200]}") from error
        if not parts:
            raise ValueError("it has no triangles")
        meshes = [TriangleMesh(np.asarray(part.vertices), np.asarray(part.faces, np.int64)) for part in parts]
        no_uvs = f"texture coordinates of .{kind} files are not read"
        return FileMesh(TriangleMesh.merged(meshes), _materials(parts), tuple(_dropped(parts)), no_uvs=no_uvs)

    return read


def _materials(parts: Sequence[object]) -> tuple[str, ...]:
    named = (getattr(getattr(part, "visual", None), "material", None) for part in parts)
    return tuple(dict.fromkeys(str(getattr(material, "name", None) or "unnamed") for material in named if material))


def _dropped(parts: Sequence[object]) -> Iterator[str]:
    visuals = [visual for part in parts if (visual := getattr(part, "visual", None)) is not None]
    if any(getattr(visual, "uv", None) is not None for visual in visuals):
        yield "texture coordinates"
    if any(getattr(visual, "kind", None) in ("vertex", "face") for visual in visuals):
        yield "colours"
