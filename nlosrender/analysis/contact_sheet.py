"""A contact sheet of a dataset: a hundred captures at a glance.

Of each: the hidden scene from the front (ground truth, where there is some), the relay wall when most light arrives,
one histogram, index, split and drawn values.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.laser_view import dotted, list_on_wall
from nlosrender.analysis.theme import COLORMAP, EDGE, FAINT, GROUND, INK, MARK, PANEL
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import replacing
from nlosrender.files.dataset_index import read_index
from nlosrender.files.file_kinds import PNG
from nlosrender.files.reading.reader import open_capture
from nlosrender.files.reading.scan import chosen_bounces, read_light
from nlosrender.files.truth_datasets import read_ground_truth

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

SIDE = 96  # pixels of each of the three pictures of a capture
LINES, LINE = 3, 13  # lines of text below the pictures, and their height [pixels]
GAP = 6  # between pictures [pixels]
LETTER = 6  # width of a character of Pillow's default font [pixels]
EMPTY = 0.06  # brightness where there is nothing
COLUMNS = 5
MAX_CAPTURES = 100
Picture = NDArray[np.float64]


def contact_sheet(folder: str | Path, output: str | Path, most: int = MAX_CAPTURES, columns: int = COLUMNS) -> int:
    """Draw the captures of a dataset, evenly chosen where there are more than ``most``; return how many.

    Raises
    ------
    FileError
        There is no index, no capture is finished, or the picture cannot be written.
    """
    from PIL import Image, ImageDraw

    folder = Path(folder)
    entries = [entry for entry in read_index(folder)["captures"] if entry["status"] != "pending"]
    if not entries:
        raise FileError(f"{folder}: no capture is finished yet.")
    chosen = [entries[at] for at in evenly(len(entries), most)]
    columns = min(columns, len(chosen))
    width, height = 3 * SIDE + 2 * GAP, SIDE + LINES * LINE + GAP
    rows = -(-len(chosen) // columns)
    sheet = Image.new("RGB", (columns * (width + 2 * GAP), rows * (height + 2 * GAP)), GROUND)
    draw = ImageDraw.Draw(sheet)
    for number, entry in enumerate(chosen):
        x, y = number % columns * (width + 2 * GAP) + GAP, number // columns * (height + 2 * GAP) + GAP
        try:
            pictures = capture_pictures(folder / entry["file"]) if entry["status"] == "done" else None
        except FileError as error:
            pictures, entry = None, {**entry, "message": str(error)}
        if pictures is not None:
            truth, wall, histogram = pictures
            for place, picture in enumerate((truth, wall)):
                if picture is not None:
                    sheet.paste(Image.fromarray(square(picture)), (x + place * (SIDE + GAP), y))
            _draw_histogram(draw, histogram, x + 2 * (SIDE + GAP), y)
        for line, text in enumerate(entry_text(entry, width // LETTER)):
            draw.text((x, y + SIDE + 2 + line * LINE), text, fill=INK if line == 0 else FAINT)
    with replacing(output, PNG) as partial:
        sheet.save(partial, format="PNG")
    return len(chosen)


def evenly(count: int, most: int) -> list[int]:
    """Return at most ``most`` of ``count`` indices, evenly chosen, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int)).tolist() if count else []


