"""Rates behind the curves: the gather against Embree's any-hit queries, and a whole ``nlosrender render`` process."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import yaml

from nlosrender.bench.any_hit import trace_any_hit
from nlosrender.bench.runs import LoadedScene, Timer, virtual_lights_of
from nlosrender.bench.scenes import BenchScene
from nlosrender.engine.interface import Budget
from nlosrender.errors import RenderError

REPEATS = 3
GATHER_TARGET = 0.01


def gather_rate(loaded: LoadedScene) -> dict[str, Any]:
    """Compare the gather of a third-bounce scene with tracing its shadow rays and doing nothing else.

    A pair is a sensor point and a patch. The gather's time is all of it: patches, lighting, histogram. The any-hit
    queries are the rays of all lit pairs that face each other, in the gather's order; the gather asks for fewer.

    Raises
    ------
    RenderError
        The virtual-light engine does not take the scene.
    """
    plan, engine = virtual_lights_of(loaded)
    patch_scale = engine.calibrate(Budget(target_error=GATHER_TARGET)).patch_scale or 1.0
    spent = []
    for _ in range(REPEATS + 1):  # the first run compiles
        engine.third.forget()  # lighting is a part of it
        timer = Timer()
        for batch in plan.batches:
            engine.third.gather(batch, patch_scale)
        spent.append(timer.read()[0])
    gather_seconds = statistics.median(spent[1:])
    lit = engine.third.shadow_ray_targets(plan.batches[0], patch_scale)
    rays, any_hit_seconds = trace_any_hit(loaded, lit)
    asked_rays, asked_seconds = trace_any_hit(loaded, lit, only_asked=True)
    n_patches, traces_rays = len(engine.tessellator.patches(patch_scale)), engine.settings.needs_visibility
    pairs = n_patches * loaded.capture.n_sensors
    return {
        "scene": loaded.scene.name,
        "triangles": loaded.built.n_triangles,
        "patches": n_patches,  # at the resolution of the target error
        "lit_patches": len(lit.positions),  # of them, lit by a laser point: only these are gathered
        "pairs": pairs,  # sensor points times all patches
        "rays": rays,  # lit pairs that face each other
        "asked_rays": asked_rays,  # of ``rays``, those that something may stop: the gather traces them
        "gather_seconds": gather_seconds,
        "any_hit_seconds": any_hit_seconds,
        "asked_seconds": asked_seconds,
        "traces_rays": traces_rays,  # False: nothing can occlude
        "gather_pairs_per_second": pairs / gather_seconds,
        "gather_rays_per_second": rays / gather_seconds,
        "any_hit_rays_per_second": rays / any_hit_seconds,
        "gather_share_of_any_hit": any_hit_seconds / gather_seconds,
        "rays_left_out": 1 - (asked_rays / pairs if traces_rays else 0.0),
    }


def whole_process(scene: BenchScene) -> dict[str, Any]:
    """Time ``nlosrender render`` of a scene as a user runs it, in a process of its own, kernels compiled before.

    Returns
    -------
    dict
        ``process_seconds`` (median of three, from start to exit), the median run's ``seconds`` per stage and its
        ``write_share`` of the whole, the file's size, and ``first_process_seconds``, which may include compilation.

    Raises
    ------
    RenderError
        The command failed.
    """
    with tempfile.TemporaryDirectory(prefix="nlosrender-bench-") as folder:
        config = Path(folder) / "scene.yaml"
        output = Path(folder) / "scene.hdf5"
        document = {**scene.sections, "render": {"max_bounces": scene.max_bounces, "target_error": 0.01}}
        config.write_text(yaml.safe_dump(document), encoding="utf-8")
        command = [sys.executable, "-m", "nlosrender", "render", str(config), "-o", str(output), "--quiet", "--json"]
        runs = []
        for _ in range(REPEATS + 1):
            timer = Timer()
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            seconds = timer.read()[0]
            if done.returncode != 0:
                raise RenderError(f"nlosrender render of the scene {scene.name} failed: {done.stderr.strip()}")
            runs.append((seconds, json.loads(done.stdout)))
        size = output.stat().st_size
    median = sorted(runs[1:], key=lambda run: run[0])[REPEATS // 2]
    return {
        "scene": scene.name,
        "first_process_seconds": runs[0][0],
        "process_seconds": median[0],
        "seconds": median[1]["seconds"],
        "write_share": median[1]["seconds"]["write"] / median[0],
        "error_estimate": median[1]["error_estimate"],
        "file_bytes": size,
    }
