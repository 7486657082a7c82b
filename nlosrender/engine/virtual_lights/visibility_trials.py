"""Trials of visibility: how many shadow rays a patch gets, and from which sensor points, tried on the pilot's points.

docs/virtual-lights.md, 5.8.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from nlosrender.engine.virtual_lights.elements.patches import SHADOW_RAYS
from nlosrender.engine.virtual_lights.refinement import (
    Gathered,
    Lattice,
    Refined,
    refined_to,
    squares_inside,
    with_lattice,
)

if TYPE_CHECKING:
    from nlosrender.engine.launch.pilot_points import Pilot
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce

POINTS_PER_CELL = 5  # every so many of the pilot's points, one is tried with a lattice cell around it
ALL_RAYS = Lattice(1, SHADOW_RAYS)  # each of the pilot's points is a node


class VisibilityTrials:
    """Finds resolution, lattice and rays per node that meet a target.

    Parameters
    ----------
    third, few
        What is gathered, and the pilot's points.
    gather
        Gathers a patch scale at ``few``, each point with shadow rays of its own; asked again for the same scale.
    known_squares
        Sum of the squares of exact light at these points [(engine unit)^-4].
    """

    def __init__(
        self, third: ThirdBounce, few: Pilot, gather: Callable[[float], Gathered], known_squares: float
    ) -> None:
        self._third, self._gather, self._known_squares = third, gather, known_squares
        self._some, self._n_sensors = few.every(POINTS_PER_CELL), third.device.capture.n_sensors
        self._points_left = self._n_sensors / few.sensors.size
        self._of_nodes = cache(lambda scale: third.gather(few, scale, lattice=ALL_RAYS))
        self._noise: tuple[int, float] | None = None  # of the last resolution tried: patches, relative error

    def refined_to(self, target: float, start: float | None = None) -> Refined:
        """Return the resolution that is fine enough, with visibility interpolated where that saves work.

        ``target`` and ``start``: as of ``refinement.refined_to``.
        """
        gather, rays = self._gather, 1
        refined = self._search(target, gather, start, self._is_noise_of_rays)
        if refined.is_paused:
            gather, rays = self._of_nodes, SHADOW_RAYS
            refined = replace(self._search(target, gather, refined.patch_scale), lattice=ALL_RAYS)
        if not self._pays_off(refined.gathered):
            return refined

        def at_some(scale: float, lattice: Lattice | None) -> NDArray[np.float64]:
            if lattice is None:
                return gather(scale).values[:, :, :, ::POINTS_PER_CELL]
            return self._third.gather(self._some, scale, lattice=lattice).values

        return with_lattice(refined, target, [replace(lattice, rays=rays) for lattice in self._third.lattices], at_some)

    def _search(
        self,
        target: float,
        gather: Callable[[float], Gathered],
        start: float | None,
        pauses: Callable[[Gathered, float], bool] | None = None,
    ) -> Refined:
        tessellator, known_squares = self._third.tessellator, self._known_squares
        return refined_to(target, tessellator, gather, known_squares, start, pauses, self._points_left)

    def _pays_off(self, gathered: Gathered) -> bool:
        """Return whether a lattice may be used, and saves more than these trials cost."""
        pairs = gathered.n_patches * self._n_sensors
        return bool(self._third.lattices) and pairs >= self._third.tuning.min_lattice_pairs

    def _is_noise_of_rays(self, gathered: Gathered, error: float) -> bool:
        """Return whether most of the error is noise of single shadow rays: several to each patch take it away.

        It falls as one over the square root of the number of patches: what was measured is not measured again while it
        stays below half of the limit by that law.
        """
        most = self._third.tuning.noise_share * error
        if not self._pays_off(gathered):
            return False
        if self._noise is not None and self._noise[1] * math.sqrt(self._noise[0] / gathered.n_patches) < 0.5 * most:
            return False
        values = self._third.gather(self._some, gathered.patch_scale, lattice=ALL_RAYS).values
        squares = squares_inside(values) + self._third.device.exact_squares(self._some)
        noise = squares_inside(values - gathered.values[:, :, :, ::POINTS_PER_CELL])
        self._noise = gathered.n_patches, math.sqrt(noise / max(squares, 1e-300))
        return self._noise[1] > most
