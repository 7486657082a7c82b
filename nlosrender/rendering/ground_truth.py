"""Ground truth of a capture, measured on the scene that is rendered, in the frame of its file (backend started)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.grids import Capture, point_grid
from nlosrender.config.document import Config
from nlosrender.config.render import OutputConfig
from nlosrender.files import layout
from nlosrender.files.truth_datasets import NO_TRUTH, GroundTruth

if TYPE_CHECKING:
    from nlosrender.scene.build import BuiltScene
    from nlosrender.scene.pose import Float64, Pose
    from nlosrender.scene.view import BuiltView

_OF_VIEW = {"depth", "normal", "albedo", "position", "instance"}


def ground_truth(config: Config, built: BuiltScene | BuiltView, capture: Capture) -> GroundTruth:
    """Return what ``output.ground_truth`` asks for."""
    output, wanted = config.output, set(config.output.ground_truth)
    if not wanted or config.capture.is_line_of_sight:
        return NO_TRUTH
    built = cast("BuiltScene", built)  # only a camera sees a view
    from nlosrender.scene.loading.front_view import front_view

    frame = layout.file_frame(output.frame, built.wall.pose)
    grid, own = capture.sensor_grid, output.ground_truth_grid
    if own is not None:
        grid = point_grid(built.wall, own.nx, own.ny, *((None, None) if grid.is_list else grid.size))
    found: dict[str, NDArray[Any]] = {}
    if wanted & _OF_VIEW:
        view = front_view(built, grid.positions, grid.normals)
        found = {
            "gt_depth": view.depth,
            "gt_normal": layout.axes_first(frame.direction_to_scene(view.normal)),
            "gt_albedo": view.albedo,
            "gt_position": layout.axes_first(frame.to_scene(view.position)),
            "gt_instance": view.item + 1,
        }
    if "occupancy" in wanted:
        found |= _occupancy(output, built, (grid.ny, grid.nx), grid.size, frame)
    if "poses" in wanted:
        found["gt_poses"] = frame.matrix() @ np.array(built.poses).reshape(-1, 4, 4)
    kept = {name: values for name, values in found.items() if name.split("_")[1] in wanted}
    return GroundTruth(kept, tuple(surface.name for surface in built.surfaces))


def _occupancy(
    output: OutputConfig, built: BuiltScene, rows: tuple[int, int], size: tuple[float, float], frame: Pose
) -> dict[str, NDArray[Any]]:
    from nlosrender.scene.loading.front_view import occupancy

    own = output.ground_truth_grid
    ends = (0.0, 1.0) if built.hidden_bounds is None else (built.hidden_bounds[0][2], built.hidden_bounds[1][2])
    near = ends[0] if own is None or own.near is None else own.near
    far = ends[1] if own is None or own.far is None else own.far
    if not near < far:  # a sheet before the wall has no depth
        far = near + 1e-3 * max(size)
    nz = rows[1] if own is None or own.nz is None else own.nz
    low: Float64 = np.array([-size[0] / 2, -size[1] / 2, near])
    high: Float64 = np.array([size[0] / 2, size[1] / 2, far])
    voxels = occupancy(built, low, high, (nz, *rows))
    return {"gt_occupancy": voxels, "gt_occupancy_bounds": frame.to_scene(np.array([low, high]))}
