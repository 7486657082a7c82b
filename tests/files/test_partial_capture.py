"""What is finished survives: an interrupted capture goes on and ends up as if nothing had happened."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import CONFIG, Stopped, items_of, part_of, validate_file, write_part

from nlosrender.capture.part import WHOLE, Selection
from nlosrender.errors import FileError
from nlosrender.files.atomic_write import partial_folder
from nlosrender.files.partial.journal import read_records
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.partial.work_item_log import JournalState

SMALL_CHUNKS = 7 * 2 * 3  # tiles of 2 x 3 of the 4 x 5 sensors, so that there are units


def contents(path: Path) -> dict[str, np.ndarray]:
    """Every dataset of a file."""
    with h5py.File(path) as file:
        return {name: file[name][()] for name in file}


def attributes(path: Path) -> dict[str, object]:
    """What a file says of its samples, times of the day left out."""
    with h5py.File(path) as file:
        return {name: str(value) for name, value in file.attrs.items() if name not in ("created", "seconds")}


def assert_same(one: Path, other: Path) -> None:
    first, second = contents(one), contents(other)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    assert attributes(one) == attributes(other)


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
def test_a_whole_capture_is_a_valid_file_and_nothing_else_is_left(
    tmp_path: Path, header_of: Callable, block_of: Callable, scan_type: str
) -> None:
    """Units add up to the file that one block gives."""
    header = header_of(scan_type)
    block = block_of(header)
    assert write_part(tmp_path / "a.hdf5", header, block) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.hdf5"]
    assert validate_file(tmp_path / "a.hdf5") == []
    stored = contents(tmp_path / "a.hdf5")["data"][0]
    if scan_type != "confocal":
        np.testing.assert_array_equal(stored[:, :2].transpose(1, 4, 5, 2, 3, 0), block[0])
    else:
        np.testing.assert_array_equal(stored[:, :2].transpose(1, 2, 3, 0), block[0, :, 0, 0])


@pytest.mark.parametrize("compression", ["gzip", "none"])
@pytest.mark.parametrize("stops", [(1,), (3, 1, 2), (0, 5)])
def test_an_interrupted_render_goes_on(
    tmp_path: Path, header_of: Callable, block_of: Callable, stops: tuple[int, ...], compression: str
) -> None:
    """However often it is interrupted, the file is the same in all but its times, and no unit is done twice."""
    header = header_of()
    block = block_of(header)
    write_part(tmp_path / "whole.hdf5", header, block, compression=compression)
    path = tmp_path / "a.hdf5"
    for stop in stops:
        with pytest.raises(Stopped):
            write_part(path, header, block, stop_after=stop, compression=compression)
        assert not path.exists()
    assert write_part(path, header, block, compression=compression) == sum(stops)
    assert_same(tmp_path / "whole.hdf5", path)
    assert len(list(tmp_path.iterdir())) == 2


def test_where_nothing_is_finished_nothing_is_left(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """A render that stops before its first unit leaves no trace."""
    with pytest.raises(Stopped):
        write_part(tmp_path / "a.hdf5", header_of(), block_of(header_of()), stop_after=0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("every", [7, pytest.param(1, marks=pytest.mark.slow)])
def test_killed_at_any_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable, every: int
) -> None:
    """Whatever was written last, and if only half of it, what is on disk then leads to the same file.

    A kill leaves exactly the writes before it: the system has them. So the folder is copied before every write and
    in the middle of it, and the render continued from each copy.
    """
    header = header_of("single")
    block = block_of(header)
    write_part(tmp_path / "whole.hdf5", header, block)
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / "a.hdf5"
    copies: list[Path] = []
    true_write = os.pwrite

    def copying(descriptor: int, content: bytes, offset: int) -> int:
        half = len(content) // 2
        for part in (content[:half], content[half:]):
            true_write(descriptor, part, offset)
            offset += len(part)
            copies.append(tmp_path / f"copy{len(copies)}")
            shutil.copytree(partial_folder(path), partial_folder(copies[-1] / "a.hdf5"))
        return len(content)

    monkeypatch.setattr(os, "pwrite", copying)
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=3)  # closing is killed at any byte too
    write_part(path, header, block)  # and so is going on
    monkeypatch.setattr(os, "pwrite", true_write)
    finished = []
    assert len(copies) > 50
    for copy in (*copies[:-1:every], copies[-1]):
        finished.append(write_part(copy / "a.hdf5", header, block))
        assert_same(tmp_path / "whole.hdf5", copy / "a.hdf5")
        assert len(list(copy.iterdir())) == 1
    assert finished == sorted(finished)  # nothing that was once finished is done again
    assert finished[0] == 0
    assert finished[-1] == len(list(items_of(header, part_of(header, WHOLE))))


def test_an_open_file_is_not_trusted(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """HDF5 writes its tables when it likes: only a file that was closed, and not opened since, is gone on with."""
    header = header_of()
    path = tmp_path / "a.hdf5"
    journal = partial_folder(path) / "journal"
    for _ in range(2):
        with pytest.raises(Stopped):
            write_part(path, header, block_of(header), stop_after=1)
        assert JournalState.from_records(read_records(journal)).closed
    with PartialCapture.claim(path, JournalState.from_records(read_records(journal)).first["identity"]) as partial:
        partial.open(header, {}, "gzip", store_variance=True)
        assert not JournalState.from_records(read_records(journal)).closed


def test_dark_chunks_take_no_space(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """A unit without light is noted as finished, and nothing is written for it."""
    header = header_of()
    block = 0 * block_of(header)
    block[0, 1, 1, 2, 3, 4, 6] = 1
    write_part(tmp_path / "a.hdf5", header, block)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert [file[name].id.get_num_chunks() for name in ("data", "variance")] == [1, 1]
        assert file["data"][0, 6, 1, 3, 4, 1, 2] == 1


def test_a_rebuild_that_is_killed_is_begun_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable
) -> None:
    """Building the samples' file anew may be interrupted as well: the old one counts until it is done."""
    header = header_of("single")
    block = block_of(header)
    write_part(tmp_path / "whole.hdf5", header, block)
    path = tmp_path / "a.hdf5"
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=3)
    journal = partial_folder(path) / "journal"
    journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-1]))  # as if not closed properly
    copies: list[Path] = []
    true_write = os.pwrite

    def copying(descriptor: int, content: bytes, offset: int) -> int:
        copies.append(tmp_path / f"copy{len(copies)}")
        shutil.copytree(partial_folder(path), partial_folder(copies[-1] / "a.hdf5"))
        return true_write(descriptor, content, offset)

    monkeypatch.setattr(os, "pwrite", copying)
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=0)
    monkeypatch.setattr(os, "pwrite", true_write)
    assert len(copies) > 10
    for copy in copies[::3]:
        assert write_part(copy / "a.hdf5", header, block) == 3
        assert_same(tmp_path / "whole.hdf5", copy / "a.hdf5")


