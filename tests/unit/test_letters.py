"""Letters: size, orientation, no overlap, closed solids."""

from collections import Counter

import numpy as np
import pytest
import shapely

from nlosrender.scene.meshes.letters import CHARACTERS, letters_mesh, letters_outline
from nlosrender.scene.pose import Pose

GLYPHS = CHARACTERS.replace(" ", "")


def directed_edges(mesh):
    faces = mesh.faces.tolist()
    return Counter((face[k], face[(k + 1) % 3]) for face in faces for k in range(3))


def ink_at(mesh, x, y):
    """Number of triangles of a flat mesh over the point (x, y)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k], :2] for k in range(3))
    point = np.array([x, y])

    def left_of(start, end):
        side, to_point = end - start, point - start
        return side[:, 0] * to_point[:, 1] - side[:, 1] * to_point[:, 0] > 0

    return int(np.sum(left_of(a, b) & left_of(b, c) & left_of(c, a)))


@pytest.mark.parametrize("glyph", GLYPHS)
@pytest.mark.parametrize("stroke_width", [0.01, 0.1, None, 0.2, 0.39])
def test_sheet_covers_its_outline_once(glyph, stroke_width):
    """The triangles' areas add up to the outline's area, and all face +z: nothing overlaps or is missing."""
    mesh = letters_mesh(glyph, 0.8, stroke_width=stroke_width)
    # Sum of ~100 products of coordinates below 1: round-off below 1e-13
    assert mesh.area == pytest.approx(letters_outline(glyph, 0.8, stroke_width).area, rel=1e-12)
    np.testing.assert_allclose(mesh.face_normals(), np.tile([0, 0, 1.0], (len(mesh.faces), 1)), atol=1e-9)


@pytest.mark.parametrize("glyph", GLYPHS)
def test_triangles_do_not_overlap(glyph):
    """The union of the triangles, one by one, is as large as their sum."""
    mesh = letters_mesh(glyph, 0.8)
    union = shapely.union_all(shapely.polygons(mesh.vertices[mesh.faces][..., :2]))
    # Each of ~100 seams may be rounded by 1e-16 along a length below 1
    assert union.area == pytest.approx(mesh.area, rel=1e-10)


@pytest.mark.parametrize("glyph", GLYPHS)
def test_cap_height_is_the_height(glyph):
    """Every glyph reaches from -height/2 to height/2 exactly, centred in x."""
    low, high = letters_mesh(glyph, 0.8).bounds()
    assert (low[1], high[1]) == (-0.4, 0.4)
    assert low[0] == pytest.approx(-high[0], abs=1e-15)


@pytest.mark.parametrize("text", [*GLYPHS, "Z 8B", "HH"])
def test_solid_is_closed_and_faces_outwards(text):
    """Each edge is run through once in each direction; the volume is area x thickness."""
    mesh = letters_mesh(text, 0.8, thickness=0.05, pose=Pose.from_normal_up([0.1, 0.2, 1], [0.3, 0, -1], [0, 1, 0]))
    edges = directed_edges(mesh)
    assert set(edges.values()) == {1}
    assert all((end, start) in edges for start, end in edges)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    volume = np.sum(a * np.cross(b, c)) / 6
    # Terms of size 1 cancel to 1e-2: round-off below 1e-12 relative
    assert volume == pytest.approx(letters_outline(text, 0.8).area * 0.05, rel=1e-10)


def test_touching_letters_do_not_overlap():
    """Without spacing, neighbours share an edge: areas add, and no point is covered twice."""
    both = letters_mesh("HH", 0.8, spacing=0.0)
    assert both.area == pytest.approx(2 * letters_mesh("H", 0.8).area, rel=1e-9)
    assert ink_at(both, 1e-4, 0.3) == ink_at(both, -1e-4, 0.3) == 1


def test_i_is_one_bar():
    """The area of I is stroke width x height; as a solid it has a box's surface."""
    assert letters_mesh("I", 0.8, stroke_width=0.1).area == pytest.approx(0.08, rel=1e-12)
    solid = letters_mesh("I", 0.8, thickness=0.05, stroke_width=0.1)
    assert solid.area == pytest.approx(2 * (0.08 + 0.1 * 0.05 + 0.8 * 0.05), rel=1e-12)
    np.testing.assert_allclose(solid.bounds(), [[-0.05, -0.4, -0.025], [0.05, 0.4, 0.025]], atol=1e-15)


