"""Scans whose points a camera sees: any surface is measured where a pixel sees it, by its own normal and BSDF."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
import pytest
from support.agreement import assert_agrees, relative_l2
from support.quadrature import Frame, Setup, rectangle_cells, third_bounces
from support.rendering import Rendering, configured, flat_wall, render

from nlosrender.config.sensor import SensorConfig
from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import ConfigError
from nlosrender.files.measured import measure_capture
from nlosrender.files.validation import check_file
from nlosrender.pipeline import render_capture
from nlosrender.rendering import stages

NONE: Mapping[str, Any] = MappingProxyType({})
PLATE = {"type": "rectangle", "width": 0.6, "height": 0.5, "center": [0.1, 0.05, 0.8], "normal": [0.1, 0.2, -1]}
BALL = {"type": "sphere", "center": [-0.5, -0.2, 0.6], "radius": 0.2}
CAMERA = {"position": [0.0, 0.0, 0.25], "look_at": [0, 0, 0], "width": 5, "height": 3}
CAMERA |= {"fov_deg": 2 * math.degrees(math.atan(1.0 / 0.25))}  # sees 2.0 x 1.2 m of the wall
DEVICES = {"laser_position": [-0.4, 0.1, 0.2], "account_first_and_last_bounces": True}
LASERS = {"single": {"laser_target": [0.3, -0.2, 0]}, "exhaustive": {"laser_targets": [[-0.375, 0, 0], [0.375, 0, 0]]}}
NO_WALL = {"type": "none"}
RECTANGLE = {"type": "rectangle", "width": 2.0, "height": 1.6, "normal": [0, 0, 1], "center": [0, 0, 0]}
BEHIND = {"type": "sphere", "center": [0, 0, -0.5], "radius": 0.1}  # a rectangle before it is no relay wall
WHITE = {"type": "diffuse", "reflectance": 1.0}
FIELDS = ("sensor_grid", "laser_grid", "laser_point")


def seen(scan: str, *items: Any, wall: Any = NONE, camera: Any = NONE, capture: Any = NONE, **render: Any) -> Any:
    """Return a configuration whose points a camera sees."""
    config = flat_wall(*items, scan=scan, wall=wall, **render)
    for key in FIELDS:
        config["capture"].pop(key, None)
    config["capture"] |= {**DEVICES, "camera": {**CAMERA, **camera}, **LASERS.get(scan, {}), **capture}
    if not wall:
        return config
    if wall.get("type") == "none":
        del config["scene"]["relay_wall"]
    return config


def scene_of(config: Any) -> Any:
    """Return the scene of a configuration that has no relay wall."""
    validated = configured(config)
    start_backend("llvm")
    built = stages.load_scene(validated)
    assert built.wall_shape is None
    return built


def gridded(scan: str, **render: Any) -> Any:
    """Return the capture of the points that ``CAMERA`` sees, as a grid."""
    config = flat_wall(PLATE, BALL, scan=scan, sensors=(5, 3), lasers=(2, 1), **render)
    config["capture"] |= {**DEVICES, "sensor_position": CAMERA["position"]}
    config["capture"]["sensor_grid"] |= {"width": 2.0, "height": 1.2}
    return config


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_camera_that_looks_straight_at_a_wall_gives_the_grid(scan: str) -> None:
    """Pixels of a camera that looks straight at a rectangle are its grid: the same bits by paths."""
    grid, pixels = render(gridded(scan, spp=16)), render(seen(scan, PLATE, BALL, spp=16))
    assert grid.mean.any()
    np.testing.assert_allclose(pixels.capture.sensor_grid.positions, grid.capture.sensor_grid.positions, atol=1e-15)
    np.testing.assert_array_equal(pixels.mean, grid.mean)


def test_virtual_lights_render_what_a_camera_sees_of_a_rectangle() -> None:
    """H of both captures is the same within the error asked for, and no relay wall has to be named."""
    asked = {"engine": "virtual_lights", "spp": None, "target_error": 0.01}
    grid = render(gridded("single", **asked))
    for bsdf in (WHITE, {"type": "twosided", "bsdf": WHITE}):
        pixels = render(seen("single", PLATE, BALL, {**RECTANGLE, "bsdf": bsdf}, wall=NO_WALL, **asked))
        assert pixels.samples == 0  # no paths
        assert relative_l2(pixels.total - grid.total, grid.total) < 0.01


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_surface_without_wall_is_rendered_as_a_wall_is(scan: str) -> None:
    """The scene without relay wall is another code path of the same estimator: H agrees within the noise."""
    asked = {"spp": 2048, "max_bounces": 4}
    config = seen(scan, PLATE, BALL, RECTANGLE, BEHIND, wall=NO_WALL, **asked)
    assert "has surfaces behind it" in scene_of(config).reason
    grid, pixels = render(gridded(scan, **asked)), render(config)
    for bounce in (3, 4):
        assert_agrees(
            pixels.bounce(bounce),
            pixels.bounce_variance(bounce),
            grid.bounce(bounce),
            reference_variance=grid.bounce_variance(bounce),
            replicas=pixels.plan.replicas,
            share=0.2,
        )
    assert not pixels.bounce(2).any()  # the points lie on a plane


def test_third_bounce_of_a_tilted_surface() -> None:
    """The third bounce of a tilted surface in any place is the integral over the hidden plate (float64 quadrature)."""
    frame, middle = Frame.of([0.6, 0.3, 1.0], [0.1, 1, 0]), np.array([3.0, -2.0, 1.0])

    def placed(x: float, y: float, z: float) -> list[float]:
        return (middle + x * frame.x + y * frame.y + z * frame.normal).tolist()

    wall = {**RECTANGLE, "center": middle.tolist(), "normal": frame.normal.tolist(), "up": frame.y.tolist()}
    items = wall, {**BEHIND, "center": placed(0, 0, -0.5)}
    plate = {"type": "rectangle", "width": 0.6, "height": 0.5, "center": placed(0.1, 0, 0.9), "up": frame.y.tolist()}
    plate |= {"normal": (-frame.normal).tolist()}
    camera = {"position": placed(-0.6, 0.2, 0.3), "look_at": placed(0.1, -0.1, 0), "up": [0, 1, 0], "fov_deg": 25}
    aim = {"laser_position": placed(0.5, 0, 0.4), "laser_target": placed(0.2, -0.3, 0)}
    config = seen("single", plate, *items, wall=NO_WALL, camera=camera, capture=aim, spp=2048)
    result, to_scene = render(config), scene_of(config).wall.pose
    grid, axis = result.capture.sensor_grid, result.time_axis
    sensors = to_scene.to_scene(grid.positions)
    np.testing.assert_allclose((sensors - middle) @ frame.normal, 0, atol=1e-6)  # float32 of coordinates near 4 m
    laser = np.array([[placed(0.2, -0.3, 0)]])
    np.testing.assert_allclose(to_scene.to_scene(result.capture.laser_grid.positions), laser, atol=1e-6)
    edges = axis.start_opl + axis.bin_width_opl * np.arange(axis.n_bins + 1)
    expected = np.zeros(result.bounce(3).shape)
    cells = rectangle_cells(0.6, 0.5, plate["center"], plate["normal"], plate["up"], n=300)
    for row, column in np.ndindex(3, 5):
        legs = np.linalg.norm(aim["laser_position"] - laser), np.linalg.norm(sensors[row, column] - camera["position"])
        setup = Setup(cells, edges, wall_normal=frame.normal, laser_leg=float(legs[0]), sensor_leg=float(legs[1]))
        expected[:, :, row, column] = third_bounces(setup, laser, sensors[None, None, row, column])[:, :, 0, 0]
    # floor: light of a cell of the quadrature, 2 mm, may fall into the next of 0.02 m bins
    assert_agrees(result.bounce(3), result.bounce_variance(3), expected, replicas=result.plan.replicas, floor=0.01)


def test_a_camera_in_a_sphere_gives_the_listed_points() -> None:
    """What a camera sees of a round relay wall is the list of these points on it, to both engines."""
    wall = {"type": "sphere", "center": [0, 0, 0], "radius": 1.5, "inside": True, "width": None, "height": None}
    camera = {"position": [0.2, 0.1, -0.6], "look_at": [0, 0, -1.5], "fov_deg": 50}
    aim = {"laser_target": [0.3, -0.2, -1.45], "laser_position": camera["position"]}
    keys = {"spp": None, "target_error": 0.05, "max_bounces": 3}
    for engine in ("virtual_lights", "path"):
        config = seen("single", BALL, wall=wall, camera=camera, capture=aim, engine=engine, **keys)
        result = render(config)
        lasers, sensors = (
            np.stack(
                [1.5 * np.arctan2(grid.positions[..., 0], grid.positions[..., 2]), grid.positions[..., 1]], axis=-1
            )
            for grid in (result.capture.laser_grid, result.capture.sensor_grid)
        )
        listed = flat_wall(BALL, wall=wall, capture=DEVICES, engine=engine, **keys)
        del listed["capture"]["sensor_grid"]
        listed["capture"] |= {"sensor_points": sensors.reshape(-1, 2).tolist(), "laser_point": lasers[0, 0].tolist()}
        listed["capture"] |= dict.fromkeys(("laser_position", "sensor_position"), camera["position"])
        expected = render(listed)
        assert (result.samples == 0) == (engine == "virtual_lights")
        second = [each.bounce(2).sum(axis=-1).ravel() for each in (result, expected)]
        np.testing.assert_allclose(*second, rtol=2e-5)  # points of float32
        third = [each.bounce(3).sum(axis=-1).ravel() for each in (result, expected)]
        assert relative_l2(third[0] - third[1], third[1]) < 0.05


CORNER = (  # a floor and a wall that meet at x = 1, and nothing else
    {"type": "rectangle", "width": 2.0, "height": 2.0, "center": [0, 0, 0], "normal": [0, 0, 1]},
    {"type": "rectangle", "width": 2.0, "height": 2.0, "center": [1, 0, 1], "normal": [-1, 0, 0], "up": [0, 0, 1]},
)
RHO = (0.8, 0.3)
EYE = {"position": [-0.7, 0.2, 1.1], "look_at": [1, 0.3, 0.9], "up": [0, 0, 1], "width": 4, "height": 3, "fov_deg": 30}


def corner(scan: str, capture: Any, *more: Any, camera: Any = EYE, **render_keys: Any) -> Rendering:
    items = [{**item, "bsdf": {"type": "diffuse", "reflectance": rho}} for item, rho in zip(CORNER, RHO, strict=True)]
    aim = {"laser_position": [-0.7, 0, 1.2], **capture}
    asked = {"spp": 16, **render_keys}
    return render(seen(scan, *items, *more, wall=NO_WALL, camera=camera, capture=aim, **asked))


def test_second_bounce_between_two_surfaces() -> None:
    """From a spot on the floor to points of a wall: rho rho' cos cos' / (pi r)^2, exact, in the bin of its length."""
    target = np.array([0.3, -0.2, 0.0])
    result = corner("single", {"laser_target": target.tolist()})
    sensors = _frame_of_corner(result)
    way = sensors - target
    r = np.linalg.norm(way, axis=-1)
    cosines = np.maximum(way[..., 2], 0) / r * (np.maximum(way[..., 0], 0) / r)  # floor's normal +z, wall's -x
    expected = RHO[0] * RHO[1] * cosines / (np.pi * r) ** 2
    second = result.bounce(2)[0, 0]
    np.testing.assert_allclose(second.sum(axis=-1), expected, rtol=2e-5)  # float32 positions: 1e-6 of 1 m legs, squared
    opl = np.linalg.norm(target - [-0.7, 0, 1.2]) + r + np.linalg.norm(sensors - EYE["position"], axis=-1)
    assert (second.argmax(axis=-1) == np.floor(opl / result.time_axis.bin_width_opl)).all()


def _frame_of_corner(result: Rendering) -> Any:
    """Return the sensor points in the scene: a scene without relay wall has its frame at the camera's target."""
    return result.capture.sensor_grid.positions + np.array(EYE["look_at"])


