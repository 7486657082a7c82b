"""Stated errors of the third bounce where patches are curved, textured, or have normals of their own.

Right values are float64 quadrature, and paths for shading normals.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.quadrature import Setup, binned, contributions, rectangle_cells, sphere_cells
from support.rendering import Rendering, flat_wall, render

FAST = {"engine": "virtual_lights", "spp": None}


def assert_honest(result: Rendering, truth: np.ndarray, target: float) -> None:
    """True relative L2 error and stated one are within a factor 2; the true one is below the target asked for."""
    error = float(np.linalg.norm(result.total - truth) / np.linalg.norm(truth))
    assert 0.5 * error < result.error_estimate < 2 * max(error, 0.5 * target), (error, result.error_estimate)
    assert error < target


def truth_of(result: Rendering, setups: list[Setup]) -> np.ndarray:
    """Return the third bounce (1, 1, y, x, bins) of surfaces that do not hide one another."""
    sensors = result.capture.sensor_grid.positions
    laser = result.capture.laser_grid.positions.reshape(3)
    rows = []
    for sensor in sensors.reshape(-1, 3):
        parts = [contributions(setup, laser, sensor) for setup in setups]
        rows.append(sum(binned(value, opl, setups[0].edges) for value, opl in parts))
    return np.array(rows).reshape(1, 1, *sensors.shape[:2], -1)


@pytest.mark.parametrize("width", [0.04, 0.01])
def test_first_light_of_a_ball_beside_a_plate(width: float) -> None:
    """Most patches are the plate's, and the first bins the ball's: light in wrong bins is part of the stated error."""
    ball = {"type": "sphere", "center": [-0.5, 0.2, 0.9], "radius": 0.25, "bsdf": {"type": "diffuse"}}
    ball["bsdf"] = {"type": "diffuse", "reflectance": 0.9}
    plate = {"type": "rectangle", "width": 0.8, "height": 1.2, "center": [0.5, 0, 1.2]}
    plate["bsdf"] = {"type": "diffuse", "reflectance": 0.1}
    n = round(5 / width)
    result = render(flat_wall(ball, plate, sensors=(3, 2), bins=(0, width, n), target_error=0.03, **FAST))
    edges = np.linspace(0, n * width, n + 1)
    setups = [
        Setup(sphere_cells([-0.5, 0.2, 0.9], 0.25, 600), edges, 0.9),
        Setup(rectangle_cells(0.8, 1.2, [0.5, 0, 1.2], [0, 0, -1], n=400), edges, 0.1),
    ]
    assert_honest(result, truth_of(result, setups), 0.03)


def test_every_round_shape_is_refined() -> None:
    """From one resolution to the next, whatever the number of patches of the others: its error would not show."""
    from test_virtual_lights import start

    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator

    balls = [{"type": "sphere", "center": [x, 0, 1], "radius": radius} for x, radius in ((0.5, 0.3), (-0.5, 0.02))]
    rods = [{"type": "cylinder", "center": [0, 0.5, 1], "axis": [1, 0, 0], "radius": 0.01, "height": 0.8}]
    built, capture, *_ = start(flat_wall(*balls, *rods))
    tessellator = Tessellator(built, capture, 0.02 / built.metres_per_engine_unit)
    for patch_scale in (1.0, 0.5):
        counts, finer = tessellator.counts(patch_scale), tessellator.counts(patch_scale / 2)
        assert len(counts) == 5
        assert all(more > 2 * count for count, more in zip(counts, finer, strict=True) if count)


def test_a_thin_rod_is_cut_along_as_a_flat_strip_is() -> None:
    """Its radius limits the patches around it, not along it: their number falls from (length / radius) to its root."""
    from test_virtual_lights import start

    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator

    rod = {"type": "cylinder", "center": [0, 0.5, 1], "axis": [1, 0, 0], "radius": 0.002, "height": 0.8}
    built, capture, *_ = start(flat_wall(rod))
    assert Tessellator(built, capture, 0.02 / built.metres_per_engine_unit).counts(1.0)[2] < 200


def test_a_texture_finer_than_patches_is_averaged(tmp_path: Path) -> None:
    """A checkerboard of 40 x 40 texels over 0.9 x 0.7 m: grey to the error asked for, and stated so."""
    texels = np.indices((40, 40)).sum(axis=0) % 2 * 255
    Image.fromarray(texels.astype(np.uint8)).save(tmp_path / "checks.png")
    picture = {"type": "bitmap", "filename": "checks.png", "raw": True, "filter_type": "nearest"}
    item = {"type": "rectangle", "width": 0.9, "height": 0.7, "center": [0.1, 0, 0.7]}
    item["bsdf"] = {"type": "diffuse", "reflectance": picture}
    config = flat_wall(item, sensors=(3, 2), bins=(1.2, 0.02, 150), target_error=0.04, color="grey", **FAST)
    result = render(config, folder=tmp_path)
    cells = rectangle_cells(0.9, 0.7, [0.1, 0, 0.7], [0, 0, -1], n=400)
    column, row = (np.minimum((cells.uv * 40).astype(int), 39)).T
    setup = Setup(cells, np.linspace(1.2, 4.2, 151))
    albedo = texels[row, column] / 255
    truth = []
    for sensor in result.capture.sensor_grid.positions.reshape(-1, 3):
        value, opl = contributions(setup, result.capture.laser_grid.positions.reshape(3), sensor)
        truth.append(binned(value * albedo, opl, setup.edges))
    assert_honest(result, np.array(truth).reshape(result.total.shape), 0.04)


def test_a_cube_with_averaged_normals_hides_its_own_back(tmp_path: Path) -> None:
    """Such normals turn sides that face away towards the wall; both engines agree within 5 standard deviations."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    lines += [f"vn {x} {y} {z}" for x, y, z in corners / np.linalg.norm(corners, axis=1)[:, None]]
    lines += ["f " + " ".join(f"{k + 1}//{k + 1}" for k in quad) for quad in quads]
    (tmp_path / "cube.obj").write_text("\n".join(lines) + "\n")
    item = {"type": "mesh", "filename": "cube.obj", "translate": [0.1, 0, 0.8], "rotate_deg": [20, 30, 0]}
    bins = (0, 0.1, 60)
    fast = render(flat_wall(item, bins=bins, target_error=0.01, **FAST), folder=tmp_path)
    paths = render(flat_wall(item, bins=bins, spp=2**16), folder=tmp_path)
    energies = [result.total.sum(axis=-1) for result in (fast, paths)]
    sigma = np.sqrt(paths.total_variance.sum(axis=-1))
    assert (np.abs(energies[0] - energies[1]) < 5 * sigma + 0.005 * energies[1]).all()
