"""Captures an hour of a data set: a new mesh in each, confocal, third bounce, depth truth, files written."""

from __future__ import annotations

import itertools
import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nlosrender.bench.generated_meshes import grid_faces, write_ply
from nlosrender.bench.runs import Timer
from nlosrender.config.load import load_document
from nlosrender.config.sweep_load import Sweep, sweep_of
from nlosrender.pipeline import render_capture

SIZES = ((64, 512), (128, 640), (256, 640))  # points per edge, bins
CELLS = 157  # along each edge of a mesh's grid: 2 x 157 x 157 triangles, 49298
TARGET = 0.02
WINDOW = 6.0  # length of the time axis, optical path [m]
FEWEST = 2  # captures of each size, beside the first, which compiles
MESHES = 12  # different ones; more captures begin anew


def factory_rates(seconds: float) -> list[dict[str, Any]]:
    """Render captures of a family, by size, for about ``seconds`` in all.

    Returns
    -------
    list
        Of each size: ``captures_per_hour``, mean CPU seconds, median seconds by stage, and how far the stated error is
        below the target (its median: 0.5 is twice as accurate as asked), without the first capture.

    Raises
    ------
    RenderError
        A render failed.
    """
    found = []
    with tempfile.TemporaryDirectory(prefix="nlosrender-bench-") as name:
        folder = Path(name)
        for number in range(MESHES):
            vertices, faces = crumpled_ball(number)
            write_ply(folder / f"{number:02d}.ply", vertices, faces)
        for points, bins in SIZES:
            found.append(
                {"points": points, "bins": bins, **_rates(_family(folder, points, bins), seconds / len(SIZES))}
            )
    return found


def crumpled_ball(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and faces (m, 3) of a ball with folds, bumps and a thin fin, another for each number."""
    random = np.random.default_rng(number)
    theta, phi = np.meshgrid(np.linspace(0, np.pi, CELLS + 1), np.linspace(0, 2 * np.pi, CELLS + 1), indexing="ij")
    ball = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1)
    radius = np.ones(ball.shape[:2])
    for strength, frequency in ((0.25, 2.0), (0.12, 5.0), (0.05, 14.0)):
        waves = random.normal(size=(5, 3)) * frequency
        radius += strength * np.sin(ball @ waves.T + random.uniform(0, 2 * np.pi, 5)).mean(axis=-1)
    radius += 0.8 * np.exp(-(((ball @ random.normal(size=3)) / 0.05) ** 2))  # the fin
    return (ball * radius[..., None]).reshape(-1, 3), grid_faces(CELLS, CELLS)


def _family(folder: Path, points: int, bins: int) -> Sweep:
    item = {
        "type": "mesh",
        "filename": {"files": "*.ply", "pick": "each"},
        "fit": {"largest": {"uniform": [0.6, 1.2]}},
        "rotate_deg": {"rotation": "uniform"},
        "translate": {"inside": [[-0.3, 0.3], [-0.3, 0.3], [0.9, 1.4]]},
        "normals": "flat",
        "bsdf": {"type": "diffuse", "reflectance": {"uniform": [0.3, 0.9]}},
    }
    document: dict[str, Any] = {
        "scene": {
            "relay_wall": {"type": "rectangle", "width": 2.0, "height": 2.0},
            "hidden_geometry": [{"type": "sphere", "radius": 0.1, "center": [0, 0, 1]}],
        },
        "capture": {
            "scan_type": "confocal",
            "sensor_grid": {"nx": points, "ny": points},
            "account_first_and_last_bounces": False,
        },
        "time_axis": {"bin_width_opl": WINDOW / bins, "n_bins": bins},
        "render": {"max_bounces": 3, "target_error": TARGET},
        "output": {"path": f"{folder}/{points}-{{index}}.hdf5", "ground_truth": ["depth"]},
        "sweep": {"random": {"count": 1000, "keys": {"scene.hidden_geometry.0": item}}},
    }
    (folder / "family.yaml").write_text(yaml.safe_dump(document), encoding="utf-8")
    sweep = sweep_of(load_document(folder / "family.yaml"))
    if sweep is None:
        raise ValueError("a family is a sweep")
    return sweep


def _rates(sweep: Sweep, seconds: float) -> dict[str, Any]:
    whole, size = Timer(), 0
    spent: list[float] = []
    cpu: list[float] = []
    errors: list[float] = []
    stages: list[dict[str, float]] = []
    for index in itertools.count():
        if index > FEWEST and whole.read()[0] + statistics.mean(spent) > seconds:
            break
        timer = Timer()
        report = render_capture(sweep.config(index))
        if index:
            elapsed, busy = timer.read()
            spent.append(elapsed)
            cpu.append(busy)
            stages.append(report.seconds)
            errors.append(report.error_estimate or 0.0)
            size += report.output.stat().st_size
        report.output.unlink()
    return {
        "captures": len(spent),
        "captures_per_hour": 3600 / statistics.mean(spent),
        "cpu_seconds": statistics.mean(cpu),
        "seconds": {stage: statistics.median(each[stage] for each in stages) for stage in stages[0]},
        "stated_error": statistics.median(errors),
        "target": TARGET,
        "missed": sum(error > TARGET for error in errors),
        "file_bytes": size / len(spent),
    }
