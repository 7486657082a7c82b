"""The Z-test of ``nlosrender compare``: no alarm over noise, an alarm over a change that noise does not explain."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import stats
from support.partial_captures import write_capture

from nlosrender.analysis.comparison.captures import Comparison, Tolerances, compare_captures
from nlosrender.analysis.comparison.report import comparison_report
from nlosrender.analysis.comparison.z_test import MIN_FREEDOM, normal_deviate
from nlosrender.errors import FileError

Header = Callable
N_BINS, SIGNIFICANCE = 64, 0.01


class Tracer:
    """Stands in for the path engine: rare deposits of random weight, a few replicas, mean and variance over them."""

    def __init__(self, header: object, paths: float, replicas: int = 2):
        self.header, self.paths, self.replicas = header, paths, replicas
        time = np.arange(N_BINS)
        rows, columns = np.indices((4, 5))
        first = 8 + 4 * rows + 2 * columns
        pulse = np.exp(-np.maximum(time - first[..., None], 0) / 12.0) * (time >= first[..., None])
        lasers = 1 + np.arange(6).reshape(2, 3)[..., None, None, None]
        self.truth = np.stack([pulse * lasers, 0.05 * pulse * lasers])[None]  # (channel, bounce, ly, lx, y, x, bin)

    def render(self, path: Path, seed: int, factor: np.ndarray | float = 1.0, **attributes: object) -> Path:
        """Write a capture in which every bin expects ``paths`` deposits per unit of its light."""
        rng = np.random.default_rng(seed)
        expected = self.truth * factor * self.paths / self.replicas
        replicas = []
        for _ in range(self.replicas):
            counts = rng.poisson(expected)
            # n exponential weights of mean 1 sum to a gamma variate
            weights = rng.gamma(np.maximum(counts, 1e-9)) * (counts > 0)
            replicas.append(weights * self.replicas / self.paths)
        mean = np.mean(replicas, axis=0)
        variance = np.var(replicas, axis=0, ddof=1) / self.replicas
        return write_capture(path, self.header, mean, variance, attributes)


def judge(a: Path, b: Path) -> Comparison:
    """Compare by the Z-test alone."""
    return compare_captures(a, b, Tolerances(significance=SIGNIFICANCE))


def without_variance(path: Path) -> Path:
    """Remove the variance from a file."""
    with h5py.File(path, "r+") as file:
        del file["variance"]
    return path


@pytest.fixture
def tracer(header_of: Header) -> Callable[..., Tracer]:
    """Builder of tracers of a 2 x 3 laser, 4 x 5 sensor capture: ``tracer(paths, replicas)``."""
    return lambda *arguments: Tracer(header_of("exhaustive", n_bins=N_BINS), *arguments)


@pytest.mark.parametrize(
    ("paths", "replicas"),
    [(0.3, 2), (4.0, 6), (100.0, 2)]
    + [pytest.param(*more, marks=pytest.mark.slow) for more in ((0.3, 6), (4.0, 2), (100.0, 6))],
)
def test_noise_raises_no_alarm(tmp_path: Path, tracer: Callable, paths: float, replicas: int) -> None:
    """Captures of one scene agree, however rare their paths and whether the other side is noisy or exact."""
    renders = [tracer(paths, replicas).render(tmp_path / f"{seed}.hdf5", seed, replicas=replicas) for seed in range(4)]
    exact = without_variance(tracer(1e9).render(tmp_path / "exact.hdf5", 99))
    alarms = sum(bool(judge(a, b).failures) for a, b in pairwise(renders))
    alarms += sum(bool(judge(a, exact).failures) for a in renders)
    # 7 judgements at 1 %: two alarms or more have a probability of 0.2 %
    assert alarms <= 1


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("part", ["everything", "one sensor point", "some bins", "one laser"])
def test_changes_raise_an_alarm(tmp_path: Path, tracer: Callable, part: str, exact: bool) -> None:
    """A change of several standard deviations is found wherever it is, and its place is told."""
    # deviations: 200 paths per bin and 2 x weights' variance: 10 % per bin; 12 lit bins 3 %, 20 sensor points 0.7 %
    where, factor = {
        "everything": (..., 1.1),
        "one sensor point": ((slice(None), 0, slice(None), slice(None), 2, 3), 2.0),
        "some bins": ((..., slice(30, 40)), 1.3),
        "one laser": ((slice(None), 0, 1, 2), 1.3),
    }[part]
    change = np.ones((1, 2, 2, 3, 4, 5, N_BINS))
    change[where] = factor
    good = tracer(200.0).render(tmp_path / "good.hdf5", 1)
    if exact:
        good = without_variance(tracer(1e9).render(tmp_path / "good.hdf5", 1))
    comparison = judge(tracer(200.0).render(tmp_path / "changed.hdf5", 2, change), good)
    assert len(comparison.failures) == 1
    report = comparison_report(comparison)["z_test"]
    assert report["z"] > report["limit"]
    worst = report["worst"]
    if part == "one laser":
        assert worst["laser"] == (1, 2)
    if part == "one sensor point":
        assert worst["sensor"] in ((2, 3), None)  # None: the sum over the wall shows it too
    if part == "some bins":
        assert worst["last_bin"] >= 30
        assert worst["first_bin"] < 40


def test_a_bounce_that_is_missing(tmp_path: Path, tracer: Callable) -> None:
    """A bounce that one of the captures does not have at all is an alarm, whatever its noise."""
    change = np.ones((1, 2, 1, 1, 1, 1, 1))
    change[:, 1] = 0
    a = tracer(3.0).render(tmp_path / "a.hdf5", 1, change)
    b = tracer(3.0).render(tmp_path / "b.hdf5", 2)
    comparison = judge(a, b)
    assert comparison.test.worst.bounce == 1
    assert comparison.failures
    assert comparison_report(comparison)["z_test"]["z"] is None  # infinite


def test_errors_that_are_no_noise_add_up(tmp_path: Path, tracer: Callable) -> None:
    """The virtual-light engine's error may have one sign everywhere: 1 % too bright with 1 % of error is no alarm."""
    one = tracer(1e9)
    for name, factor, engine in (("a", 1.01, "virtual_lights"), ("b", 1.0, "path"), ("c", 1.01, "path")):
        path = one.render(tmp_path / f"{name}.hdf5", 1, factor, render_engine=engine)
        with h5py.File(path, "r+") as file:
            file["variance"][...] = (0.01 * file["data"][...]) ** 2
    assert not judge(tmp_path / "a.hdf5", tmp_path / "b.hdf5").failures
    # as noise, 1 % of every bin is 0.05 % of the sum over all
    assert judge(tmp_path / "c.hdf5", tmp_path / "b.hdf5").failures


