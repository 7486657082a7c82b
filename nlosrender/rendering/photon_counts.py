"""Photon counts of the configured sensor, drawn on the complete ideal histograms of a render."""

from __future__ import annotations

import functools

from nlosrender.capture.part import WHOLE, Selection
from nlosrender.config.document import Config
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.rendering.render_report import Stopwatch, Warnings


def photon_counts(
    config: Config, selection: Selection, partial: PartialCapture, stopwatch: Stopwatch, warnings: Warnings
) -> dict[str, object]:
    """Add the dataset of counts to a capture, if a sensor is configured, and return its attributes.

    A part of a capture has none: it is measured once it is merged.

    Raises
    ------
    ConfigError, FileError
        As ``measure_capture``.
    """
    if config.sensor is None or selection != WHOLE:
        return {}
    from nlosrender.files.measured import add_counts  # SciPy takes time to import

    add = functools.partial(add_counts, config=config.sensor, warn=lambda text: warnings.emit([text]))
    with stopwatch.stage("measure"):
        return dict(partial.extend(add))
