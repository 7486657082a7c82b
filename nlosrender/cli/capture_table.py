"""The metadata of a capture as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.cli.stated_error import energies_by_bounce, errors_by_bounce
from nlosrender.readable import readable_size

SHOWN_LENGTH = 160  # characters of one value in the table; --json has all of it
_MAX_LENGTH = {"mesh": 600}  # names of materials


def summary_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return label and text of every line about a capture (``analysis.summary.summarise``)."""
    return [(label, printable(text, _MAX_LENGTH.get(label, SHOWN_LENGTH))) for label, text in _rows(summary) if text]


def _rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return label and text of every line; an empty text means that the file does not say."""
    legs = {True: "included in time", False: "NOT included in time"}
    is_view = summary["scan_type"] == LINE_OF_SIGHT
    differences = _sequence(summary.get("deviations") or [])
    return [
        ("file", f"{summary['file']} ({readable_size(summary['size_on_disk'])})"),
        ("PART ONLY", _part(summary["part"])),
        ("scan type", _text(summary["scan_type"])),
        ("pixels" if is_view else "sensor points", _grid(summary["sensor_grid"], summary["sensor_grid_size"])),
        ("laser points", "" if is_view else _grid(summary["laser_grid"], summary["laser_grid_size"])),
        ("camera at" if is_view else "sensor at", _lengths(summary["sensor_position"])),
        ("laser at", "" if is_view else _lengths(summary["laser_position"])),
        ("time axis", _time_axis(summary)),
        ("first and last legs", legs.get(summary["account_first_and_last_bounces"], "")),
        ("interactions" if is_view else "bounces", _bounces(summary)),
        ("channels", _text(summary["channels"])),
        ("frame", _text(summary["frame"])),
        ("scene" if is_view else "hidden volume", _hidden_volume(summary)),
        ("data", _storage(summary)),
        ("engine", _text(summary["engine"])),
        ("samples per pixel" if is_view else "samples per pair", _text(summary["samples"])),
        ("seed", _text(summary["seed"])),
        ("error estimate", _error(summary)),
        ("error per bounce", errors_by_bounce(_object(summary["error_estimate_per_bounce"]))),
        ("energy", energies_by_bounce(_object(summary["energy"]), _object(summary["energy_error_per_bounce"]))),
        *(("NOT SAMPLED", _text(paths)) for paths in _sequence(summary["unsampled_paths"] or [])),
        *(("ZERO BECAUSE", _text(reason)) for reason in _sequence(summary["zero_because"] or [])),
        ("outside the window", _text(summary["out_of_window_energy"])),
        ("seconds", _named(summary["seconds"])),
        ("created", _text(summary["created"])),
        ("config hash", _text(summary["config_hash"])),
        ("written by", _text(summary["written_by"])),
        *(("mesh", line) for line in _meshes(summary["meshes"])),
        ("versions", _named(summary["versions"])),
        ("check", _verdict(summary)),
        *(("differs", str(difference)) for difference in differences),
    ]


def _verdict(summary: dict[str, Any]) -> str:
    """Return the outcome of a check in words; empty without one."""
    if "violations" not in summary:
        return ""
    if summary["violations"]:
        return "FAILED, see below"
    if summary["complete"]:
        return "matches the Z-NLOS layout, all samples finite"
    return "readable Z-NLOS by another writer, all samples finite; from what nlosrender writes it"


def _part(part: object) -> str:
    """Return which part of a capture the file holds; empty for a whole one."""
    if not isinstance(part, dict):
        return ""
    lasers, tiles = _sequence(part.get("lasers")), _sequence(part.get("sensor_tiles"))
    shown = "; ".join(f"rows {t[0]}:{t[1]} columns {t[2]}:{t[3]}" for t in tiles if isinstance(t, list) and len(t) == 4)
    return f"lasers {':'.join(str(bound) for bound in lasers)}, sensor {shown}; nlosrender merge puts parts together"


def _time_axis(summary: dict[str, Any]) -> str:
    window = f"{_text(summary['start_opl'])} to {_text(summary['end_opl'])} m of optical path"
    bins = f"{_text(summary['bin_width_opl'])} m ({_text(summary['bin_width_ps'])} ps)"
    return f"{summary['n_bins']} bins of {bins}, {window}"


def _bounces(summary: dict[str, Any]) -> str:
    if isinstance(summary["bounces"], list):
        listed = ", ".join(str(bounce) for bounce in summary["bounces"])
    else:
        listed = "" if summary["split_bounces"] is None else "all in one"
    limit = _text(summary["max_bounces"])
    return listed + (f" (highest rendered: {limit})" if listed and limit else "")


def _hidden_volume(summary: dict[str, Any]) -> str:
    edges, center = summary["hidden_volume_size"], summary["hidden_volume_position"]
    if not isinstance(edges, list) or not any(edges):
        return ""
    return f"{' x '.join(_text(edge) for edge in edges)} m, centre {_lengths(center)}"


def _storage(summary: dict[str, Any]) -> str:
    shape = " x ".join(str(length) for length in _sequence(summary["data_shape"]))
    variance = ", with variance" if summary["has_variance"] else ""
    size = readable_size(summary["size_of_samples"])
    return f"{shape} {summary['dtype']} ({size}), compression {summary['compression']}{variance}"


def _grid(points: object, size: object) -> str:
    extent = f" over {' x '.join(_text(length) for length in _sequence(size))} m" if size else ""
    return " x ".join(str(number) for number in _sequence(points)) + extent


def _lengths(position: object) -> str:
    return f"({', '.join(_text(length) for length in _sequence(position))}) m" if position else ""


def _meshes(meshes: object) -> list[str]:
    """Return a line for each mesh; as it stands where it is not ours."""
    from nlosrender.scene.meshes.mesh_report import MAX_LINES, MeshReport

    lines, rest = [], len(_sequence(meshes)) - MAX_LINES
    for mesh in _sequence(meshes)[:MAX_LINES]:
        try:
            lines.append(MeshReport(**mesh).line())  # type: ignore[arg-type]
        except (TypeError, ValueError, AttributeError):
            lines.append(_text(mesh))
    return [*lines, f"and {rest} more, which --json has"] if rest > 0 else lines


def _named(values: object) -> str:
    return (
        ", ".join(f"{name} {_text(value)}" for name, value in values.items())
        if isinstance(values, dict)
        else _text(values)
    )


def _object(value: object) -> dict[str, object]:
    return value if isinstance(value, dict) else {}


def _error(summary: dict[str, Any]) -> str:
    if summary["error_estimate"] is None and summary["unsampled_paths"]:
        return "unknown: light is missing"
    if summary["error_estimate"] is None and summary["zero_because"]:
        return "unknown: H is zero everywhere"
    return _percent(summary["error_estimate"])


def _percent(value: object) -> str:
    return f"{100 * value:.3g} % (relative L2)" if isinstance(value, (int, float)) else _text(value)


def _text(value: object) -> str:
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def _sequence(value: object) -> Sequence[object]:
    return value if isinstance(value, (list, tuple)) else [value]


def printable(text: object, max_length: int = SHOWN_LENGTH) -> str:
    """Return text from a file as one line that is safe to print."""
    # attributes are anybody's: control characters would reach the terminal
    shown = "".join(character if character.isprintable() else ascii(character)[1:-1] for character in str(text))
    return shown if len(shown) <= max_length else shown[:max_length] + " ..."
