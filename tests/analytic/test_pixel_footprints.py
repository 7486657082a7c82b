"""Pixels with an area: H of a sensor point is the mean over all that its pixel sees."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from support.agreement import assert_agrees
from support.rendering import Rendering, configured, flat_wall, render
from support.varied_scenes import Stage

from nlosrender.config.load import config_to_dict
from nlosrender.files.validation import check_file
from nlosrender.pipeline import render_capture

NX, NY, FINER = 4, 3, 24
FLOOR = {"type": "rectangle", "width": 2.0, "height": 2.0, "center": [0, 0, 0], "normal": [0, 0, 1]}
SIDE = {"type": "rectangle", "width": 2.0, "height": 2.0, "center": [1, 0, 1], "normal": [-1, 0, 0], "up": [0, 0, 1]}
PLATE = {"type": "rectangle", "width": 0.5, "height": 0.4, "center": [-0.2, 0.1, 1.6], "normal": [0.3, 0, -1]}
ITEMS = [
    {**item, "bsdf": {"type": "diffuse", "reflectance": rho}} for item, rho in ((FLOOR, 0.8), (SIDE, 0.3), (PLATE, 0.7))
]
# sees floor and side, their edge and beside them: pixels of 0.2 to 0.5 m, longer than a bin of 0.1 m
CAMERA = {"position": [-0.7, 0.2, 1.1], "look_at": [0.8, 0.1, 0.4], "up": [0, 0, 1], "fov_deg": 80}
LASER = {"laser_position": [-0.7, 0, 1.2], "account_first_and_last_bounces": True}
AREA = {"footprint": {"pixel": True}}


def described(scan: str = "single", *, finer: int = 1, camera: Any = None, **capture: Any) -> Any:
    """Return the configuration of a corner that a camera of ``finer`` times NX x NY pixels sees."""
    render_keys = {key: capture.pop(key) for key in ("spp", "max_bounces") if key in capture}
    config = flat_wall(*ITEMS, scan=scan, bins=(0.0, 0.1, 110), **{"max_bounces": 4, "spp": 100_000, **render_keys})
    del config["scene"]["relay_wall"], config["capture"]["sensor_grid"]
    for key in ("laser_point", "laser_grid"):
        config["capture"].pop(key, None)
    seen = {**CAMERA, "width": NX * finer, "height": NY * finer, **(camera or {})}
    aim = {"laser_target": [0.3, -0.2, 0]} if scan == "single" else {}
    config["capture"] |= {"camera": seen, **LASER, **aim, **capture}
    return config


def _blocks(fine: Rendering, bounce: int) -> NDArray[np.float64]:
    return fine.bounce(bounce)[0, 0].reshape(NY, FINER, NX, FINER, -1).mean(axis=(1, 3))


def test_a_pixel_is_the_mean_over_its_points() -> None:
    """Bounce by bounce H is the mean over a camera with 24 x 24 times as many pixels, dark ones included."""
    area, fine = render(described(**AREA)), render(described(finer=FINER, spp=700))
    is_empty = fine.capture.sensor_grid.is_empty
    assert is_empty is not None
    seen = 1 - is_empty.reshape(NY, FINER, NX, FINER).mean(axis=(1, 3))
    assert ((seen > 0) & (seen < 1)).sum() > 2
    for bounce in (2, 3, 4):
        expected, found = _blocks(fine, bounce), area.bounce(bounce)[0, 0]
        spread = fine.bounce_variance(bounce)[0, 0].reshape(NY, FINER, NX, FINER, -1).sum(axis=(1, 3)) / FINER**4
        # floor: the second bounce of a point is in one bin, which of 24 points along a side moves a share of 1 / 24
        assert_agrees(
            found,
            area.bounce_variance(bounce)[0, 0],
            expected,
            reference_variance=spread,
            replicas=area.plan.replicas,
            floor=0.02 if bounce == 2 else 0.0,
        )
        sigma = np.sqrt((area.bounce_variance(bounce)[0, 0] + spread).sum(axis=-1))
        # 0.01: the edge and the rim pass through one in 24 cells of a pixel, whose midpoints stand for them
        assert (np.abs((found - expected).sum(axis=-1)) <= 5 * sigma + 0.01 * expected.sum(axis=-1)).all()
    point = render(described())
    off = np.linalg.norm(point.total[0, 0] - _blocks(fine, 2) - _blocks(fine, 3) - _blocks(fine, 4))
    assert off > 0.3 * np.linalg.norm(point.total)  # that of the centres is another one


def test_light_of_a_pixel_tends_to_that_of_its_point_at_second_order() -> None:
    """The energy differs from the point's by an amount that falls to a quarter when the pixel's sides are halved."""
    look, tangent = {"look_at": [0.1, 0.1, 0.0], "width": 1, "height": 1}, 0.12

    def energy(share: float, **capture: Any) -> float:
        camera = {**look, "fov_deg": float(np.degrees(2 * np.arctan(share * tangent)))}
        # the second bounce alone: the spot on the side wall, far from the pixel
        aim = {"laser_target": [1.0, -0.5, 0.6], "max_bounces": 2, "spp": 400_000}
        return float(render(described(camera=camera, **aim, **capture)).total.sum())

    point, half, whole = energy(1), energy(0.5, **AREA), energy(1, **AREA)
    assert 0.002 < abs(whole - point) / point < 0.1
    # 400,000 rays of the same numbers leave 2e-4 of the spread of 10 % over the pixel, a hundredth of the difference
    assert (whole - point) / (half - point) == pytest.approx(4, rel=0.02)


def test_the_laser_of_a_confocal_pixel_stays_a_point() -> None:
    """A confocal pixel is the single capture whose laser lights its ``pixel_point``."""
    camera = {"width": 1, "height": 1, "fov_deg": 30}
    keys = {"camera": camera, "pixel_point": [0, 1], "spp": 200_000, **AREA}
    pair = render(described("confocal", **keys))
    spot = pair.capture.laser_grid.positions[0, 0] + CAMERA["look_at"]
    single = render(described(laser_target=spot.tolist(), **keys))
    for bounce in (2, 3):
        found = (pair.bounce(bounce)[0, 0], pair.bounce_variance(bounce)[0, 0])
        other = single.bounce(bounce)[0, 0], single.bounce_variance(bounce)[0, 0]
        assert found[0].any()
        assert_agrees(*found, other[0], reference_variance=other[1], replicas=pair.plan.replicas)


def test_how_pixels_are_cut_into_batches_changes_no_bit() -> None:
    """Rays of a pixel depend on the pixel, not on the batch that it is in."""
    config = described(spp=64, **AREA)
    whole, cut = render(config), render(config, batch_bytes=250_000)
    assert len(cut.plan.batches) > len(whole.plan.batches)
    assert np.array_equal(whole.mean, cut.mean)


def test_a_file_of_pixels_with_an_area(tmp_path: Path) -> None:
    """It says what H is the mean over; only pixels of which no place sees a surface are empty; paths render it."""
    centres = render(described(spp=16, max_bounces=3)).capture.sensor_grid.is_empty
    config = configured({**described(spp=16, **AREA), "output": {"path": str(tmp_path / "c.hdf5")}})
    assert config_to_dict(configured(config_to_dict(config))) == config_to_dict(config)
    render_capture(config)
    assert not check_file(tmp_path / "c.hdf5").violations
    assert Stage.of(described(**AREA), tmp_path).engine.name == "path"
    with h5py.File(tmp_path / "c.hdf5") as file:
        assert "mean over each pixel" in file.attrs["footprint"]
        is_empty = ~file["cameraGridNormals"][...].any(axis=0)
        assert centres is not None
        assert is_empty.sum() < centres.sum()
        light = file["data"][...].sum(axis=(0, 1, 2, 5, 6))
        assert (light > 0).sum() == (~is_empty).sum()
