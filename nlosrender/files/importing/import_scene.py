"""``nlosrender import``: a scene file of mitransient or y-tal -> the text of a configuration, checked."""

from __future__ import annotations

from pathlib import Path

import yaml

from nlosrender.config.foreign_scenes import is_xml
from nlosrender.config.load import parse_config
from nlosrender.config.yaml_tree import MAX_BYTES, read_document
from nlosrender.errors import ConfigError, OptionError
from nlosrender.files.importing.mitransient_scene import translate_xml
from nlosrender.files.importing.translation import Translation
from nlosrender.files.importing.ytal_scene import translate_yaml

_SECTIONS = ("name", "scene", "capture", "time_axis", "render")
_WIDTH = 120  # characters of a line


def import_scene(
    source: Path, target: Path, laser: tuple[float, float] | None = None, meshes: Path | None = None
) -> tuple[Translation, str]:
    """Read a scene file of another renderer.

    Parameters
    ----------
    source
        XML of mitransient, or YAML of y-tal.
    target
        The configuration's file, whose folder relative names start from; it is not written.
    laser
        Where the laser of a single scan hits, wall coordinates (x, y) [m], instead of where the file's looks.
    meshes
        A folder where y-tal's mesh names start, tried first.

    Returns
    -------
    tuple
        What became of every key, with the mistakes found; and the configuration's YAML, valid where there are none.

    Raises
    ------
    ConfigError
        The file cannot be read, or is neither.
    OptionError
        ``laser`` is given for a scan with many laser points.
    """
    try:
        with source.open("rb") as file:
            text = file.read(MAX_BYTES + 1).decode("utf-8-sig", "replace")
    except OSError as error:
        raise ConfigError.of_file(str(source), f"cannot be read: {error.strerror}.") from error
    translation = Translation(source, target.absolute().parent)
    if is_xml(text) or source.suffix.lower() == ".xml":
        translate_xml(translation, laser)
    else:
        document = read_document(text, str(source), source.absolute().parent)
        if document.issues or not isinstance(document.tree, dict):
            what = "no scene of y-tal, which is a mapping with geometry and relay_wall, and no XML of mitransient."
            raise ConfigError(document.issues or ConfigError.of_file(translation.start, what).issues)
        folders = (meshes, source.parent, source.absolute().parent.parent, Path.cwd())
        translate_yaml(translation, document, laser, [folder for folder in folders if folder is not None])
    scan = translation.config.get("capture", {}).get("scan_type")
    if laser is not None and scan not in ("single", None):
        raise OptionError(f"--laser: a {scan} capture has no single laser point.")
    content = _text(translation)
    if not translation.issues:
        try:
            parse_config(content, str(target), translation.folder)
        except ConfigError as error:
            translation.issues += [translation.placed(issue) for issue in error.issues]
    return translation, content


def _text(translation: Translation) -> str:
    config = {key: translation.config[key] for key in _SECTIONS if key in translation.config}
    text = yaml.safe_dump(config, sort_keys=False, default_flow_style=None, width=_WIDTH, allow_unicode=True)
    lines = text.split("\n")
    for key, remark in translation.remarks.items():
        lines = [f"{line}  # {remark}" if f"{key}:" in line else line for line in lines]
    source = "".join(character for character in translation.source.name if character.isprintable())
    return "\n".join([f"# From {source}, by nlosrender import. Lengths in metres.", *lines])
