"""Settings compiled into the path tracer's kernels, and the parameters of their launches."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from nlosrender.capture.bounces import FIRST_BOUNCE, THIRD_BOUNCE, BounceAxis
from nlosrender.engine.launch.hidden_aabb import HiddenAabb
from nlosrender.engine.launch.launch_params import LaunchParams
from nlosrender.engine.launch.mirror_connections import Mirrors
from nlosrender.engine.path.laser_flash import LaserFlash
from nlosrender.engine.path.tuning import PathTuning


@dataclass(frozen=True)
class PathSettings:
    """Switches and numbers that are part of the compiled kernels."""

    bounces: BounceAxis
    first_bounce: int  # lowest bounce that is deposited, >= 3
    p_hidden_sampling: float  # share of wall vertices that sample the hidden geometry; 0 = BSDF only, 1 = hidden only
    laser_sampling: bool
    russian_roulette: bool
    spot_radius: float  # of the laser on the wall [engine units]; 0 = a point
    needs_visibility: bool  # something may occlude a vertex from a laser or sensor point
    has_transmission: bool  # some BSDF refracts: the optical path length needs the medium's index
    is_plain_diffuse: bool  # flat surfaces of one reflectance each: only normals matter to their BSDFs
    only_specular: bool = False  # only paths with a delta event after the sensor point are deposited
    delta_share: float = 0.0  # probability of delta lobes where a path still needs one; 0: that of the BSDF
    has_mirrors: bool = False  # vertices are connected to the lasers by way of mirrors, too
    max_tries: int = PathTuning.max_tries  # see ``PathTuning``
    flashes: bool = False  # vertices are connected to random places of the laser's flash
    samples_second_bounce: bool = False  # sensor points, which are areas of any surfaces, are connected to the lasers

    @property
    def goes_on(self) -> bool:
        """Whether paths have more than one vertex after the sensor point."""
        return self.last_vertex is None or self.last_vertex > FIRST_BOUNCE + 1

    @property
    def last_vertex(self) -> int | None:
        """Bounce index of the last vertex a path may have: one more than the bounces when rays look for the spot."""
        highest = self.bounces.max_bounces
        return highest + 1 if highest is not None and self.finds_spot else highest

    @property
    def has_time_gate(self) -> bool:
        """Whether the time gate's roulette applies."""
        return self.goes_on and self.russian_roulette

    @property
    def has_continuation_roulette(self) -> bool:
        """Whether the roulette after bounce 3 applies: all paths deposit bounce 3, one in n continues."""
        is_first = self.first_bounce == THIRD_BOUNCE and self.laser_sampling
        return self.has_time_gate and is_first and not self.finds_spot

    def is_deposited(self, bounce: mi.UInt32) -> mi.Bool | bool:
        """Return whether a connection of this bounce index is one of those asked for."""
        in_reach: mi.Bool | bool = True
        if self.first_bounce > FIRST_BOUNCE + 1:
            in_reach &= bounce >= self.first_bounce
        highest = self.bounces.max_bounces
        if highest is not None and (self.goes_on or highest < THIRD_BOUNCE):
            in_reach &= bounce <= highest
        return in_reach

    def may_go_on(self, bounce: mi.UInt32) -> mi.Bool | bool:
        """Return whether a path may have another vertex after one of this bounce index."""
        if not self.goes_on:
            return False
        return True if self.last_vertex is None else bounce < self.last_vertex

    def slot(self, bounce: mi.UInt32) -> mi.UInt32:
        """Return the histogram's slot of a bounce."""
        if not self.bounces.split:
            return mi.UInt32(0)
        first = self.first_slot
        return dr.minimum(bounce - (FIRST_BOUNCE + first), mi.UInt32(self.bounces.n_slots - 1 - first))

    @property
    def first_slot(self) -> int:
        """The first bounce slot that is sampled: that of the second bounce, or the next where that is computed."""
        return 1 if self.bounces.split and not self.samples_second_bounce else 0

    @property
    def mirrors_spot(self) -> bool:
        """Whether sensor points are connected to points of the spot by way of mirrors, and rays need not find it so."""
        return self.has_mirrors and self.finds_spot

    @property
    def finds_spot(self) -> bool:
        """Whether rays may find the laser's spot by chance."""
        return self.spot_radius > 0


@dataclass(frozen=True, eq=False)
class PathParams(LaunchParams):
    """What a launch of the path tracer reads."""

    hidden_aabb: HiddenAabb | None  # None: few rays from the wall miss it
    continuation_period: mi.UInt32  # n: one path in n continues after bounce 3; opaque
    mirrors: tuple[Mirrors, ...]  # by way of which vertices are connected
    flash: LaserFlash | None  # None: the laser lights points or spots
    mirrors_per_vertex: mi.UInt32  # how many of them a vertex is connected by way of, drawn at random; opaque
