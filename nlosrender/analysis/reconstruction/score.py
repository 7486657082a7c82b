"""How well a reconstruction shows the hidden scene: its front view against the true silhouette."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from nlosrender.errors import NlosError

LEVELS = 256  # of the histogram that the threshold is chosen from


@dataclass(frozen=True)
class Score:
    """Agreement of a front view with a silhouette."""

    correlation: float  # Pearson's, over all pixels
    iou: float  # intersection over union of the pixels above the threshold and those covered by half or more
    threshold: float  # Otsu's, as a share of the largest value


def score_front_view(front: ArrayLike, silhouette: ArrayLike) -> Score:
    """Compare a front view (y, x) with the share of each pixel that the true geometry covers (y, x).

    Raises
    ------
    NlosError
        The silhouette or the front view is the same everywhere: nothing can be compared.
    """
    front = np.asarray(front, dtype=np.float64)
    covered = np.asarray(silhouette, dtype=np.float64)
    if np.ptp(covered) == 0:
        what = "covers all of" if covered.any() else "lies outside"
        raise NlosError(f"--score: the hidden geometry {what} the front view, so nothing can be compared")
    if np.ptp(front) == 0:
        raise NlosError("--score: the front view is the same everywhere, so nothing can be compared")
    threshold = otsu_threshold(front)
    bright, true = front > threshold, covered >= 0.5
    union = np.count_nonzero(bright | true)
    return Score(
        correlation=float(np.corrcoef(front.ravel(), covered.ravel())[0, 1]),
        iou=float(np.count_nonzero(bright & true) / union),
        threshold=threshold / float(front.max()),
    )


def otsu_threshold(values: ArrayLike) -> float:
    """Return the threshold that parts ``values`` into the two most compact classes.

    Otsu 1979 (A threshold selection method from gray-level histograms): the largest variance between the classes.
    """
    counts, edges = np.histogram(values, bins=LEVELS)
    middle = (edges[:-1] + edges[1:]) / 2
    below = np.cumsum(counts)[:-1]
    above = below[-1] + counts[-1] - below
    sums = np.cumsum(counts * middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        gap = sums[:-1] / below - (sums[-1] - sums[:-1]) / above
        between = np.where((below > 0) & (above > 0), below * above * gap**2, 0.0)
    return float(edges[1:-1][np.argmax(between)])
