"""Reads .obj meshes: positions, texture coordinates and normals of polygons, in float64.

Materials, groups, lines and curves are passed over; no other file is opened.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nlosrender.scene.triangle_mesh import TriangleMesh, fan_triangles, numbers_in

Int64 = NDArray[np.int64]

MOST_CORNERS = 1000  # of a polygon
ABSENT = 0  # in place of an index; the first of each kind is 1
_LARGEST_INDEX = 2**40
_KINDS = {b"v": 3, b"vt": 2, b"vn": 3}  # numbers that count; more may follow (weights, colours)


def read_obj(content: bytes) -> TriangleMesh:
    """Return the mesh of an .obj file.

    Parameters
    ----------
    content
        The file's bytes.

    Returns
    -------
    TriangleMesh
        In the file's coordinates; texture coordinates and normals are kept when every corner has them. The vertical
        texture coordinate is turned round, as images in .obj files have it. Polygons are cut into fans from their
        first corner (right for convex ones).

    Raises
    ------
    ValueError
        A number or an index cannot be; names the line's content.
    """
    if b"\0" in content:
        raise ValueError("it holds a zero byte, so it is not text")
    lines = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    rows: dict[bytes, list[int]] = {kind: [] for kind in (*_KINDS, b"f")}
    for number, line in enumerate(lines):
        words = line.split(None, 1)
        if words and words[0] in rows:
            rows[words[0]].append(number)
    positions, uvs, normals = (_numbers([lines[i] for i in rows[kind]], kind) for kind in _KINDS)
    for kind, what in ((b"v", "vertices"), (b"f", "faces")):
        if not rows[kind]:
            raise ValueError(f"no line of it starts with {kind.decode()}: it has no {what}")
    defined = [np.asarray(rows[kind], dtype=np.int64) for kind in _KINDS]
    polygons = _polygons([lines[i] for i in rows[b"f"]], np.asarray(rows[b"f"], dtype=np.int64), defined)
    corners = np.stack([fan_triangles([part[..., k] for part in polygons]) for k in range(3)], axis=-1).reshape(-1, 3)
    has_uvs, has_normals = (bool((corners[:, k] >= 0).all()) for k in (1, 2))
    chosen, faces = _distinct(corners, [0] + [1] * has_uvs + [2] * has_normals)
    return TriangleMesh(
        positions[chosen[:, 0]],
        faces.reshape(-1, 3),
        uvs[chosen[:, 1]] * [1.0, -1.0] + [0.0, 1.0] if has_uvs else None,
        normals[chosen[:, 2]] if has_normals else None,
    )


def _numbers(lines: Sequence[bytes], kind: bytes) -> NDArray[np.float64]:
    """Return the numbers of all lines of one kind, (lines, 2 or 3)."""
    need = _KINDS[kind]
    if not lines:
        return np.zeros((0, need))
    width = len(lines[0].split()) - 1
    values = _parsed(lines, np.float64)
    if width >= need and len(values) == width * len(lines) and all(len(line.split()) == width + 1 for line in lines):
        return values.reshape(-1, width)[:, :need]
    rows = []
    for line in lines:
        row = _parsed([line], np.float64)
        if len(row) < need or len(row) != len(line.split()) - 1:
            raise ValueError(f"line {_shown(line)}: need {need} numbers after {kind.decode()}")
        rows.append(row[:need])
    return np.array(rows)


def _parsed(lines: Sequence[bytes], dtype: type) -> NDArray:
    """Return the numbers after the first word of each line, up to the first word that is none."""
    words = (line.split(None, 1) for line in lines)
    return numbers_in(b" ".join(parts[1] for parts in words if len(parts) > 1).replace(b"/", b" "), dtype)


def _polygons(lines: Sequence[bytes], at: Int64, defined: Sequence[Int64]) -> list[Int64]:
    """Return polygons grouped by how their lines are built: (faces, corners, 3) indices from 0, -1 where absent.

    Parameters
    ----------
    lines
        The lines that start with f.
    at
        Their places in the file.
    defined
        Places of the lines that define positions, texture coordinates and normals: a negative index counts back
        from those above its line.
    """
    groups: dict[tuple[int, int, bytes], list[int]] = {}
    for number, line in enumerate(lines):
        pattern = line.translate(None, b"+-0123456789")
        groups.setdefault((len(line.split()) - 1, line.count(b"//"), pattern), []).append(number)
    found = []
    for (n_corners, gaps, pattern), numbers in groups.items():
        if n_corners > MOST_CORNERS:
            raise ValueError(f"line {_shown(lines[numbers[0]])}: {n_corners} corners, need at most {MOST_CORNERS}")
        if n_corners < 3:
            continue  # a point or a line has no surface
        members = [lines[number] for number in numbers]
        written = _corners(members, n_corners, _parts(n_corners, gaps, pattern.split()[1:]))
        indices = written - 1
        for k, places in enumerate(defined):
            above = np.searchsorted(places, at[numbers])[:, None]
            indices[..., k] = np.where(written[..., k] < 0, above + written[..., k], indices[..., k])
            wrong = (indices[..., k] >= len(places)) | (indices[..., k] < (0 if k == 0 else -1))
            wrong |= (indices[..., k] < 0) & (written[..., k] != ABSENT)
            if wrong.any():
                what, count = ("vertex", "texture coordinate", "normal")[k], len(places)
                line = members[int(np.argmax(wrong.any(axis=1)))]
                raise ValueError(
                    f"line {_shown(line)} refers to a {what} that is not there: the file has {count}, the first is 1"
                )
        found.append(indices)
    return found


def _parts(n_corners: int, gaps: int, slashes: Sequence[bytes]) -> list[int]:
    """Return which of position, texture coordinate and normal the corners of a line have; empty: not all the same.

    Parameters
    ----------
    n_corners, gaps
        Corners of the line, and how many of its slashes follow another one.
    slashes
        What is left of the corners without their digits.
    """
    if not slashes:
        return [0]
    if len(slashes) != n_corners or len(set(slashes)) > 1:
        return []
    if slashes[0] == b"/":
        return [0, 1]
    if slashes[0] == b"//" and gaps in (0, n_corners):
        return [0, 2] if gaps else [0, 1, 2]
    return []


def _corners(lines: Sequence[bytes], n_corners: int, parts: Sequence[int]) -> Int64:
    """Return the indices as written, (lines, corners, 3)."""
    found = np.full((len(lines), n_corners, 3), ABSENT, dtype=np.int64)
    numbers = _parsed(lines, np.int64) if parts else np.zeros(0, dtype=np.int64)
    if len(numbers) == len(lines) * n_corners * len(parts) > 0 and np.abs(numbers).max() < _LARGEST_INDEX:
        found[..., parts] = numbers.reshape(len(lines), n_corners, len(parts))
        return found
    for row, line in enumerate(lines):
        for corner, word in enumerate(line.split()[1:]):
            try:
                written = [int(part) if part else ABSENT for part in word.split(b"/")]
            except ValueError:
                written = []
            if not 1 <= len(written) <= 3 or any(abs(index) >= _LARGEST_INDEX for index in written):
                raise ValueError(f"line {_shown(line)}: {_shown(word)} is no corner, need v, v/vt, v//vn or v/vt/vn")
            found[row, corner, : len(written)] = written
    return found


def _distinct(corners: Int64, parts: Sequence[int]) -> tuple[Int64, Int64]:
    """Return the different corners (n, 3), told by ``parts`` of their indices, and which of them each corner is."""
    ids = corners[:, 0]
    for part in parts[1:]:
        # below 2^63: the first factor counts lines of the file at most
        ids = np.unique(ids, return_inverse=True)[1] * (int(corners[:, part].max(initial=0)) + 1) + corners[:, part]
    _, first, which = np.unique(ids, return_index=True, return_inverse=True)
    return corners[first], which


def _shown(text: bytes) -> str:
    return repr(text[:60].decode("latin-1"))
