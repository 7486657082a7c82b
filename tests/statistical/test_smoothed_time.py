"""Kernel density estimation in time: unbiased for what it estimates, and less noise."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d
from support.rendering import flat_wall, render

from nlosrender.engine.backend.start import start_backend

PLATE = {"type": "rectangle", "width": 0.8, "height": 0.6, "center": [0.1, 0, 1], "normal": [0, 0, -1]}
BINS = (1.8, 0.01, 160)
WIDTH = 8  # bins


def test_a_kernel_estimates_the_smoothed_histogram_with_less_noise() -> None:
    """H with a kernel is H without it, convolved; its variance is far smaller; its total is the same."""
    from nlosrender.engine.launch.temporal_kernel import kernel_shares

    start_backend()
    settings = {"engine": "path", "spp": 4096, "bins": BINS, "sensors": (3, 2)}
    plain = render(flat_wall(PLATE, **settings, seed=1))
    smooth = render(flat_wall(PLATE, **settings, seed=2, temporal_kernel_opl=WIDTH * BINS[1]))
    shares = kernel_shares(WIDTH, WIDTH // 2 + 1)
    expected = convolve1d(plain.total, shares, axis=-1, mode="constant")
    # bins of one row are almost independent: their variances convolve with the squares of the shares
    variance = convolve1d(plain.total_variance, shares**2, axis=-1, mode="constant")
    lit = expected > 1e-3 * expected.max()
    deviation = (smooth.total - expected)[lit]
    scale = np.sqrt(variance.mean() + smooth.total_variance.mean())
    # the mean of many deviations: a bias of a tenth of the noise would show
    assert abs(deviation.mean()) < 0.1 * scale
    assert np.sqrt(np.square(deviation).mean()) < 2 * scale
    assert smooth.total_variance.sum() < 0.4 * plain.total_variance.sum()
    total = [found.total.sum() + found.outside.sum() for found in (plain, smooth)]
    assert abs(total[0] / total[1] - 1) < 0.01


def test_a_kernel_changes_no_light_of_the_same_paths() -> None:
    """The same seed: window and outside together are the same to rounding, also where the window cuts the signal."""
    start_backend()
    settings = {"engine": "path", "spp": 256, "bins": (2.05, 0.01, 12), "sensors": (3, 2), "seed": 3}
    plain = render(flat_wall(PLATE, **settings))
    smooth = render(flat_wall(PLATE, **settings, temporal_kernel_opl=0.07))
    assert smooth.total.sum() < plain.total.sum()
    np.testing.assert_allclose(
        smooth.total.sum(axis=-1) + smooth.outside.sum(axis=(0, 1)),
        plain.total.sum(axis=-1) + plain.outside.sum(axis=(0, 1)),
        rtol=1e-12,
    )