def test_points_of_pixels_and_their_normals() -> None:
    """A point lies where the pixel's ray meets its surface; its normal is the surface's, on the side that is seen."""
    result = corner("single", {"laser_target": [0.3, -0.2, 0.0]})
    points, normals = _frame_of_corner(result), result.capture.sensor_grid.normals
    np.testing.assert_allclose(points[..., 0], 1, atol=1e-6)
    np.testing.assert_allclose(normals, np.broadcast_to([-1, 0, 0], normals.shape), atol=1e-6)
    assert (np.diff(points[..., 2], axis=0) > 0).all()  # rows ascend in the picture
    assert (np.diff(points[..., 1], axis=1) < 0).all()  # columns go right: looking along +x with +z up, that is -y
    shifted = corner("single", {"laser_target": [0.3, -0.2, 0.0], "pixel_point": [0, 1]}).capture.sensor_grid.positions
    finer = corner("single", {"laser_target": [0.3, -0.2, 0.0]}, camera={**EYE, "width": 8, "height": 6})
    between = finer.capture.sensor_grid.positions  # of twice as many pixels, four meet in such a point
    mean = (between[1:-1:2, 1:-1:2] + between[2::2, 2::2] + between[1:-1:2, 2::2] + between[2::2, 1:-1:2]) / 4
    # curvature of a plane in perspective over a pixel of 0.1 m seen at 9 degrees: below 1 mm
    np.testing.assert_allclose(shifted[:-1, 1:], mean, atol=1e-3)


