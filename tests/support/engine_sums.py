"""The two engines against each other: sums over bins, rows and captures, by Welch's t test over independent seeds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from nlosrender.engine.interface import Budget
from support.agreement import grouped, t_limit
from support.engines import in_bins
from support.varied_scenes import Repeated

Array = NDArray[np.float64]
# Energy of the third bounce: its discretisation error is up to 0.35 % of H (L2) of the 1 % that is asked for, and
# adds up over bins to less.
ENERGY_FLOOR = 0.003
# Rays start 1e-4 engine units off a surface, in either engine, but not at the same vertices; float32 within a path.
FURTHER_FLOOR = 1e-3
# Blur of VPL histograms, which round delays to half a bin: a variance of 1/24 bin^2 adds 1/48 of the second difference.
# Twice that, for higher orders.
BLUR = 1 / 24
# Share of the capture's sum: float32 cosines of a surface seen edge on are not quite 0, where no path arrives.
GRAZING = 1e-12
SHARE = 0.1  # bins are joined until they hold this share of their row


@dataclass(frozen=True, eq=False)
class Sums:
    """One sum per seed (seed, n) from each engine, and what may differ between them beyond noise (n,)."""

    lights: Array
    paths: Array
    floor: Array

    def worst(self) -> tuple[float, int]:
        """Return the largest Welch t, as the |t| of a normal number that is exceeded as rarely, and how many sums."""
        stated = (self.lights.std(axis=0) > 0) | (self.paths.std(axis=0) > 0)
        lights, paths = self.lights[:, stated], self.paths[:, stated]
        if not stated.any():
            return 0.0, 1
        own, other = (values.var(axis=0, ddof=1) / len(values) for values in (lights, paths))
        excess = np.abs(lights.mean(axis=0) - paths.mean(axis=0)) - self.floor[stated]
        t = np.maximum(excess, 0) / np.sqrt(own + other)
        # Welch-Satterthwaite
        freedom = (own + other) ** 2 / (own**2 / (len(lights) - 1) + other**2 / (len(paths) - 1))
        return float(stats.norm.isf(stats.t.sf(t, freedom)).max()), int(stated.sum())


def finer(engine: Any, target_error: float) -> Any:
    """Return the budget of a ninth of the error.

    What is stated is the error of all bins together. Of single sums it is a few times that, one to a few percent, which
    paths of minutes resolve; a ninth of it is below their noise. Calibrated, not scaled: the divisor of differences is
    that of two resolutions. Light above the third bounce is in bins of its own, not in time steps: what these change is
    part of the error of all bins together, and of some of them more than paths resolve.
    """
    return in_bins(engine.calibrate(Budget(target_error=target_error / 9)))


def rows(values: Array) -> Array:
    """Return (seed, channel, laser, sensor, ...) as (seed, row, ...)."""
    return values.reshape(values.shape[0], -1, *values.shape[4:])


def group_sums(lights: Repeated, paths: Repeated, slot: int, is_third: bool) -> Sums:
    """Sums over neighbouring bins of every row, each at least ``SHARE`` of the row, and over whole rows."""
    ours, theirs, stated = (
        rows(values[:, :, slot]) for values in (lights.means, paths.means, np.sqrt(lights.variances))
    )
    relative = float(np.linalg.norm(stated) / np.linalg.norm(ours))  # L2, what is stated
    columns: list[tuple[Array, Array, float]] = []
    for row in range(ours.shape[1]):
        both = ours[:, row].mean(axis=0) + theirs[:, row].mean(axis=0)
        if not both.any():
            continue
        labels = grouped(both, SHARE)
        bend = np.diff(np.pad(theirs[:, row].mean(axis=0), 1), 2)
        for chosen in [*(labels == label for label in range(labels.max() + 1)), labels >= 0]:
            value, other = ours[:, row, chosen].sum(axis=1), theirs[:, row, chosen].sum(axis=1)
            # the third bounce is as good as it says itself, bin by bin; over all where resolutions agree by chance
            floor = 2 * max(stated[:, row, chosen].mean(axis=0).sum(), relative * other.mean()) if is_third else 0.0
            if not is_third:
                floor = BLUR * np.abs(bend[chosen]).sum() + GRAZING * theirs.sum() / len(theirs)
            columns.append((value, other, max(floor, FURTHER_FLOOR * other.mean())))
    return Sums(*(np.array(column).T for column in zip(*columns, strict=True)))


def energies(lights: Repeated, paths: Repeated) -> Sums:
    """Sums over the whole capture, one per channel and bounce index."""
    ours, theirs = (values.means.sum(axis=(3, 4, 5)).reshape(len(values.means), -1) for values in (lights, paths))
    return Sums(ours, theirs, ENERGY_FLOOR * theirs.mean(axis=0))


def assert_alike(sums: Sums, what: str) -> None:
    """No sum differs by more than chance allows, over all of them."""
    worst, n = sums.worst()
    limit = t_limit(n, 10**6)  # of normal numbers
    assert worst <= limit, f"{what}: {worst:.1f} > {limit:.1f} standard deviations over {n} sums"