def capture_pictures(path: Path) -> tuple[Picture | None, Picture, Picture]:
    """Return front view and wall at the peak (rows, columns, 3), and the brightest point's histogram, from 0 to 1.

    Raises
    ------
    FileError
        The file is missing, damaged or no capture.
    """
    with open_capture(path) as capture:
        sizes = capture.header.sizes
        laser = (0, 0) if capture.header.confocal else (sizes["laser_y"] // 2, sizes["laser_x"] // 2)
        points = list_on_wall(capture)
        light = read_light(capture, laser, None, None, chosen_bounces(capture.header, "all")).astype(np.float64)
    truth = read_ground_truth(path, ("gt_depth", "gt_instance"))
    peak = int(light.sum(axis=(0, 1)).argmax())
    brightest = np.unravel_index(int(light.sum(axis=2).argmax()), light.shape[:2])
    front = _front(truth)
    if front is not None and front.shape[:2] == light.shape[:2]:  # seen from the sensor points
        front = dotted(points, front, EMPTY)
    return front, dotted(points, _colored(light[..., peak]), EMPTY), _scaled(light[brightest])


def _front(truth: Mapping[str, Picture]) -> Picture | None:
    """Return the depth, near brighter than far, shaded by the normals; else instances; None: there are neither."""
    if "gt_depth" not in truth:
        return _colored(truth["gt_instance"]) if "gt_instance" in truth else None
    depth = truth["gt_depth"]
    if not np.isfinite(depth).any():
        return np.zeros((*depth.shape, 3))
    near, far = np.nanmin(depth), np.nanmax(depth)
    shade = 1 - 0.7 * (depth - near) / max(far - near, 1e-9)
    return np.where(np.isfinite(depth)[..., None], _colored(np.nan_to_num(shade), 1.0), 0.0)


def _colored(values: Picture, top: float | None = None) -> Picture:
    from matplotlib import colormaps

    return np.asarray(colormaps[COLORMAP](_scaled(values) if top is None else values))[..., :3]


def _scaled(values: Picture) -> Picture:
    return values / max(float(values.max(initial=0)), 1e-300)


def square(picture: Picture) -> NDArray[np.uint8]:
    """Return a grid on the wall as bytes of ``SIDE`` x ``SIDE`` pixels, its sides' ratio kept.

    It is what the wall sees: wall y upwards, wall x to the left, so that letters can be read.
    """
    rows, columns = picture.shape[:2]
    scale = max(rows, columns) / SIDE
    steps = (np.arange(SIDE) + 0.5 - SIDE / 2) * scale
    y, x = np.floor(rows / 2 - steps).astype(int), np.floor(columns / 2 - steps).astype(int)
    inside = ((y >= 0) & (y < rows))[:, None] & ((x >= 0) & (x < columns))
    found = picture[np.clip(y, 0, rows - 1)][:, np.clip(x, 0, columns - 1)]
    return (np.where(inside[..., None], found, EMPTY) * 255).astype(np.uint8)


def _draw_histogram(draw: ImageDraw, histogram: Picture, x: int, y: int) -> None:
    draw.rectangle((x, y, x + SIDE - 1, y + SIDE - 1), fill=PANEL, outline=EDGE)
    lit = np.flatnonzero(histogram)
    if not len(lit):
        return
    shown = histogram[lit[0] : lit[-1] + 1]
    columns = np.array([part.max() for part in np.array_split(shown, min(SIDE - 4, len(shown)))])
    places = x + 2 + np.arange(len(columns)) * (SIDE - 5) / max(len(columns) - 1, 1)
    heights = y + SIDE - 3 - columns * (SIDE - 8)
    draw.line(list(zip(places.tolist(), heights.tolist(), strict=True)), fill=MARK)


def entry_text(entry: Mapping[str, Any], width: int) -> list[str]:
    """Return index, split, label, error, and the drawn values, cut to lines."""
    error = entry["error_estimate"]
    head = [str(entry["index"]), entry["split"], entry["label"], None if error is None else f"{100 * error:.2g} %"]
    first = "  ".join(str(part) for part in head if part is not None)
    if entry["status"] == "failed":
        first, rest = f"{entry['index']}  FAILED", str(entry["message"])
    else:
        shown = ((key, value) for key, value in entry["values"].items() if key != "render.seed")
        rest = "  ".join(f"{short_key(key)} {shown_value(value)}" for key, value in shown)
    return [first[:width], *textwrap.wrap(rest, width)[: LINES - 1]]


def short_key(key: str) -> str:
    """Return the last part of a dotted key, with the one before it where that is a number."""
    parts = key.split(".")
    return ".".join(parts[-2:] if parts[-1].isdigit() else parts[-1:])


def shown_value(value: Any) -> str:
    """Return a drawn value with three digits; of a file its name alone."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list):
        return ",".join(shown_value(item) for item in value)
    return Path(value).name if isinstance(value, str) else json.dumps(value)
