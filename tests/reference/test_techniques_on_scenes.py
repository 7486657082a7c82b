"""The program's own cross-check on scenes in which its techniques have disagreed: all of them agree."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from reference import scenes

from nlosrender.analysis.engine_check import check_engines
from nlosrender.config.load import load_config

pytestmark = pytest.mark.slow
WHITE, BLACK = ({"type": "diffuse", "reflectance": rho} for rho in (1.0, 0.0))
BOARD = {"type": "rectangle", "width": 0.6, "height": 0.6, "center": [0, 0, 1], "bsdf": WHITE}
BALL = {"type": "sphere", "center": [0, 0, 1], "radius": 0.3, "bsdf": WHITE}
QUAD = "v -0.3 -0.3 1\nv 0.3 -0.3 1\nv 0.3 0.3 1\nv -0.3 0.3 1\nf 1 2 3 4\nf 4 3 2 1\n"
COINCIDENT = {
    "black poster 10 um before a board": [BOARD, BOARD | {"width": 0.4, "center": [0.05, 0, 0.99999], "bsdf": BLACK}],
    "white poster on a board": [BOARD, BOARD | {"width": 0.4, "bsdf": {"type": "diffuse", "reflectance": 0.8}}],
    "two boards overlap in one plane": [BOARD, BOARD | {"center": [0.3, 0, 1]}],
    "a ball in a black shell 100 um larger": [BALL, BALL | {"radius": 0.3001, "bsdf": BLACK}],
    "a ball in a grey shell 15 um larger": [BALL, BALL | {"radius": 0.300015, "bsdf": BLACK | {"reflectance": 0.1}}],
    "a sheet with a front and a back of its own": [
        {"type": "mesh", "filename": "sheet.obj", "face_normals": True, "bsdf": {"type": "twosided", "a": WHITE}}
    ],
}


def checked(config: dict, folder: Path) -> list[str]:
    """Return which techniques differ, with the worst place."""
    (folder / "sheet.obj").write_text(QUAD)
    (folder / "scene.yaml").write_text(yaml.safe_dump(config))
    loaded = load_config(folder / "scene.yaml")
    limits = {"points_per_axis": 3, "target_error": 0.01, "time_limit_s": 8.0, "significance": 1e-3}
    check = check_engines(loaded, **limits)
    assert check.pairs
    return [
        f"{' and '.join(p.techniques)}: {p.z:.1f} > {p.z_limit:.1f}, {p.worst}" for p in check.pairs if not p.agrees
    ]


@pytest.mark.parametrize("seed", range(10), ids=scenes.name)
def test_techniques_agree_on_every_kind_of_scene(seed, tmp_path):
    """Specular parts, vertex normals, pictures, round shapes, coincident surfaces, rooms: no technique stands alone."""
    assert checked(scenes.configuration(seed, tmp_path), tmp_path) == []


@pytest.mark.parametrize("name", COINCIDENT)
def test_techniques_agree_on_surfaces_that_nearly_coincide(name, tmp_path):
    """A shadow ray that ends short of the surface in front counts light twice; what is met first does not."""
    config = scenes.configuration(0, tmp_path)
    config["scene"]["hidden_geometry"] = COINCIDENT[name]
    config["render"]["max_bounces"] = 3
    assert checked(config, tmp_path) == []
