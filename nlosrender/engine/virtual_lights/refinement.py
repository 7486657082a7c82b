"""Refinement of the third bounce: how fine is enough, and the error that the difference of two resolutions states.

A render has two resolutions, its pilot a third, finer one: docs/virtual-lights.md, 6.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.relative_error import relative_l2_error

if TYPE_CHECKING:
    from nlosrender.engine.virtual_lights.elements.tessellator import Tessellator
    from nlosrender.engine.virtual_lights.tuning import VirtualLightTuning


@dataclass(frozen=True)
class Lattice:
    """Sensor lattice that visibility is interpolated on, see ``SensorLattice``."""

    step: int  # sensor points along rows and columns from one node to the next
    rays: int  # from a node to points of each patch: 1 or ``SHADOW_RAYS``


@dataclass(frozen=True, eq=False)
class Gathered:
    """The third bounce at one resolution, (channel, 1, laser, sensor, row), per J and (engine unit)^2."""

    values: NDArray[np.float64]
    n_patches: int
    patch_scale: float
    footprint_deviation: NDArray[np.float64] | None = None  # of ``values``: half the difference of two sets of places

    @property
    def squares(self) -> float:
        """Sum of squares inside the time window."""
        return squares_inside(self.values)


@dataclass(frozen=True, eq=False)
class Refined:
    """A resolution that is fine enough."""

    patch_scale: float
    gathered: Gathered
    error: float  # relative L2, as estimated
    divisor: float | None  # turns the difference from the coarser resolution into it; None: ``difference_divisor``
    finer: float | None = None  # patch scale that the error was measured against; None: it is extrapolated
    is_paused: bool = False  # not fine enough yet, see ``pauses``
    lattice: Lattice | None = None


@dataclass(frozen=True)
class _Level:
    """A resolution that was tried."""

    patch_scale: float
    n_patches: int
    error: float

    def order(self, n_patches: int, error: float) -> float:
        """Return the power of the number of patches that the error falls by from here to a finer resolution."""
        return math.log(self.error / error) / math.log(n_patches / self.n_patches)


def estimated_error(coarse: Gathered, fine: Gathered, known_squares: float = 0.0) -> float:
    """Return the relative L2 error of the finer resolution, with ``known_squares`` of other bounces beside it."""
    noise = squares_inside(fine.values - coarse.values) / difference_divisor(coarse, fine) ** 2
    return _relative(noise, fine, known_squares)


def difference_divisor(coarse: Gathered, fine: Gathered) -> float:
    """Return the divisor that turns the difference of two resolutions into the error of the finer one.

    The error of random shadow rays is independent at the two, and falls as n^(-1/2) to n^(-3/4): at least sqrt(r + 1),
    with r the ratio of the numbers of patches, or of the scales' squares where small triangles cease to be merged.
    What is left of the discretisation falls faster than 1 / n: at least r - 1, which is no less from r = 3 on
    (docs/virtual-lights.md, 6.2).
    """
    ratio = min(fine.n_patches / coarse.n_patches, (coarse.patch_scale / fine.patch_scale) ** 2)
    return math.sqrt(max(ratio, 1.0) + 1)


def finer_scale(tessellator: Tessellator, patch_scale: float, factor: float) -> float:
    """Return a patch scale with at least ``factor`` times the patches (a mesh may be finer than asked for).

    Of hidden surfaces and wall each: if only one of them became finer, the error of the other would not show.
    """
    counts, finer = tessellator.counts(patch_scale), patch_scale / math.sqrt(factor)
    while any(0 < more < 0.9 * factor * count for more, count in zip(tessellator.counts(finer), counts, strict=True)):
        finer *= 0.9
    return finer


def coarser_scale(tessellator: Tessellator, patch_scale: float) -> float:
    """Return the patch scale that is compared with: a third of the patches, or the coarsest there is."""
    refinement, coarsest = tessellator.tuning.refinement, tessellator.tuning.coarsest_compared
    counts, coarser = tessellator.counts(patch_scale), patch_scale * math.sqrt(refinement)
    while coarser < coarsest and any(
        less > count / refinement for less, count in zip(tessellator.counts(coarser), counts, strict=True)
    ):
        coarser = min(1.1 * coarser, coarsest)
    return coarser


def footprint_error(gathered: Gathered, known_squares: float = 0.0) -> float:
    """Return the relative L2 error of the mean over a footprint, as the two halves of its places differ."""
    noise = 0.0 if gathered.footprint_deviation is None else squares_inside(gathered.footprint_deviation)
    return _relative(noise, gathered, known_squares)


def refined_to(
    target: float,
    tessellator: Tessellator,
    gather: Callable[[float], Gathered],
    known_squares: float,
    start: float | None = None,
    pauses: Callable[[Gathered, float], bool] | None = None,
    points_left: float = 0.0,
) -> Refined:
    """Return the resolution whose estimated error is at most ``target``.

    Ends earlier where refining is in vain: float32 path lengths and grazing contacts leave an error that no refinement
    takes away, and ``max_patches`` bounds the number of patches.

    Parameters
    ----------
    target
        Relative L2 error of the second and third bounce together.
    tessellator, gather
        Count the patches of a scale, and gather them on a few points of the capture; asked again for the same scale.
    known_squares
        Sum of the squares of exact light at these points [(engine unit)^-4].
    start
        Patch scale to begin with; None: the coarsest.
    pauses
        Asked, with its error, whether the search ends at a resolution that is not fine enough; None: never.
    points_left
        Of the capture, over those that ``gather`` gathers at: what one patch fewer saves.
    """
    tuning = tessellator.tuning
    levels: list[_Level] = []  # coarse to fine
    coarsest = min(finer_scale(tessellator, tuning.coarsest_compared, tuning.refinement), tuning.coarsest_scale)
    patch_scale = start or coarsest

    def refined_at(scale: float, noise: float, error: float, finer: float | None) -> Refined:
        fine, coarse = gather(scale), gather(coarser_scale(tessellator, scale))  # the pair that a render gathers
        divisor = math.sqrt(squares_inside(fine.values - coarse.values) / noise) if noise > 0 else None
        return Refined(scale, fine, error, divisor, finer)

    while True:
        fine, finer = gather(patch_scale), finer_scale(tessellator, patch_scale, tuning.refinement)
        if tessellator.count(finer) > tuning.max_patches:
            coarse = gather(coarser_scale(tessellator, patch_scale))
            return Refined(patch_scale, fine, estimated_error(coarse, fine, known_squares), None)
        better = gather(finer)
        noise = tuning.difference_margin**2 * squares_inside(better.values - fine.values)
        error = _relative(noise, fine, known_squares)
        earlier = next(
            (one.error for one in reversed(levels) if one.n_patches <= fine.n_patches / tuning.stagnation_ratio),
            math.inf,
        )
        is_stuck = tuning.stagnation * earlier < error
        is_beyond = fine.n_patches * error / target > tuning.max_patches
        if error <= target or (error < tuning.max_regular_error and (is_stuck or is_beyond)):
            refined = refined_at(patch_scale, noise, error, finer)
            if levels and (between := _between(levels[-1], refined, target, tessellator, points_left)) is not None:
                again = refined_to(target, tessellator, gather, known_squares, between, lambda *_: True)
                return refined if again.is_paused else again
            return refined
        if pauses is not None and pauses(fine, error):
            return Refined(patch_scale, fine, error, None, is_paused=True)
        more = (tuning.refinement_margin * error / target) ** (1 / _order(levels, fine.n_patches, error, tuning.orders))
        more = min(max(more, tuning.min_refinement), tuning.refinement)
        less_noise = noise * (better.n_patches / fine.n_patches) ** (-2 * tuning.slowest_order)
        expected = _relative(less_noise, better, known_squares)
        if expected <= target and not _pays(fine.n_patches * more, better.n_patches, tuning, points_left):
            return refined_at(finer, less_noise, expected, None)
        levels.append(_Level(patch_scale, fine.n_patches, error))
        patch_scale = finer_scale(tessellator, patch_scale, more)


def _pays(wanted: float, n_patches: int, tuning: VirtualLightTuning, points_left: float) -> bool:
    """Return whether it pays to try a resolution of ``wanted`` patches where one of ``n_patches`` will do.

    The pilot gathers it and a finer one, at points too far apart for their rays to stay together.
    """
    trial = tuning.pilot_cost * (1 + tuning.refinement) * wanted
    return wanted < n_patches and (n_patches - wanted) * (1 + 1 / tuning.refinement) * points_left > trial


def _between(
    coarser: _Level, refined: Refined, target: float, tessellator: Tessellator, points_left: float
) -> float | None:
    """Return a scale between one that is too coarse and a fine one that may meet the target; None: no trial pays."""
    tuning, n_patches = tessellator.tuning, refined.gathered.n_patches
    if not 0 < refined.error < coarser.error or n_patches <= coarser.n_patches:
        return None
    order = coarser.order(n_patches, refined.error)
    wanted = n_patches * (tuning.refinement_margin * refined.error / target) ** (1 / order)
    if wanted >= n_patches / tuning.min_refinement or not _pays(wanted, n_patches, tuning, points_left):
        return None
    between = finer_scale(tessellator, coarser.patch_scale, max(wanted / coarser.n_patches, 1.0))
    return between if tessellator.count(between) < n_patches / tuning.min_refinement else None


def with_lattice(
    refined: Refined,
    target: float,
    lattices: Sequence[Lattice],
    gather: Callable[[float, Lattice | None], NDArray[np.float64]],
) -> Refined:
    """Return the same resolution with visibility interpolated on the first lattice that leaves its error in bounds.

    That is the ``target``, or the error of ``refined`` where that is larger. By what factor interpolation changes the
    error, a few points tell against the finer patch scale, or without one against rays of their own.

    Parameters
    ----------
    refined, target
        As ``refined_to`` returned and took them.
    lattices
        The widest first.
    gather
        Returns the values of a patch scale and a lattice at some of the pilot's points; None: as ``refined`` has them.
    """
    if refined.divisor is None or not lattices:
        return refined
    own = gather(refined.patch_scale, None)
    better = own if refined.finer is None else gather(refined.finer, None)
    noise = refined.error**2 * squares_inside(own) if refined.finer is None else squares_inside(better - own)
    for lattice in lattices if noise > 0 else ():
        squares = squares_inside(better - gather(refined.patch_scale, lattice))
        factor = math.sqrt(squares / noise + (refined.finer is None))
        if refined.error * factor <= max(target, refined.error):
            factor = max(factor, 1.0)
            return replace(refined, error=refined.error * factor, divisor=refined.divisor / factor, lattice=lattice)
    return refined


def _order(levels: list[_Level], n_patches: int, error: float, bounds: tuple[float, float]) -> float:
    """Return the power of the number of patches that the error falls by from the last level on, within bounds."""
    if not levels or levels[-1].n_patches >= n_patches:
        return 1.0
    return float(np.clip(levels[-1].order(n_patches, error), *bounds))


def _relative(noise: float, fine: Gathered, known_squares: float) -> float:
    """Return the relative L2 error for the square ``noise`` of an absolute one."""
    return relative_l2_error(noise, fine.squares + noise + known_squares)


def squares_inside(values: NDArray[np.float64]) -> float:
    """Return the sum of the squares of (channel, bounce, laser, sensor, row) inside the time window, without a copy."""
    inside = values[..., :-1]
    return float(np.einsum("abcde,abcde->", inside, inside))