def test_equal_captures(tmp_path: Path, tracer: Callable) -> None:
    """A capture agrees with itself without any deviation."""
    path = tracer(10.0).render(tmp_path / "a.hdf5", 1)
    comparison = judge(path, path)
    assert comparison.test.z == 0
    assert comparison.test.n_statements > 100
    assert comparison.failures == ()


def test_no_variance_anywhere(tmp_path: Path, tracer: Callable) -> None:
    """Without any variance there is nothing to judge by, and the message says how to get it."""
    path = without_variance(tracer(10.0).render(tmp_path / "a.hdf5", 1))
    with pytest.raises(FileError, match=r"neither it nor .* output\.variance: true"):
        judge(path, path)


def test_a_negative_variance(tmp_path: Path, tracer: Callable) -> None:
    """A variance below zero is a damaged file."""
    path = tracer(10.0).render(tmp_path / "a.hdf5", 1)
    with h5py.File(path, "r+") as file:
        file["variance"][0, 30, 1, 1, 1, 0, 1] = -1
    with pytest.raises(FileError, match="variance is negative"):
        judge(path, path)


@pytest.mark.parametrize("freedom", [MIN_FREEDOM, 30, 1000])
def test_normal_deviate(freedom: float) -> None:
    """z is as rare as t."""
    t = np.array([0.5, 2.0, 5.0, 10.0])
    exact = stats.norm.isf(stats.t.sf(t, freedom))
    # Wallace 1959: better than 1 % for 10 degrees of freedom and more
    assert normal_deviate(t, freedom) == pytest.approx(exact, rel=0.01)


def test_sidak_limit(tmp_path: Path, tracer: Callable) -> None:
    """The limit is what one of n independent normal deviates exceeds with the significance asked for."""
    path = tracer(10.0).render(tmp_path / "a.hdf5", 1)
    test = judge(path, path).test
    stays_below = (1 - 2 * stats.norm.sf(test.limit)) ** test.n_statements
    assert 1 - stays_below == pytest.approx(SIGNIFICANCE, rel=1e-6)