def test_the_hidden_volume_leaves_out_what_the_camera_sees() -> None:
    """It is the box of the surfaces without points, which reconstruction looks in; of all where each has some."""
    items = [{**item, "bsdf": WHITE} for item in CORNER]
    ball = {"type": "sphere", "center": [-0.6, 0.2, 2.1], "radius": 0.2}  # behind the camera
    aim = {"laser_position": [-0.7, 0, 1.2], "laser_target": [0.3, -0.2, 0]}
    alone, hiding = (
        scene_of(seen("single", *items, *more, wall=NO_WALL, camera=EYE, capture=aim)) for more in ((), (ball,))
    )
    np.testing.assert_array_equal(alone.unseen_bounds, alone.hidden_bounds)
    low, high = np.array(hiding.unseen_bounds) + EYE["look_at"]
    np.testing.assert_allclose([low, high], [[-0.8, 0, 1.9], [-0.4, 0.4, 2.3]], atol=1e-6)


def test_pixels_that_see_nothing_are_empty() -> None:
    """A pixel beside all surfaces has no light, and the others have theirs as if it were not there."""
    wide = {**EYE, "fov_deg": 100}
    result = corner("single", {"laser_target": [0.3, -0.2, 0.0]}, camera=wide)
    is_empty = result.capture.sensor_grid.is_empty
    assert is_empty is not None
    assert 0 < is_empty.sum() < is_empty.size
    assert not result.total[0, 0][is_empty].any()
    points = _frame_of_corner(result)[~is_empty]
    assert (np.isclose(points[:, 0], 1, atol=1e-6) | np.isclose(points[:, 2], 0, atol=1e-6)).all()


