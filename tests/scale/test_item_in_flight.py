"""A unit that takes long: stopped, killed or damaged half-way, the file in the end is that of an undisturbed render."""

from __future__ import annotations

import errno
import math
import os
import signal
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.rendering import configured, flat_wall

from nlosrender import pipeline
from nlosrender.config.document import Config
from nlosrender.engine.backend.start import start_backend
from nlosrender.errors import FileError, IncompleteRender, InterruptedRender
from nlosrender.files.partial.work_item_state import ItemState
from nlosrender.pipeline import render_capture
from nlosrender.rendering.item_in_flight import SavePolicy

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0, 1.0], "normal": [0, 0, -1]}


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    """A capture of one unit in several launches, however fast the machine; a signal ends it at once."""
    start_backend("llvm")
    from nlosrender.engine.launch.schedule import ScheduleTuning

    long_launches = {"schedule": ScheduleTuning(pass_seconds=math.inf)}  # of 1, 4, 20, ... paths a lane
    monkeypatch.setattr(pipeline, "set_up_engine", partial(pipeline.set_up_engine, changes=long_launches))
    scene = flat_wall(PLATE, max_bounces=4, spp=60_000)
    return configured(scene | {"output": {"path": str(tmp_path / "a.hdf5")}})


AT_ONCE = SavePolicy(grace_seconds=0.0)  # a signal ends the item


class Killed(BaseException):
    """The process ends here."""


def at(share: float, end: BaseException | None = None):
    """Return a progress that sends this process a signal at a share of the work, or raises."""
    came = False

    def progress(done: float) -> None:
        nonlocal came
        if done >= share and not came:
            came = True
            if end is not None:
                raise end
            os.kill(os.getpid(), signal.SIGTERM)

    return progress


def states(config: Config) -> list[Path]:
    return list(Path(config.output.path).parent.glob(".a.hdf5.partial/unit.*"))


def samples(config: Config) -> np.ndarray:
    with h5py.File(config.output.path) as file:
        return file["data"][()]


def whole(config: Config) -> np.ndarray:
    render_capture(config)
    content = samples(config)
    Path(config.output.path).unlink()
    assert content.any()
    return content


def test_a_signal_ends_a_long_unit_and_the_same_command_goes_on(config: Config) -> None:
    """No more of the unit is lost than the pass in flight, though not one unit is finished."""
    undisturbed = whole(config)
    with pytest.raises(
        InterruptedRender, match="0 of 1 work items are finished and saved, and so is what was done of the"
    ):
        render_capture(config, at(0.1), saving=AT_ONCE)
    assert len(states(config)) == 1
    shares: list[float] = []
    report = render_capture(config, shares.append, resume=True)
    assert shares[0] >= 0.1  # it begins where the other ended
    assert (report.resumed_units, report.units) == (0, 1)
    np.testing.assert_array_equal(samples(config), undisturbed)
    assert not Path(config.output.path).with_name(".a.hdf5.partial").exists()


def test_a_kill_costs_what_was_done_since_the_last_state(config: Config) -> None:
    """States are kept now and then; the last one is what a later render goes on from."""
    undisturbed = whole(config)
    with pytest.raises(Killed):
        render_capture(config, at(0.1, Killed()), saving=SavePolicy(seconds=0.0))
    assert len(states(config)) == 1
    shares: list[float] = []
    render_capture(config, shares.append)
    assert shares[0] > 0.01
    np.testing.assert_array_equal(samples(config), undisturbed)


def test_a_short_unit_keeps_nothing(config: Config) -> None:
    """States are for units that take longer than ``SavePolicy.seconds``."""
    with pytest.raises(Killed):
        render_capture(config, at(0.1, Killed()))
    assert not Path(config.output.path).with_name(".a.hdf5.partial").exists()


def test_a_damaged_state_begins_the_unit_anew(config: Config) -> None:
    """A flipped bit in the sums, or a state of another target: the checksum tells, and nothing of it is used."""
    undisturbed = whole(config)
    with pytest.raises(InterruptedRender):
        render_capture(config, at(0.1), saving=AT_ONCE)
    (state,) = states(config)
    content = bytearray(state.read_bytes())
    content[-100] ^= 1
    state.write_bytes(content)
    shares: list[float] = []
    render_capture(config, shares.append)
    assert shares[0] < 0.1
    np.testing.assert_array_equal(samples(config), undisturbed)


def test_another_render_is_refused_for_a_state_alone(config: Config) -> None:
    """What is unfinished is not thrown away for a capture of another seed, though no unit is finished."""
    with pytest.raises(InterruptedRender):
        render_capture(config, at(0.1), saving=AT_ONCE)
    other = config.model_copy(update={"render": config.render.model_copy(update={"seed": 7})})
    with pytest.raises(FileError, match="unfinished render of something else"):
        render_capture(other)
    assert len(states(config)) == 1
    render_capture(other, resume=False)
    assert not states(config)


def test_a_disk_that_takes_no_state_stops_all_the_same(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal is obeyed, and what could not be kept is said."""

    def refused(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(ItemState, "write", refused)
    warnings: list[str] = []
    with pytest.raises((InterruptedRender, IncompleteRender), match="nothing is kept"):
        render_capture(config, at(0.1), warnings.append, saving=AT_ONCE)
    assert any("cannot be kept" in warning for warning in warnings)
