"""The one definition of a bounce, and where each one goes."""

import pytest

from nlosrender.capture.bounces import BounceAxis


def test_each_bounce_has_its_own_slot_until_the_file_runs_out_of_indices():
    """Bounces 2 to 7 have slots 0 to 5; everything above adds into the last."""
    axis = BounceAxis(max_bounces=None, split=True)
    assert [axis.slot(bounce) for bounce in (2, 3, 4, 5, 6, 7, 8, 100)] == [0, 1, 2, 3, 4, 5, 5, 5]
    assert axis.n_slots == 6
    assert axis.file_indices == (0, 1, 2, 3, 4, 5)


def test_a_render_that_stops_early_has_a_short_axis():
    """With bounces up to 4 there are three slots, and they keep their place in the file."""
    axis = BounceAxis(max_bounces=4, split=True)
    assert (axis.n_slots, axis.file_indices) == (3, (0, 1, 2))


def test_unsplit_light_goes_to_the_index_of_the_third_bounce():
    """Every loader reads index 1."""
    axis = BounceAxis(max_bounces=9, split=False)
    assert {axis.slot(bounce) for bounce in (2, 3, 9)} == {0}
    assert axis.file_indices == (1,)


def test_a_path_has_at_least_two_interactions():
    """There is no bounce 1: the laser point and the sensor point both count."""
    with pytest.raises(ValueError, match="at least 2"):
        BounceAxis(None, split=True).slot(1)


def test_names_say_when_a_slot_holds_more_than_one_bounce():
    """The last slot holds bounce 7 alone only when 7 is the highest bounce."""
    assert BounceAxis(7, split=True).name(5) == "7"
    assert BounceAxis(8, split=True).name(5) == "7 and above"
    assert BounceAxis(None, split=True).name(5) == "7 and above"
    assert BounceAxis(7, split=False).name(0) == "all"
