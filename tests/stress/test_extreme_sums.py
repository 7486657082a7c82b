"""Laws of sums: nothing is lost in them, and the order of work does not matter."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Ledger
from stressed import BOTH, ENGINES, PLATE, relative_difference, scene
from support.rendering import render

from nlosrender.engine.backend.start import start_backend

SIDE = {"type": "rectangle", "width": 1.0, "height": 1.0, "center": [-0.5, 0.0, 0.5], "normal": [1.0, 0.2, -0.1]}


def deposited(first: float, then: float, times: int) -> float:
    """Return a bin's sum after one deposit of ``first`` and ``times`` deposits of ``then``, by lanes and loops."""
    start_backend("llvm")
    import drjit as dr
    import mitsuba as mi

    from nlosrender.engine.launch.histogram import DeviceHistogram, HistogramShape

    lanes = 128
    histogram = DeviceHistogram(HistogramShape(2, lanes // 2, 1, 1, 1, 3))
    lane, zero = dr.arange(mi.UInt32, lanes), dr.zeros(mi.UInt32, lanes)

    def deposit(value: float) -> None:
        histogram.deposit(lane, zero, zero, mi.Int32(1), mi.Spectrum(value), mi.Bool(True))

    deposit(first)
    dr.eval(histogram.sums)

    def deposit_again(i: mi.UInt32) -> tuple[mi.UInt32]:
        deposit(then)
        return (i + 1,)

    count = dr.opaque(mi.UInt32, times // lanes)
    dr.while_loop((dr.zeros(mi.UInt32, lanes),), lambda i: i < count, deposit_again)
    return float(histogram.sums.numpy().reshape(lanes, -1)[:, 1].sum())


@pytest.mark.parametrize("times", [10**6, pytest.param(10**9, marks=pytest.mark.stress)])
@pytest.mark.parametrize(("first", "then"), [(0.0, 0.1), (1e6, 1e-3)])
def test_a_bin_loses_nothing_of_a_billion_deposits(first: float, then: float, times: int, ledger: Ledger) -> None:
    """Sum of 1e9 deposits, also small ones on top of a large one, within 1e-6; float32 would stop at 1.7e7 of them."""
    lanes = 128
    expected = lanes * float(np.float32(first)) + times // lanes * lanes * float(np.float32(then))
    law = f"{times:.0e} deposits of {then:g} upon {first:g} in one bin"
    ledger.check(law, abs(deposited(first, then, times) / expected - 1), 1e-6)


@pytest.mark.stress
@pytest.mark.parametrize("engine", ENGINES)
def test_bounces_sum_to_the_total(engine: str, ledger: Ledger) -> None:
    """Split or not, the light is the same: to rounding by paths, to the stated errors where pilots choose the work.

    A pilot of split bounces does not know how they add up within a bin, and may choose other time steps.
    """
    settings = {"engine": engine, "max_bounces": 5, "sensors": (3, 2)}
    split, whole = (render(scene(PLATE, SIDE, split_bounces=each, **settings)) for each in (True, False))
    tolerance = 1e-6 if engine == "path" else split.error_estimate + whole.error_estimate
    ledger.check(f"bounces sum to the total ({engine})", relative_difference(split.total, whole.total), tolerance)


@pytest.mark.parametrize("engine", BOTH)
@pytest.mark.parametrize("scan", ["confocal", pytest.param("exhaustive", marks=pytest.mark.stress)])
def test_batches_do_not_matter(engine: str, scan: str, ledger: Ledger) -> None:
    """A capture cut into many batches is the capture in one."""
    config = scene(engine=engine, scan=scan, max_bounces=3)
    whole = render(config)
    pair = 2 * 161 * (8 * whole.plan.replicas + 56)
    cut = render(config, batch_bytes=int(2.5 * pair))
    assert len(cut.plan.batches) > len(whole.plan.batches)
    ledger.check(f"batches change nothing ({engine})", relative_difference(cut.mean, whole.mean), 1e-6)


@pytest.mark.parametrize("engine", BOTH)
def test_the_number_of_threads_does_not_matter(engine: str, ledger: Ledger) -> None:
    """A lane owns its rows: one thread or many, the same sums."""
    start_backend("llvm")
    import drjit as dr

    config, before = scene(PLATE, SIDE, engine=engine, max_bounces=4), dr.thread_count()
    try:
        found = []
        for threads in (1, 2, 5):
            dr.set_thread_count(threads)
            found.append(render(config).mean)
    finally:
        dr.set_thread_count(before)
    for other in found[1:]:
        ledger.check(f"thread count changes nothing ({engine})", relative_difference(other, found[0]), 1e-6)
