"""``compare_captures`` and ``check_dataset`` on captures whose differences are known."""

from __future__ import annotations

import math
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import write_capture

from nlosrender.analysis.comparison.blocks import BLOCK_SAMPLES
from nlosrender.analysis.comparison.captures import Comparison, Tolerances, compare_captures
from nlosrender.analysis.comparison.dataset import check_dataset
from nlosrender.analysis.comparison.report import comparison_report
from nlosrender.errors import FileError
from nlosrender.files.capture_header import CaptureHeader

ROUNDING = 2e-7  # relative: two float32 roundings of 6e-8 in samples, squares summed in float64
Header = Callable[..., CaptureHeader]


@pytest.fixture
def compare(tmp_path: Path, header_of: Header) -> Callable[..., Comparison]:
    """Write two blocks with one header, or one each, and compare them: ``compare(a, b, tolerances)``."""

    def run(a: np.ndarray, b: np.ndarray, tolerances: Tolerances | None = None, **options: object) -> Comparison:
        header_a = options.get("header") or header_of("exhaustive")
        header_b = options.get("reference") or header_a
        for name, block, header in (("a", a, header_a), ("b", b, header_b)):
            write_capture(tmp_path / f"{name}.hdf5", header, block)
        paths = tmp_path / "a.hdf5", tmp_path / "b.hdf5"
        return compare_captures(*paths, tolerances or Tolerances(), options.get("block_samples", BLOCK_SAMPLES))

    return run


@pytest.mark.parametrize("scan", ["single", "confocal", "exhaustive"])
def test_a_capture_agrees_with_itself(compare: Callable, header_of: Header, block_of: Callable, scan: str) -> None:
    """Without tolerances equal samples pass, and every number says that nothing differs."""
    header = header_of(scan)
    block = block_of(header)
    comparison = compare(block, block, header=header)
    report = comparison_report(comparison)
    assert comparison.failures == ()
    assert report["identical"]
    assert (report["relative_l2"], report["relative_energy"], report["shift_bins"]) == (0, 0, 0)
    assert report["worst"] is report["largest_difference"] is None


