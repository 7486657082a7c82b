"""What a capture file holds, from its metadata alone: as quick for a terabyte as for a kilobyte."""

from __future__ import annotations

import json
from math import prod
from pathlib import Path

from nlosrender.analysis.json_values import finite_or_none
from nlosrender.constants import opl_to_seconds
from nlosrender.errors import FileError
from nlosrender.files import layout
from nlosrender.files.attributes import text_list
from nlosrender.files.capture_results import OMITTED, UNSAMPLED, WARNINGS, ZERO
from nlosrender.files.reading.reader import read_header

# keys of the summary that are attributes of the file, as text, number or JSON
_ATTRIBUTES = {"engine": "render_engine", "engine_reason": "engine_reason", "written_by": "engine"} | {
    name: name
    for name in (
        *(
            "samples",
            "seed",
            "target_missed",
            "error_estimate",
            "error_estimate_per_bounce",
            "energy",
            "energy_error_per_bounce",
        ),
        *("energy_error", "out_of_window_energy", "seconds", "created", "config_hash", "part", "meshes", "versions"),
        *("sensor", "measurement", "corrections", "measured_from", "ideal_error_estimate"),
    )
}


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
    try:
        size = header.path.stat().st_size
    except OSError as error:  # removed since it was read
        raise FileError(f"{path}: cannot be read: {error}") from error
    apart = header.bounces_known and header.split_bounces
    summary = {
        "file": str(path),
        "scan_type": header.scan_type,
        "sensor_grid": list(header.sensor_grid[::-1]),
        "sensor_grid_size": _listed(header.sensor_grid_size),
        "laser_grid": list(header.laser_grid[::-1]),
        "laser_grid_size": _listed(header.laser_grid_size),
        "point_lists": [name for name in ("sensor", "laser") if header.is_list(name)],
        "laser_spots": header.attributes.get("laser_spots"),
        "laser_flash": header.attributes.get("laser_flash"),
        "footprint": None if header.footprint is None else header.footprint[0],
        "sensor_position": _listed(header.sensor_position),
        "laser_position": _listed(header.laser_position),
        "n_bins": header.n_bins,
        "bin_width_opl": header.bin_width_opl,
        "bin_width_ps": opl_to_seconds(header.bin_width_opl) * 1e12,
        "start_opl": header.start_opl,
        "end_opl": header.end_opl,
        "account_first_and_last_bounces": _flag(attributes.get("account_first_and_last_bounces")),
        "bounces": [index + header.first_bounce for index in header.bounce_indices] if apart else None,
        "split_bounces": header.split_bounces,
        "max_bounces": attributes.get("max_bounces"),
        "channels": attributes.get("channels", "grey" if header.sizes["channel"] == 1 else None),
        "frame": attributes.get("frame"),
        "planar_wall": _flag(attributes.get("planar_wall")),
        **{name: attributes.get(name) for name in (layout.EMPTY_POINTS, layout.UNLIT_POINTS)},
        "hidden_volume_position": _listed(header.hidden_volume_position),
        "hidden_volume_size": _listed(header.hidden_volume_edges),
        "data_shape": list(header.data_shape),
        "dtype": header.dtype,
        "compression": header.compression,
        "has_variance": header.has_variance,
        "size_on_disk": size,
        "size_of_samples": prod(header.data_shape) * header.itemsize,
        **{
            name: list(text_list(attributes, name)) if name in attributes else None
            for name in (UNSAMPLED, ZERO, WARNINGS, OMITTED)
        },
        **{key: _unpacked(attributes.get(name)) for key, name in _ATTRIBUTES.items()},
    }
    return finite_or_none(summary)


def _unpacked(value: object) -> object:
    """Return the content of JSON text; any other value as it is."""
    try:
        return json.loads(value) if isinstance(value, str) and value[:1] in ("{", "[") else value
    except (ValueError, RecursionError):
        return value  # another writer's


def _flag(value: object) -> bool | None:
    return bool(value) if isinstance(value, int) else None


def _listed(numbers: tuple[float, ...] | None) -> list[float] | None:
    return None if numbers is None else list(numbers)
