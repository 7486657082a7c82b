"""From a ``CaptureHeader`` to a Z-NLOS file without light: all small datasets, attributes, and no chunk of samples."""

from __future__ import annotations

from collections.abc import Mapping

import h5py
import numpy as np
from numpy.typing import NDArray

from nlosrender.capture.bounces import (
    FILE_BOUNCES,
    FIRST_BOUNCE,
    LAST_FILE_BOUNCE,
    LINE_OF_SIGHT,
    THIRD_BOUNCE,
)
from nlosrender.files import layout
from nlosrender.files.attributes import set_attributes
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.truth_datasets import NO_TRUTH, GroundTruth, write_ground_truth
from nlosrender.scene.pose import Pose

_VIEW_TEXT = {
    "sensor_points": "centres of a camera's pixels on an image plane, which takes the relay wall's place in this file; "
    "rows ascend upwards in the picture, columns to the right; cameraPosition is the camera's",
    "laser_points": "none: emitters in the scene flash at t = 0; the laser's datasets mean nothing",
}
_PIXELS_TEXT = {
    "sensor_points": "what each pixel of a camera sees first, on whatever surface; rows ascend upwards in the picture, "
    "columns to the right; pixels that see nothing have zeros as position, normal and light",
    "laser_points": "what the beam from laserPosition meets first; those that are hidden from the laser light nothing",
}
_VIEW_QUANTITY = (
    "of a pixel's steady radiance the share that arrives in the bin: the sum over bins, and what falls outside the "
    "time window, is the steady picture"
)
_STOKES_TEXT = (
    "I, Q, U, V of the light that reaches camera or sensor, as Mitsuba's stokes integrator defines them; reference: "
    "to the right in the picture (ray direction x camera's up), or ray from the sensor x relay wall's y axis"
)


GZIP_LEVEL = 4  # stored as the filter's level; HDF5 itself packs only chunks that are filled in parts, by merge


def create_capture(
    file: h5py.File,
    header: CaptureHeader,
    attributes: Mapping[str, object],
    compression: str,
    store_variance: bool,
    truth: GroundTruth = NO_TRUTH,
) -> None:
    """Create everything of a capture file but its light.

    Parameters
    ----------
    file
        Empty and open for writing.
    header, attributes
        Description of the capture; further attributes, such as its provenance.
    compression
        ``gzip`` (with shuffle: the one filter pair that every HDF5 build has) or ``none``.
    store_variance
        Also create a dataset ``variance`` shaped as ``data``.
    truth
        What is known of the hidden scene.

    Raises
    ------
    ValueError
        One of ``attributes`` belongs to the layout.
    """
    write_header(file, header)
    filters = {"compression": "gzip", "compression_opts": GZIP_LEVEL, "shuffle": True} if compression == "gzip" else {}
    for name in layout.sample_names(store_variance):
        shape = layout.data_shape(header.sizes, header.confocal)
        samples = file.create_dataset(name, shape, layout.FLOAT, chunks=header.chunks, fillvalue=0.0, **filters)
        meaning = "H" if name == layout.DATA else "variance of each sample of data"
        described = sample_attributes(header) | {"meaning": meaning}
        if name == layout.VARIANCE:
            described["unit"] = f"({layout.DATA_UNIT})^2"
            if header.shared_samples:
                described["not_to_be_summed"] = header.shared_samples
        set_attributes(samples, described)
    write_ground_truth(file, truth, filters)
    add_attributes(file, header, attributes)


def add_attributes(file: h5py.File, header: CaptureHeader, attributes: Mapping[str, object]) -> None:
    """Add attributes to a capture file.

    Raises
    ------
    ValueError
        One of them belongs to the layout.
    """
    taken = sorted(root_attributes(header).keys() & attributes.keys())
    if taken:
        raise ValueError(f"attributes: {', '.join(taken)} already set by the layout, choose another name")
    set_attributes(file, attributes)