def test_a_file_of_pixels_keeps_which_are_empty(tmp_path: Path) -> None:
    """Position, normal and light of empty pixels are zeros, counted in an attribute, in the file of counts as well."""
    items = [{**item, "bsdf": {"type": "diffuse", "reflectance": 0.5}} for item in CORNER]
    aim = {"laser_position": [-0.7, 0, 1.2], "laser_target": [0.3, -0.2, 0]}
    config = seen("single", *items, wall=NO_WALL, camera={**EYE, "fov_deg": 100}, capture=aim, spp=16)
    validated = configured({**config, "output": {"path": str(tmp_path / "c.hdf5")}})
    warned: list[str] = []
    render_capture(validated, warn=warned.append)
    counts = tmp_path / "counts.hdf5"
    sensor = SensorConfig.model_validate({"photons_per_pulse": {"mean": 0.1}, "pulses": 1000})
    measure_capture(tmp_path / "c.hdf5", counts, sensor)
    for name in ("c.hdf5", "counts.hdf5"):
        assert not check_file(tmp_path / name).violations
        with h5py.File(tmp_path / name) as file:
            is_empty = ~file["cameraGridNormals"][...].any(axis=0)
            assert file.attrs["empty_sensor_points"] == is_empty.sum() > 0
            assert not file["cameraGridPositions"][...][:, is_empty].any()
            light = file["data"][...].sum(axis=(0, 1, 2, 5, 6))  # channel, bin, bounce, lasers
            assert not light[is_empty].any()
            assert light.any()
    assert f"{is_empty.sum()} of 12 pixels see no surface" in " ".join(warned)


