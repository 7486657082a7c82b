"""The light of mesh files against quadrature: what their faces are, whatever the file leaves out or contradicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.quadrature import Setup, box_cells, grid_points, rectangle_cells, third_bounces
from support.rendering import flat_wall, render

from nlosrender.engine.backend.start import start_backend

EDGES = 0.1 * np.arange(61)
LASER, SENSORS = np.array([[[0.3, -0.2, 0.0]]]), grid_points(5, 3, 2.0, 1.6)
SIDES = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"]
CUBE = [f"v {x} {y} {z}" for z in (-0.2, 0.2) for y in (-0.2, 0.2) for x in (-0.2, 0.2)]


def light(folder: Path, text: str, **keys: object) -> np.ndarray:
    """Energy at each sensor point of an .obj file in front of the wall, asked to 0.5 %."""
    (folder / "a.obj").write_text(text)
    item = {"type": "mesh", "filename": "a.obj", "bsdf": {"type": "diffuse", "reflectance": 0.7}, **keys}
    config = flat_wall(item, bins=(0.0, 0.1, 60), engine="virtual_lights", spp=None, target_error=0.005)
    return render(config, folder=folder).total.sum(axis=-1)


def test_a_cube_without_normals_is_a_box(tmp_path: Path) -> None:
    """Upright and mirrored, as quadrangles: with averaged normals single sensor points were up to 376 % off."""
    cells = box_cells([0.1, 0.0, 0.8], [0.4, 0.4, 0.4], n=100)  # convex: cosines alone tell what is seen
    expected = third_bounces(Setup(cells, EDGES, rho=0.7), LASER, SENSORS).sum(axis=-1)
    text = "\n".join([*CUBE, *(f"f {side}" for side in SIDES)])
    for keys in ({"translate": [0.1, 0, 0.8]}, {"translate": [0.1, 0, 0.8], "scale": [-1, 1, 1]}):
        # asked to 0.5 % of all of H; a sensor point's energy is the sum over bins of the same error
        np.testing.assert_allclose(light(tmp_path, text, **keys), expected, rtol=0.01)


def test_a_concave_polygon_reflects_once(tmp_path: Path) -> None:
    """An L from a corner that does not see all of it: fans counted a part twice, 1.5 times the light."""
    corners = [(0, 0.8), (0.24, 0.8), (0.24, 0.24), (0.8, 0.24), (0.8, 0), (0, 0)]
    text = "\n".join([*(f"v {x} {y} 0.9" for x, y in corners), "f 1 2 3 4 5 6"])
    arms = [((0.24, 0.8), (0.12, 0.4)), ((0.56, 0.24), (0.52, 0.12))]
    expected = sum(
        third_bounces(
            Setup(rectangle_cells(*size, [*middle, 0.9], [0, 0, -1], n=100), EDGES, rho=0.7), LASER, SENSORS
        ).sum(axis=-1)
        for size, middle in arms
    )
    np.testing.assert_allclose(light(tmp_path, text), expected, rtol=0.01)


@pytest.mark.parametrize(("normal", "faces", "is_lit"), [(-1, "1 3 2", True), (1, "1 2 3", False)])
def test_warnings_go_by_the_normals_that_light_goes_by(tmp_path: Path, normal: int, faces: str, is_lit: bool) -> None:
    """A plate whose normals contradict its faces' order is lit by its normals, and told to be dark by them."""
    start_backend("llvm")
    from support.rendering import configured

    from nlosrender.capture.part import WHOLE
    from nlosrender.engine.preflight.scene_warnings import scene_warnings
    from nlosrender.rendering.stages import set_up_engine

    corners = ["v -0.1 -0.1 0.8", "v -0.1 0.3 0.8", "v 0.5 0.3 0.8"]
    face = "f " + " ".join(f"{v}//1" for v in faces.split())
    (tmp_path / "a.obj").write_text("\n".join([*corners, f"vn 0 0 {normal}", face]))
    config = configured(flat_wall({"type": "mesh", "filename": "a.obj"}, spp=1), folder=tmp_path)
    _, engine, _ = set_up_engine(config, start_backend("llvm"), WHOLE)
    told = " ".join(scene_warnings(engine))
    assert ("turns its back" in told) != is_lit
    assert ("no hidden surface faces the relay wall" in told) != is_lit
    assert "the file's normals contradict its faces on 100 %" in told