def write_header(file: h5py.File, header: CaptureHeader) -> None:
    """Create every dataset but the samples, and the attributes that explain them."""
    for name, values in dataset_values(header).items():
        spec = layout.SPECS[name]
        dataset = file.create_dataset(name, data=np.asarray(values, dtype=spec.dtype))
        set_attributes(dataset, {"meaning": spec.meaning} | ({"unit": spec.unit} if spec.unit else {}))
    # float32 holds 3 mm to one part in 1.7e7 only: over 2048 bins that is visible against the exact width
    set_attributes(file["deltaT"], {"exact": np.float64(header.bin_width_opl)})
    set_attributes(file["t0"], {"exact": np.float64(header.start_opl)})
    set_attributes(file["hiddenVolumeSize"], {"exact": _hidden_volume(header)[2]})
    if header.laser_spots is not None:
        spots, shares = header.laser_spots
        points = layout.axes_first(layout.file_frame(header.frame, header.pose).to_scene(spots[None]))
        file.create_dataset(layout.SPOT_POSITIONS, data=points.astype(layout.FLOAT))
        file.create_dataset(layout.SPOT_SHARES, data=shares.astype(layout.FLOAT))
    set_attributes(file, root_attributes(header))


def dataset_values(header: CaptureHeader) -> dict[str, object]:
    """Return the value of every small dataset of the layout, in the file's frame."""
    frame = layout.file_frame(header.frame, header.pose)
    sizes = layout.grid_sizes(header.sizes, header.confocal)
    center, rotation, edges = _hidden_volume(header)
    sensors, lasers = header.empty_sensors, header.empty_lasers
    return {
        "cameraGridPositions": _points(frame.to_scene(header.sensor_positions), sensors),
        "cameraGridNormals": _points(frame.direction_to_scene(header.sensor_normals), sensors),
        "laserGridPositions": _points(frame.to_scene(header.laser_positions), lasers),
        "laserGridNormals": _points(frame.direction_to_scene(header.laser_normals), lasers),
        "cameraPosition": frame.to_scene(header.sensor_position),
        "laserPosition": frame.to_scene(header.laser_position),
        "cameraGridSize": header.sensor_grid_size,
        "laserGridSize": header.laser_grid_size,
        "cameraGridPoints": (sizes["sensor_x"], sizes["sensor_y"]),
        "laserGridPoints": (sizes["laser_x"], sizes["laser_y"]),
        "t": header.n_bins,
        "t0": header.start_opl,
        "deltaT": header.bin_width_opl,
        "hiddenVolumePosition": center,
        "hiddenVolumeRotation": rotation,
        "hiddenVolumeSize": edges.max(),
        "isConfocal": int(header.confocal),
    }


def _points(values: layout.Float64, is_empty: NDArray[np.bool_] | None) -> layout.Float64:
    return layout.axes_first(values if is_empty is None else np.where(is_empty[..., None], 0.0, values))


def root_attributes(header: CaptureHeader) -> dict[str, object]:
    """Return the attributes of the file itself that follow from the header."""
    legs = header.account_first_and_last_bounces
    attributes: dict[str, object] = {
        **layout.ROOT_TEXT,
        "nlosrender_format_version": layout.FORMAT_VERSION,
        "scan_type": header.scan_type,
        "units": "lengths in m, times in m of optical path (divide by c = 299792458 m/s), angles in rad",
        "frame": header.frame,
        "frame_convention": layout.FRAME_TEXT[header.frame],
        "file_to_scene": layout.file_to_scene(header.frame, header.pose),
        "relay_wall_to_scene": header.pose.matrix(),
        "planar_wall": header.planar_wall,
        "account_first_and_last_bounces": legs,
        "first_and_last_legs": "included: laser -> wall and wall -> sensor count in the optical path length"
        if legs
        else "NOT included: optical path lengths run from the laser point to the sensor point only",
        "max_bounces": "no limit" if header.max_bounces is None else header.max_bounces,
        "split_bounces": header.split_bounces,
    }
    if header.scan_type == LINE_OF_SIGHT:
        attributes |= _VIEW_TEXT | {
            "first_and_last_legs": "included: surface -> camera counts in the optical path length"
            if legs
            else "NOT included: optical path lengths run from the emitter to the last surface only"
        }
    if header.point_lists:
        attributes[layout.POINT_LISTS] = " ".join(header.point_lists)
    if header.empty_sensors is not None:
        attributes |= _PIXELS_TEXT | {
            layout.EMPTY_POINTS: int(header.empty_sensors.sum()),
            layout.UNLIT_POINTS: header.n_unlit_lasers,
        }
    if header.laser_spots is not None:
        attributes[layout.MULTIPLEXED] = (
            f"{len(header.laser_spots[1])} spots, lit at once by one pulse, share its energy ({layout.SPOT_SHARES}); "
            "laserGridPositions is their weighted middle, where no light need be"
        )
    if header.laser_flash:
        attributes[layout.FLASH] = header.laser_flash
    if header.footprint is not None:
        words, area = header.footprint
        attributes |= {layout.FOOTPRINT: words} | ({} if area is None else {layout.FOOTPRINT_AREA: area})
    if header.n_channels in layout.CHANNELS:
        attributes["channels"] = layout.CHANNELS[header.n_channels]
    if attributes.get("channels") == layout.STOKES:
        attributes["stokes_frame"] = _STOKES_TEXT
    return attributes


