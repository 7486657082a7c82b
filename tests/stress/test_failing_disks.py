"""``nlosrender`` killed, damaged on the disk, out of space: the right file, or none and the reason. Never exit code 0
with a broken file."""

from __future__ import annotations

import random
import shutil
import signal
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import Ledger
from PIL import Image
from scipy.io import loadmat
from support.render_processes import INTERRUPTED, N_UNITS, PARTIAL, ended, start, wait_for_units

PLACES = 30
SIZES = (0, 2_000, 12_000, 25_000)  # bytes that a file may have


def contents(path: Path) -> dict[str, object]:
    """Every dataset, and what the render says of itself."""
    names = ("samples", "error_estimate", "energy", "out_of_window_energy", "capture_hash")
    with h5py.File(path) as file:
        stored = {name: file[name][()].tobytes() for name in file}
        return stored | {name: file.attrs[name] for name in names}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a configuration, what an undisturbed render makes of it, and its two halves."""
    folder = tmp_path_factory.mktemp("disks")
    (folder / "scene.yaml").write_text(INTERRUPTED)
    for options in (("-o", "whole.hdf5"), ("-o", "1.hdf5", "--shard", "1/2"), ("-o", "2.hdf5", "--shard", "2/2")):
        code, errors = ended(start(folder, "render", "scene.yaml", "--quiet", *options))
        assert code == 0, errors
    return folder


def damage(partial: Path, rng: random.Random) -> str:
    """Do something to a file of an unfinished capture at a random place; return what."""
    kind = rng.choice(["nothing", "flip", "flip", "flip", "cut"])
    if kind == "nothing":
        return kind
    file = rng.choice([*partial.glob("samples.*"), *partial.iterdir()])  # the journal, and a unit in flight
    content = bytearray(file.read_bytes())
    place = rng.randrange(len(content))
    if kind == "flip":
        content[place] ^= 1 << rng.randrange(8)
    else:
        del content[place:]
    file.write_bytes(content)
    return f"{kind} in {file.name.partition('.')[0]}"


@pytest.mark.stress
def test_stopped_killed_and_damaged_at_random_places(folder: Path, ledger: Ledger) -> None:
    """The same command then makes the file of an undisturbed render, or says what is wrong and makes none."""
    whole = contents(folder / "whole.hdf5")
    refused = []
    for seed in range(PLACES):
        rng = random.Random(seed)
        running = start(folder, "render", "scene.yaml", "--quiet")
        wait_for_units(folder, running, rng.randint(1, N_UNITS - 3))
        number = rng.choice([signal.SIGKILL, signal.SIGTERM])
        running.send_signal(number)
        ended(running)
        output, partial = folder / "a.hdf5", folder / PARTIAL
        done = "nothing" if output.exists() else damage(partial, rng)
        code, errors = ended(start(folder, "render", "scene.yaml", "--quiet"))
        fault = ""
        if code == 0:
            fault = "" if contents(output) == whole else "another file"
            check, _ = ended(start(folder, "info", "a.hdf5", "--check"))
            fault = fault or ("info --check" if check else "")
        elif "a.hdf5" not in errors or output.exists():
            fault = f"exit code {code}: {errors}"
        refused.append(code != 0)
        ledger.count(f"render ended by {number.name}, then {done}", refused=code != 0, fault=fault)
        assert not fault, (seed, done, fault)
        output.unlink(missing_ok=True)
        shutil.rmtree(partial, ignore_errors=True)
    assert not all(refused)


def is_whole(path: Path) -> bool:
    """Whether a reader of its kind reads all of a file."""
    if path.suffix == ".hdf5":
        with h5py.File(path) as file:
            return all(np.isfinite(file[name][()]).all() for name in file if file[name].dtype.kind == "f")
    if path.suffix == ".mat":
        return bool(loadmat(path))
    if path.suffix == ".png":
        Image.open(path).load()
    return path.stat().st_size > 0


WRITERS = {
    "a.hdf5": ("render", "scene.yaml", "--overwrite"),
    "merged.hdf5": ("merge", "1.hdf5", "2.hdf5", "-o", "merged.hdf5"),
    "plot.png": ("plot", "whole.hdf5", "-o", "plot.png"),
    "tal.hdf5": ("export", "whole.hdf5", "--format", "tal", "-o", "tal.hdf5"),
    "volume.hdf5": ("reconstruct", "whole.hdf5", "--voxels", "24", "-o", "volume.hdf5"),
    "new.yaml": ("new", "new.yaml", "--force"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk(name: str, folder: Path, ledger: Ledger) -> None:
    """Exit code 1, or 5 where a render goes on, with the name of the file; the earlier file stays as it was, and
    nothing else is left but what a render goes on with."""
    target = folder / name
    target.unlink(missing_ok=True)
    code, errors = ended(start(folder, *WRITERS[name]))
    assert code == 0, errors
    before, present = target.read_bytes(), sorted(folder.iterdir())
    full = 0
    for limit in SIZES:
        code, errors = ended(start(folder, *WRITERS[name], file_limit=limit))
        fault = "" if is_whole(target) else "a broken file"
        if code != 0:
            full += 1
            fault = fault or ("" if target.read_bytes() == before else "the earlier file is gone")
            fault = fault or ("" if code in (1, 5) else f"exit code {code}")
            fault = fault or ("" if f"{name}: cannot be written: File too large" in errors else errors)
            if code == 5:
                shutil.rmtree(folder / f".{name}.partial")
        ledger.count(f"files of at most {limit} bytes", refused=code != 0, fault=fault)
        assert not fault, (limit, fault)
        assert sorted(folder.iterdir()) == present
    assert full > 0