def test_coincident_surfaces_are_told_apart() -> None:
    """Of two surfaces in one place every pixel sees the later one, with its BSDF, and a warning says so."""
    poster = {"width": 0.4, "height": 0.4, "center": [1, 0.3, 0.9], "bsdf": {"type": "diffuse", "reflectance": 0.6}}
    aim = {"laser_target": [0.3, -0.2, 0.0]}
    plain, covered = corner("single", aim), corner("single", aim, {**CORNER[1], **poster})
    ratio = covered.bounce(2).sum(axis=-1) / plain.bounce(2).sum(axis=-1)
    on_it = (np.abs(_frame_of_corner(plain)[..., 1:] - [0.3, 0.9]) < 0.2).all(axis=-1)
    assert 0 < on_it.sum() < on_it.size
    np.testing.assert_allclose(ratio[0, 0], np.where(on_it, 0.6 / RHO[1], 1), rtol=1e-4)  # moved by some 1e-5 m


def test_the_laser_lights_what_it_meets_first() -> None:
    """A target behind a surface lights the surface; the spot is the same for each target along the beam."""
    place, target = np.array([-0.7, 0, 1.2]), np.array([0.3, -0.2, 0.0])
    spots = [
        corner("single", {"laser_target": (place + share * (target - place)).tolist()}).capture.laser_grid.positions
        for share in (0.5, 1.0, 3.0)
    ]
    for spot in spots:
        np.testing.assert_allclose(spot[0, 0] + EYE["look_at"], target, atol=1e-6)


@pytest.mark.parametrize(("scan", "key"), [("single", "laser_target"), ("exhaustive", "laser_targets.1")])
def test_a_laser_that_hits_nothing_is_refused(scan: str, key: str) -> None:
    """Its capture would be black: a mistake, with the beam."""
    away = [-0.7, 0.0, 3.0]
    aim = {"laser_target": away} if scan == "single" else {"laser_targets": [[0.3, 0, 0], away]}
    with pytest.raises(ConfigError, match=rf"capture\.{key}: the beam from \[-0\.7, .*meets no surface"):
        corner(scan, aim)


