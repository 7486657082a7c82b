"""Time steps of several bins (docs/virtual-lights.md, 7.7): what they keep of the light, and what they change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nlosrender.engine.backend.start import start_backend

start_backend("llvm")
import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from nlosrender.engine.launch.device_arrays import on_device  # noqa: E402
from nlosrender.engine.launch.histogram import DeviceHistogram, HistogramShape  # noqa: E402
from nlosrender.engine.launch.time_steps import StepKernel, TimeSteps  # noqa: E402
from nlosrender.engine.virtual_lights.vpls.step_sums import StepSums, in_steps  # noqa: E402


def histogram_of(light: NDArray[np.float64], replicas: int = 1) -> DeviceHistogram:
    """Return a histogram with rows of ``light`` (replica and sensor point, slot, bin), and none outside the window."""
    lanes, slots, n_bins = light.shape
    shape = HistogramShape(replicas, lanes // replicas, 1, slots, 1, n_bins)
    rows = np.zeros((lanes, shape.entries_per_lane))
    rows[:, : slots * shape.row] = np.pad(light, ((0, 0), (0, 0), (0, 1))).reshape(lanes, -1)
    result = DeviceHistogram(shape)
    result.sums = on_device(mi.Float64, rows.ravel())
    return result


def rows_of(histogram: DeviceHistogram) -> NDArray[np.float64]:
    """Return the sums (lane, slot, bin), the entry outside the window last."""
    shape = histogram.shape
    lanes = histogram.sums.numpy().reshape(shape.lanes, -1)
    return lanes[:, : shape.slots * shape.row].reshape(shape.lanes, shape.slots, shape.row)


def smooth_light(n_bins: int) -> NDArray[np.float64]:
    """Return light of 3 lanes and 2 slots, a parabola over time each, nowhere negative."""
    time = np.arange(n_bins) / n_bins
    bends = np.array([[-1.0, 0.0], [0.5, 1.0], [2.0, -0.3]])
    return 3 + bends[..., None] * (time - 0.4) ** 2 + np.arange(3)[:, None, None] * time


@pytest.mark.parametrize("bins_per_step", [2, 4, 8])
def test_light_that_is_quadratic_in_time_is_kept(bins_per_step: int) -> None:
    """Roundings to half a step spread it by a variance that is taken back, and parabolas have the mean of each bin.

    Steps of one bin have that variance, too, 1 / 24: in the comparison it is taken back as well. But for three steps at
    either end of the window, where a neighbour is missing; 1e-6: float32 sums of a step.
    """
    light = smooth_light(96)
    found = rows_of(in_steps(histogram_of(light), bins_per_step))[..., :-1]
    expected = light[..., 1:-1] - np.diff(light, 2) / 48
    inner = slice(3 * bins_per_step, -3 * bins_per_step)
    np.testing.assert_allclose(found[..., 1:-1][..., inner], expected[..., inner], rtol=1e-6)


def test_light_of_steps_is_kept_where_the_window_ends_within_one() -> None:
    """101 bins in steps of 8: what the last step holds after the window is counted as outside, and nothing is lost."""
    histogram = histogram_of(np.zeros((3, 2, 101)))
    sums, generator = StepSums(histogram.shape, 8), np.random.default_rng(4)
    assert sums.shape.n_bins == 13
    steps = np.zeros((6, sums.blocks * 8))
    steps[:, :13] = generator.exponential(size=(6, 13))
    sums.sums = on_device(mi.Float, steps.ravel())
    sums.outside = on_device(mi.Float, np.arange(6.0))
    sums.add_to(histogram)
    found = rows_of(histogram).reshape(6, -1)
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=1), steps.sum(axis=1) + np.arange(6), rtol=1e-6)
    last = steps[:, 12] * 3 / 8  # three of eight bins lie behind the window; a line or parabola moves less than half
    assert (np.abs(found[:, -1] - np.arange(6) - last) < last / 2 + 0.1 * steps[:, 11]).all()


@pytest.mark.parametrize("bins_per_step", [2, 5, 16])
def test_smoothed_rows_keep_their_light(bins_per_step: int) -> None:
    """Every step its sum, bins behind the last whole step and the entry outside the window as they are; none negative.

    Light that is linear in time comes out as it is, but in the first and the last step, which have one neighbour.
    """
    generator, n_bins = np.random.default_rng(8), 83
    light = generator.exponential(size=(3, 2, n_bins + 1)) * (generator.random((3, 2, n_bins + 1)) < 0.2)
    light[2] = 1 + np.arange(n_bins + 1) / 7
    kernel = StepKernel(bins_per_step)
    found = kernel.smoothed(on_device(mi.Float64, light.ravel()), n_bins + 1).numpy().reshape(light.shape)
    whole = n_bins // bins_per_step * bins_per_step
    assert found.min() >= 0
    np.testing.assert_array_equal(found[..., whole:], light[..., whole:])
    sums = (rows[..., :whole].reshape(3, 2, -1, bins_per_step).sum(axis=-1) for rows in (found, light))
    np.testing.assert_allclose(next(sums), next(sums), rtol=1e-12, atol=1e-12)
    inner = slice(bins_per_step, whole - bins_per_step)
    np.testing.assert_allclose(found[2][:, inner], light[2][:, inner], rtol=1e-12)


def test_a_window_of_few_steps_is_not_smoothed() -> None:
    values = on_device(mi.Float64, np.random.default_rng(9).random(2 * 32))
    np.testing.assert_array_equal(StepKernel(8).smoothed(values, 32).numpy(), values.numpy())


def test_steps_of_one_bin_change_nothing() -> None:
    light = np.random.default_rng(5).exponential(size=(3, 2, 37))
    histogram = histogram_of(np.zeros_like(light))
    sums = StepSums(histogram.shape, 1)
    padded = np.zeros((3, 2, sums.blocks * 8))
    padded[..., :37] = light
    sums.sums = on_device(mi.Float, padded.ravel())
    sums.add_to(histogram)
    np.testing.assert_array_equal(rows_of(histogram)[..., :-1], light.astype(np.float32))


def test_change_is_told_from_noise() -> None:
    """Noise of the replicas has no expected part in the change: 400 rows of noise twice as strong as a step of light.

    The estimate's standard deviation is that of a mean of 400 products of independent noise, far below a tenth.
    """
    generator = np.random.default_rng(6)
    light = np.where(np.arange(64) < 29, 0.0, 10.0)
    exact = histogram_of(np.broadcast_to(light, (1, 1, 64)))
    change = np.square(rows_of(in_steps(exact, 4)) - rows_of(exact))[..., :-1].sum()
    assert change > 1
    noisy = histogram_of(light + generator.normal(0, 2, (400, 1, 64)), replicas=2)
    steps = TimeSteps.of_pilot(noisy, (4,), 1, 0.0, in_steps)
    assert steps[1].change ** 2 * np.square(light).sum() == pytest.approx(change, rel=0.1)
    # the mean of two has a variance of 2; steps of four bins leave a quarter of it, and what they spread it by less
    assert steps[0].error == pytest.approx(np.sqrt(2 * 64 / np.square(light).sum()), rel=0.05)
    assert steps[0].error / 3 < steps[1].error < steps[0].error / 2


@pytest.mark.parametrize("lengthened", [in_steps, None], ids=["added", "smoothed"])
def test_longer_steps_change_more(lengthened: Any) -> None:
    """Of light that begins at once; the change is that of the whole H, of which more is known from elsewhere."""
    light = np.tile(np.where(np.arange(64) < 29, 0.0, 10.0), (4, 1, 1))
    pilot = histogram_of(light, replicas=2)
    steps = TimeSteps.of_pilot(pilot, (2, 4, 8), 1, 0.0, lengthened)
    assert [step.bins for step in steps] == [1, 2, 4, 8]
    changes = [step.change for step in steps]
    assert changes[0] == 0 < changes[1] < changes[2] < changes[3]
    assert all(step.error == 0 for step in steps)  # replicas are the same
    known = 3 * np.square(light[:2]).sum()  # four times the squares in all
    assert TimeSteps.of_pilot(pilot, (8,), 1, known, lengthened)[1].change == pytest.approx(changes[3] / 2)
    doubled = histogram_of(2 * light, replicas=2)  # by two units
    assert TimeSteps.of_pilot(doubled, (8,), 2, 0.0, lengthened)[1].change == pytest.approx(changes[3])
    dr.sync_thread()
