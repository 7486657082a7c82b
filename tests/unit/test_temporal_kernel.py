"""Kernels in time: where the light of a bin goes, and that none is lost."""

from __future__ import annotations

import numpy as np
import pytest

from nlosrender.capture.limits import refuse_wide_kernel
from nlosrender.capture.time_axis import TimeAxis
from nlosrender.errors import ConfigError

pytestmark = pytest.mark.usefixtures("backend")

WIDTHS = (0.3, 1.0, 2.0, 4.7, 12.0)


@pytest.mark.parametrize("width", WIDTHS)
def test_shares_are_those_of_the_kernel_spread_over_a_bin(width: float) -> None:
    """Against quadrature: a path anywhere in bin 0, its kernel cut at the bins' edges."""
    from nlosrender.engine.launch.temporal_kernel import TemporalKernel

    kernel = TemporalKernel(width)
    half, n = width / 2, 4000
    places = (np.arange(n) + 0.5) / n

    def below(edge: np.ndarray) -> np.ndarray:
        t = np.clip((edge - places) / half, -1, 1)
        return 0.5 + 0.75 * t - 0.25 * t**3

    steps = np.arange(-kernel.reach, kernel.reach + 1)
    expected = [(below(np.full(n, step + 1.0)) - below(np.full(n, float(step)))).mean() for step in steps]
    # the midpoint rule over a kernel of width h bins with n points errs by less than (1 / (n h))^2
    np.testing.assert_allclose(kernel.shares, expected, atol=(1 / (n * width)) ** 2 + 1e-15)
    assert kernel.shares.sum() == pytest.approx(1, abs=1e-14)


@pytest.mark.parametrize("width", WIDTHS)
def test_smoothing_is_a_convolution_that_loses_no_light(width: float) -> None:
    """Every row by itself; what leaves the window goes to the entry for it, at both ends."""
    import mitsuba as mi

    from nlosrender.engine.launch.temporal_kernel import TemporalKernel

    rows, n_bins = 3, 7
    kernel = TemporalKernel(width)
    values = np.random.default_rng(5).random((rows, n_bins + 1))
    found = kernel.smoothed(mi.Float64(values.ravel()), n_bins + 1).numpy().reshape(rows, n_bins + 1)
    whole = np.array([np.convolve(row[:-1], kernel.shares) for row in values])
    np.testing.assert_allclose(found[:, :-1], whole[:, kernel.reach : kernel.reach + n_bins], rtol=1e-13)
    np.testing.assert_allclose(found.sum(axis=1), values.sum(axis=1), rtol=1e-13)


def test_a_kernel_wider_than_the_time_axis_is_refused() -> None:
    """Its work grows with its width in bins: a slip of the pen would take all memory, or all time."""
    axis = TimeAxis(1.0, 0.5, 7)
    refuse_wide_kernel(3.5, axis)
    with pytest.raises(ConfigError, match=r"render.temporal_kernel_opl: got 1e\+09 m, wider than the time axis, 3.5 m"):
        refuse_wide_kernel(1e9, axis)
