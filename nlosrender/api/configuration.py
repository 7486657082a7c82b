"""A configuration from Python: read, checked, planned."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from nlosrender.config.load import config_of, config_to_dict, load_document
from nlosrender.config.mapping_load import Changes, change_texts, mapping_document
from nlosrender.config.overrides import apply_overrides
from nlosrender.config.sweep_load import Sweep, sweep_of
from nlosrender.config.warnings import config_warnings
from nlosrender.config.yaml_tree import Document
from nlosrender.files.path_argument import path_argument
from nlosrender.scene.item_bounds import item_bounds

if TYPE_CHECKING:
    from nlosrender.analysis.render_plan import RenderPlan
    from nlosrender.config.document import Config
    from nlosrender.scene.meshes.mesh_report import MeshReport


@dataclass(frozen=True, eq=False)
class Configuration:
    """A validated configuration, of one capture or of a sweep; made by :func:`load`.

    Its length is the number of captures. Iterating over a sweep gives the :class:`Config` of each.
    """

    document: Document  # the values, and where they stand
    file: Path | None  # the YAML; None: it was a mapping
    sweep: Sweep | None
    single: Config | None  # the capture, where there is no sweep

    @property
    def config(self) -> Config:
        """The configuration of the one capture, typed and with every default.

        Raises
        ------
        ConfigError
            It is a sweep.
        """
        return config_of(self.document) if self.single is None else self.single

    @property
    def paths(self) -> tuple[Path, ...]:
        """Where the captures are written."""
        return (Path(self.config.output.path),) if self.sweep is None else self.sweep.paths

    def to_dict(self) -> dict[str, object]:
        """Return it as plain values, every default filled in, file names absolute; errors as of ``config``."""
        return config_to_dict(self.config)

    def __len__(self) -> int:
        """Return the number of captures."""
        return 1 if self.sweep is None else len(self.sweep)

    def __iter__(self) -> Iterator[Config]:
        """Yield the configuration of each capture."""
        yield from [self.config] if self.sweep is None else map(self.sweep.config, range(len(self.sweep)))


Source: TypeAlias = str | os.PathLike[str] | Mapping[str, object] | Configuration


def load(source: Source, changes: Changes | Iterable[str] = ()) -> Configuration:
    """Read and validate a configuration.

    Parameters
    ----------
    source
        The name of a YAML file, in which relative file names start at its folder; a mapping with the keys of one, whose
        file names start at the current folder; or what an earlier call returned.
    changes
        Values put over those of the source, by dotted key: ``{"capture.sensor_grid.nx": 16}``. Or texts as ``--set``
        takes them: ``["capture.sensor_grid.nx=16"]``.

    Raises
    ------
    ConfigError
        With every mistake found; ``issues`` has the key of each.
    OptionError
        An argument is of another type.
    """
    if isinstance(source, Configuration):
        document, file = source.document.copy(), source.file
        apply_overrides(document, (*document.overrides, *change_texts(changes)))
    elif isinstance(source, Mapping):
        document, file = mapping_document(source), None
        apply_overrides(document, change_texts(changes))
    else:
        file = path_argument("source", source, "a mapping, a Configuration, or the name of a YAML file")
        document = load_document(file, change_texts(changes))
    sweep = sweep_of(document, item_bounds)
    return Configuration(document, file, sweep, config_of(document) if sweep is None else None)


@dataclass(frozen=True)
class Validation:
    """What there is to say about a configuration without mistakes."""

    configuration: Configuration
    first: Config  # its first capture
    warnings: tuple[str, ...]
    meshes: tuple[MeshReport, ...]  # what was read of mesh files; of a sweep those of its first capture


def validate(source: Source, changes: Changes | Iterable[str] = ()) -> Validation:
    """Check a configuration and read its meshes; nothing is rendered. Parameters as of :func:`load`.

    Raises
    ------
    ConfigError
        With every mistake found.
    """
    configuration = load(source, changes)
    config = next(iter(configuration))
    warnings = tuple(config_warnings(config))
    if not config.scene.has_mesh_files:  # NumPy is imported only for these
        return Validation(configuration, config, warnings, ())
    from nlosrender.scene.read_surfaces import describe_meshes

    with configuration.document.placing_issues():
        read = describe_meshes(config.scene)
    return Validation(configuration, config, (*warnings, *read.warnings), read.meshes)


def plan(source: Source, changes: Changes | Iterable[str] = ()) -> RenderPlan:
    """Say what a render of one capture will do, skip and cost; a short pilot measures the speed.

    Parameters as of :func:`load`. Nothing is written.

    Raises
    ------
    ConfigError, BackendError, RenderError
        As :func:`render`.
    """
    from nlosrender.analysis.render_plan import plan_render

    configuration = load(source, changes)
    with configuration.document.placing_issues():
        return plan_render(configuration.config)