def sample_attributes(header: CaptureHeader) -> dict[str, object]:
    """Return the attributes of ``data`` (and of ``variance``): axes, bounces, unit."""
    is_view = header.scan_type == LINE_OF_SIGHT
    attributes: dict[str, object] = {
        "bounces": _bounces_text(header, is_view),
        "bounce_indices": np.asarray(header.bounce_indices, dtype=np.int32),
        "axes": " ".join(layout.file_axes(header.confocal)),
        "unit": layout.data_unit(header.scan_type),
    }
    if is_view:
        return attributes | {"quantity": _VIEW_QUANTITY}
    return attributes | {"third_bounce": np.int32(THIRD_BOUNCE - FIRST_BOUNCE)}


def _bounces_text(header: CaptureHeader, is_view: bool) -> str:
    if not header.split_bounces:
        return f"the sum of all {'paths' if is_view else 'bounces'} is in index {header.bounce_indices[0]}"
    last = FILE_BOUNCES - 1
    if is_view:
        meaning = "index k of the bounce axis holds the paths with k surface interactions (0: an emitter seen directly)"
        return f"{meaning}; those with more than {last} are added into index {last}"
    more = header.max_bounces is None or header.max_bounces > LAST_FILE_BOUNCE
    meaning = f"index k of the bounce axis holds bounce k + {FIRST_BOUNCE}"
    return meaning + (f"; bounces above {LAST_FILE_BOUNCE} are added into index {last}" if more else "")


def _hidden_volume(header: CaptureHeader) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centre (file's frame), rotation [rad] and edges of the box around the hidden geometry.

    The box lies along the relay wall's axes. In the Z-NLOS frame these are the file's own axes (and the edges are
    given in their order); in the scene's frame the box is turned with the wall, and the edges are along the wall's
    x, y and z.
    """
    if header.hidden_bounds is None:
        return np.zeros(3), np.zeros(3), np.zeros(3)
    low, high = header.hidden_bounds
    center = layout.file_frame(header.frame, header.pose).to_scene((low + high) / 2)
    edges = high - low
    if header.frame == "znlos":
        return center, np.zeros(3), np.abs(layout.ZNLOS_FROM_LOCAL @ edges)
    return center, _euler_angles(header.pose), edges


def _euler_angles(pose: Pose) -> np.ndarray:
    """Return the angles (3,) [rad] about x, then y, then z of a pose's rotation (inverse of ``euler_xyz``)."""
    rotation = pose.rotation
    y = np.arcsin(np.clip(-rotation[2, 0], -1, 1))
    if abs(rotation[2, 0]) > 1 - 1e-12:  # looking along y: x and z turn about the same axis, give all of it to z
        return np.array([0.0, y, np.arctan2(-rotation[0, 1], rotation[1, 1])])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), y, np.arctan2(rotation[1, 0], rotation[0, 0])])
