"""What a capture file holds, from its metadata alone: as quick for a terabyte as for a kilobyte."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from math import prod
from pathlib import Path

from nlosrender.constants import opl_to_seconds
from nlosrender.errors import FileError
from nlosrender.files.parts.part_attributes import UNSAMPLED, ZERO, text_list
from nlosrender.files.reading.reader import read_header
from nlosrender.files.reading.stored_header import StoredHeader


def summarise(path: str | Path) -> dict[str, object]:
    """Return a capture's metadata as a plain dict that JSON can hold.

    Grids are (nx, ny), lengths in m, times in ps; None where the file does not say, which is the rule with files by
    other writers.

    Raises
    ------
    FileError
        The file is missing, damaged or not a capture.
    """
    header = read_header(path)
    attributes = header.attributes
    summary: dict[str, object] = {
        "file": str(path),
        "scan_type": header.scan_type,
        "sensor_grid": list(header.sensor_grid[::-1]),
        "sensor_grid_size": _listed(header.sensor_grid_size),
        "laser_grid": list(header.laser_grid[::-1]),
        "laser_grid_size": _listed(header.laser_grid_size),
        "sensor_position": _listed(header.sensor_position),
        "laser_position": _listed(header.laser_position),
        **_time_axis(header),
        **_bounces(header),
        "channels": attributes.get("channels", "grey" if header.sizes["channel"] == 1 else None),
        "frame": attributes.get("frame"),
        "planar_wall": _flag(attributes.get("planar_wall")),
        "hidden_volume_position": _listed(header.hidden_volume_position),
        "hidden_volume_size": _listed(header.hidden_volume_edges),
        **_storage(header),
        **_provenance(attributes),
    }
    return {key: _finite(value) for key, value in summary.items()}


def _time_axis(header: StoredHeader) -> dict[str, object]:
    return {
        "n_bins": header.n_bins,
        "bin_width_opl": header.bin_width_opl,
        "bin_width_ps": opl_to_seconds(header.bin_width_opl) * 1e12,
        "start_opl": header.start_opl,
        "end_opl": header.end_opl,
        "account_first_and_last_bounces": _flag(header.attributes.get("account_first_and_last_bounces")),
    }


def _bounces(header: StoredHeader) -> dict[str, object]:
    known = header.bounces_known
    split = header.split_bounces
    return {
        "bounces": [index + header.first_bounce for index in header.bounce_indices] if known and split else None,
        "split_bounces": split,
        "max_bounces": header.attributes.get("max_bounces"),
    }


def _storage(header: StoredHeader) -> dict[str, object]:
    try:
        size = header.path.stat().st_size
    except OSError as error:  # removed since it was read
        raise FileError(f"{header.path}: cannot be read: {error}") from error
    return {
        "data_shape": list(header.data_shape),
        "dtype": header.dtype,
        "compression": header.compression,
        "has_variance": header.has_variance,
        "size_on_disk": size,
        "size_of_samples": prod(header.data_shape) * header.itemsize,
    }


def _provenance(attributes: Mapping[str, object]) -> dict[str, object]:
    return {
        "engine": attributes.get("render_engine"),
        "samples": attributes.get("samples"),
        "seed": attributes.get("seed"),
        "error_estimate": attributes.get("error_estimate"),
        "error_estimate_per_bounce": _json(attributes.get("error_estimate_per_bounce")),
        "energy": _json(attributes.get("energy")),
        "energy_error_per_bounce": _json(attributes.get("energy_error_per_bounce")),
        "energy_error": attributes.get("energy_error"),
        "unsampled_paths": list(text_list(attributes, UNSAMPLED)) if UNSAMPLED in attributes else None,
        "zero_because": list(text_list(attributes, ZERO)) if ZERO in attributes else None,
        "out_of_window_energy": attributes.get("out_of_window_energy"),
        "seconds": _json(attributes.get("seconds")),
        "created": attributes.get("created"),
        "config_hash": attributes.get("config_hash"),
        "part": _json(attributes.get("part")),
        "written_by": attributes.get("engine"),
        "meshes": _json(attributes.get("meshes")),
        "versions": _json(attributes.get("versions")),
    }


def _json(text: object) -> object:
    if not isinstance(text, str):
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text  # not ours: show it as it is


def _flag(value: object) -> bool | None:
    return bool(value) if isinstance(value, int) else None


def _listed(numbers: tuple[float, ...] | None) -> list[float] | None:
    return None if numbers is None else list(numbers)


def _finite(value: object) -> object:
    """Replace numbers that JSON cannot hold by None."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    return value
