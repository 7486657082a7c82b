"""Closed forms of what a camera sees when: single patches, panes of glass, and what adds up to what."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.views import see, view_config

from nlosrender.config.load import load_config
from nlosrender.errors import ConfigError

ROOT = Path(__file__).parents[2]

WALL = {"type": "rectangle", "width": 2, "height": 2, "center": [0, 0, 0], "normal": [0, 0, 1]}
WALL |= {"bsdf": {"type": "diffuse", "reflectance": 0.5}}
PANEL = {"type": "rectangle", "width": 2, "height": 2, "center": [0, 0, 0], "normal": [0, 0, 1], "radiance": 3.0}
PINHOLE = {"fov_deg": 0.01}  # what is seen is a point: 0.7 mm across at 4 m
TOLERANCE = 1e-4  # of the radiance: the pixel's extent changes the angle to the lamp by less


@pytest.mark.parametrize("counts_leg", [True, False])
def test_a_patch_lit_by_a_point(counts_leg: bool) -> None:
    """Radiance rho / pi I cos / r^2 arrives in the bin of the path lamp - patch - camera, and in no other."""
    lamp = np.array([0.3, -0.2, 1.0])
    config = view_config(
        WALL,
        emitters=[{"type": "point", "position": lamp.tolist(), "intensity": 2.0}],
        camera=PINHOLE,
        bins=(1.0, 0.01, 600),
        capture={"account_first_and_last_bounces": counts_leg},
        spp=64,
        max_bounces=1,
    )
    histogram = see(config).mean[0, 1, 1, 2]
    distance = np.linalg.norm(lamp)
    assert np.flatnonzero(histogram).tolist() == [int((distance + (4 if counts_leg else 0) - 1.0) / 0.01)]
    assert histogram.sum() == pytest.approx(0.5 / np.pi * 2.0 * lamp[2] / distance**3, rel=TOLERANCE)


def test_an_emitter_seen_directly() -> None:
    """Bounce 0 holds the emitter's own radiance, at its distance."""
    view = see(view_config(emitters=[PANEL], camera=PINHOLE, bins=(0, 0.03, 200), max_bounces=0, spp=64))
    assert view.mean.shape == (1, 1, 3, 5, 200)
    assert np.flatnonzero(view.mean[0, 0, 2, 4]).tolist() == [133]  # 4 m
    assert view.mean[0, 0, :, :, 133] == pytest.approx(3.0, rel=1e-6)


@pytest.mark.parametrize("index", [1.2, 1.5])
def test_glass_delays_by_its_index(index: float) -> None:
    """A pane of thickness d delays by (n - 1) d and lets (1 - R)^2 through, R = ((n - 1) / (n + 1))^2."""
    pane = {"type": "box", "center": [0, 0, 1.9], "size": [1, 1, 0.5]}
    pane |= {"bsdf": {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}}
    view = see(view_config(pane, emitters=[PANEL], camera=PINHOLE, bins=(0, 0.03, 200), max_bounces=2, spp=4096))
    histogram = view.mean[0, 2].mean(axis=(0, 1))
    assert np.flatnonzero(histogram).tolist() == [int((4 + 0.5 * (index - 1)) / 0.03)]
    through = (1 - ((index - 1) / (index + 1)) ** 2) ** 2
    deviation = np.sqrt(view.variance[0, 2].sum()) / 15
    assert abs(histogram.sum() - 3.0 * through) < 5 * deviation + 1e-5  # 5 sigma of 15 x 4096 choices


def test_rough_glass_delays_connections_too() -> None:
    """What crosses a rough surface on its way to a lamp is no earlier than the straight way through the glass."""
    pane = {"type": "box", "center": [0, 0, 1.9], "size": [3, 3, 0.5]}
    pane |= {"bsdf": {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.03}}
    lamp = {"type": "point", "position": [0, 0, 0], "intensity": 1.0}
    view = see(view_config(pane, emitters=[lamp], camera=PINHOLE, bins=(3.0, 0.01, 300), max_bounces=2, spp=16384))
    histogram = view.mean[0, 2].sum(axis=(0, 1))
    first = round((4 + 0.25 - 3.0) / 0.01)
    assert histogram.sum() > 0
    assert not histogram[: first - 1].any()
    assert histogram[first - 1 : first + 5].sum() > 0.9 * histogram.sum()  # slopes of 0.03 bend it by little


def crowded(**render: object) -> dict:
    """A lamp over a wall and a ball: light of every bounce."""
    ball = {"type": "sphere", "center": [0.3, 0.1, 0.4], "radius": 0.3, "bsdf": {"type": "plastic"}}
    lamp = {"type": "sphere", "center": [-0.5, 0.4, 0.8], "radius": 0.2, "radiance": 2.0}
    return view_config(WALL, ball, emitters=[lamp], **({"spp": 256, "bins": (0, 0.1, 90)} | render))


def test_bounces_add_up() -> None:
    """Bounces apart or together: the same light."""
    apart, together = see(crowded()), see(crowded(split_bounces=False))
    assert apart.mean.shape[1] == 6
    assert apart.mean.sum(axis=1) == pytest.approx(together.mean[:, 0], rel=1e-9)
    assert (apart.mean[:, :4].sum(axis=(0, 2, 3, 4)) > 0).all()


