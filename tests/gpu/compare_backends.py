"""Small captures rendered on the processor and on a GPU, and compared: ``make gpu-check``.

Each render is a process of its own, so that one that ends in a crash is one line of the table. Exit code 0: all agree;
1: a render failed; 4: captures differ; 6: there is no GPU.

    .venv/bin/python tests/gpu/compare_backends.py                       # cuda against llvm, some minutes
    .venv/bin/python tests/gpu/compare_backends.py --backends llvm llvm  # proves the script: another seed, no GPU
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlosrender.errors import EXIT_COMPARISON_EXCEEDED, EXIT_ENVIRONMENT, EXIT_FAILURE, EXIT_OK

ROOT = Path(__file__).parents[2]
SECONDS = 300.0  # of all of it; two to eight of a process on two cores, kernels compiled
# Relative L2 of third bounces without noise. A delay of 4 m errs by 4 float32 roundings of 6e-8, 1e-6 m or 1e-4 of a
# bin of 0.01 m, which moves so much light to the neighbouring bin; a GPU's square roots and divisions err by twice that
ROUNDING = 2e-4
NOISE = ("--z-test", "--significance", "0.001")

WALL = {"type": "rectangle", "width": 2.0, "height": 1.6}
PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.15, -0.1, 0.8], "normal": [0.2, -0.1, -1.0]}
MIRROR = {"type": "rectangle", "width": 1.2, "height": 1.0, "center": [-0.7, 0, 0.9], "normal": [1, 0, -0.6]}
GLOSSY = {"type": "roughconductor", "alpha": 0.3, "material": "Al"}
ROOM = {"type": "room", "size": [2.0, 1.6, 1.8], "bsdf": {"type": "diffuse", "reflectance": 0.5}}
LENS = {"type": "sphere", "center": [-0.4, 0.1, 0.7], "radius": 0.2, "bsdf": {"type": "diffuse", "reflectance": 0.6}}
POINTS = [[-0.7, 0.4], [0.6, -0.3], [0.1, 0.7], [0.35, 0.2], [-0.2, -0.65]]
GRID = {"nx": 7, "ny": 5}


def scene(
    hidden: Iterable[Mapping[str, Any]],
    scan: str,
    render: Mapping[str, Any],
    grid: Mapping[str, Any] = GRID,
    **more: Any,
) -> dict[str, Any]:
    """Return a configuration of a flat wall."""
    capture = {"scan_type": scan, "sensor_grid": grid, **more}
    capture = {key: value for key, value in capture.items() if value is not None}
    axis = {"bin_width_opl": 0.01, "start_opl": 2.0, "n_bins": 500}
    return {
        "scene": {"relay_wall": WALL, "hidden_geometry": list(hidden)},
        "capture": capture,
        "time_axis": axis,
        "render": render,
    }


LIGHTS, PATHS = {"engine": "virtual_lights"}, {"engine": "path"}
EXACT = {**LIGHTS, "max_bounces": 3, "target_error": 0.01}
# name: configuration (or a file below configs/ and what is changed of it), and the tolerances of ``nlosrender compare``
CAPTURES: dict[str, tuple[dict[str, Any] | tuple[str, ...], tuple[str, ...]]] = {
    "single": (scene([PLATE], "single", EXACT), ("--max-rel-l2", f"{ROUNDING}")),
    "confocal": (scene([PLATE], "confocal", EXACT), ("--max-rel-l2", f"{ROUNDING}")),
    "exhaustive": (
        scene([PLATE], "exhaustive", EXACT, laser_grid={"nx": 3, "ny": 2}),
        ("--max-rel-l2", f"{ROUNDING}"),
    ),
    "listed points": (scene([PLATE, LENS], "confocal", EXACT, None, sensor_points=POINTS), NOISE),
    "virtual lights, further bounces": (
        scene([ROOM], "confocal", {**LIGHTS, "max_bounces": 6, "target_error": 0.1}),
        NOISE,
    ),
    "path engine": (scene([ROOM, LENS], "exhaustive", {**PATHS, "spp": 65536}, laser_grid={"nx": 2, "ny": 3}), NOISE),
    "path engine, colours": (
        scene(
            [{**LENS, "bsdf": {"type": "diffuse", "reflectance": [0.8, 0.4, 0.1]}}], "single", {**PATHS, "spp": 65536}
        ),
        NOISE,
    ),
    "mirror": (scene([PLATE, {**MIRROR, "bsdf": {"type": "conductor"}}], "single", {**PATHS, "spp": 65536}), NOISE),
    "mirror, virtual lights": (scene([PLATE, {**MIRROR, "bsdf": {"type": "conductor"}}], "single", EXACT), NOISE),
    "glossy": (scene([{**PLATE, "bsdf": GLOSSY}], "single", {**LIGHTS, "max_bounces": 3, "target_error": 0.02}), NOISE),
    "polarised": (scene([{**PLATE, "bsdf": GLOSSY}], "confocal", {**PATHS, "spp": 65536, "polarized": True}), NOISE),
    "camera scan": (
        ("camera-nlos.yaml", "capture.camera.width=13", "capture.camera.height=9", "render.target_error=0.1"),
        NOISE,
    ),
    "line of sight": (("mitsuba-scene.yaml", "render.spp=32"), NOISE),
    "64 x 64 points, paths": (scene([ROOM, LENS], "confocal", {**PATHS, "spp": 2048}, {"nx": 64, "ny": 64}), NOISE),
}


@dataclass(frozen=True)
class Row:
    """What became of one capture."""

    name: str
    exit_code: int
    engine: str = ""
    seconds: tuple[float, ...] = ()  # of each backend: kernels compiled and run
    verdict: str = ""


def compare_backends(
    backends: tuple[str, str], folder: Path, names: Iterable[str] = tuple(CAPTURES), changes: Iterable[str] = ()
) -> Iterable[Row]:
    """Yield a row for each capture, rendered with both backends and compared.

    Parameters
    ----------
    backends
        Names as in ``render.backend``, the judged one first. Where they are equal, the first renders with another seed.
    folder
        Where files go.
    changes
        ``KEY=VALUE`` for the renders of the first backend alone: what the comparison has to find.
    """
    folder.mkdir(parents=True, exist_ok=True)
    end = time.monotonic() + SECONDS
    seeds = ["render.seed=1"] if backends[0] == backends[1] else []
    for name in names:
        source, tolerances = CAPTURES[name]
        config, own = (ROOT / "configs" / source[0], source[1:]) if isinstance(source, tuple) else (None, ())
        if config is None:
            config = folder / f"{name}.yaml"
            config.write_text(json.dumps(source), encoding="utf-8")
        files = [folder / f"{name}, {place} {backend}.hdf5" for place, backend in zip("ab", backends, strict=True)]
        reports: list[Mapping[str, Any]] = []
        for backend, file, extra in zip(backends, files, ([*seeds, *changes], []), strict=True):
            keys = [*own, f"render.backend={backend}", *extra]
            sets = [word for key in keys for word in ("--set", key)]
            code, report = run(end, "render", config, *sets, "-o", file, "--overwrite", "--quiet")
            if code != EXIT_OK:
                yield Row(name, code, verdict=f"{backend}: {'; '.join(report['messages'])}")
                break
            reports.append(report)
        else:
            code, report = run(end, "compare", *files, *tolerances)
            seconds = tuple(each["seconds"]["compile"] + each["seconds"]["render"] for each in reports)
            apart = report.get("relative_l2")
            said = [] if apart is None else [f"relative L2 {apart:.2g}"]
            said += report.get("failures") or report.get("messages") or []
            yield Row(name, code, reports[0]["engine"], seconds, "; ".join(said))


def run(end: float, *arguments: object) -> tuple[int, Mapping[str, Any]]:
    """Return the exit code of a command and what it prints as JSON; of one that dies or hangs, what is known.

    It is stopped at ``end``, by the monotonic clock [s].
    """
    left = max(0.0, end - time.monotonic())
    command = [sys.executable, "-m", "nlosrender", *map(str, arguments), "--json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=left, check=False)
    except subprocess.TimeoutExpired:
        return EXIT_FAILURE, {"messages": [f"stopped: the {SECONDS:g} s for all captures are over"]}
    try:
        return done.returncode, json.loads(done.stdout)
    except ValueError:  # a signal's number is negative
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        return EXIT_FAILURE, {"messages": [f"the process ended with code {done.returncode}: {last[0]}"]}


def main() -> int:
    """Print the table and what fails; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backends", nargs=2, choices=("cuda", "llvm"), default=("cuda", "llvm"), metavar="NAME")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/gpu-check"), metavar="FOLDER")
    options = parser.parse_args()
    worst = EXIT_OK
    print(f"{'capture':34}{'engine':16}" + "".join(f"{name + ' s':>8}" for name in options.backends))
    for row in compare_backends(tuple(options.backends), options.output):
        if row.exit_code == EXIT_ENVIRONMENT:
            print(f"error: {row.verdict}", file=sys.stderr)
            return EXIT_ENVIRONMENT
        times = "".join(f"{seconds:8.2f}" for seconds in row.seconds) or " " * 16
        print(f"{row.name:34}{row.engine:16}{times}  {'FAILED' if row.exit_code else 'ok'}: {row.verdict}", flush=True)
        if row.exit_code:
            worst = EXIT_COMPARISON_EXCEEDED if row.exit_code == EXIT_COMPARISON_EXCEEDED else EXIT_FAILURE
    return worst


if __name__ == "__main__":
    sys.exit(main())
