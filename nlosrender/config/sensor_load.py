"""The sensor of ``nlosrender measure``: a profile, a YAML file, or that of a capture, with ``--set`` over it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from nlosrender.config.load import in_order, load_document, validated
from nlosrender.config.mapping_load import mapping_document
from nlosrender.config.overrides import apply_overrides
from nlosrender.config.sensor import SensorConfig, profile_names
from nlosrender.config.yaml_tree import Document, Place
from nlosrender.errors import ConfigError


def load_sensor(
    name: str | Mapping[str, object] | None, known: SensorConfig | None, overrides: Sequence[str]
) -> SensorConfig:
    """Return a validated sensor.

    Parameters
    ----------
    name
        A profile, or a YAML file: a configuration with a section ``sensor``, or the keys of one alone, which a mapping
        has, too.
    known
        The sensor without a name.
    overrides
        ``sensor.KEY=VALUE`` each.

    Raises
    ------
    ConfigError
        With every issue found.
    """
    if isinstance(name, Mapping):
        document = mapping_document({"sensor": name})
    elif name is not None and name not in profile_names() and Path(name).suffix in (".yaml", ".yml"):
        document = load_document(Path(name))
        if "sensor" not in document.tree:
            document.tree = {"sensor": document.tree}
            document.places = {("sensor", *path): place for path, place in document.places.items()}
    else:
        values = {"profile": name} if name is not None else known.model_dump(mode="json") if known else {}
        source = f"--sensor {name}" if name is not None else "sensor of the capture"
        document = Document(source, Path.cwd(), "sensor", places={(): Place(source, source)})
        document.tree = {"sensor": {key: value for key, value in values.items() if value is not None}}
    apply_overrides(document, overrides)
    sensor, found = validated(SensorConfig, document.tree["sensor"], document, ("sensor",))
    if found or document.issues:
        raise ConfigError(in_order(found, document))
    return sensor