def test_norms_and_energies(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """Relative L2 and energies are those of the definition, over everything and per bounce."""
    a, b = block_of(header_of(), 1), block_of(header_of(), 2)
    report = comparison_report(compare(a, b))
    norm = np.linalg.norm
    assert report["relative_l2"] == pytest.approx(norm(a - b) / norm(b), rel=ROUNDING)
    for slot, bounce in enumerate(report["bounces"]):
        x, y = a[:, slot].astype(float), b[:, slot].astype(float)
        assert bounce["bounce"] == str(slot + 2)
        assert bounce["relative_l2"] == pytest.approx(norm(x - y) / norm(y), rel=ROUNDING)
        assert bounce["energy"] == pytest.approx(x.sum(), rel=ROUNDING)
        # the difference of two sums, each off by their rounding
        assert bounce["relative_energy"] == pytest.approx((x.sum() - y.sum()) / y.sum(), abs=2 * ROUNDING)


def test_the_place_of_a_difference_is_named(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """One sample that is changed is found: laser, sensor, bounce, bin, and both values."""
    b = block_of(header_of())
    a = b.copy()
    a[0, 1, 1, 2, 3, 4, 5] += 0.5
    report = comparison_report(compare(a, b))
    place = {"laser": (1, 2), "sensor": (3, 4), "bounce": "3", "bin": 5}
    assert report["worst"] == place
    values = {"channel": 0, "value": float(a[0, 1, 1, 2, 3, 4, 5]), "reference": float(b[0, 1, 1, 2, 3, 4, 5])}
    assert report["largest_difference"] == place | values
    assert not report["agrees"]


@pytest.mark.parametrize(("limit", "passes"), [(0.0099, False), (0.0101, True)])
def test_tolerances_of_norm_and_energy(
    compare: Callable, header_of: Header, block_of: Callable, limit: float, passes: bool
) -> None:
    """A capture 1 % too bright passes at 1.01 % and fails at 0.99 %, by either tolerance."""
    b = block_of(header_of())
    for tolerances in (Tolerances(max_rel_l2=limit), Tolerances(max_energy=limit), Tolerances(limit, limit)):
        assert (compare(b * np.float32(1.01), b, tolerances).failures == ()) is passes


def test_only_the_asked_tolerances_count(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """With --max-shift alone a brighter capture passes; without any it does not."""
    b = block_of(header_of())
    assert compare(b * 2, b, Tolerances(max_shift=0.01)).failures == ()
    assert len(compare(b * 2, b).failures) == 1


def test_energy_is_held_per_bounce(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """Bounces whose changes cancel in the sum fail, each by name; a bounce out of nothing is infinitely more."""
    b = block_of(header_of())
    b[:, 0] = b[:, 1]
    a = b.copy()
    a[:, 0] *= 0.5
    a[:, 1] *= 1.5
    failures = compare(a, b, Tolerances(max_energy=0.1)).failures
    assert [failure.split(":")[0] for failure in failures] == ["energy of bounce 2", "energy of bounce 3"]
    b[:, 0] = 0
    comparison = compare(a, b, Tolerances(max_energy=10.0))
    assert [finding.value for finding in comparison.findings if finding.exceeds] == [math.inf]
    assert comparison_report(comparison)["bounces"][0]["relative_energy"] is None


@pytest.mark.parametrize("shift", [-3.0, -0.25, 0.0, 0.4, 2.0])
def test_shift_in_time(compare: Callable, header_of: Header, shift: float) -> None:
    """Smooth pulses that come later by a part of a bin are found to do so, where each sensor point has its own time."""
    header = header_of("single", n_bins=61)
    time = np.arange(61) + 0.5
    center = 20 + np.arange(20).reshape(4, 5)[..., None] * 0.7

    def pulses(delay: float) -> np.ndarray:
        one = np.exp(-0.5 * ((time - center - delay) / 3) ** 2)
        return np.stack([one, 0.1 * one])[None, :, None, None]

    comparison = compare(pulses(shift), pulses(0), Tolerances(max_shift=0.1), header=header)
    found = comparison_report(comparison)["shift_bins"]
    # the parabola through three points of a Gaussian correlation of width s = 3 sqrt 2: less than 1 / (8 s^2) off
    assert found == pytest.approx(shift, abs=1 / (8 * 18))
    assert (comparison.failures == ()) is (abs(shift) < 0.1)


def test_shift_of_one_laser(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """One laser point of six that is late by one bin is named, and fails the tolerance that the rest meets."""
    b = block_of(header_of())
    b[..., -1] = 0
    a = b.copy()
    a[:, :, 1, 2] = np.roll(b[:, :, 1, 2], 1, axis=-1)
    comparison = compare(a, b, Tolerances(max_shift=0.3))
    # the peak's neighbours of a random histogram are not symmetric: the parabola is off by part of a bin
    assert comparison_report(comparison)["worst_shift"] == {"bins": pytest.approx(1, abs=0.3), "laser": [1, 2]}
    assert any(failure.startswith("shift of laser (1, 2)") for failure in comparison.failures)


CHANGES = {
    "bin width": {"bin_width_opl": 0.004},
    "start of bin 0": {"start_opl": 0.71},
    "frame": {"frame": "scene"},
    "account_first_and_last_bounces": {"account_first_and_last_bounces": False},
    "bins": {"n_bins": 8},
    "channels": {"n_channels": 3},
    "laser position": {"laser_position": np.array([-0.5, 0.1, 0.26])},
    "sensor position": {"sensor_position": np.array([0.3, 0.2, 1.6])},
}


@pytest.mark.parametrize("name", CHANGES)
def test_differences_of_structure(compare: Callable, header_of: Header, block_of: Callable, name: str) -> None:
    """Captures that measure different things are not compared: the property is named with both values."""
    header, other = header_of(), header_of("exhaustive", **CHANGES[name])
    comparison = compare(block_of(header), block_of(other), Tolerances(1e9), header=header, reference=other)
    assert [difference.name for difference in comparison.structure][:1] == [name]
    difference = comparison.structure[0]
    assert difference.value != difference.reference
    assert str(difference) in comparison.failures
    assert comparison_report(comparison)["agrees"] is False


def test_scan_types_and_grids_differ(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """Scan type, numbers of points and their positions are structure; a hidden volume is not."""
    header, other = header_of("exhaustive"), header_of("single")
    names = [d.name for d in compare(block_of(header), block_of(other), header=header, reference=other).structure]
    assert names == ["scan type", "laser points"]
    moved = replace(header, sensor_positions=header.sensor_positions * 1.01)
    names = [d.name for d in compare(block_of(header), block_of(header), header=header, reference=moved).structure]
    assert len(names) == 1
    assert names[0].startswith("sensor positions (worst at row")
    bounds = (np.array([-0.1, -0.2, 0.7]), np.array([0.3, 0.4, 1.3]))
    assert not compare(block_of(header), block_of(header), reference=replace(header, hidden_bounds=bounds)).structure


def test_split_bounces_are_structure(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """Index 1 of a file whose bounces are not split holds all of them: it is no third bounce."""
    header, other = header_of(), header_of("exhaustive", split_bounces=False, bounce_indices=(1,))
    comparison = compare(block_of(header), block_of(other), header=header, reference=other)
    assert [difference.name for difference in comparison.structure] == ["split_bounces"]


def test_files_by_other_writers(tmp_path: Path) -> None:
    """Captures without chunks, attributes and positions are compared by what they have."""
    rng = np.random.default_rng(0)
    samples = rng.random((1, 9, 6, 3, 4), dtype=np.float32)
    for name, factor in (("a", 1.5), ("b", 1.0)):
        with h5py.File(tmp_path / f"{name}.hdf5", "w") as file:
            file["data"] = samples * np.float32(factor)
            file["deltaT"] = np.float32(0.003)
    comparison = compare_captures(tmp_path / "a.hdf5", tmp_path / "b.hdf5", Tolerances(max_rel_l2=0.51))
    assert comparison.failures == ()
    assert comparison_report(comparison)["relative_l2"] == pytest.approx(0.5, rel=ROUNDING)


@pytest.mark.parametrize("shape", [(1, 7, 6, 10**5, 10**5), (1, 10**12, 6, 3, 4), (10**8, 7, 6, 3, 4)])
def test_absurd_shapes(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """A file that claims what no capture has is refused before memory runs out."""
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file.create_dataset("data", shape, "f4", chunks=(1,) * 5)
        file["deltaT"] = 0.003
    with pytest.raises(FileError, match="more than a comparison takes"):
        compare_captures(tmp_path / "a.hdf5", tmp_path / "a.hdf5", Tolerances())


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_samples_that_are_not_finite(tmp_path: Path, header_of: Header, write_capture: Callable, value: float) -> None:
    """A NaN compares with nothing: the file is refused, whichever side it is on."""
    paths = [tmp_path / "a.hdf5", tmp_path / "b.hdf5"]
    for path in paths:
        write_capture(path, header_of())
    with h5py.File(paths[0], "r+") as file:
        file["data"][0, 3, 1, 2, 1, 1, 2] = value
    for order in (paths, paths[::-1]):
        with pytest.raises(FileError, match=r"a\.hdf5: data holds a value that is not finite \(laser 1, 2\)"):
            compare_captures(*order, Tolerances())


def test_empty_captures_agree(compare: Callable, header_of: Header) -> None:
    """No light against no light is no difference; light against none is infinitely much."""
    dark = np.zeros([header_of().sizes[a] for a in ("channel", "bounce", "laser_y", "laser_x")] + [4, 5, 7])
    report = comparison_report(compare(dark, dark, Tolerances(0.0, 0.0, 0.0)))
    assert report["agrees"]
    assert report["shift_bins"] is None
    report = comparison_report(compare(dark + 1, dark, Tolerances(max_rel_l2=1e9)))
    assert not report["agrees"]
    assert report["relative_l2"] is None


SPARSE = """
import resource, sys, time
import h5py, numpy as np
from nlosrender.analysis.comparison.captures import Tolerances, compare_captures
begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
comparison = compare_captures(sys.argv[1], sys.argv[2], Tolerances())
print(comparison.differences.worst.laser, time.perf_counter() - begun)
"""


def test_what_neither_file_stores_is_not_read(tmp_path: Path) -> None:
    """Two captures of 384 GiB with one written chunk each are compared in seconds and little memory."""
    for name, laser in (("a", (31, 40)), ("b", (31, 41))):
        with h5py.File(tmp_path / f"{name}.hdf5", "w") as file:
            chunks = (1, 2048, 1, 8, 16, 1, 1)
            data = file.create_dataset("data", (1, 2048, 6, 64, 64, 64, 64), "f4", chunks=chunks, compression="gzip")
            data[0, 100:200, 1, 8:16, 16:32, *laser] = 1.0
            file["deltaT"] = 0.003

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (2 * 2**30, 2 * 2**30))  # address space: libraries take 0.5 GiB of it

    command = [sys.executable, "-c", SPARSE, str(tmp_path / "a.hdf5"), str(tmp_path / "b.hdf5")]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # each thread reserves address space
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=60, preexec_fn=limit, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(31, 40)")
    assert float(done.stdout.split()[-1]) < 10


def test_blocks_cover_everything(compare: Callable, header_of: Header, block_of: Callable) -> None:
    """However small the blocks are, the numbers are the same."""
    a, b = block_of(header_of(), 1), block_of(header_of(), 2)
    whole = comparison_report(compare(a, b))
    cut = comparison_report(compare(a, b, block_samples=30))  # two sensor points of 2 x 7
    assert cut["largest_difference"] == whole["largest_difference"]
    assert cut["worst"] == whole["worst"]
    assert cut["relative_l2"] == pytest.approx(whole["relative_l2"], rel=1e-12)
    assert cut["shift_bins"] == pytest.approx(whole["shift_bins"], abs=1e-5)


@pytest.mark.parametrize("wrong", [{"max_rel_l2": -0.1}, {"max_shift": math.nan}, {"significance": 1.0}])
def test_impossible_tolerances(wrong: dict[str, float]) -> None:
    """A tolerance that nothing or everything meets is refused by name."""
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: got "):
        Tolerances(**wrong)


def test_a_dataset_against_its_reference(tmp_path: Path, header_of: Header, block_of: Callable) -> None:
    """Every capture of the reference has a verdict: equal, different, missing, unreadable; extra ones are named."""
    block = block_of(header_of())
    names = ("equal.hdf5", "sub/different.h5", "missing.hdf5", "broken.hdf5")
    for name in (*(f"ref/{name}" for name in names), "new/equal.hdf5", "new/sub/different.h5", "new/extra.hdf5"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_capture(path, header_of(), block * np.float32(1.1) if name == "new/sub/different.h5" else block)
    (tmp_path / "new/broken.hdf5").write_text("no capture")
    (tmp_path / "ref/notes.txt").write_text("no capture either")
    (tmp_path / "ref/.hidden.hdf5").write_text("nor this")
    seen = []
    found = check_dataset(tmp_path / "new", tmp_path / "ref", Tolerances(max_rel_l2=0.05), seen.append)
    assert seen == list(found.files)
    assert {file.name: file.status for file in found.files} == {
        "broken.hdf5": "unreadable",
        "equal.hdf5": "ok",
        "missing.hdf5": "missing",
        "sub/different.h5": "exceeds",
    }
    assert found.extra == ("extra.hdf5",)
    assert [file.name for file in found.with_status("exceeds")] == ["sub/different.h5"]
    assert "relative L2: 0.1, tolerance 0.05" in found.with_status("exceeds")[0].message


def test_a_check_of_nothing_does_not_pass(tmp_path: Path) -> None:
    """A reference without captures, and folders that are none, are mistakes."""
    (tmp_path / "file").write_text("x")
    for folder, reference, message in (
        (tmp_path, tmp_path, "holds no capture"),
        (tmp_path, tmp_path / "nowhere", "there is no such folder"),
        (tmp_path / "file", tmp_path, "is no folder"),
    ):
        with pytest.raises(FileError, match=message):
            check_dataset(folder, reference, Tolerances())
