"""Render with mitransient on request; runs in mitransient's own environment, where nlosrender is not installed.

One JSON object per line on stdin, one per line back on stdout. A request holds ``scene`` (see ``load_scene``),
``settings`` (properties of mitransient's ``transient_nlos_path``), ``spp``, ``seed`` and ``output``, a .npy file to
write: float64 (rows, columns, bins). The answer holds ``seconds`` and ``cpu_seconds`` of the render alone, up to
the histogram as a numpy array.

    .venv-peers-mitransient/bin/python tests/peers/render_with_mitransient.py LIBLLVM [RUNTIME...]

LIBLLVM is the LLVM library to use; RUNTIME are libraries it needs loaded before.
"""

import ctypes
import json
import os
import sys
import time

import numpy as np

LANES_PER_PASS = 2**23  # longer wavefronts run out of memory; a shorter one would not keep the processor busier


def main() -> None:
    """Answer requests until stdin ends."""
    library, *runtime = sys.argv[1:]
    for path in runtime:
        ctypes.CDLL(path, mode=ctypes.RTLD_LOCAL)
    os.environ["DRJIT_LIBLLVM_PATH"] = library
    answers, sys.stdout = sys.stdout, sys.stderr  # the packages print; answers must stay alone
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    import mitransient

    mi.set_log_level(mi.LogLevel.Error)
    scenes: dict[str, mi.Scene] = {}
    print(json.dumps({"peer": f"mitransient {mitransient.__version__}", "mitsuba": mi.__version__}), file=answers)
    answers.flush()
    for line in sys.stdin:
        request = json.loads(line)
        key = json.dumps([request["scene"], request["settings"]], sort_keys=True)
        if key not in scenes:
            scenes[key] = load_scene(mi, request["scene"], request["settings"])
        histogram, seconds, cpu_seconds = render(mi, scenes[key], request["spp"], request["seed"])
        np.save(request["output"], histogram)
        print(json.dumps({"seconds": seconds, "cpu_seconds": cpu_seconds}), file=answers)
        answers.flush()


def load_scene(mi, scene: dict, settings: dict):
    """Build the scene with a projector as laser, legs not counted.

    ``scene``: wall [width, height], wall_reflectance, scan (single or confocal), sensors [rows, columns],
    laser_point [x, y], bins [start_opl, bin_width_opl, n_bins], max_bounces (or null), surfaces: a list of
    {mesh: .ply file, to_world: 4 x 4, bsdf}. Or xml: a scene file, which is loaded as it is.
    """
    if "xml" in scene:
        return mi.load_file(scene["xml"])
    transform = mi.ScalarTransform4f
    rows, columns = scene["sensors"]
    start, width, n_bins = scene["bins"]
    film = {
        "type": "transient_hdr_film",
        "width": columns,
        "height": rows,
        "temporal_bins": n_bins,
        "bin_width_opl": width,
        "start_opl": start,
        "rfilter": {"type": "box"},
    }
    wall = {
        "type": "rectangle",
        "to_world": transform().scale([scene["wall"][0] / 2, scene["wall"][1] / 2, 1]),
        "bsdf": {"type": "diffuse", "reflectance": scene["wall_reflectance"]},
        "sensor": {"type": "nlos_capture_meter", "sensor_origin": [0.1, 0.2, 0.5], "film": film},
    }
    target = [*scene["laser_point"], 0.0]
    laser = {
        "type": "projector",
        "irradiance": 100.0,
        "fov": 0.2,
        "to_world": transform().look_at(origin=[target[0], target[1], 0.5], target=target, up=[0, 1, 0]),
    }
    integrator = {
        "type": "transient_nlos_path",
        "temporal_filter": "box",
        "capture_type": scene["scan"].capitalize(),
        "account_first_and_last_bounces": False,
        # the connection at vertex k needs max_depth k + 1: three is the third bounce and nothing more
        "max_depth": -1 if scene["max_bounces"] is None else scene["max_bounces"],
        **settings,
    }
    hidden = {
        f"hidden_{index}": {
            "type": "ply",
            "filename": surface["mesh"],
            "to_world": transform(np.array(surface["to_world"])),
            "face_normals": True,
            "bsdf": surface["bsdf"],
        }
        for index, surface in enumerate(scene["surfaces"])
    }
    return mi.load_dict({"type": "scene", "integrator": integrator, "relay_wall": wall, "laser": laser, **hidden})


def render(mi, scene, spp: int, seed: int) -> tuple[np.ndarray, float, float]:
    """Render in passes that fit the memory; return their mean (rows, columns, bins), seconds and CPU seconds."""
    rows_columns = scene.sensors()[0].film().size()
    most = max(1, LANES_PER_PASS // int(rows_columns[0] * rows_columns[1]))
    passes = [most] * (spp // most) + ([spp % most] if spp % most else [])
    begun, cpu_begun = time.perf_counter(), time.process_time()
    total = 0.0
    for number, share in enumerate(passes):
        _, transient = scene.integrator().render(scene, seed=seed * 65536 + number, spp=share)
        total = total + np.array(transient, dtype=np.float64)[..., 0] * (share / spp)
    return total, time.perf_counter() - begun, time.process_time() - cpu_begun


if __name__ == "__main__":
    main()