@pytest.mark.parametrize("share", [0.0, 0.5], ids=["missing", "torn"])
def test_bytes_that_never_reached_the_disk_cost_their_unit(
    tmp_path: Path, header_of: Callable, block_of: Callable, share: float
) -> None:
    """After a power failure the journal may know of more than there is: checksums tell, the unit is done again."""
    header = header_of()
    block = block_of(header)
    write_part(tmp_path / "whole.hdf5", header, block)
    path = tmp_path / "a.hdf5"
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=5)
    folder = partial_folder(path)
    journal = folder / "journal"
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:-1]))  # not closed properly
    _, _, offset, length, _ = json.loads(lines[3].partition(b" ")[2])["chunks"][2]
    (samples,) = folder.glob("samples.*")
    with samples.open("r+b") as stream:
        arrived = round(share * length)
        stream.seek(offset + arrived)
        stream.write(bytes(length - arrived))
    assert write_part(path, header, block) == 4
    assert_same(tmp_path / "whole.hdf5", path)


@pytest.mark.parametrize("built_anew", [False, True])
def test_power_failures_after_going_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable, built_anew: bool
) -> None:
    """Records that nobody waited for are lost, whatever has reached the samples: the file is the same all the same.

    What the journal has for sure is what it was at its last fsync. So the folder is copied before every write and in
    the middle of it, with that journal, and the render continued from the copies.
    """
    header = header_of()
    block = block_of(header)
    write_part(tmp_path / "whole.hdf5", header, block)
    (tmp_path / "run").mkdir()
    path = tmp_path / "run" / "a.hdf5"
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=3)
    journal = partial_folder(path) / "journal"
    if built_anew:
        journal.write_bytes(b"".join(journal.read_bytes().splitlines(keepends=True)[:-1]))  # as if not closed properly
    on_disk = [journal.read_bytes()]  # that run was long ago
    copies: list[Path] = []
    true_write, true_sync = os.pwrite, os.fsync

    def copying(descriptor: int, content: bytes, offset: int) -> int:
        half = len(content) // 2
        for part in (content[:half], content[half:]):
            true_write(descriptor, part, offset)
            offset += len(part)
            copies.append(tmp_path / f"copy{len(copies)}")
            shutil.copytree(partial_folder(path), partial_folder(copies[-1] / "a.hdf5"))
            (partial_folder(copies[-1] / "a.hdf5") / "journal").write_bytes(on_disk[0])
        return len(content)

    def synchronising(descriptor: int) -> None:
        true_sync(descriptor)
        if os.path.samestat(os.fstat(descriptor), journal.stat()):
            on_disk[0] = journal.read_bytes()

    monkeypatch.setattr(os, "pwrite", copying)
    monkeypatch.setattr(os, "fsync", synchronising)
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=2)
    monkeypatch.undo()
    assert len(copies) > 20
    every = 7 if built_anew else 3  # prime to the two halves of a write
    for copy in copies[::every]:
        assert write_part(copy / "a.hdf5", header, block) >= 3  # what was finished long ago is not done again
        assert_same(tmp_path / "whole.hdf5", copy / "a.hdf5")


