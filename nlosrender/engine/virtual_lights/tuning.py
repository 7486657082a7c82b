"""Every tunable number of the virtual-light engine, with its derivation or the measurement behind it.

What follows from float32 (rounding bounds, guards of quotients) and what lays out packed data (bins of a block, tiles
of a rectangle) is not tunable and stays beside the code that relies on it.

"a / b / c at half / as is / twice" compares values of a number. Third bounce: relative L2 error of a gather at
``patch_scale`` 0.7 against a fine one of single triangles, 16 x 16 sensor points, of *waves* (a wavy sheet of 51,500
triangles), *two sheets* (one behind the other), *crumpled* (45,000 triangles displaced at random), *letters* (thick
ones that hide themselves) and a *screen* before a plate. Further bounces: variance times CPU seconds of 4 rounds, up
to bounce 5, between two facing *plates* and in a closed *room*. Renders: error reached at a target of 3 %. Sections
are those of docs/virtual-lights.md.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class VirtualLightTuning:
    """Numbers that trade run time for error; lengths in engine units.

    None of them biases a result beyond the error that it states.
    """

    # ---- Elements: sizes (3.2), limits ----------------------------------------------------------------------------
    # Nearer to a point patches are half as large: a dozen elements around its foot make up H, and their numbers of
    # parts have to follow the scale in small steps. A plate on the wall: error 4.7 / 4.9 / 4.8 % with 1160 / 1404 /
    # 1834 patches at half / as is / twice.
    close_distance: float = 1e-2
    # Elements smaller than this part of the size allowed are merged: a box then holds ten of them at least, of which a
    # rough cluster has three facets. 2 % of 32 x 32 points, confocal, CPU s at 0.5 / 0.35 / 0.25 / 0.15: folded ball of
    # 49,000 triangles 12.0 / 7.9 / 5.2 / 4.8, another 5.7 / 4.4 / 4.3 / 3.3; wavy sheet 0.23 / - / 0.43 / 2.3.
    merge_ratio: float = 0.25
    # Of one gather; 500 bytes each, 1 GB. Beyond it paths reach the error sooner (chosen, 6.5).
    max_patches: int = 2_000_000
    # Of a resolution that is kept for the next batch: 80 MB, and two resolutions are kept.
    max_kept_patches: int = 200_000

    # ---- Elements: clusters (4.1) ----------------------------------------------------------------------------------
    # Edge of a box over the size allowed, rounded down to a power of two: its diagonal is 0.57 to 1.13 of that size.
    # Waves: 1.8 / 7.4 / 24.9 % with 564 / 140 / 37 clusters at half / as is / twice: it acts as ``patch_scale`` does.
    cluster_box: float = 0.8
    # Height of a box over its edge: a surface at 45 degrees to both sides rises by two. Half: 4 to 7 % more clusters at
    # the same error; twice: 2 % fewer (waves on its side, two sheets).
    cluster_box_height: float = 5.0
    # Variance of the slopes in a box, at scale 1, above which three facets stand for it if laser points lie in several
    # places. Crumpled, confocal, 3 %: energy 0.989 / 0.998 / 0.999 with 4481 / 2301 / 3035 patches at 4 times / as is /
    # a quarter, 0.937 with one facet each.
    facet_roughness: float = 0.25
    # Boxes that are filled less join a neighbour. Two sheets: 7.3 / 7.3 / 8.0 % with 297 / 285 / 252 clusters.
    min_box_fill: float = 0.3
    # Cosine of a cluster's mean normal to the lasers below which some members may face away from them (4.3). Energy of
    # crumpled -0.3 / -0.3 / -0.6 %, of waves on its side -0.1 / -0.2 / -0.4 % at 0.25 / 0.5 / 0.9.
    min_laser_cosine: float = 0.5
    # Clusters are made of moments so many halvings of the scale finer. Error 10.0 / 7.4 / 7.0 % (waves) and 9.9 / 7.3 /
    # 7.2 % (two sheets) at 0 / 1 / 2: boxes that are no multiple of finer ones are ragged. 940,000 triangles: merging
    # takes back what 2 gains.
    moment_halvings: int = 1
    # Moments are kept where they are so many times fewer than the elements: set-up time alone, error 7.44 and 7.32 % at
    # half, as is and twice (waves, two sheets).
    min_elements_per_moment: int = 4

    # ---- Footprints of sensor points (docs/scans.md) ---------------------------------------------------------------
    # Places tried until their halves agree; the second without a target. Powers of two: halves of whole quarter turns.
    footprint_places: tuple[int, ...] = (8, 16, 32, 64, 128, 256, 512)
    share_of_places: float = 0.6  # of the error that the third bounce may have

    # ---- Elements: regions of the sensor grid (3.4) ----------------------------------------------------------------
    # Regions along each side, the first with at least ``min_region_sensors`` each. A room before 64 x 64 points: 2081 /
    # 2867 / 6613 patches a point and 0.31 / 0.28 / 0.38 s CPU at 64 / 256 / 512, the error 3.2 to 3.3 %.
    region_blocks: tuple[int, ...] = (8, 4, 2)
    min_region_sensors: int = 256
    # Close to the wall, of all regions together: 0.5 GB. 1.2 million triangles took 18 s and gigabytes without it.
    max_region_elements: int = 1_000_000
    # Cutting and lighting a patch takes as long as gathering it by 40 (room), 140 (plate), 220 (letters), 430 sensor
    # points (bunny of 3,674 triangles). A room before 64 x 64 points has the same regions at half and twice.
    sensors_per_patch_cost: int = 500
    # Of the cost without regions, above which they are left out; the same regions at half and twice (room, plate on the
    # wall): savings are far larger, or none.
    max_region_cost: float = 0.7
    max_regional_patches: int = 500_000  # made together: 0.2 GB

    # ---- Visibility (5) --------------------------------------------------------------------------------------------
    # Sensor points that share a mask: a patch's mask costs what it saves 210 (bunny) to 260 of them (letters).
    min_mask_sensors: int = 256
    # Steps of the sensor lattice (5.8), tried in this order. Confocal, 2 %, CPU s without and with it: folded balls of
    # 49,000 triangles before 64 x 64 points 11.5 and 6.0, before 256 x 256 points 116 and 38; bunny 0.47 and 0.38.
    visibility_steps: tuple[int, ...] = (8, 4, 2)
    # Share of the error that is noise of single shadow rays, above which nodes trace several to each patch (chosen).
    noise_share: float = 0.4
    # Fewest nodes along a side of the sensor grid, so that a shadow covers several (chosen).
    min_lattice: int = 16
    # Pairs of patch and sensor point below which trying costs what is saved: letters before 64 x 64 points, 4.6
    # million, take 0.30 instead of 0.27 s CPU; a bunny, 11 million, 0.38 instead of 0.47.
    min_lattice_pairs: int = 2**23

    # ---- Gather ----------------------------------------------------------------------------------------------------
    # Squared lookups of a textured patch, of more than ``few_patches`` and of fewer. A checkerboard of 40 x 40 on 314
    # patches: 13.2 / 10.1 / 9.2 / 9.3 / 9.2 / 9.1 % at 2 / 4 / 8 / 6 / 12 / 24, the energy off by 2.3 % at 2, 0.4 % at
    # 8 and above; 0.12 s at 12, 0.63 s at 24.
    texture_splits: tuple[int, int] = (4, 12)
    few_patches: int = 2**14
    # Points times bins of an exhaustive capture that reciprocity halves: 1 GB of float64. A larger one is cut into
    # batches that hold few of the other halves of their pairs. It saves 36 % of the CPU time (bench --part skips).
    max_reciprocal_sums: int = 2**27

    # ---- Third bounce: two resolutions (6) -------------------------------------------------------------------------
    coarsest_scale: float = 1.0  # the delay is off by one bin in the mean: (7)
    # Of the resolution that the rendered one is compared with: beyond, few meshes have fewer patches.
    coarsest_compared: float = 3.0
    # Error over the difference from a finer resolution, on the pilot: 1.34 where errors fall by -1.25, 0.87 for noise.
    difference_margin: float = 1.25
    near_distance: float = 1e-3  # nearer, float32 rounds a patch's centre by more than 6e-5 of its distance (3.6)
    # Patches of the finer over those of the coarser resolution. Error (and what is stated): waves 2.2 (1.8) / 1.9 (2.1)
    # / 1.6 (2.0) % at 2 / 3 / 6, in 0.38 / 0.18 / 0.21 s; letters 1.6 (1.7) / 1.8 (1.8) / 1.3 (1.9) %, in 0.33 / 0.14 /
    # 0.22 s CPU: 2 states too little.
    refinement: float = 3.0
    # Refining stops where so many times the patches leave more of the error than this part; by the law noise leaves a
    # third. With twice the patches two estimates of few patches differed by chance (poster on a board, 50 and 135 of
    # them: 4.3 and 5.3 %, target 0.5 %).
    stagnation_ratio: float = 8.0
    stagnation: float = 0.9
    # Errors above it follow no law yet (table in 6.4). No effect at half and twice (letters, screen).
    max_regular_error: float = 0.2
    # Power of the number of patches that errors are extrapolated by: shadow rays leave noise by -0.5 to -0.6 (furnished
    # room: 7.3, 4.4, 3.5 % with 7263, 18749, 27894 patches), matt surfaces -1.25 (6.4), lobes -2 while patches are
    # wider than they are (bunny, GGX 0.2: 24, 2.7 and 0.4 % with 2693, 7529 and 22023 patches).
    orders: tuple[float, float] = (0.6, 2.0)
    # Power by which the error of a resolution is extrapolated that is not compared with a finer one: 0.35 on a sheet of
    # noise, 1.9 and 1.5 % with 2300 and 4800 patches.
    slowest_order: float = 0.35
    # On the patches that an extrapolated error asks for, in steps of ``min_refinement`` at least: one more level costs
    # more than 10 % of the patches.
    refinement_margin: float = 1.1
    min_refinement: float = 1.25
    # Seconds per patch and point of the pilot over those of the render: 120 and 18 ns on folded balls of 49,000
    # triangles, 216 and 17 ns in the furnished room; and an extrapolation often takes two trials.
    pilot_cost: float = 16.0

    # ---- Bounces 4 and up (7) --------------------------------------------------------------------------------------
    # Of all replicas together. Plates 4.9 / 3.0 / 2.4, room 42 / 29 / 28 at half / as is / twice: what a round costs
    # besides; more would make a round too long to stop in time.
    vpls_per_round: int = 4096
    # Sensor points along each side of the grid that the density of VPLs is made for, and the part of VPLs that have a
    # density by distance alone. Variance times CPU seconds at 1 / 0.7 / 0.5 / 0.3: room 18 / 12 / 12 / 14, plates 6.7 /
    # 7.3 / 7.1 / 8.0, letters 9.3 / 9.6 / 9.4 / 9.6, bunny 40 / 39 / 37 / 38; room 12 at 16 x 16 points.
    density_sensors_per_axis: int = 8
    nearness_share: float = 0.6
    # Kept per VPL. Plates 3.5 / 3.8 / 3.3, room 43 / 30 / 34 at half / as is / twice; more in 7.6.
    contributions_per_vpl: int = 8
    # The same of confocal captures, where each takes a ray to the sensor point's own laser. Plates 14 / 7.3 / 8.1, room
    # 1480 / 1080 / 810.
    confocal_contributions_per_vpl: int = 2
    # Proposal lasers along each side of the grid. Confocal: plates 6.5 / 7.3 / 6.6, room 800 / 1030 /
    # 1800 at 1 / 2 / 3; at 1 nothing tells a vertex of one side of the wall from one of the other.
    proposal_lasers_per_axis: int = 2
    # Sensor points along each side of the grid that glossy VPLs are chosen for. Error of 4 rounds 2.1 / 2.2 / 2.2 % at
    # 1 / 3 / 5 (bunny, principled), 2.0 / 2.0 / 2.0 % (GGX 0.2).
    proposal_sensors_per_axis: int = 3
    # Of the light of an average laser, expected of those that are no proposal lasers. Confocal: plates 5.8 / 6.3 /
    # 6.8, room 1310 / 990 / 960 at half / as is / twice.
    untried_share: float = 0.2
    # Subpaths of a VPL: one per 32 pairs of sensor and laser point, within these. 16 x 16 points: plates 3.3 / 2.7 /
    # 2.1 / 1.8 / 1.8, room 38 / 31 / 31 / 46 / 58 at 8 / 16 / 32 / 64 / 128.
    min_subpaths: int = 16
    max_subpaths: int = 64
    # The same where surfaces are glossy: contributions cost more. CPU s times squared error of 4 rounds (1e-4) 27.7 /
    # 10.4 / 8.3 at 16 / 64 / 256 (bunny, principled), 23.7 / 10.9 / 8.0 (GGX 0.2).
    max_glossy_subpaths: int = 256
    # Single-laser captures: VPLs that share subpaths, all replicas together, 1 to ``max_units`` times as many a round.
    # Variance times CPU seconds of 2 / 4 / 8 / 16 units: room 25 / 19 / 20 / 20 in steps of 4 bins.
    sharing_vpls: int = 256
    max_units: int = 16
    pilot_units: int = 2
    # Power of the units of a round by which the error falls. Room, steps of 4 bins: 11.6 / 7.7 / 5.3 / 3.7 % at 2 / 4 /
    # 8 / 16 units.
    order_of_units: float = 0.55
    # Subpaths of such a VPL, one per 8 sensor points. Room 18.9 / 18.3 / 19.0 at 128 / 192 / 256; before 64 x 64
    # points 56 / 51 / 52, bunny 231 / 202 / 219 at 128 / 256 / 512.
    max_shared_subpaths: int = 256
    # Bins of the time steps that their light may be added in, and the part of the target that these may change.
    # Variance times CPU seconds of 4 units of 512 VPLs, room: 61 / 39 / 20 / 9 at 1 / 2 / 4 / 8 bins.
    bins_per_step: tuple[int, ...] = (2, 4, 8)
    share_of_steps: float = 0.4
    # The same of light that is added contribution by contribution, and smoothed afterwards. Trying one takes a pilot of
    # 256 points and 1000 bins 0.1 s CPU.
    bins_smoothed: tuple[int, ...] = (4, 16)
    groups_at_once: int = 4  # of a replica: 256 histograms; as many times more as a step has bins
    max_histogram_values: int = 2**24  # of them together: 0.13 GB
    # For a sensor point to add a histogram, in patches: 0.2 us and 15 ns in steps of one bin, 0.1 us in steps of 4.
    connection_cost: int = 4
    histogram_cost: int = 12  # over the bins of a step
    max_contribution_values: int = 2**24  # of a round, times lasers: 0.3 GB
    # Of the target: paths of light that delta lobes reflect, beside VPLs, which take far less time (plastic bunny, 5
    # bounces, 2 %: 77,000 paths per sensor point at 0.3).
    specular_share: float = 0.65
    # Of a time limit, and of the progress that is told: VPLs beside such paths (chosen).
    time_share_of_lights: float = 0.8
    # Of the squares that third bounce and VPLs share: the third bounce, at most (chosen; 0.65^2 of 0.9 is 0.47).
    most_of_third: float = 0.7
    max_rounds: int = 2**20  # of a target that is out of reach

    # ---- Split of the target error (8); squares of shares leave 10 % for what a pilot cannot know ------------------
    # Where the third bounce is the highest. Letters, waves: true 1.8, 1.9 % (stated 1.8, 2.1) at 0.85 of 3 %; 2.2, 1.9
    # % (2.7, 2.2) at 1.
    third_share_alone: float = 0.85
    third_share_of_many: float = 0.35  # beside paths: patches are cheaper than these
    rest_share_of_many: float = 0.88  # 0.35^2 + 0.88^2 = 0.90
    # Beside VPLs: the one that costs least by (21). Target 1.5 %, each alone: plates 0.39 / 0.46 / 0.66 s CPU, room 3.6
    # / 3.2 / 2.8 s; (21) takes 0.65 for both.
    third_shares: tuple[float, ...] = (0.65, 0.5, 0.35)
    # Room, target 1.5 %: 28 / 26 / 22 rounds, stated 1.1 / 1.1 / 1.2 % at 0.7 / 0.9 / 1.
    share_squares: float = 0.9
    # A pilot of VPLs ends once its error is this many times the goal, or after so many rounds: it is extrapolated by
    # 1 / sqrt(rounds). Plates and room, targets 3 and 0.5 %: the same rounds at 1 and 16, and at half and twice the
    # lanes. Principled bunny, 2 %, where few contributions are bright: 10 / 7 / 6 rounds, 11.6 / 8.9 / 8.4 s CPU in all
    # at 4 / 2 / 1.4; room, 3 %, 0.99 / 0.94 / 1.19 s.
    max_pilot_error: float = 2.0
    max_pilot_rounds: int = 16
    pilot_lanes: int = 2048
    # Sensor points along each side of the pilot of patches, and where surfaces are near. Scale and error at 4, 8 and 16
    # differ by less than 6 % (letters, screen). Furnished room, difference of two resolutions 3.7 / 3.6 / 3.6 % in 1.4
    # / 1.7 / 3.9 s CPU at 8 / 12 / 16: 256 points have visibility masks made, which save them nothing.
    patch_pilot_sensors: tuple[int, int] = (8, 12)
    missed_light: float = (
        3.0  # times bounce 5 as found: of its four legs one is found that may lead past the laser point
    )
    # Of the hidden area: light from less is not found by renders of common lengths; one of 1e4 vertices lies there.
    rare_share: float = 1e-4


DEFAULT_TUNING = VirtualLightTuning()