@pytest.mark.parametrize(
    "engine",
    [
        {"engine": "path", "spp": 256, "max_bounces": 4},
        {"engine": "virtual_lights", "spp": None, "target_error": 0.1, "max_bounces": 3},
    ],
    ids=["path", "virtual_lights"],
)
def test_confocal_points_hidden_from_the_laser_stay_dark(engine: dict[str, Any]) -> None:
    """A plate before the laser hides part of the wall: dark and counted there, elsewhere as without the plate."""
    plate = {"type": "rectangle", "width": 0.02, "height": 0.02, "center": [-0.6, 0.01, 1.18], "normal": [1, 0, 0]}
    black = {"bsdf": {"type": "diffuse", "reflectance": 0.0}}
    near = {"laser_position": [-0.7, 0, 1.2]}
    camera = {**EYE, "position": [-0.5, 0.2, 1.1]}
    free = corner("confocal", near, camera=camera, **engine)
    shaded = corner("confocal", near, {**plate, **black, "up": [0, 0, 1]}, camera=camera, **engine)
    n_unlit = shaded.capture.n_unlit_lasers
    assert free.capture.n_unlit_lasers == 0
    assert 0 < n_unlit < 12
    energy = shaded.total.sum(axis=-1)[0, 0]
    assert (energy == 0).sum() == n_unlit
    assert (free.total.sum(axis=-1) > 0).all()


def test_an_exhaustive_scan_of_the_pixels_is_symmetrical() -> None:
    """Without targets the laser points are the pixels': the second bounce is the same from l to s as from s to l."""
    result = corner("exhaustive", {"laser_targets": None}, camera={**EYE, "fov_deg": 70, "look_at": [0.8, 0.3, 0.4]})
    second = result.bounce(2).sum(axis=-1).reshape(12, 12)
    assert np.count_nonzero(second) > 30  # pairs of a point on the floor and one on the wall
    np.testing.assert_allclose(second, second.T, rtol=1e-5)
    assert not np.diag(second).any()


XML = """<scene version="3.0.0"><bsdf type="twosided" id="white"><bsdf type="diffuse">
<rgb name="reflectance" value="1"/></bsdf></bsdf>
<shape type="obj"><string name="filename" value="wall.obj"/><ref id="white"/></shape>
<shape type="rectangle">TURNED<translate x="0.1" y="0.05" z="0.8"/></transform>
<bsdf type="diffuse"><rgb name="reflectance" value="1"/></bsdf></shape></scene>"""
SIZED = '<transform name="to_world"><scale x="0.3" y="0.25"/>'
OBJ = "v -1 -0.8 0\nv 1 -0.8 0\nv 1 0.8 0\nv -1 0.8 0\nf 1 2 3 4\n"


@pytest.mark.parametrize(
    "turned", [f'{SIZED}<rotate y="1" angle="180"/>', f'<boolean name="flip_normals" value="true"/>{SIZED}']
)
def test_a_rectangle_of_a_mitsuba_scene_is_a_wall(tmp_path: Path, turned: str) -> None:
    """Two triangles of a mesh file that all pixels see are the wall of virtual lights, as a rectangle of ours is."""
    (tmp_path / "room.xml").write_text(XML.replace("TURNED", turned), encoding="utf-8")
    (tmp_path / "wall.obj").write_text(OBJ, encoding="utf-8")
    asked = {"engine": "virtual_lights", "spp": None, "target_error": 0.01}
    plate = {**PLATE, "normal": [0, 0, -1], "bsdf": WHITE}
    own = render(seen("single", plate, {**RECTANGLE, "bsdf": WHITE}, wall=NO_WALL, **asked))
    config = seen("single", wall=NO_WALL, **asked)
    config["scene"]["mitsuba"] = "room.xml"
    theirs = render(config, folder=tmp_path)
    assert theirs.samples == 0
    config["scene"]["hidden_geometry"] = [BEHIND]  # and without wall, by paths
    pathwise = render(config, ["render.target_error=0.05", "render.engine=path"], folder=tmp_path)
    assert pathwise.samples > 0
    assert relative_l2(pathwise.total - own.total, own.total) < 0.1
    np.testing.assert_allclose(theirs.capture.sensor_grid.positions, own.capture.sensor_grid.positions, atol=1e-6)
    assert relative_l2(theirs.total - own.total, own.total) < 0.01
