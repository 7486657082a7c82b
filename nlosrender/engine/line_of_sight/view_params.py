"""What a launch of the line-of-sight integrator reads: settings, scene, pixels, refractive indices."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import BounceAxis
from nlosrender.capture.grids import Capture
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.scene.loading.materials import index_behind
from nlosrender.scene.view import BuiltView

STOKES = 4  # components of a Stokes vector: channels of a polarised capture


@dataclass(frozen=True)
class ViewSettings:
    """What the integrator computes and how; part of the compiled kernel."""

    bounces: BounceAxis  # slot k: paths with k surface interactions
    channels: int  # 1 grey, 3 colours, 4 Stokes components
    russian_roulette: bool
    counts_last_leg: bool  # whether the leg from the last surface to the camera counts
    has_sky: bool  # some light comes from infinitely far away: it has no arrival time
    bends: bool  # connections may cross a rough refracting surface

    @property
    def polarized(self) -> bool:
        """Whether the channels are the components of a Stokes vector."""
        return self.channels == STOKES


@dataclass(frozen=True, eq=False)
class ViewLaunchParams:
    """Everything a launch reads; lengths in engine units."""

    scene: mi.Scene
    camera: mi.Point3f
    pixels: mi.Point3f  # centre of each lane's pixel on the image plane
    pixel_x: mi.Vector3f  # from one pixel to the next to the right
    pixel_y: mi.Vector3f  # from one pixel to the next above
    up: mi.Vector3f  # unit, the camera's
    indices: mi.Float  # refractive index behind the surface of a shape, by its registry number
    bins_per_unit: mi.Float
    start_bins: mi.Int32  # start of the window in bins: whole part ...
    start_fraction: mi.Float  # ... and the rest, in [0, 1)

    def bin_of(self, opl: mi.Float) -> mi.Int32:
        """Return the bin of an optical path length [engine units]; any integer."""
        delay = dr.minimum(opl * self.bins_per_unit - self.start_fraction, 1e9)
        return mi.Int32(dr.floor(delay)) - self.start_bins


def view_launch_params(
    built: BuiltView, capture: Capture, time_axis: TimeAxis, pixels: NDArray[np.integer], n_lanes: int
) -> ViewLaunchParams:
    """Return what the lanes read: lane i looks through pixel ``pixels[i % len(pixels)]`` of the row-major grid."""
    grid = capture.sensor_grid
    centres = built.to_engine(grid.positions.reshape(-1, 3)[pixels])
    lane = dr.arange(mi.UInt32, n_lanes) % len(pixels)
    per_lane = dr.gather(mi.Point3f, mi.Point3f(centres.T.astype(np.float32)), lane)
    # float64, and split: a window far from zero must not eat the precision of the path lengths
    start = time_axis.start_opl / time_axis.bin_width_opl
    whole = float(np.clip(np.floor(start), -(2**30), 2**30))
    params = ViewLaunchParams(
        scene=built.scene,
        camera=mi.Point3f(built.to_engine(capture.sensor_position).tolist()),
        pixels=per_lane,
        pixel_x=mi.Vector3f(
            built.direction_to_engine([grid.size[0] / grid.nx / built.metres_per_engine_unit, 0.0, 0.0]).tolist()
        ),
        pixel_y=mi.Vector3f(
            built.direction_to_engine([0.0, grid.size[1] / grid.ny / built.metres_per_engine_unit, 0.0]).tolist()
        ),
        up=mi.Vector3f(built.direction_to_engine([0.0, 1.0, 0.0]).tolist()),
        indices=refractive_indices(built.scene),
        bins_per_unit=mi.Float(built.metres_per_engine_unit / time_axis.bin_width_opl),
        start_bins=mi.Int32(int(whole)),
        start_fraction=mi.Float(start - np.floor(start)),
    )
    # opaque: a kernel must not depend on where the camera stands
    for name in ("camera", "pixel_x", "pixel_y", "up", "bins_per_unit", "start_bins", "start_fraction"):
        dr.make_opaque(getattr(params, name))
    dr.eval(params.pixels)
    return params


def refractive_indices(scene: mi.Scene) -> mi.Float:
    """Return for each shape, by its registry number, the relative index behind its surface; 1 where none is known."""
    shapes = scene.shapes_dr()
    numbers = np.array(dr.reinterpret_array(mi.UInt32, shapes)) if dr.width(shapes) else np.zeros(0, dtype=np.uint32)
    table = np.ones(int(numbers.max(initial=0)) + 1, dtype=np.float32)
    for number, shape in zip(numbers, scene.shapes(), strict=True):
        table[number] = index_behind(shape.bsdf())
    return mi.Float(table)


def crosses_rough_surfaces(scene: mi.Scene) -> bool:
    """Return whether a straight connection may pass through a refracting surface of the scene."""
    return bool(any(index_behind(shape.bsdf()) != 1.0 for shape in scene.shapes()))
