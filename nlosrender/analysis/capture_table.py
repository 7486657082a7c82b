"""The metadata of a capture as a table for people."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from nlosrender.analysis.stated_error import energies_by_bounce, errors_by_bounce
from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.readable import SHOWN_LENGTH, printable, readable_size

_MAX_LENGTH = {"mesh": 600, "sensor": 600, "WARNING": 600}  # names of materials


def summary_rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return label and text of every line about a capture (``analysis.summary.summarise``)."""
    return [(label, printable(text, _MAX_LENGTH.get(label, SHOWN_LENGTH))) for label, text in _rows(summary) if text]


def _rows(summary: dict[str, Any]) -> list[tuple[str, str]]:
    """Return label and text of every line; an empty text means that the file does not say."""
    legs = {True: "included in time", False: "NOT included in time"}
    is_view = summary["scan_type"] == LINE_OF_SIGHT
    window = f"{_text(summary['start_opl'])} to {_text(summary['end_opl'])} m of optical path"
    bins = f"{summary['n_bins']} bins of {_text(summary['bin_width_opl'])} m ({_text(summary['bin_width_ps'])} ps)"
    edges, center = summary["hidden_volume_size"], _lengths(summary["hidden_volume_position"])
    has_volume = isinstance(edges, list) and any(edges)
    samples = (
        f"{_joined(summary['data_shape'], ' x ')} {summary['dtype']} ({readable_size(summary['size_of_samples'])})"
    )
    variance = ", with variance" if summary["has_variance"] else ""
    return [
        ("file", f"{summary['file']} ({readable_size(summary['size_on_disk'])})"),
        ("PART ONLY", _part(summary["part"])),
        ("scan type", _text(summary["scan_type"])),
        ("pixels" if is_view else "sensor points", _grid(summary, "sensor")),
        ("laser points", "" if is_view else _grid(summary, "laser")),
        ("of a camera", _pixels(summary)),
        ("laser spots", _text(summary["laser_spots"])),
        ("laser", _text(summary["laser_flash"])),
        ("footprint", _text(summary["footprint"])),
        ("camera at" if is_view else "sensor at", _lengths(summary["sensor_position"])),
        ("laser at", "" if is_view else _lengths(summary["laser_position"])),
        ("time axis", f"{bins}, {window}"),
        ("first and last legs", legs.get(summary["account_first_and_last_bounces"], "")),
        ("interactions" if is_view else "bounces", _bounces(summary)),
        ("channels", _text(summary["channels"])),
        ("frame", _text(summary["frame"])),
        ("scene" if is_view else "hidden volume", f"{_joined(edges, ' x ')} m, centre {center}" if has_volume else ""),
        ("data", f"{samples}, compression {summary['compression']}{variance}"),
        ("engine", ": ".join(filter(None, map(_text, (summary["engine"], summary["engine_reason"]))))),
        ("samples per pixel" if is_view else "samples per pair", _text(summary["samples"])),
        ("seed", _text(summary["seed"])),
        ("error estimate", _error(summary)),
        ("error per bounce", errors_by_bounce(_object(summary["error_estimate_per_bounce"]))),
        ("energy", energies_by_bounce(_object(summary["energy"]), _object(summary["energy_error_per_bounce"]))),
        *(("NOT SAMPLED", _text(paths)) for paths in _sequence(summary["unsampled_paths"] or [])),
        *(("ZERO BECAUSE", _text(reason)) for reason in _sequence(summary["zero_because"] or [])),
        *(("WARNING", _text(warning)) for warning in _sequence(summary["warnings"] or [])),
        *(("skipped", _text(work)) for work in _sequence(summary["omitted_work"] or [])),
        ("outside the window", _text(summary["out_of_window_energy"])),
        ("sensor", _sensor(summary["sensor"])),
        *measurement_rows(_object(summary["measurement"])),
        ("corrected for", "" if summary["corrections"] in (None, "none") else _joined(summary["corrections"])),
        ("measured from", _text(summary["measured_from"])),
        ("seconds", _text(summary["seconds"])),
        ("created", _text(summary["created"])),
        ("config hash", _text(summary["config_hash"])),
        ("written by", _text(summary["written_by"])),
        *(("mesh", line) for line in _meshes(summary["meshes"])),
        ("versions", _text(summary["versions"])),
        ("check", _verdict(summary)),
        *(("differs", str(difference)) for difference in summary.get("deviations", ())),
    ]


