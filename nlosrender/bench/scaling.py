"""How the time grows with the size of the problem: triangles, sensor points, lasers, bins, bounces."""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nlosrender.bench.curve import power_law
from nlosrender.bench.generated_meshes import grid_faces, write_ply
from nlosrender.bench.runs import Timer, load, render
from nlosrender.bench.scenes import BenchScene, closed_room, many_lasers, plate, wavy_sheet
from nlosrender.engine.interface import Budget

REPEATS = 3
TARGET = 0.02  # error asked for at every size
SHORT = 1.5  # seconds
LONGEST = 20.0  # seconds; a size expected to take longer is left out
WAVES = 3  # across the sheet
ALL_BOUNCES = 12  # stands for "no limit" on the axis of bounces


def measure_scaling(seconds: float) -> list[dict[str, Any]]:
    """Measure every quantity in about ``seconds`` together; sizes that do not fit are left out.

    Returns
    -------
    list of dict
        Plain values: ``quantity``, ``setting``, ``sizes``; for each size medians of ``seconds``, ``cpu_seconds`` and
        ``setup_seconds`` (see ``Run``), and ``engines``; ``exponent`` p of seconds ~ size^p over the last three.

    Raises
    ------
    RenderError
        A render failed.
    """
    with tempfile.TemporaryDirectory(prefix="nlosrender-bench-") as folder:
        return [_measure(*axis, seconds / 5) for axis in _axes(Path(folder))]


def _axes(folder: Path) -> list[tuple[str, str, Sequence[float], Callable[[int], BenchScene]]]:
    """Return quantity, what stays fixed, sizes, and the scene of a size."""

    def sheet(n_triangles: int) -> BenchScene:
        mesh = folder / f"sheet_{n_triangles}.ply"
        write_wavy_sheet(mesh, n_triangles)
        return wavy_sheet(mesh)

    return [
        ("triangles", "32 x 32 sensor points, 700 bins", (200, 1000, 5000, 50_000, 500_000), sheet),
        ("sensor points", "plate, 320 bins", (256, 1024, 4096, 16384), lambda n: plate(round(n**0.5))),
        ("lasers", "plate, 16 x 16 sensor points", (1, 4, 16, 64), lambda n: many_lasers(round(n**0.5))),
        ("bins", "plate, 64 x 64 sensor points, same window", (160, 320, 640, 1280), lambda n: plate(n_bins=n)),
        (
            "bounces",
            f"closed room, 16 x 16 sensor points; {ALL_BOUNCES} stands for no limit",
            (3, 4, 5, 7, ALL_BOUNCES),
            lambda n: closed_room(16, None if n == ALL_BOUNCES else n),
        ),
    ]


def _measure(
    quantity: str, setting: str, sizes: Sequence[float], scene_of: Callable[[int], BenchScene], seconds: float
) -> dict[str, Any]:
    begun, budget, options = Timer(), Budget(target_error=TARGET), {"engine": "auto"}
    found: dict[str, list[Any]] = {name: [] for name in ("seconds", "cpu_seconds", "setup_seconds", "engines")}
    times = found["seconds"]
    for size in sizes:
        if len(times) >= 2:
            growth = times[-1] / times[-2]
            if begun.read()[0] + 2 * times[-1] * max(growth, 1.0) > seconds or times[-1] * growth > LONGEST:
                break
        loaded = load(scene_of(int(size)))
        runs = [render(loaded, budget, seed, options) for seed in range(2)]
        if runs[1].seconds < SHORT:  # the first run compiles; long runs are not repeated
            runs += [render(loaded, budget, 2 + k, options) for k in range(REPEATS - 1)]
        for name in ("seconds", "cpu_seconds", "setup_seconds"):
            found[name].append(statistics.median(getattr(run, name) for run in runs[1:]))
        found["engines"].append(runs[0].engine)
    measured = list(sizes[: len(times)])
    exponent = power_law(measured[-3:], times[-3:])
    return {"quantity": quantity, "setting": setting, "sizes": measured, **found, "exponent": exponent}


def write_wavy_sheet(path: Path, n_triangles: int) -> None:
    """Write a square sheet of 0.8 m with waves of 5 cm, facing -z, of 2 n^2 triangles, near ``n_triangles``."""
    n = max(1, round((n_triangles / 2) ** 0.5))
    along = np.linspace(-0.4, 0.4, n + 1)
    x, y = (side.ravel() for side in np.meshgrid(along, along))
    z = 0.05 * np.sin(2 * np.pi * WAVES * x / 0.8) * np.cos(2 * np.pi * WAVES * y / 0.8)
    faces = grid_faces(n, n)[:, ::-1]  # facing -z
    write_ply(path, np.stack([x, y, z], axis=1), faces)
