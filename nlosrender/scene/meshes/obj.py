"""Reads .obj meshes: positions, texture coordinates and normals of polygons, in float64.

No other file is opened; materials, lines and curves are counted (``FileMesh``), not read.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.meshes.file_mesh import BYTE_ORDER_MARK, NO_UVS, FileMesh, numbers_in
from nlosrender.scene.meshes.obj_lines import ObjLines, shown
from nlosrender.scene.meshes.polygons import MAX_CORNERS, cut_polygons
from nlosrender.scene.meshes.triangle_mesh import Int64, TriangleMesh, distinct_columns
from nlosrender.scene.pose import Float64

ABSENT = 0  # in place of an index; the first of each kind is 1
MAX_INDEX = 2**40  # digits beyond are damage; sums with line counts stay below 2^63
_KINDS = {b"v": (3, 3), b"vt": (1, 2), b"vn": (3, 3)}  # numbers needed, and read; more may follow (weights, colours)
_NAMES = ("vertex", "texture coordinate", "normal")


def read_obj(content: bytes) -> FileMesh:
    """Return the mesh of an .obj file from its bytes, in the file's coordinates.

    Polygons are cut into triangles. Texture coordinates are kept when every corner has them; the vertical one is turned
    round, as images in .obj files have it.

    Raises
    ------
    ValueError
        A number or an index cannot be, or a polygon crosses itself; names the line.
    """
    if b"\0" in content:
        hint = ". It may be UTF-16: save it as UTF-8" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else ""
        raise ValueError(f"it holds a zero byte, so it is not text{hint}")
    text = ObjLines.of(content.removeprefix(BYTE_ORDER_MARK))
    positions, uvs, normals = (_numbers(text, kind) for kind in _KINDS)
    for kind, what in ((b"v", "vertices"), (b"f", "faces")):
        if not text.rows(kind):
            raise ValueError(f"no line of it starts with {kind.decode()}: it has no {what}")
    TriangleMesh(positions, np.zeros((0, 3), dtype=np.int64))  # refuses what is not finite
    groups = _polygons(text)
    corners, bent = _triangles(text, groups, positions)
    has = corners >= 0
    no_uvs = NO_UVS
    if has[:, 1].any():
        no_uvs = "" if has[:, 1].all() else f"its face at {_first_without_uvs(text, groups)} has no texture coordinates"
    has_normals = bool(has[:, 2].any())
    # corners with the same position, texture coordinate and normal, as far as these are kept, are one vertex
    first, faces = distinct_columns(corners.T[[2] * has_normals + [1] * (not no_uvs) + [0]])
    chosen = corners[first]
    mesh = TriangleMesh(
        positions[chosen[:, 0]],
        faces.reshape(-1, 3),
        None if no_uvs else uvs[chosen[:, 1]] * [1.0, -1.0] + [0.0, 1.0],
        # the row that -1 finds: a corner without a normal
        np.append(normals, [[0.0, 0.0, 0.0]], axis=0)[chosen[:, 2]] if has_normals else None,
    )
    n_flat = sum(len(rows) for rows, indices in groups if indices.shape[1] < 3)
    dropped = [f"{n_flat} faces of less than 3 corners"] * bool(n_flat)
    dropped += ["texture coordinates of some faces"] * bool(no_uvs and has[:, 1].any())
    return FileMesh(mesh, text.materials(), (*dropped, *text.dropped()), (*bent, *text.doubts()), no_uvs)


def _numbers(text: ObjLines, kind: bytes) -> Float64:
    """Return the numbers of all lines of one kind, (lines, 2 or 3); zero where they may be left away."""
    n_needed, n_read = _KINDS[kind]
    lines = [text.lines[row] for row in text.rows(kind)]
    counts = np.array([len(line.split()) - 1 for line in lines], dtype=np.int64)
    values = _parsed(lines, np.float64)
    if len(values) != counts.sum() or counts.min(initial=n_needed) < n_needed:
        for row, line, count in zip(text.rows(kind), lines, counts, strict=True):
            if count < n_needed or len(_parsed([line], np.float64)) != count:
                needed = f"need {n_needed} numbers after {kind.decode()}, got {shown(line)}"
                raise ValueError(f"{text.place(row)}: {needed}")
    column = np.arange(n_read)
    at = np.minimum((np.cumsum(counts) - counts)[:, None] + column, len(values) - 1)
    return np.where(column < counts[:, None], values[at], 0.0)


def _parsed(lines: Sequence[bytes], dtype: type) -> NDArray[Any]:
    """Return the numbers after the first word of each line, up to the first word that is none."""
    words = (line.split(None, 1) for line in lines)
    return numbers_in(b" ".join(parts[1] for parts in words if len(parts) > 1).replace(b"/", b" "), dtype)


def _triangles(
    text: ObjLines, groups: Sequence[tuple[Int64, Int64]], positions: Float64
) -> tuple[Int64, tuple[str, ...]]:
    """Return the corners (3 m, 3) of the triangles that polygons are cut into, and sentences about bent polygons."""
    polygons = [(rows, indices) for rows, indices in groups if indices.shape[1] > 2]
    cuts, bent = cut_polygons(
        [positions[indices[..., 0]] for _, indices in polygons],
        lambda group, number: text.place(polygons[group][0][number]),
    )
    parts = [indices[owners[:, None], corners] for (_, indices), (owners, corners) in zip(polygons, cuts, strict=True)]
    return np.concatenate([np.zeros((0, 3, 3), np.int64), *parts]).reshape(-1, 3), bent


def _polygons(text: ObjLines) -> list[tuple[Int64, Int64]]:
    """Return polygons grouped by how their lines are built: the lines (faces,), and the corners (faces, corners, 3) as
    indices of position, texture coordinate and normal from 0, -1 where absent."""
    face_rows, defined = np.asarray(text.rows(b"f")), [np.asarray(text.rows(kind), np.int64) for kind in _KINDS]
    groups: dict[tuple[int, int, bytes], list[int]] = {}
    for row in face_rows:
        line = text.lines[row]
        pattern = line.translate(None, b"+-0123456789")
        groups.setdefault((len(line.split()) - 1, line.count(b"//"), pattern), []).append(row)
    found = []
    for (n_corners, n_gaps, pattern), members in groups.items():
        rows = np.asarray(members)
        if n_corners > MAX_CORNERS:
            raise ValueError(f"{text.place(rows[0])}: {n_corners} corners, need at most {MAX_CORNERS}")
        written = _corners(text, rows, n_corners, _parts(n_corners, n_gaps, pattern.split()[1:]))
        found.append((rows, _from_zero(text, written, rows, defined)))
    return found


def _from_zero(text: ObjLines, written: Int64, rows: Int64, defined: Sequence[Int64]) -> Int64:
    """Return indices from 0, -1 where absent, of indices as the lines have them: negative ones count back.

    Parameters
    ----------
    written
        (faces, corners, 3).
    rows
        Lines of the faces; a negative index counts from the last definition above its line.
    defined
        Lines that define positions, texture coordinates and normals.
    """
    indices = written - 1
    for k, places in enumerate(defined):
        above = np.searchsorted(places, rows)[:, None]
        indices[..., k] = np.where(written[..., k] < 0, above + written[..., k], indices[..., k])
        wrong = (indices[..., k] >= len(places)) | (indices[..., k] < (0 if k == 0 else -1))
        wrong |= (indices[..., k] < 0) & (written[..., k] != ABSENT)
        if wrong.any():
            row = rows[int(np.argmax(wrong.any(axis=1)))]
            raise ValueError(
                f"{text.place(row)}, {shown(text.lines[row])}, refers to a {_NAMES[k]} that is not there: the file has "
                f"{len(places)}, the first is 1"
            )
    return indices


def _parts(n_corners: int, n_gaps: int, slashes: Sequence[bytes]) -> list[int]:
    """Return which of position, texture coordinate and normal the corners of a line have; empty: not all the same.

    ``n_gaps`` slashes follow another one; ``slashes`` is what is left of the corners without their digits.
    """
    if not slashes:
        return [0]
    if len(slashes) == n_corners and len(set(slashes)) == 1:
        if slashes[0] == b"/":
            return [0, 1]
        if slashes[0] == b"//" and n_gaps in (0, n_corners):
            return [0, 2] if n_gaps else [0, 1, 2]
    return []


def _corners(text: ObjLines, rows: Int64, n_corners: int, parts: Sequence[int]) -> Int64:
    """Return the indices as written, (lines, corners, 3): all lines at once where they are alike, else word by word."""
    lines = [text.lines[row] for row in rows]
    found = np.full((len(lines), n_corners, 3), ABSENT, dtype=np.int64)
    numbers = _parsed(lines, np.int64) if parts else np.zeros(0, dtype=np.int64)
    if len(numbers) == len(lines) * n_corners * len(parts) > 0 and np.abs(numbers).max() < MAX_INDEX:
        found[..., parts] = numbers.reshape(len(lines), n_corners, len(parts))
        return found
    for face, line in enumerate(lines):
        for corner, word in enumerate(line.split()[1:]):
            try:
                written = [int(part) if part else ABSENT for part in word.split(b"/")]
            except ValueError:
                written = []
            if not 1 <= len(written) <= 3 or any(abs(index) >= MAX_INDEX for index in written):
                raise ValueError(
                    f"{text.place(rows[face])}: {shown(word)} is no corner, need v, v/vt, v//vn or v/vt/vn"
                )
            found[face, corner, : len(written)] = written
    return found


def _first_without_uvs(text: ObjLines, groups: Sequence[tuple[Int64, Int64]]) -> str:
    lacking = [rows[(indices[..., 1] < 0).any(axis=1)] for rows, indices in groups if indices.shape[1] > 2]
    return text.place(int(np.concatenate(lacking).min()))
