"""Generated meshes, written as binary .ply files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nlosrender.files.atomic_write import replacing
from nlosrender.files.file_kinds import PLY

FACE = np.dtype([("count", "u1"), ("corners", "<u4", 3)])


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write vertices (n, 3) [m] and faces (m, 3).

    Raises
    ------
    FileError
        The file cannot be written.
    """
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar uint vertex_indices", "end_header"]
    rows = np.zeros(len(faces), FACE)
    rows["count"], rows["corners"] = 3, faces
    with replacing(path, PLY) as partial, partial.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(np.asarray(vertices, dtype="<f4").tobytes())
        file.write(rows.tobytes())


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return the triangles (2 rows columns, 3) of a grid of (rows + 1) x (columns + 1) vertices.

    Counter-clockwise where columns go to the right and rows go up.
    """
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    above = corner + columns + 1
    lower = np.stack([corner, corner + 1, above + 1], axis=1)
    upper = np.stack([corner, above + 1, above], axis=1)
    return np.concatenate([lower, upper])