def test_window_and_outside_are_everything() -> None:
    """A window misses what arrives outside it, and reports it."""
    whole, part = see(crowded()), see(crowded(bins=(4.1, 0.1, 3)))
    assert part.outside.sum() > 0.1 * whole.steady.sum()
    assert part.steady == pytest.approx(whole.steady, rel=1e-9)
    assert part.mean == pytest.approx(whole.mean[..., 41:44], rel=1e-6, abs=1e-6)  # float32 at the edges of bins


def test_batches_change_no_bit() -> None:
    """A pixel's light depends on the pixel alone, however the picture is cut, and a launch on no clock."""
    whole, rows = see(crowded()), see(crowded(), batch_rows=1)
    for name in ("mean", "variance", "outside"):
        assert np.array_equal(getattr(whole, name), getattr(rows, name))


def test_samples_of_a_launch_all_count() -> None:
    """Many short launches are one long one, to the last bit."""
    long = see(crowded())
    from nlosrender.engine.launch.schedule import ScheduleTuning  # the backend has been started

    short = see(crowded(), schedule=ScheduleTuning(pass_seconds=1e-9, first_samples=3))
    assert np.array_equal(long.mean, short.mean)


def test_target_error_is_met() -> None:
    """A pilot turns an error into samples, and the picture has that error."""
    view = see(crowded(spp=None, target_error=0.05))
    error = np.sqrt(view.variance.sum() / ((view.mean**2).sum() - view.variance.sum()))
    assert 0.02 < error < 0.06  # the pilot's own error is some 10 %


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<shape type='ply'><string name='filename' value='damaged.ply'/></shape>", "damaged.ply"),
        ("<shape type='sphere'><ref id='nobody'/></shape>", "nobody"),
        (
            "<shape type='cube'><transform name='to_world'><scale value='1e8'/><scale x='1e8'/></transform></shape>",
            "reaches 1e\\+16 m from the origin",
        ),
    ],
)
def test_what_mitsuba_finds_wrong_with_a_scene(content: str, message: str, tmp_path: Path) -> None:
    """Errors that only the loader can find are told at scene.mitsuba, and end no process."""
    (tmp_path / "damaged.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 1\n")
    (tmp_path / "scene.xml").write_text(f"<scene version='3.0.0'>{content}</scene>", encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        see(view_config(emitters=[PANEL], scene={"mitsuba": "scene.xml"}), folder=tmp_path)
    assert caught.value.issues[0].key == "scene.mitsuba"


@pytest.mark.parametrize("axis", ["x", "y", "smaller", "larger", "diagonal"])
def test_field_of_view_of_a_mitsuba_camera(axis: str, tmp_path: Path) -> None:
    """A picture of 6 x 3 pixels that is 40 degrees across ``fov_axis`` sees what Mitsuba's camera would see."""
    (tmp_path / "scene.xml").write_text(
        f"<scene version='3.0.0'><sensor type='perspective'><string name='fov_axis' value='{axis}'/>"
        "<float name='fov' value='40'/><film type='hdrfilm'><integer name='width' value='6'/>"
        "<integer name='height' value='3'/></film></sensor><shape type='sphere'/></scene>",
        encoding="utf-8",
    )
    config = view_config(emitters=[PANEL], scene={"mitsuba": "scene.xml"}, spp=16)
    del config["capture"]["camera"]
    plane = see(config, folder=tmp_path).engine.built.wall
    extent = {"x": 1.0, "larger": 1.0, "y": 0.5, "smaller": 0.5, "diagonal": np.hypot(1, 0.5)}[axis]  # of the width
    half_width = np.tan(np.radians(20)) / extent
    assert plane.width / 2 / plane.distance == pytest.approx(half_width, rel=1e-5)
    assert plane.height == pytest.approx(plane.width / 2)


@pytest.mark.parametrize("index", [{"specular": 0.5}, {}, {"eta": 1.5}])
def test_index_of_a_principled_surface(index: dict[str, float]) -> None:
    """It may be told as ``eta`` or as ``specular``, of which 0.5, the default, is 1.5."""
    ball = {"type": "sphere", "center": [0, 0, 0], "radius": 0.5}
    bsdf = {"type": "principled", "spec_trans": 0.5, **index}
    view = see(view_config({**ball, "bsdf": bsdf}, emitters=[PANEL], spp=16))
    from nlosrender.engine.line_of_sight.view_params import refractive_indices

    assert max(np.array(refractive_indices(view.engine.built.scene))) == pytest.approx(1.5, rel=1e-5)


def test_the_box_of_a_scene_file_holds_the_meshes_that_mitsuba_joins() -> None:
    """The floor and the back wall of the example become one mesh, whose own box Mitsuba leaves empty."""
    view = see(load_config(ROOT / "configs" / "mitsuba-scene.yaml", ["render.spp=1", "time_axis.n_bins=3"]))
    low, high = view.engine.built.hidden_bounds
    # the floor reaches further than lamp, mirror and block, all of which lie within 1.4 m of the middle
    assert float((high - low).max()) > 3
