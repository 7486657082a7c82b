"""Identity of a capture: what has to agree for one render to continue, or complete, another."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from nlosrender.capture.part import WHOLE
from nlosrender.config.canonical import tree_hash
from nlosrender.config.mitsuba_xml import named_files, read_mitsuba_xml
from nlosrender.files.layout import FORMAT_VERSION
from nlosrender.files.provenance import package_versions

# Where a capture is written and what it is rendered on say nothing about its samples; the backend that was used is
# told by the Mitsuba variant.
# The sensor counts what has been rendered: another one goes on with the same render.
MEASURED_AFTERWARDS = "sensor"
NOT_THE_CAPTURE = (("output", "path"), ("render", "memory_limit"), ("render", "backend"))
PACKAGES = ("nlosrender", "mitsuba", "drjit")  # whose versions the samples depend on
FILE_KEYS = ("filename", "file")  # of meshes, textures, spectra; of lists of points
SCENE_KEY = "mitsuba"  # of a whole scene, which names files of its own
KEPT_DIGESTS = 65536  # of meshes, which the captures of a dataset share
MAX_LISTED = 6  # differences in one message
SELECTION = "part_selection"  # attribute of a file that holds a part: the option that selected it


def capture_identity(resolved_config: Mapping[str, Any], part: str, variant: str, replicas: int) -> dict[str, Any]:
    """Return all that has to agree for a render to go on with an earlier one.

    Parameters
    ----------
    resolved_config
        The configuration with all defaults filled in, plain and JSON-able.
    part, variant
        Which part of the capture is rendered, in words; Mitsuba variant.
    replicas
        Independent estimates behind each sensor point; for small grids the number of processors decides.
    """
    installed = package_versions()
    return {
        "config": comparable_config(resolved_config),
        "versions": {package: installed[package] for package in PACKAGES} | {"file layout": str(FORMAT_VERSION)},
        "variant": variant,
        "replicas": replicas,
        "part": part,
    }


def identity_attributes(identity: Mapping[str, Any]) -> dict[str, object]:
    """Return the attributes by which a file tells the capture it is, or is a part of."""
    selected = {} if identity["part"] == str(WHOLE) else {SELECTION: identity["part"]}
    own = {name: identity[name] for name in ("variant", "replicas")}
    return {"capture_hash": tree_hash(identity["config"])} | own | selected


def comparable_config(resolved_config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a resolved configuration without what does not change the samples, and with digests for names of files."""
    kept: dict[str, Any] = {
        section: {key: value for key, value in content.items() if (section, key) not in NOT_THE_CAPTURE}
        if isinstance(content, Mapping)
        else content
        for section, content in resolved_config.items()
        if section != MEASURED_AFTERWARDS
    }
    return {section: _with_digests(section, content) for section, content in kept.items()}


def capture_hash(resolved_config: Mapping[str, Any]) -> str:
    """Return the hash by which files of the same capture are known: their attribute ``capture_hash``."""
    return tree_hash(comparable_config(resolved_config))


def differences(one: Any, other: Any, key: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield (dotted key, value in ``one``, value in ``other``) for everything in which two trees differ."""
    if one == other:
        return
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        for name in [*one, *(name for name in other if name not in one)]:
            yield from differences(one.get(name), other.get(name), f"{key}.{name}" if key else str(name))
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for index, (first, second) in enumerate(zip(one, other, strict=True)):
            yield from differences(first, second, f"{key}.{index}")
    else:
        yield key, _shown(one), _shown(other)


def listed(texts: Sequence[str]) -> str:
    """Return the first few of many differences, and how many more there are."""
    more = f"; and {len(texts) - MAX_LISTED} more" if len(texts) > MAX_LISTED else ""
    return "; ".join(texts[:MAX_LISTED]) + more


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:40]}..."


def _with_digests(key: str, value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _with_digests(name, item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_with_digests("", item) for item in value]
    if isinstance(value, str) and key in FILE_KEYS:
        return _digest(value)
    return _scene_digests(value) if isinstance(value, str) and key == SCENE_KEY else value


def files_read(resolved_config: Any) -> Iterator[str]:
    """Yield the names of the meshes, images, scenes and lists of points that a configuration names."""
    if isinstance(resolved_config, Mapping):
        for key, value in resolved_config.items():
            if isinstance(value, str) and key in (*FILE_KEYS, SCENE_KEY):
                yield value
            else:
                yield from files_read(value)
    elif isinstance(resolved_config, (list, tuple)):
        for item in resolved_config:
            yield from files_read(item)


def _scene_digests(name: str) -> str | list[str]:
    """Return the digest of a Mitsuba scene, and those of the files it names, which may change while it does not."""
    try:
        root, _ = read_mitsuba_xml(Path(name))
    except ValueError:  # the renderer says so, with its place in the YAML
        return _digest(name)
    return [_digest(name), *(_digest(str(file)) for file in named_files(root))]


def _digest(name: str) -> str:
    """Return a digest of a file: the same mesh may lie elsewhere on another machine, or be another one by now."""
    digest = file_digest(Path(name))
    return name if digest is None else f"sha256:{digest}"  # the renderer says so, with its place in the YAML


def file_digest(path: Path) -> str | None:
    """Return the SHA-256 (hex) of a file; None: it cannot be read."""
    try:
        status = path.stat()
        return _sha256(path, status.st_mtime_ns, status.st_size)
    except OSError:
        return None


@functools.lru_cache(KEPT_DIGESTS)
def _sha256(path: Path, changed: int, size: int) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