def test_l_is_a_stem_and_a_foot():
    """The area of L is counted by hand."""
    # cap height 1, stroke 0.2: stem 0.2 x 1 and foot (0.6 - 0.2) x 0.2; the width of L is 0.6
    assert letters_mesh("L", 1.0).area == pytest.approx(0.2 + 0.4 * 0.2, rel=1e-12)


def test_l_reads_from_the_side_the_normal_points_to():
    """A viewer at the wall (+z ahead, y up, so x on the left) sees the stem of L on the left, at larger x."""
    pose = Pose.from_normal_up([0, 0, 1], [0, 0, -1], [0, 1, 0])
    mesh = letters_mesh("L", 0.8, pose=pose)
    assert np.all(mesh.face_normals()[:, 2] < -0.999)  # faces the viewer
    upper = mesh.vertices[mesh.vertices[:, 1] > 0]  # the stem only
    low, high = mesh.bounds()
    # viewer looking along +z with y up: right hand = ahead x up = -x
    assert upper[:, 0].min() > (low[0] + high[0]) / 2
    assert upper[:, 0].max() == pytest.approx(high[0])


def test_text_runs_along_x():
    """In 'LI' the bar of I stands at larger x than the stem of L, with the spacing between their extents."""
    mesh = letters_mesh("LI", 1.0, spacing=0.37)
    low, high = mesh.bounds()
    # widths 0.6 and 0.2
    assert high[0] - low[0] == pytest.approx(0.6 + 0.37 + 0.2, rel=1e-12)
    assert ink_at(mesh, low[0] + 0.1, 0.45) == 1
    assert ink_at(mesh, high[0] - 0.1, 0.45) == 1
    assert ink_at(mesh, low[0] + 0.4, 0.45) == 0  # over the foot of L


def test_space_widens_the_text():
    """A space adds its width and one spacing; at the ends it adds nothing."""
    joined, spaced, padded = (letters_outline(text, 1.0, spacing=0.1).bounds for text in ("II", "I I", " II "))
    assert spaced[2] - spaced[0] == pytest.approx(joined[2] - joined[0] + 0.4 + 0.1, rel=1e-12)
    np.testing.assert_allclose(padded, joined, atol=1e-15)


def test_z_is_two_bars_and_a_diagonal():
    """Z has ink along both bars and the rising diagonal, and none beside it."""
    mesh = letters_mesh("Z", 1.0)
    for x, y in [(-0.25, 0.4), (0.25, 0.4), (0, 0.01), (-0.25, -0.4), (0.25, -0.4)]:
        assert ink_at(mesh, x, y) == 1
    for x, y in [(-0.25, 0.1), (0.25, -0.1)]:
        assert ink_at(mesh, x, y) == 0


def test_texture_spans_the_text():
    """uv run from 0 to 1 over the extent, u along x, v along y, on the front and on the back."""
    mesh = letters_mesh("L8", 0.5, thickness=0.1)
    low, high = mesh.bounds()
    np.testing.assert_allclose(mesh.uvs, ((mesh.vertices - low) / (high - low))[:, :2], atol=1e-12)


def test_default_stroke_and_spacing_are_a_fifth_of_the_height():
    """None means 0.2 x height for both."""
    default, explicit = letters_mesh("AB", 0.7), letters_mesh("AB", 0.7, 0.0, 0.14, 0.14)
    # 0.14 / 0.7 rounds: vertices may come in another order, what they cover is the same
    assert default.area == pytest.approx(explicit.area, rel=1e-12)
    np.testing.assert_allclose(default.bounds(), explicit.bounds(), atol=1e-14)
