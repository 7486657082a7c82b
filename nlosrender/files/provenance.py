"""Provenance of a capture as attributes: enough to render it again and to judge it."""

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
) -> dict[str, object]:
    """Return the attributes that say how a capture was made.

    Parameters
    ----------
    resolved_config, config_hash
        The configuration with all defaults filled in, plain and JSON-able; its hash.
    engine, seed
        Name of the engine that rendered, stored as ``render_engine`` (``engine`` names the program); seed of the random
        numbers.
    meshes
        What was read of mesh files.
    created
        Time of creation, with its time zone; now when omitted.

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
    return attributes


def package_versions(packages: Sequence[str] = PACKAGES) -> dict[str, str]:
    """Return the versions of Python and of ``packages``, this program among them, without importing any."""
    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions
