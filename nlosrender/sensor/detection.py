"""From mean photons per pulse to detections: pile-up by a detector that is blind for a while after each detection.

All functions take bins along the first axis and points along the second: r, the mean photons that would be detected
per laser pulse and bin if nothing were lost.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from nlosrender.sensor.rebinning import TimeBins

Float64 = NDArray[np.float64]
MOST_PULSES = 2**53  # of which a float64 counts every one
GAP_CELLS = 64  # between window and next pulse, where only background is detected: its rate changes nowhere quickly
MAX_ROUNDS = 200  # over the period, until what it hands to the next one stays
JOINED = 1e-8  # detections per pulse that it may change by: their relative effect on any count
JOINED_DRAWS = 0.1  # the same of draws, in standard deviations of all pulses' detections, one each
FEW = 1e-3  # detections per pulse and bin: up to there a binomial's variance is a Poisson's to 0.1 %
# Of the bins that fluctuations of the readiness are solved in: fine against the dead time, little light in each
GROUPS_PER_DEAD_TIME, GROUP_LIGHT, LARGEST_GROUP = 64, 0.05, 8
# Detections in a bin are taken to come evenly in it. With more light they do not, after a dead time that is no multiple
# of the bins: 0.3 photons a bin are wrong by up to 2 %, in parts of a bin by less with the square of their width.
EVEN_LIGHT, MOST_PARTS = 0.05, 16
SMALL = 0.02  # below it 1 - (1 - exp(-r)) / r loses digits, and four terms of its series have ten


def first_photon_mean(r: Float64) -> Float64:
    """Return detections per pulse where only the first photon of each pulse is detected."""
    earlier = np.cumsum(r, axis=0)
    return np.exp(r - earlier) * -np.expm1(-r)


def first_photon_counts(r: Float64, pulses: int, random: Generator) -> Float64:
    """Draw counts of ``pulses`` pulses: a multinomial, exactly, bin by bin among the pulses without detection yet."""
    left = np.full(r.shape[1], pulses, np.int64)
    counts = np.empty(r.shape)
    share = -np.expm1(-r)
    for row, probability in zip(counts, share, strict=True):
        found = random.binomial(left, probability)
        left -= found
        row[:] = found
    return counts


def coates(counts: Float64, pulses: float) -> Float64:
    """Return r from counts of the first photon (Coates 1968); inf where no pulse is left, NaN after it."""
    before = pulses - np.cumsum(counts, axis=0) + counts
    with np.errstate(divide="ignore", invalid="ignore"):
        return -np.log1p(-counts / before)


@dataclass(frozen=True, eq=False)
class DeadTime:
    """A free-running detector that is blind for a fixed time after each detection, whatever arrives meanwhile.

    With a(t) the rate of detections, 1 - integral of a from t - dead_time to t is the probability that the detector is
    ready, and a = r (1 - integral): exact, since no two detections lie within one dead time, and linear in a. The
    counts n of N pulses obey the same equation with a term of noise, whose parts in different bins are uncorrelated:
    n = N a + (solution for the noise). So counts are drawn bin by bin from the readiness of the mean, and what their
    fluctuation makes the detector blind for is corrected for by a second solution. That has the variance of the renewal
    process (at constant rate, lambda t / (1 + lambda dead_time)^3), within and across pulses.

    Attributes
    ----------
    bins
        The detector's bins.
    dead_time
        In metres of optical path, of any length.
    period
        From pulse to pulse [m], at least the bins' extent; infinite: the detector is ready when the bins begin.
    group
        Bins that are one cell.
    """

    bins: TimeBins
    dead_time: float
    period: float = math.inf
    group: int = 1

    @cached_property
    def _edges(self) -> Float64:
        """Of the cells: the bins, in groups, and ``GAP_CELLS`` of the rest of the period."""
        edges = np.append(self.bins.edges[: -1 : self.group], self.bins.end)
        gap = self.period - (self.bins.end - self.bins.start)
        if math.isinf(gap) or gap <= 1e-9 * self.bins.width:
            return edges
        return np.concatenate([edges, self.bins.end + np.arange(1, GAP_CELLS + 1) * (gap / GAP_CELLS)])

    def with_gap(self, r: Float64, background: float) -> Float64:
        """Return r of the bins continued over the rest of the period, where ``background`` photons a metre arrive."""
        rest = np.diff(self._edges)[len(r) :, None] * background
        return np.concatenate([r, np.broadcast_to(rest, (len(rest), r.shape[1]))])

    def mean(self, r: Float64, tolerance: float = JOINED) -> Float64:
        """Return detections per pulse; r and they are (cells of the period, points), as from ``with_gap``."""
        parts = min(math.ceil(float(r.max(initial=0.0)) / EVEN_LIGHT), MOST_PARTS)
        if parts > 1:
            fine = replace(self, bins=TimeBins(self.bins.start, self.bins.width / parts, self.bins.count * parts))
            light = np.concatenate([np.repeat(r[: self.bins.count] / parts, parts, axis=0), r[self.bins.count :]])
            found = fine._mean(light, tolerance)
            return _row_sums(found, np.r_[: self.bins.count * parts : parts, self.bins.count * parts : len(found)])
        return self._mean(r, tolerance)

    def _mean(self, r: Float64, tolerance: float) -> Float64:
        widths = np.diff(self._edges)[:, None]
        return self._solve(r, -np.expm1(-r), _cumulated(r / (1 + r * (self.dead_time / widths))), tolerance)

    def counts(self, r: Float64, pulses: int, random: Generator) -> Float64:
        """Draw counts of ``pulses`` pulses, (cells of the period, points)."""
        # of constant light the deviation is that of all pulses, and less by the power 3/2 of the light that is lost
        lost = 1 + float(r.sum(axis=0).max()) * self.dead_time / self.period
        tolerance = JOINED_DRAWS / math.sqrt(pulses * lost**3)
        absorbed, expected = -np.expm1(-r), self.mean(r, tolerance)
        if absorbed.max() > FEW:  # of the pulses whose detector is ready, a share is detected: binomial
            ready = np.divide(expected, absorbed, out=np.zeros_like(r), where=absorbed > 0)
            counts = random.binomial(np.rint(pulses * ready).astype(np.int64), absorbed).astype(np.float64)
        else:
            counts = random.poisson(pulses * expected).astype(np.float64)
        # what the detector is blind for changes slowly against its dead time: groups of bins have it in common
        fine = min(self.dead_time / self.bins.width / GROUPS_PER_DEAD_TIME, GROUP_LIGHT / max(float(r.max()), 1e-9))
        group = int(min(max(fine, 1), LARGEST_GROUP))
        grouped = replace(self, group=group)
        first = np.r_[0 : self.bins.count : group, self.bins.count : len(r)]
        mean = pulses * _row_sums(expected, first)
        noise = _row_sums(counts, first) - mean
        light = _row_sums(r, first)
        answer = grouped._solve(light, noise, np.zeros((len(first) + 1, r.shape[1])), pulses * tolerance) - noise
        factor = 1.0 + np.divide(answer, mean, out=np.zeros_like(mean), where=mean > 0)
        counts *= np.repeat(np.maximum(factor, 0.0), np.diff(np.append(first, len(r))), axis=0)
        counts += random.random(r.shape)  # rounded at random: no mean is moved
        return np.floor(counts, out=counts)

    def corrected(self, counts: Float64, pulses: float) -> Float64:
        """Return r from counts per bin: Coates' inversion with the pulses that are not blind; inf where there are none.

        Detections between the window and the next pulse are not known: they are taken to be none.
        """
        edges, share = self._edges, counts / pulses
        share = np.concatenate([share, np.zeros((len(edges) - 1 - len(share), share.shape[1]))])
        total = _cumulated(share)
        blind = np.empty_like(share)
        back = np.empty_like(share)
        for cell, (early, late) in enumerate(pairwise(self._places)):
            start = self._at(early, total, total)
            blind[cell] = total[cell] - start
            back[cell] = self._at(late, total, total) - start
        ready = 1.0 - blind
        with np.errstate(divide="ignore", invalid="ignore"):
            # a = ready E1 + back (1 - E1 / r) with E1 = 1 - exp(-r), solved by steps from r = a / (ready + back / 2)
            r = -np.log1p(-np.minimum(share / (ready + back / 2), 1.0))
            for _ in range(20):
                r = r * share / np.maximum(-np.expm1(-r) * ready + back * _returning(r), 1e-300)
        return np.where(share > 0, r, 0.0)[: self.bins.count]

    @cached_property
    def _places(self) -> list[tuple[int, int, float]]:
        """For each edge of the cells: where the time one dead time earlier lies (periods, cell, share of the cell)."""
        edges = self._edges
        length, places = edges[-1] - edges[0], []
        for index, edge in enumerate(edges - self.dead_time - edges[0]):
            periods = math.floor(edge / length + 1e-12)
            within = max(edge - periods * length, 0.0) + edges[0]
            cell = int(np.searchsorted(edges, within + 1e-12 * length, side="right")) - 1
            cell = min(cell, len(edges) - 2, *((max(index - 1, 0),) if periods == 0 else ()))
            share = (within - edges[cell]) / (edges[cell + 1] - edges[cell])
            places.append((periods, cell, float(share) if share > 1e-9 else 0.0))
        return places

    def _at(self, place: tuple[int, int, float], total: Float64, earlier: Float64) -> Float64 | float:
        """Return the detections from the period's start to a place: ``total`` of this period, ``earlier`` of others."""
        periods, cell, share = place
        if periods < 0 and math.isinf(self.period):
            return 0.0
        known = earlier if periods else total
        value = known[cell] if not share else known[cell] + share * (known[cell + 1] - known[cell])
        return value + periods * known[-1] if periods else value

    def _solve(self, r: Float64, source: Float64, earlier: Float64, tolerance: float) -> Float64:
        """Return x = source - absorbed x (blind at the cell's start) + returning x (back in the cell), cell by cell.

        Of the pulses that are ready at the start of a cell that light reaches evenly, the share ``absorbed`` is
        detected in it, and of those that come back in it, evenly, the share ``returning``. Begins with the detections
        ``earlier`` in the periods before, (cells + 1, points) from the start of one, and is repeated until what one
        period hands to the next is known to ``tolerance``.
        """
        absorbed, returning = -np.expm1(-r), _returning(r)
        total = np.zeros_like(earlier)
        for _ in range(MAX_ROUNDS):
            start = self._at(self._places[0], total, earlier)
            for cell, place in enumerate(self._places[1:]):
                own = (
                    place[2] if place[:2] == (0, cell) else 0.0
                )  # dead time < cell: some come back to be detected again
                end = total[cell] if own else self._at(place, total, earlier)
                value = end - start
                value *= returning[cell]
                value -= absorbed[cell] * (total[cell] - start)
                value += source[cell]
                if own:
                    value /= 1.0 - own * returning[cell]
                    end = end + own * value
                np.add(total[cell], value, out=total[cell + 1])
                start = end
            if self._change(total, earlier) <= tolerance:
                break
            earlier = self._next_guess(total, earlier, absorbed)
        return np.diff(total, axis=0)

    def _change(self, total: Float64, earlier: Float64) -> float:
        """Return by how much what this period hands to the next differs from what it was handed."""
        used = [place for place in self._places if place[0] < 0] if math.isfinite(self.period) else []
        if not used:
            return 0.0
        low, high = min(cell for _, cell, _ in used), max(cell for _, cell, _ in used) + 2
        change = np.abs((total[low:high] - total[-1]) - (earlier[low:high] - earlier[-1])).max()
        periods = -min(periods for periods, _, _ in used)
        return float(change + (periods - 1) * np.abs(total[-1] - earlier[-1]).max())

    def _next_guess(self, total: Float64, earlier: Float64, absorbed: Float64) -> Float64:
        """Return what to hand to the next period: a detector blind for whole periods answers to their total at once."""
        whole = self.dead_time // self.period
        if not whole:
            return total.copy()
        shape = _cumulated(absorbed)
        # blind for the total of whole periods: total = what was found - whole x absorbed x (total - that assumed)
        excess = (total[-1] - earlier[-1]) * (whole / (1 + whole * shape[-1]))
        return total - shape * excess


def _returning(r: Float64) -> Float64:
    """Return 1 - (1 - exp(-r)) / r."""
    series = r * (1 / 2 - r * (1 / 6 - r * (1 / 24 - r * (1 / 120))))
    if r.max(initial=0.0) < SMALL:
        return series
    return np.where(r < SMALL, series, 1 + np.expm1(-r) / np.maximum(r, SMALL))


def _cumulated(x: Float64) -> Float64:
    """Return the sums of the rows before each row, and of all; numpy's own goes column by column, ten times slower."""
    total = np.zeros((len(x) + 1, x.shape[1]))
    for row, values in enumerate(x):
        np.add(total[row], values, out=total[row + 1])
    return total


def _row_sums(x: Float64, first: NDArray[np.int64]) -> Float64:
    """Return sums of rows, from each of ``first`` to the next."""
    sums = np.empty((len(first), x.shape[1]))
    for row, (start, end) in enumerate(pairwise([*first.tolist(), len(x)])):
        x[start:end].sum(axis=0, out=sums[row])
    return sums
