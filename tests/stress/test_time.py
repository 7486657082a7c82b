"""Laws of the time axis: every delay in its bin, however long the legs, fine the bins or short the window."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import Ledger
from stressed import BOTH, ENGINES, relative_difference, rendered

FAR = {
    "account_first_and_last_bounces": True,
    "laser_position": [300.0, -400.0, 866.0],
    "sensor_position": [-600.0, 0.0, 800.0],
}


@pytest.mark.parametrize("engine", ENGINES)
def test_legs_of_a_kilometre_keep_bins_of_a_third_of_a_millimetre(engine: str, ledger: Ledger) -> None:
    """A patch of 4 micrometres arrives at its path length, 2 km and some metres, in a bin of 0.3 mm."""
    patch = {"type": "rectangle", "width": 4e-6, "height": 4e-6, "center": [0.2, 0.1, 0.8]}
    width, start = 3e-4, 1999.0
    result = rendered(patch, engine=engine, bins=(start, width, 20_000), capture=FAR, max_bounces=3)
    capture = result.capture
    sensors, lasers = (grid.positions.reshape(-1, 3) for grid in (capture.sensor_grid, capture.laser_grid))
    centre = np.array(patch["center"])
    opl = np.linalg.norm(sensors - centre, axis=1) + capture.sensor_legs.ravel()
    opl += np.linalg.norm(lasers - centre, axis=1) + capture.laser_legs.ravel()
    histograms = result.bounce(3).reshape(len(sensors), -1)
    # the patch's size, and float32 paths of 2 engine units: 6e-6 m and 1e-6 m around the centre's delay
    early, late = ((opl + shift - start) / width for shift in (-1e-5, 1e-5))
    for row, first, last in zip(histograms, np.floor(early).astype(int), np.floor(late).astype(int), strict=True):
        assert row.sum() > 0
        astray = 1 - row[first : last + 1].sum() / row.sum()
        ledger.check(f"2 km of legs, bins of 0.3 mm: light outside its bin ({engine})", astray, 1e-12)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_delay_on_an_edge_belongs_to_the_bin_after_it(engine: str, ledger: Ledger) -> None:
    """Light of a plate 1 m in front of a confocal point is never earlier than 2 m, the start of bin 4 of 0.5 m."""
    plate = {"type": "rectangle", "width": 0.1, "height": 0.1, "center": [0.0, 0.0, 1.0]}
    result = rendered(plate, engine=engine, scan="confocal", sensors=(1, 1), bins=(0.0, 0.5, 8), max_bounces=3)
    histogram = result.bounce(3).ravel()
    # float32 cannot tell delays within 1.2e-7 * 2 m of the edge: a disc of radius sqrt(2.4e-7) m around the middle
    share = np.pi * 2.4e-7 / 0.01
    ledger.check(
        f"a delay on a bin's edge: light in the bin before ({engine})", 1 - histogram[4] / histogram.sum(), share
    )


@pytest.mark.parametrize("engine", BOTH)
def test_one_bin_and_65536_bins_hold_the_same_light(engine: str, ledger: Ledger) -> None:
    """However the window is cut, its light is the same: to the last digits for paths, to its error for the gather."""
    coarse = rendered(engine=engine, bins=(0.0, 8.0 / 64, 64), sensors=(3, 2))
    for n_bins in (1, 65536):
        other = rendered(engine=engine, bins=(0.0, 8.0 / n_bins, n_bins), sensors=(3, 2))
        if n_bins == 1:
            deviation = relative_difference(other.total[..., 0], coarse.total.sum(axis=-1))
        else:
            folded = other.total.reshape(*other.total.shape[:-1], 64, -1).sum(axis=-1)
            deviation = relative_difference(folded, coarse.total)
        # the same samples in other bins, sums in another order; the gather cuts its patches to the bins
        tolerance = 1e-9 if engine == "path" else 2 * ENGINES[engine]["target_error"]
        ledger.check(f"1 bin or 65,536 bins hold the light of 64 ({engine})", deviation, tolerance)


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("window", [(100.0, 0.5, 7), (-50.0, 0.5, 7), (1.6, 0.01, 40), (2.0, 1e-3, 1)])
def test_light_is_inside_the_window_or_counted_outside(
    engine: str, window: tuple[float, float, int], ledger: Ledger
) -> None:
    """Whatever the window cuts off: inside plus outside is all there is."""
    settings: dict[str, Any] = {"engine": engine, "max_bounces": 3, "sensors": (3, 2)}
    everything = rendered(bins=(0.0, 0.03125, 320), **settings).total.sum(axis=-1)
    cut = rendered(bins=window, **settings)
    outside = cut.outside.sum(axis=(0, 1))
    if window[0] > 50 or window[0] < 0:
        assert not cut.mean.any()
    # the gather is as fine as the light inside the window needs: where there is none, its first resolution, about 2 %
    tolerance = 1e-9 if engine == "path" else 0.04
    deviation = relative_difference(cut.total.sum(axis=-1) + outside, everything)
    ledger.check(f"inside plus outside of the window is everything ({engine})", deviation, tolerance)