def test_an_old_journal_does_not_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable
) -> None:
    """What --overwrite throws away is off the disk before the first new sample is on it."""
    path = tmp_path / "a.hdf5"
    with pytest.raises(Stopped):
        write_part(path, header_of(), block_of(header_of()), stop_after=3)
    journal = partial_folder(path) / "journal"
    sizes: list[int] = []
    true_sync = os.fsync

    def synchronising(descriptor: int) -> None:
        true_sync(descriptor)
        if os.path.samestat(os.fstat(descriptor), journal.stat()):
            sizes.append(journal.stat().st_size)

    monkeypatch.setattr(os, "fsync", synchronising)
    with PartialCapture.claim(path, {}, resume=False):
        assert sizes == [0]


def test_another_render_is_not_continued(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """What differs is named; --overwrite starts anew, and the memory limit does not count."""
    header = header_of()
    block = block_of(header)
    path = tmp_path / "a.hdf5"
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=5)
    other = {**CONFIG, "render": {"spp": 16}}
    with pytest.raises(FileError, match=r"unfinished render of something else \(config.render.spp: 8 then, 16 now"):
        write_part(path, header, block, config=other)
    with pytest.raises(FileError, match=r'part: "the whole capture" then, "--shard 1/2" now\). Use --overwrite'):
        write_part(path, header, block, Selection(shard=(1, 2)))
    assert write_part(path, header, 2 * block, config=other, resume=False) == 0
    assert contents(path)["data"].max() == 2 * block.max()


def test_resuming_needs_something_to_resume(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """--resume does not begin a render, and says so when there is a complete one."""
    header = header_of()
    path = tmp_path / "a.hdf5"
    with pytest.raises(FileError, match="there is no unfinished render to resume"):
        write_part(path, header, block_of(header), resume=True)
    assert list(tmp_path.iterdir()) == []
    write_part(path, header, block_of(header))
    with pytest.raises(FileError, match="It is complete: leave out --resume"):
        write_part(path, header, block_of(header), resume=True)


def test_one_render_at_a_time(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """A second render into the same file is refused and harms nothing."""
    path = tmp_path / "a.hdf5"
    with PartialCapture.claim(path, {}) as first:
        with pytest.raises(FileError, match="another render is writing it now"):
            PartialCapture.claim(path, {}, resume=False)
        first.open(header_of(), {}, "gzip", store_variance=False)
        first.publish({})
    assert write_part(path, header_of(), block_of(header_of()), resume=False) == 0


def test_a_full_disk_costs_the_unit_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable
) -> None:
    """When the disk takes no more, the earlier file is untouched and what was finished is kept."""
    header = header_of("single")
    block = block_of(header)
    write_part(tmp_path / "whole.hdf5", header, block)
    true_write = os.pwrite
    kept = set()
    for limit in (1, 12_000, 15_000, 18_000, 20_000):
        path = tmp_path / f"{limit}.hdf5"
        write_part(path, header, 2 * block)  # the same capture, as an earlier render left it
        precious = path.read_bytes()
        left = [limit]

        def filling(descriptor: int, content: bytes, offset: int, left: list[int] = left) -> int:
            if left[0] <= 0:
                raise OSError(28, "No space left on device")
            left[0] -= min(len(content), left[0])
            return true_write(descriptor, content[: max(1, min(len(content), left[0]))], offset)

        monkeypatch.setattr(os, "pwrite", filling)
        with pytest.raises(FileError, match=r"No space left on device\. Free some space"):
            write_part(path, header, block)
        monkeypatch.setattr(os, "pwrite", true_write)
        assert path.read_bytes() == precious
        kept.add(write_part(path, header, block))
        assert_same(tmp_path / "whole.hdf5", path)
    assert min(kept) == 0
    assert max(kept) >= 2


def test_an_interrupt_while_a_unit_is_stored_waits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable
) -> None:
    """Ctrl-C inside a write of HDF5 comes after it; what was finished before is kept."""
    header = header_of()
    block = block_of(header)
    path = tmp_path / "a.hdf5"
    true_write = os.pwrite
    calls = []

    def interrupted(descriptor: int, content: bytes, offset: int) -> int:
        calls.append(1)
        if len(calls) == 60:
            signal.raise_signal(signal.SIGINT)
        return true_write(descriptor, content, offset)

    monkeypatch.setattr(os, "pwrite", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_part(path, header, block)
    assert write_part(path, header, block) > 0
    write_part(tmp_path / "whole.hdf5", header, block)
    assert_same(tmp_path / "whole.hdf5", path)
