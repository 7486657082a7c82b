"""An unfinished render whose files were damaged on the disk ends in the right file all the same, and says so."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import CONFIG, Stopped, validate_file, write_part

from nlosrender.files.atomic_write import partial_folder
from nlosrender.files.partial.journal import Journal, read_records
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.partial.work_item_log import JournalState

SMALL_CHUNKS = 7 * 2 * 3  # tiles of 2 x 3 of the 4 x 5 sensors, so that there are units

UNITS = 3  # finished before the damage


@pytest.fixture
def stopped(tmp_path: Path, header_of: Callable, block_of: Callable) -> Callable[[str, bool], Path]:
    """Stops a render after ``UNITS`` units, and returns the output: ``stopped(compression, closed)``."""
    path = tmp_path / "a.hdf5"

    def stop(compression: str, closed: bool) -> Path:
        header = header_of("single")
        with pytest.raises(Stopped):
            write_part(path, header, block_of(header), stop_after=UNITS, compression=compression, resume=False)
        if not closed:  # as a kill leaves it
            journal = partial_folder(path) / "journal"
            journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-1]))
        return path

    return stop


def damaged(file: Path, rng: random.Random, kind: str) -> None:
    """Flip a bit of a file, or cut it off, at a random place."""
    content = bytearray(file.read_bytes())
    place = rng.randrange(len(content))
    if kind == "flip":
        content[place] ^= 1 << rng.randrange(8)
    else:
        del content[place:]
    file.write_bytes(content)


def claimed(path: Path) -> PartialCapture:
    return PartialCapture.claim(path, {"config": CONFIG, "variant": "none", "replicas": 2, "part": "the whole capture"})


@pytest.mark.parametrize("compression", ["gzip", pytest.param("none", marks=pytest.mark.slow)])
@pytest.mark.parametrize("closed", [True, False], ids=["stopped", "killed"])
@pytest.mark.parametrize("kind", ["flip", "cut"])
@pytest.mark.parametrize("name", ["samples.0.hdf5", "journal"])
def test_damage_at_random_places(
    stopped: Callable, header_of: Callable, block_of: Callable, compression: str, closed: bool, kind: str, name: str
) -> None:
    """Whatever byte of the samples or of the journal is wrong or missing, the file is what it would have been."""
    header = header_of("single")
    block = block_of(header)
    whole = stopped(compression, closed=True).with_name("whole.hdf5")
    write_part(whole, header, block, compression=compression)
    expected = contents(whole)
    for seed in range(2):
        path = stopped(compression, closed)
        damaged(partial_folder(path) / name, random.Random(seed), kind)
        assert write_part(path, header, block, compression=compression) <= UNITS
        found = contents(path)
        assert found.keys() == expected.keys()
        for dataset in expected:
            np.testing.assert_array_equal(found[dataset], expected[dataset])
        assert validate_file(path) == []
        path.unlink()


def contents(path: Path) -> dict[str, np.ndarray]:
    """Every dataset of a file, and its attributes but the times of day."""
    with h5py.File(path) as file:
        stored = {name: file[name][()] for name in file}
        return stored | {
            f"@{name}": np.asarray(value) for name, value in file.attrs.items() if name not in ("created", "seconds")
        }


@pytest.mark.parametrize("closed", [True, False], ids=["stopped", "killed"])
def test_a_flipped_bit_in_a_chunk_costs_its_unit(
    stopped: Callable, header_of: Callable, block_of: Callable, closed: bool
) -> None:
    """The unit is rendered again, the others are not, and it is said."""
    path = stopped("none", closed)
    folder = partial_folder(path)
    state = JournalState.from_records(read_records(folder / "journal"))
    record = next(record for record in read_records(folder / "journal") if "unit" in record)
    _, _, offset, _, _ = record["chunks"][0]
    with (folder / "samples.0.hdf5").open("r+b") as samples:
        samples.seek(offset + 3)  # the exponent of the first sample
        byte = samples.read(1)[0]
        samples.seek(offset + 3)
        samples.write(bytes([byte ^ 4]))
    with claimed(path) as partial:
        partial.open(header_of("single"), {}, "none", store_variance=True)
        assert partial.finished.items == state.finished.items[1:]
        (message,) = partial.damage
        assert "1 of 3 finished work items are damaged on the disk and are rendered again" in message
    header = header_of("single")
    assert write_part(path, header, block_of(header), compression="none") == UNITS - 1


@pytest.mark.parametrize("length", [0, 1, 3000])
def test_samples_that_were_cut_short_are_said(stopped: Callable, header_of: Callable, length: int) -> None:
    """An empty samples file, too, is built anew."""
    path = stopped("gzip", closed=True)
    with (partial_folder(path) / "samples.0.hdf5").open("r+b") as samples:
        samples.truncate(length)
    with claimed(path) as partial:
        partial.open(header_of("single"), {}, "gzip", store_variance=True)
        assert any("are damaged on the disk and are rendered again" in text for text in partial.damage)


def test_a_flipped_bit_outside_the_chunks_costs_nothing(stopped: Callable, header_of: Callable) -> None:
    """Header and tables are built anew from units that are whole; a position on the wall is not believed."""
    path = stopped("gzip", closed=True)
    samples = partial_folder(path) / "samples.0.hdf5"
    with h5py.File(samples) as file:
        offset = file["cameraGridPositions"].id.get_offset()
    content = bytearray(samples.read_bytes())
    content[offset + 3] ^= 1
    samples.write_bytes(content)
    with claimed(path) as partial:
        partial.open(header_of("single"), {}, "gzip", store_variance=True)
        assert len(partial.finished.items) == UNITS
        assert any("is damaged; it is built anew" in text for text in partial.damage)


def test_a_damaged_journal_is_said(stopped: Callable) -> None:
    """What came after the damage is rendered again; a record that was cut off in a kill is no damage."""
    path = stopped("gzip", closed=True)
    journal = partial_folder(path) / "journal"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(lines[0] + lines[1] + lines[2][:-5])
    with claimed(path) as partial:
        assert (len(partial.finished.items), partial.damage) == (1, [])
    journal.write_bytes(lines[0] + lines[1] + lines[2].replace(b"data", b"dada") + lines[3])
    with claimed(path) as partial:
        assert len(partial.finished.items) == 1
        (message,) = partial.damage
        assert "the units it told of from there on are rendered again" in message


@pytest.mark.parametrize("record", [{"unit": 3}, {"unit": [], "generation": 0}, {"switched_to": "x"}, [1], "text"])
def test_records_of_something_else_are_no_traceback(stopped: Callable, record: object) -> None:
    """A journal that passes its checksums and makes no sense is damage like any other."""
    path = stopped("gzip", closed=True)
    journal = Journal(partial_folder(path) / "journal")
    journal.append(record)  # type: ignore[arg-type]
    journal.close()
    with claimed(path) as partial:
        assert partial.finished.items == []
        assert any("is damaged; everything is rendered again" in text for text in partial.damage)
