"""Every tunable number of the virtual-light engine, with its derivation or the measurement behind it.

What follows from float32 (rounding bounds, guards of quotients) and what lays out packed data (bins of a block, tiles
of a rectangle, numbers of a row) is not tunable and stays beside the code that relies on it.

"half / twice" are the errors of the gathered third bounce, relative L2 against a fine gather of single triangles, at
half and at twice the value, on 16 x 16 sensor points: *waves*, a wavy sheet of 51,500 triangles; *two sheets*, one
behind the other; *crumpled*, 45,000 triangles displaced at random; *letters*, thick letters that hide themselves. Where
not said otherwise at ``patch_scale`` 0.7. Numbers marked "bench" are of ``nlosrender bench``.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VirtualLightTuning:
    """Numbers that trade run time for error; none of them biases a result beyond the error that is stated.

    Lengths are in engine units, half of the relay wall's longer side.
    """

    # ---- elements: size of patches --------------------------------------------------------------------------------
    # Patches on surfaces nearer than this are half as large: there a dozen elements around a point's foot make up H,
    # and their numbers of parts have to follow the scale in small steps, or two resolutions differ by less than either
    # errs. A plate that touches the wall: error 4.7 / 4.9 / 4.8 %, patches 1160 / 1404 / 1834 at half / this / twice.
    close_distance: float = 1e-2
    # Elements below this part of the size allowed are merged into clusters. Twice: elements of half to all of the size
    # allowed are merged, too, which took twice the patches at the same error (bunny of 58,784 triangles).
    merge_ratio: float = 0.5

    # ---- elements: clusters ---------------------------------------------------------------------------------------
    # Edge of a cluster's box over the size allowed; error and number of clusters go with its square, as with that of
    # ``patch_scale``: waves 1.8 / 7.4 / 24.9 % with 564 / 140 / 37 clusters at half / this / twice. At 0.8 clusters err
    # about as much as cut triangles do at the same scale (letters 9.7 %), so that one scale refines both.
    cluster_box: float = 0.8
    # Height of a box over its edge: a surface at 45 degrees to both sides rises by two edges. Half: 4 to 7 % more
    # clusters at the same error; twice: 2 % fewer (waves on its side, two sheets).
    cluster_box_height: float = 5.0
    # Width of the classes that slopes are sorted into where a box is rough, at scale 1. Crumpled: error 7.2 / 7.6 /
    # 7.5 % with 2074 / 964 / 935 clusters at half / this / twice.
    slope_class: float = 3.0
    # Boxes filled less than this join a neighbour. Two sheets: error 7.26 / 7.32 / 7.99 % with 297 / 285 / 252 clusters
    # at half / this / twice.
    min_box_fill: float = 0.3
    # Below this cosine between a cluster's mean normal and the lasers some members may face away from these (they lie
    # up to 55 degrees off the axis they share): it reflects by its own normal. Crumpled: energy -0.3 / -0.3 / -0.6 %
    # at half / this / 0.9; on its side -0.1 / -0.2 / -0.4 %.
    min_laser_cosine: float = 0.5
    # Clusters are summed up from moments so many halvings of the scale finer. At 0 boxes are of their own size: error
    # 10.0 instead of 7.4 % (waves); at 2 7.0 %, with four times the moments to sum.
    moment_halvings: int = 1
    # Moments are kept where they are so many times fewer than the elements; no effect on the error (waves, two sheets:
    # 7.44, 7.32 % at half, this and twice), memory and set-up only.
    min_elements_per_moment: int = 4

    # ---- elements: regions of the sensor grid ---------------------------------------------------------------------
    # Regions along each side of the sensor grid, the first that leaves ``min_region_sensors`` in each.
    region_blocks: tuple[int, ...] = (8, 4, 2)
    min_region_sensors: int = 256
    # Elements close to the wall of all regions together: 0.5 GB and some seconds. 1.2 million triangles on the wall
    # took 18 s and gigabytes without this bound.
    max_region_elements: int = 1_000_000
    # Cutting and lighting a patch takes as long as gathering it by so many sensor points.
    sensors_per_patch_cost: int = 500
    # Regions are made where they cost at most this part of one set of patches.
    max_region_cost: float = 0.7
    # Patches of regions that are made together, for memory: 400 bytes each, 0.2 GB.
    max_regional_patches: int = 500_000

    # ---- elements: limits -----------------------------------------------------------------------------------------
    # Patches of one gather, 0.8 GB; beyond it paths reach the error sooner.
    max_patches: int = 2_000_000
    # Patches of a resolution that are kept for the next batch, 80 MB; two resolutions are kept.
    max_kept_patches: int = 200_000

    # ---- visibility -----------------------------------------------------------------------------------------------
    # A mask is asked for where at least so many sensor points share it: for fewer it costs more than the rays it saves.
    min_mask_sensors: int = 256

    # ---- gather ---------------------------------------------------------------------------------------------------
    # Shadow rays from the only laser to points spread over a patch. Error 9.68 % at 2, 4 and 8 (letters), energy +0.2 /
    # +0.1 / +0.1 %: patches on the edge of a shadow are few, and lighting is paid once a capture.
    laser_rays: int = 4
    # A textured patch takes the mean of this many squared lookups where there are more than ``few_patches``, else the
    # second number: 16 of many, 144 of few.
    texture_splits: tuple[int, int] = (4, 12)
    few_patches: int = 2**14
    # Pairs of patch, sensor and laser point in the first kernel, whose speed is not known yet: below a second at 30 ns.
    first_gather_pairs: int = 2**25
    # Sums (points times bins) of an exhaustive capture up to which reciprocity halves it, 1 GB of float64: a larger one
    # is cut into batches that hold few of the other halves of their pairs. Bench: 36 % of the CPU time saved.
    max_reciprocal_sums: int = 2**27

    # ---- third bounce: resolutions --------------------------------------------------------------------------------
    # The coarsest scale: beyond it patches are larger than their distance and the error follows no law.
    coarsest_scale: float = 1.0
    # Float32 rounds the centres of patches nearer than this by more than 1e-4 of their distance (6e-8 / 1e-3).
    near_distance: float = 1e-3
    # Patches of the finer over those of the coarser of the two resolutions that are compared.
    refinement: float = 3.0
    # A resolution is compared with the finest earlier one that has at most 1/2.5 of its patches.
    min_patch_ratio: float = 2.5
    # Resolutions whose scales differ by less are taken for the same.
    same_scale: float = 0.1
    # Refining stops where doubling the patches leaves more than this part of the error, ...
    stagnation: float = 0.9
    # ... if the error is below this: above it the law of its decrease does not hold yet.
    max_regular_error: float = 0.2
    # On the number of patches that an extrapolated error asks for, at least 1.25 times more in a step.
    refinement_margin: float = 1.1
    min_refinement: float = 1.25

    # ---- bounces 4 and up -----------------------------------------------------------------------------------------
    vpls_per_round: int = 4096  # of all replicas together
    contributions_per_vpl: int = 8
    confocal_contributions_per_vpl: int = 2  # each takes a ray of its own to the sensor point's laser
    # Laser points along each side of the grid by which vertices of subpaths are judged.
    proposal_lasers_per_axis: int = 2
    # Part of the average laser's light that a vertex is taken to receive from the lasers it was not tried with.
    untried_share: float = 0.2
    # Subpaths of a VPL: one per 32 sensor points, for they are cheap beside the gather where many points share them.
    min_subpaths: int = 16
    max_subpaths: int = 64
    max_contribution_values: int = 2**24  # contributions of a round times lasers: 0.3 GB
    first_vpl_pairs: int = 2**26  # of contributions with sensor and laser points in the first kernel
    max_rounds: int = 2**20  # of a target that is out of reach

    # ---- split of the target error, docs/virtual-lights.md, 8 -----------------------------------------------------
    third_share_alone: float = 0.85  # of the target error, where the third bounce is the highest
    third_share_of_many: float = 0.35  # beside paths: patches are cheaper than these
    rest_share_of_many: float = 0.88  # 0.35^2 + 0.88^2 = 0.90
    third_shares: tuple[float, ...] = (0.65, 0.5, 0.35)  # beside VPLs: the one that costs least
    share_squares: float = 0.9  # sum of the squares: 10 % are left for what a pilot cannot know
    max_pilot_error: float = 4.0  # times the target: a pilot has seen enough to say how many rounds are needed
    max_pilot_rounds: int = 16
    pilot_lanes: int = 2048
    patch_pilot_sensors: int = 8  # along each side: the error of patches has no noise
    missed_light: float = 3.0  # times bounce 5 as found: one of the four legs that may lead past the laser point is
    rare_share: float = 1e-4  # of subpaths or paths: rarer light is not found by renders of common lengths


DEFAULT_TUNING = VirtualLightTuning()
