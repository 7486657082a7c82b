"""Where a capture comes from, as attributes: enough to render it again and to judge it."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nlosrender.scene.meshes.mesh_report import MeshReport

PACKAGES = ("nlosrender", "mitsuba", "drjit", "numpy", "h5py")


def provenance_attributes(
    resolved_config: Mapping[str, object],
    config_hash: str,
    *,
    engine: str | None = None,
    seed: int | None = None,
    meshes: Sequence[MeshReport] = (),
    created: datetime | None = None,
    samples: int | None = None,
    error_estimate: float | None = None,
    seconds: Mapping[str, float] | None = None,
    out_of_window_energy: float | Sequence[float] | None = None,
) -> dict[str, object]:
    """Return the attributes that say how a capture was made.

    Parameters
    ----------
    resolved_config
        The configuration with all defaults filled in, plain and JSON-able.
    config_hash
        Its hash.
    engine
        Name of the engine that rendered. Stored as ``render_engine``: ``engine`` names the program.
    seed
        Seed of the random numbers.
    meshes
        What was read of mesh files.
    created
        Time of creation, with its time zone; now when omitted.
    samples, error_estimate, seconds, out_of_window_energy
        As in :func:`result_attributes`, when they are known already.

    Returns
    -------
    dict
        Text and numbers, for ``CaptureWriter``.

    Raises
    ------
    ValueError
        ``created`` has no time zone.
    TypeError
        ``resolved_config`` holds something JSON does not know.
    """
    created = created or datetime.now(UTC)
    if created.tzinfo is None:
        raise ValueError(f"created: got {created.isoformat()} without a time zone, need one")
    attributes: dict[str, object] = {
        "config": json.dumps(resolved_config, ensure_ascii=False),
        "config_hash": config_hash,
        "versions": json.dumps(package_versions()),
        "created": created.astimezone(UTC).isoformat(timespec="seconds"),
    }
    if engine is not None:
        attributes["render_engine"] = engine
    if seed is not None:
        attributes["seed"] = seed
    if meshes:
        attributes["meshes"] = json.dumps([asdict(mesh) for mesh in meshes], ensure_ascii=False)
    return attributes | result_attributes(
        samples=samples, error_estimate=error_estimate, seconds=seconds, out_of_window_energy=out_of_window_energy
    )


def result_attributes(
    *,
    samples: int | None = None,
    error_estimate: float | None = None,
    seconds: Mapping[str, float] | None = None,
    out_of_window_energy: float | Sequence[float] | None = None,
    energy: Mapping[str, float] | None = None,
    error_estimate_per_bounce: Mapping[str, float | None] | None = None,
    energy_error_per_bounce: Mapping[str, float | None] | None = None,
    energy_error: float | None = None,
) -> dict[str, object]:
    """Return what is known when a render ends, for ``CaptureWriter.set_attributes``; None is left out.

    Parameters
    ----------
    samples
        Paths per pair of laser and sensor point.
    error_estimate
        Estimated relative L2 error of H over the whole capture; NaN: not known.
    seconds
        Time spent in each stage [s].
    out_of_window_energy
        Light that arrived before the first or after the last bin, summed over all points: one number or one per
        bounce [J m^-2 sr^-1].
    energy
        H summed over all samples, by bounce number [J m^-2 sr^-1].
    error_estimate_per_bounce
        Estimated relative L2 error of H, by bounce number; None: not known, or no light.
    energy_error_per_bounce, energy_error
        Estimated standard error of ``energy``, by bounce number and of all of it [J m^-2 sr^-1]; None and NaN: not
        known.
    """
    known = {
        "samples": samples,
        "error_estimate": error_estimate,
        "seconds": None if seconds is None else json.dumps({stage: float(spent) for stage, spent in seconds.items()}),
        "out_of_window_energy": out_of_window_energy,
        "energy": None if energy is None else json.dumps(dict(energy)),
        "error_estimate_per_bounce": _json(error_estimate_per_bounce),
        "energy_error_per_bounce": _json(energy_error_per_bounce),
        "energy_error": energy_error,
    }
    return {name: value for name, value in known.items() if value is not None}


def _json(errors: Mapping[str, float | None] | None) -> str | None:
    return None if errors is None else json.dumps(dict(errors), allow_nan=False)


def package_versions() -> dict[str, str]:
    """Return the versions of this program and what its numbers depend on, without importing any of it."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions
