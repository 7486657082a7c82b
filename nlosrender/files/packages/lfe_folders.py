"""The folders of learned feature embeddings (Chen et al. 2020), as its renderer writes and its loaders read them.

``0/MODEL/shine_0.0000-rot_X_Y_Z-shift_X_Y_Z.../`` holds ``light-1-MAX-LAST-FIRST.hdr``, the confocal transient (of one
laser point ``light-0-...``) as one picture of 600 blocks of rows, ``depth-0-MAX-MIN.hdr``, ``confocal-0-MAX-MIN.hdr``.
Lengths are in half wall widths; a bin is 0.01 of them, and depth is 1 at the wall, 0 two of them away and where there
is nothing.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nlosrender.files.packages.package import WHOLE_SET, Packing, splits_of
from nlosrender.files.packages.radiance_hdr import write_hdr
from nlosrender.files.packages.samples import Float32, WallSample, rounding, wall_sample
from nlosrender.files.reading.reader import read_header

BINS, BIN = 600, 0.01  # number and width of LFE's time bins, in half wall widths
SLACK = 1e-3  # relative difference in bin width that is not worth a note


def write_lfe(packing: Packing, entries: list[dict[str, Any]], progress: Callable[[float], None]) -> None:
    """Write a root for each split; errors as of ``pack``."""
    done = 0
    for split, chosen in splits_of(entries).items():
        root = packing.folder if split == WHOLE_SET else packing.folder / split
        for entry in chosen:
            _write(packing, entry, root / "0" / _model(entry, packing.name))
            done += 1
            progress(done / len(entries))


def _write(packing: Packing, entry: dict[str, Any], model: Path) -> None:
    sample = wall_sample(packing.source / entry["file"])
    folder = model / _folder_name(packing.source / entry["file"], entry["index"], sample.width)
    folder.mkdir(parents=True)
    if abs(2 * sample.bin_width / BIN - 1) > SLACK:
        needed = BIN / 2 * sample.width
        packing.note(f"bins of {sample.bin_width * sample.width:g} m, where LFE has {needed:g} m")
    light = np.zeros((BINS, *sample.light.shape[1:]), dtype=np.float32)
    kept = min(BINS, len(sample.light))
    light[:kept] = sample.light[:kept]
    if sample.light[BINS:].any():
        packing.note(f"light after bin {BINS} is left out")
    lit = np.flatnonzero(light.any(axis=(1, 2)))
    first, last = (lit[0] * BIN, lit[-1] * BIN) if len(lit) else (0.0, 0.0)
    name = f"light-{int(sample.confocal)}-{light.max():.4f}-{last:.4f}-{first:.4f}.hdr"
    stored = write_hdr(folder / name, light.reshape(-1, light.shape[2]))
    packing.stated_error(entry, rounding(stored, light.reshape(stored.shape)))
    for kind, picture in (("depth", lfe_depth(sample)), ("confocal", sample.image)):
        if picture is None:
            packing.note(f"no {kind} picture: the captures have no ground truth for it")
        else:
            write_hdr(folder / f"{kind}-0-{picture.max():.4f}-{picture.min():.4f}.hdr", picture)


def lfe_depth(sample: WallSample) -> Float32 | None:
    """Return the depth as LFE has it: 1 - d / wall width, 0 where there is nothing; None without a ground truth."""
    if sample.depth is None:
        return None
    return np.nan_to_num(np.clip(1 - sample.depth, 0, 1)).astype(np.float32)


def _model(entry: Mapping[str, Any], name: str) -> str:
    """Return the name of the model's folder: of the drawn file, or of what the capture shows."""
    file = next(iter(entry["files"].values()), None)
    text = Path(file["file"]).with_suffix("").as_posix() if file else str(entry["label"] or name)
    return re.sub(r"[^\w.]+", "-", text).strip("-") or "model"


def _folder_name(path: Path, index: int, width: float) -> str:
    """Return the name of a capture's folder: rotation [degrees] and place of its first item, half wall widths."""
    items = (
        json.loads(str(read_header(path).attributes.get("config", "{}"))).get("scene", {}).get("hidden_geometry", [])
    )
    item = items[0] if items else {}
    rotation = item.get("rotate_deg") or (0.0, 0.0, 0.0)
    place = item.get("translate") or item.get("center") or (0.0, 0.0, 0.0)
    numbers = ["_".join(f"{value:.4f}" for value in values) for values in (rotation, np.array(place) * 2 / width)]
    return f"shine_0.0000-rot_{numbers[0]}-shift_{numbers[1]}-{index:06d}"