def _pixels(summary: dict[str, Any]) -> str:
    """Return how many points of a camera are empty, and how many the laser does not reach."""
    if summary["empty_sensor_points"] is None:
        return ""
    counts = f"{summary['empty_sensor_points']} of its pixels see nothing"
    unlit = summary["unlit_laser_points"]
    return f"{counts}, {unlit} laser points are hidden from the laser" if unlit else counts


def measurement_rows(found: Mapping[str, object]) -> list[tuple[str, str]]:
    """Return label and text of what a detector counted (``files.measured``); nothing where there are no counts."""
    if not found:
        return []
    number = {key: value if isinstance(value, (int, float)) else None for key, value in found.items()}

    def text(key: str, form: str = ".4g", unit: str = "") -> str:
        value = number.get(key)
        return "unknown" if value is None else f"{value:{form}}{unit}"

    ratio = number.get("signal_to_background")
    return [
        (
            "counts",
            f"{text('counts')}, {text('counts_per_histogram')} per histogram; expected {text('expected_counts')}",
        ),
        (
            "photons",
            f"{text('photons_per_pulse')} per pulse and histogram, {text('pulses', '.6g')} pulses "
            f"(scale {text('scale', '.6g')} photons per unit of data)",
        ),
        (
            "detections",
            f"{text('detections_per_pulse')} per pulse, brightest histogram {text('detections_per_pulse_brightest')}",
        ),
        ("lost to pile-up", text("lost_to_pile_up", ".3%")),
        ("signal/background", "no background" if ratio is None else f"{ratio:.4g}"),
        ("outside the bins", text("outside_the_bins", ".3%", " of the photons")),
        (
            "response",
            f"{text('response_fwhm_opl')} m at half maximum, mean delay {text('response_mean_delay_opl', '.3g')} m"
            if number.get("response_fwhm_opl")
            else "",
        ),
    ]


def _verdict(summary: dict[str, Any]) -> str:
    if "violations" not in summary:
        return ""
    if summary["violations"]:
        return "FAILED, see below"
    if summary["complete"]:
        return "matches the Z-NLOS layout, all samples finite"
    return "readable Z-NLOS by another writer, all samples finite; from what nlosrender writes it"


def _part(part: object) -> str:
    if not isinstance(part, dict):
        return ""
    lasers, tiles = _sequence(part.get("lasers")), _sequence(part.get("sensor_tiles"))
    shown = "; ".join(f"rows {t[0]}:{t[1]} columns {t[2]}:{t[3]}" for t in tiles if isinstance(t, list) and len(t) == 4)
    return f"lasers {_joined(lasers, ':')}, sensor {shown}; nlosrender merge puts parts together"


def _bounces(summary: dict[str, Any]) -> str:
    if isinstance(summary["bounces"], list):
        listed = _joined(summary["bounces"])
    else:
        listed = "" if summary["split_bounces"] is None else "all in one"
    limit = _text(summary["max_bounces"])
    return listed + (f" (highest rendered: {limit})" if listed and limit else "")


def _grid(summary: Mapping[str, Any], name: str) -> str:
    points, size = summary[f"{name}_grid"], summary[f"{name}_grid_size"]
    is_list = name in _sequence(summary["point_lists"])
    shown = f"a list of {_text(points[0])}" if is_list else _joined(points, " x ")
    # a single point, and a camera's points in no plane, have no extent
    return shown + (f" over {_joined(size, ' x ')} m" if size and any(_sequence(size)) else "")


def _lengths(position: object) -> str:
    return f"({_joined(position)}) m" if position else ""


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


def _error(summary: dict[str, Any]) -> str:
    error = summary["error_estimate"]
    if error is None and summary["unsampled_paths"]:
        return "unknown: light is missing"
    if error is None and summary["zero_because"]:
        return "unknown: H is zero everywhere"
    return f"{100 * error:.3g} % (relative L2)" if isinstance(error, (int, float)) else _text(error)


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_text(entry)}" for name, entry in value.items())
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def _joined(values: object, separator: str = ", ") -> str:
    return separator.join(_text(value) for value in _sequence(values))


def _sensor(sensor: object) -> str:
    """Return the keys of a sensor that differ from their defaults, with their values."""
    from nlosrender.config.sensor import SensorConfig

    fields = SensorConfig.model_fields
    given = {key: value for key, value in _object(sensor).items() if key in fields and value is not None}
    changed = {key: value for key, value in given.items() if _as_json(fields[key].default) != value}
    return json.dumps(_without_none(changed))[1:-1].replace('"', "")


def _as_json(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value


def _without_none(value: object) -> object:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value


def _sequence(value: object) -> Sequence[object]:
    return value if isinstance(value, (list, tuple)) else [value]


def _object(value: object) -> dict[str, object]:
    return value if isinstance(value, dict) else {}
