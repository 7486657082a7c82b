"""Numbers of the path engine, each with its derivation or the measurement it comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LoopCost:
    """What the bounces after the third cost in a loop, and how rare they may become (``continuation_period``)."""

    relative: float  # b / a: seconds of a path's higher bounces over those of its third bounce
    max_period: int  # bound, because a short pilot misses rare bright paths and would choose too large a period
    max_period_split: int  # where bounces are kept apart: none may converge more slowly than without roulette


@dataclass(frozen=True)
class PathTuning:
    """Numbers of the path engine; none changes what an estimate converges to."""

    # Hidden area over pi (its distance from the wall)^2 above which hidden geometry sampling alone gives way to the
    # mixture. The density of a direction is r^2 / (A cos) at distance r: on a disk of that area, of radius 2 d at
    # distance d, it grows by (1 + 2^2)^(3/2) = 11 from the centre to the rim.
    max_area_ratio: float = 4.0
    # Cosine-weighted share of the hemisphere that meets hidden geometry above which BSDF sampling is used alone: it
    # then loses a quarter of its paths. Variance x CPU time of the mixture over BSDF sampling's (a sheet at 0.5 m):
    # 3.9 at a share of 0.68, 4.9 at 0.93, 5.3 at 1; with 5 bounces 2.8 to 3.8. At 0.21 hidden geometry sampling has
    # 1 / 8 of BSDF sampling's, with 5 bounces half.
    surrounded_share: float = 0.75
    # Share of rays from the wall that miss the box of the hidden geometry above which the box is tested before a ray is
    # traced. CPU time with the box over that without (square sheet at 0.5 m, 16 x 16 sensor points, BSDF sampling):
    # 0.4 at 98 % misses, 0.8 at 91 and 70 %, 1.1 at 32 %, 1.06 at 14 %. So it pays off above about half; from 0.2 to
    # there it costs up to a tenth.
    min_miss_share: float = 0.2
    # Paths that a lane begins in a row while they miss the box: with four tries 1 - 0.8^4 = 59 % of lanes have a ray
    # where one in five meets the box. 1 to 8 tries take equal CPU time within 20 % (scenes as above).
    max_tries: int = 4
    # Widening of the box over 1 + its largest coordinate: 80 times the rounding of float32 (1.2e-7).
    box_margin: float = 1e-5
    # Samples per lane of the pilot that chooses the continuation period: 16, 64, 256 give the same period with 12
    # seeds (letters and plate 3, closed room 1; all bounces). Paths of a capture below which no pilot is run: 2^20
    # paths take 0.20 to 0.35 CPU s on these scenes, compiling and running the pilot 0.22 to 0.36 CPU s.
    pilot_samples: int = 64
    min_paths_for_pilot: int = 2**20
    # Mirrors tried for the connections of a vertex, of those near it (``MirrorIndex``), 3 ns each. Of all 2,910 facets
    # of a bunny's front CPU s to equal error with a mirror bunny on a matt floor, bounce 4: 18 / 14 / 12 / 27 / 63 at
    # 16 / 64 / 256 / 1024 / all. For a spot, sensor points try all that are near, because that sum is all they see.
    mirrors_per_vertex: int = 256
    # Probability of delta lobes at a surface with others, where only paths with a delta event are deposited. Bunny of
    # plastic, 5 bounces, 2 %: 7.2 / 6.0 / 5.0 CPU s at that of the BSDF / 0.3 / 0.5; noise at 0.7 and 0.9 10 and 30 %
    # above that at 0.5.
    delta_share: float = 0.5
    # Beside virtual lights: bins of the time steps that light of delta lobes may be smoothed by, and the part of the
    # target that these may change. Plastic bunny, bounces 4 and 5, 2000 paths: error 2.0 / 0.97 / 0.45 % and change 0 /
    # 0.3 / 0.5 % at 1 / 4 / 16 bins.
    bins_smoothed: tuple[int, ...] = (4, 16)
    share_of_steps: float = 0.4
    direct: LoopCost = LoopCost(2.0, 8, 3)  # ``third_bounce_loop``; measured on open scenes (5c22817)
    traced: LoopCost = LoopCost(0.5, 8, 1)  # ``full_loop``, whose third bounce itself takes a closest-hit ray


PILOT_SEED = 0x5EED  # of the pilot alone: the continuation period does not depend on the render's seed
PHASE_TILE = 4  # 4 x 4 sensor points, a vector of 16 lanes in Morton order, go on after bounce 3 at the same time
DEFAULT_TUNING = PathTuning()
