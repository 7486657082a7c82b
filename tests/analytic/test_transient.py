"""``nlosrender.transient``: a scene that Mitsuba has loaded gives what the same configuration gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nlosrender as nr
from nlosrender.errors import BackendError, ConfigError, OptionError

pytestmark = pytest.mark.filterwarnings("ignore::nlosrender.NlosWarning")
WALL: dict[str, Any] = {
    "type": "rectangle",
    "width": 2.0,
    "height": 1.5,
    "bsdf": {"type": "diffuse", "reflectance": 0.5},
}
GREY, DARK = ({"type": "diffuse", "reflectance": value} for value in (0.75, 0.25))
TIME = {"bin_width_opl": 0.03125, "n_bins": 150}
RENDER = {"target_error": 0.05, "max_bounces": 3}
X, Y = np.meshgrid(((np.arange(5) + 0.5) / 5 - 0.5) * 2.0, ((np.arange(3) + 0.5) / 3 - 0.5) * 1.5)
SENSORS = np.stack([X, Y], axis=-1)
LASERS = np.array([[0.125, 0.25], [-0.5, 0.25]])


@pytest.fixture
def plates(backend: None) -> Any:
    """A plate and a sphere before the wall, each moved by a matrix, as a Mitsuba scene."""
    import mitsuba as mi

    def make(matrix: Any = None, **added: Any) -> Any:
        to_scene = mi.ScalarTransform4f(np.eye(4) if matrix is None else matrix)
        at = mi.ScalarTransform4f
        plate = to_scene @ at().translate([0.25, 0.125, 1.0]).rotate([0, 1, 0], 180).scale([0.25, 0.5, 1])
        ball = to_scene @ at().translate([-0.5, 0, 0.75]).scale(0.25)
        scene = {"type": "scene", "plate": {"type": "rectangle", "to_world": plate, "bsdf": GREY}}
        return mi.load_dict(scene | {"ball": {"type": "sphere", "to_world": ball, "bsdf": DARK}, **added})

    return make


def test_a_loaded_scene_gives_what_its_configuration_gives(plates: Any, tmp_path: Path) -> None:
    """For each pair of points, within float32: shapes are rounded to it before they are moved, or after."""
    found = nr.transient(plates(), WALL, SENSORS, LASERS, time_axis=TIME, render=RENDER)
    scene = {
        "scene": {
            "relay_wall": WALL,
            "hidden_geometry": [
                {"type": "rectangle", "width": 0.5, "height": 1, "center": [0.25, 0.125, 1], "normal": [0, 0, -1]}
                | {"bsdf": GREY},
                {"type": "sphere", "radius": 0.25, "center": [-0.5, 0, 0.75], "bsdf": DARK},
            ],
        },
        "capture": {"scan_type": "single", "sensor_grid": {"nx": 5, "ny": 3}, "account_first_and_last_bounces": False},
        "time_axis": TIME,
        # the error of the two captures that are rendered alone is settled for each of them: far below the tolerance
        "render": RENDER | {"target_error": 0.01},
    }
    exact = nr.transient(plates(), WALL, SENSORS, LASERS, time_axis=TIME, render=RENDER | {"target_error": 0.01})
    assert found.H.shape == (1, 2, 2, 3, 5, 150)
    assert found.bounces == ("2", "3")
    assert found.opl[0] == 0.03125 / 2
    for index, point in enumerate(LASERS):
        alone = nr.render(scene, tmp_path / f"{index}.hdf5", {"capture.laser_point": point}).numpy()[:, :, 0, 0]
        error = np.linalg.norm(exact.H[:, :, index] - alone) / np.linalg.norm(alone)
        assert error < 2 * 0.01 * 1.25  # both are within what was asked for, and a quarter for the estimate's own error
    assert np.linalg.norm(found.H - exact.H) / np.linalg.norm(exact.H) < 0.05 * 1.25
    assert found.error_estimate < 0.05 * 1.25


def test_the_order_of_the_points_is_that_of_the_result(plates: Any) -> None:
    """Any order and shape; each pair is its own."""
    exact = RENDER | {"target_error": 0.01}
    grid = nr.transient(plates(), WALL, SENSORS, LASERS, time_axis=TIME, render=exact).H
    order = np.random.default_rng(3).permutation(15)
    listed = nr.transient(plates(), WALL, SENSORS.reshape(-1, 2)[order], LASERS[1], time_axis=TIME, render=exact)
    assert listed.H.shape == (1, 2, 15, 150)
    expected = grid[:, :, 1].reshape(1, 2, 15, 150)[:, :, order]
    assert np.linalg.norm(listed.H - expected) / np.linalg.norm(expected) < 2 * 0.01 * 1.25
    paired = nr.transient(plates(), WALL, SENSORS.reshape(-1, 2)[order], time_axis=TIME, render=exact)
    one = nr.transient(plates(), WALL, SENSORS[1, 2], SENSORS[1, 2], time_axis=TIME, render=exact).H
    at = int(np.flatnonzero(order == 7)[0])
    assert np.linalg.norm(paired.H[:, :, at] - one) / np.linalg.norm(one) < 2 * 0.02  # of one point, not of all


def test_light_does_not_depend_on_where_the_scene_stands(plates: Any) -> None:
    """Wall and scene turned and moved together; legs are counted where laser and sensor stand."""
    angle = np.radians(40)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    matrix[:3, :3] = matrix[:3, :3] @ [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    matrix[:3, 3] = [3, -2, 5]
    turned = WALL | {"center": matrix[:3, 3], "normal": matrix[:3, 2], "up": matrix[:3, 1]}
    exact = RENDER | {"target_error": 0.01}
    here = nr.transient(plates(), WALL, SENSORS, LASERS[0], time_axis=TIME, render=exact)
    there = nr.transient(plates(matrix), turned, SENSORS, LASERS[0], time_axis=TIME, render=exact)
    assert np.linalg.norm(there.H - here.H) / np.linalg.norm(here.H) < 2 * 0.01 * 1.25
    # 1 m before the wall's centre: legs of sqrt(1 + 0) m and sqrt(1 + |laser|^2) m for the middle sensor point
    device = (matrix @ [0, 0, 1, 1])[:3]
    legs = 1 + np.sqrt(1 + (LASERS[0] ** 2).sum())
    ends = {"sensor_position": device, "laser_position": device}
    shifted = nr.transient(plates(matrix), turned, [0.0, 0.0], LASERS[0], time_axis=TIME, render=exact, **ends)
    middle = here.H[0, 1, 1, 2]
    assert shifted.H[0, 1] @ shifted.opl / shifted.H[0, 1].sum() == pytest.approx(
        middle @ here.opl / middle.sum() + legs, abs=0.02 * 0.03125
    )


def test_a_scene_without_light_says_why(plates: Any) -> None:
    """A window that ends too early is told, as by a render."""
    with pytest.warns(nr.NlosWarning, match="H is zero everywhere"):
        found = nr.transient(plates(), WALL, SENSORS, time_axis={"bin_width_opl": 0.03, "n_bins": 7}, render=RENDER)
    assert not found.H.any()
    assert found.outside.sum() > 0


@pytest.mark.parametrize(
    ("changed", "kind", "message"),
    [
        ({"scene": "scene.xml"}, ConfigError, "scene: got a str, need a scene of the active variant llvm_ad_mono"),
        ({"sensor_points": SENSORS * 3}, ConfigError, r"capture\.sensor_points.*off the relay wall"),
        ({"sensor_points": SENSORS[..., :1]}, OptionError, r"sensor_points: got shape \(3, 5, 1\), need"),
        (
            {"sensor_points": "points.csv"},
            OptionError,
            "sensor_points: got .points.csv., need an array of real",
        ),
        ({"laser_points": [[0, 0], [1]]}, OptionError, r"laser_points: got .*, need an array of real numbers"),
        ({"sensor_points": SENSORS + 1j}, OptionError, "need an array of real numbers"),
        ({"render": 5}, OptionError, "render: got 5, need a mapping"),
        ({"laser_points": [np.nan, 0]}, ConfigError, r"capture\.laser_points\.0\.0: got nan"),
        ({"sensor_points": np.zeros((2, 2))}, ConfigError, r"capture\.sensor_points\.1: got .* a second time"),
        ({"laser_points": np.zeros((0, 2))}, OptionError, r"laser_points: got shape \(0, 2\)"),
        ({"wall": {"type": "rectangle", "width": 1}}, ConfigError, "scene.relay_wall.height: missing"),
        ({"time_axis": {"bins": 3}}, ConfigError, "time_axis.bins: unknown key"),
        ({"render": {"color": "rgb"}}, OptionError, "render: color is decided by Mitsuba's variant"),
        ({"sensor_position": [0, 0, 1]}, OptionError, "need both"),
    ],
)
def test_mistakes_are_told(plates: Any, changed: dict[str, Any], kind: type[Exception], message: str) -> None:
    """With the argument, and what it takes."""
    arguments = {"scene": plates(), "wall": WALL, "sensor_points": SENSORS, "time_axis": TIME, "render": RENDER}
    with pytest.raises(kind, match=message):
        nr.transient(**(arguments | changed))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"emitter": {"type": "area", "radiance": 1.0}}, "scene: has 1 emitters, and the laser is the only light"),
        ({"interior": {"type": "homogeneous"}}, "scene.x: is filled with a medium"),
        (
            {"bsdf": {"type": "blendbsdf", "weight": 0.5, "a": {"type": "conductor"}, "b": {"type": "diffuse"}}},
            "scene.x: blends a mirror: .* use type: exactblend",
        ),
    ],
)
def test_what_would_come_out_wrong_is_refused(plates: Any, shape: dict[str, Any], message: str) -> None:
    """Never left out."""
    with pytest.raises(ConfigError, match=message):
        nr.transient(plates(x={"type": "sphere", **shape}), WALL, SENSORS, time_axis=TIME, render=RENDER)


@pytest.mark.parametrize(
    ("kind", "scale", "is_round"),
    [
        ("sphere", [0.2, 0.2, 0.2], True),
        ("sphere", [0.2, 0.2, 0.1], False),
        ("cylinder", [0.2, 0.2, 0.1], True),
        ("cylinder", [0.2, 0.1, 0.2], False),
    ],
)
def test_a_stretched_round_shape_is_refused(plates: Any, kind: str, scale: list[float], is_round: bool) -> None:
    """Mitsuba makes one radius of its matrix, while bounds and warnings would be those of the ellipsoid."""
    import mitsuba as mi

    stretched = mi.ScalarTransform4f().translate([0.5, 0, 1.25]).rotate([0.6, 0, 0.8], 40).scale(scale)
    scene = plates(x={"type": kind, "to_world": stretched})
    if is_round:
        nr.transient(scene, WALL, SENSORS, time_axis=TIME, render=RENDER)
    else:
        with pytest.raises(ConfigError, match=f"scene.x: is stretched or sheared .* a {kind} of Mitsuba stays round"):
            nr.transient(scene, WALL, SENSORS, time_axis=TIME, render=RENDER)


def test_other_scenes_of_the_program_play_no_part(plates: Any) -> None:
    """A call through a pointer to a shape is compiled for every shape of the process, also of kinds without samples."""
    import mitsuba as mi

    options = {"time_axis": TIME, "render": {"engine": "path", "spp": 64, "max_bounces": 3}}
    alone = nr.transient(plates(), WALL, SENSORS, **options)
    group = {"type": "shapegroup", "ball": {"type": "sphere"}}
    copy = {"type": "instance", "of": {"type": "ref", "id": "group"}}
    other = mi.load_dict({"type": "scene", "group": group, "copy": copy})
    assert "Instance" in {shape.class_name() for shape in other.shapes()}
    np.testing.assert_array_equal(nr.transient(plates(), WALL, SENSORS, **options).H, alone.H)


def test_other_variants_are_refused() -> None:
    """The engines run on four of them."""
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant("scalar_rgb")
    try:
        with pytest.raises(BackendError, match="variant is scalar_rgb, need one of llvm_ad_mono"):
            nr.transient(None, WALL, SENSORS, time_axis=TIME)
    finally:
        mi.set_variant(before)
