"""Numbers, names and parameters that once got through, each with the message it now gives."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.rendering import configured, flat_wall

from nlosrender.errors import ConfigError

PLATE = {"type": "rectangle", "width": 0.5, "height": 0.5, "center": [0, 0, 1]}
ITEM = "scene.hidden_geometry.0"


def refused(override: str, match: str, hidden: dict | None = None) -> None:
    """Check that one ``--set`` is refused with a message."""
    with pytest.raises(ConfigError, match=match):
        configured(flat_wall(hidden or PLATE), [override])


@pytest.mark.parametrize(
    ("override", "match"),
    [
        ("scene.relay_wall.width=1e10", r"got 10000000000, need 1e-09 to 1e\+09 m"),
        ("scene.relay_wall.width=1e-300", r"need 1e-09 to 1e\+09 m"),
        ("time_axis.bin_width_opl=1e-12", r"need 1e-09 to 1e\+09 m"),
        ("time_axis.start_opl=1e308", r"need 0 to 1e\+09 m"),
        (f"{ITEM}.center=[0, 0, 1e30]", r"need coordinates up to 1e\+09 m"),
        (f"{ITEM}.normal=[1e308, 0, 0]", "need 3 finite numbers"),
        ("capture.laser_energy=1e300", r"need 1e-15 to 1e\+15 J"),
        ("render.max_bounces=1000000000000", r"need at most 1_000_000\."),
        ("render.spp=100000000000000000000", r"need at most 1_000_000_000_000\."),
        ("render.memory_limit=" + "9" * 400 + "GB", "need auto or a size"),
        ("render.memory_limit=" + "9" * 30000 + "GB", "need auto or a size"),
        ('name="\\ud800"', "halves of characters"),
        (".".join("a" * 5000) + "=1", "got 5000 keys, one inside the other; need at most 32"),
    ],
)
def test_numbers_out_of_all_proportion(override: str, match: str) -> None:
    """Lengths, energies and counts that float32 or a lifetime cannot hold are refused where they stand."""
    refused(override, match)


def test_a_letter_is_no_book() -> None:
    """Text is cut into polygons letter by letter: its length has a bound."""
    letters = {"type": "letters", "text": "Z", "height": 0.5, "center": [0, 0, 1]}
    refused(f"{ITEM}.text={'A' * 100_000}", "need at most 256 characters", letters)


@pytest.mark.parametrize(
    ("shape", "match"),
    [
        ("{type: cylinder, p0: [0, 0], radius: 0.1}", r"p0: got \[0, 0\], need 3 finite numbers"),
        ("{type: cylinder, p0: [0, 0, 1], p1: [0, 0, 1]}", "p0 and p1 are the same point"),
        ("{type: sphere, center: [0, 0, .nan]}", "need a finite number"),
        ("{type: sphere, radius: 0}", r"radius: got 0, need a number from 1e-09 to 1e\+09 m"),
        ("{type: sphere, radius: big}", r"radius: got 'big' \(text\)"),
    ],
)
def test_round_plugin_shapes_have_three_coordinates_and_a_radius(shape: str, match: str) -> None:
    """Their boxes are computed before Mitsuba sees them."""
    refused(f"{ITEM}.shape={shape}", match, {"type": "mitsuba", "shape": {"type": "sphere"}})


@pytest.mark.parametrize("texture", ["volume", "blackbody", "regular", "irregular"])
def test_textures_that_end_or_fail_a_render_are_not_offered(texture: str) -> None:
    """volume without its plugin is a segmentation fault; the others need a spectral variant."""
    refused(f"{ITEM}.bsdf={{type: diffuse, reflectance: {{type: {texture}}}}}", f"got '{texture}'.*need one of bitmap")


def test_the_name_of_a_metal_is_no_path() -> None:
    """Mitsuba makes a file name of it."""
    refused(f"{ITEM}.bsdf={{type: conductor, material: ../../etc/passwd}}", "need the name of a metal")


def test_thousands_of_mistakes_are_told_in_part() -> None:
    """The first hundred, and how many more; each takes a search for the nearest known key."""
    text = "scene: 1\ncapture: 1\n" + "".join(f"k{i}: 1\n" for i in range(2_000))
    with pytest.raises(ConfigError, match=r"19\d\d more mistakes are not listed") as error:
        configured(text)
    assert len(error.value.issues) == 101


def test_a_key_that_is_a_list_is_called_one(tmp_path: Path) -> None:
    """Not by the name of the parser's node."""
    with pytest.raises(ConfigError, match="got a list or mapping as a key, need text"):
        configured("? [a, b]\n: 1\n", folder=tmp_path)
