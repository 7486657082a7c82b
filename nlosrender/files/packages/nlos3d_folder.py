"""The folder of nlos3d (Mu et al. 2022): ``splits/NAME.json`` lists {meas, image, depth}, files below ``data/``.

Each file is a .mat with one variable ``data``: meas (1, t, h, w), image (h, w, 3 v), depth (h, w, v). The one view is
stored twice, v = 2: the program's loader drops an axis of length 1 of depths, and then fails.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np

from nlosrender.files.packages.lfe_folders import lfe_depth
from nlosrender.files.packages.package import Packing, splits_of
from nlosrender.files.packages.samples import wall_sample

VIEWS = 2


def write_nlos3d(packing: Packing, entries: list[dict[str, Any]], progress: Callable[[float], None]) -> None:
    """Write lists and files; errors as of ``pack``."""
    from scipy.io import savemat

    data, splits = packing.folder / "data", packing.folder / "splits"
    data.mkdir()
    splits.mkdir()
    done = 0
    for split, chosen in splits_of(entries).items():
        listed = []
        for entry in chosen:
            sample = wall_sample(packing.source / entry["file"])
            image, depth = sample.image, lfe_depth(sample)
            arrays = {"meas": sample.light[None]}
            if image is None or depth is None:
                packing.note("no image or no depth: the captures have no ground truth for it")
            if image is not None:
                arrays["image"] = np.repeat(image[..., None], 3 * VIEWS, axis=2)
            if depth is not None:
                arrays["depth"] = np.repeat(depth[..., None], VIEWS, axis=2)
            names = {kind: f"{entry['index']:06d}-{kind}.mat" for kind in arrays}
            for kind, values in arrays.items():
                savemat(data / names[kind], {"data": values}, do_compression=True)
            listed.append(names)
            packing.stated_error(entry, 0.0)
            done += 1
            progress(done / len(entries))
        (splits / f"{split}.json").write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
