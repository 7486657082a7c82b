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
    with_lattice,
)

if TYPE_CHECKING:
    from nlosrender.engine.launch.pilot_points import Pilot
    from nlosrender.engine.virtual_lights.third_bounce import ThirdBounce

POINTS_PER_CELL = 5  # of the pilot, one of which gets a cell of the sensor lattice around it
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
        tessellator, rest = self._third.tessellator, (self._known_squares, start)
        refined = refined_to(target, tessellator, self._gather, *rest, self._is_noise_of_rays, self._points_left)
        gather, base = self._gather, None
        if refined.is_paused:
            gather, base, rest = self._of_nodes, ALL_RAYS, (self._known_squares, refined.patch_scale)
            refined = refined_to(target, tessellator, gather, *rest, points_left=self._points_left)
        refined = replace(refined, lattice=base)
        if not self._pays_off(refined.gathered):
            return refined

        def at_some(scale: float, lattice: Lattice | None) -> NDArray[np.float64]:
            if lattice is None:
                return gather(scale).values[:, :, :, ::POINTS_PER_CELL]
            return self._third.gather(self._some, scale, lattice=lattice).values

        rays = 1 if base is None else base.rays
        return with_lattice(refined, target, [replace(lattice, rays=rays) for lattice in self._third.lattices], at_some)

    def _pays_off(self, gathered: Gathered) -> bool:
        """Return whether a lattice may be used, and saves more than these trials cost."""
        pairs = gathered.n_patches * self._n_sensors
        return bool(self._third.lattices) and pairs >= self._third.tuning.min_lattice_pairs

    def _is_noise_of_rays(self, gathered: Gathered, error: float) -> bool:
        """Return whether most of the error is noise of single shadow rays: several to each patch take it away.

        Patches that are smaller have less of it, by the square root of their number.
        """
        most = self._third.tuning.noise_share * error
        if not self._pays_off(gathered):
            return False
        if self._noise is not None and self._noise[1] * math.sqrt(self._noise[0] / gathered.n_patches) < 0.5 * most:
            return False
        values = self._third.gather(self._some, gathered.patch_scale, lattice=ALL_RAYS).values
        squares = replace(gathered, values=values).squares + self._third.device.exact_squares(self._some)
        noise = replace(gathered, values=values - gathered.values[:, :, :, ::POINTS_PER_CELL])
        self._noise = gathered.n_patches, math.sqrt(noise.squares / max(squares, 1e-300))
        return self._noise[1] > most
