"""Scene files of other renderers, told apart from a configuration: ``nlosrender import`` makes one of them."""

from __future__ import annotations

import re
from collections.abc import Mapping

_XML = re.compile(r"\s*<(\?xml|!--|!DOCTYPE|scene\b)")
_YTAL = {"geometry", "mitsuba_variant", "num_bins", "relay_wall", "sample_count", "scan_type", "sensor_width"}
_LIKELY = 2  # of y-tal's keys: one may be a key of ours in the wrong place


def is_xml(text: str) -> bool:
    """Return whether a text begins as a Mitsuba scene does."""
    return _XML.match(text) is not None


def advice_to_import(text: str, tree: object, file: str) -> str | None:
    """Return what to say of a scene file of another renderer; None for what may be a configuration.

    Parameters
    ----------
    text
        The file's.
    tree
        The values in it, if it is YAML.
    file
        Its name.
    """
    kind = "a Mitsuba scene in XML" if is_xml(text) else None
    if isinstance(tree, Mapping) and not {"scene", "capture"} & {*tree} and len(_YTAL & {*tree}) >= _LIKELY:
        kind = "a scene of y-tal"
    command = f"nlosrender import {file} -o capture.yaml"
    return f"this is {kind}, no configuration; {command} makes one of it." if kind else None
