"""HDF5 never sees a disk that fails or a Ctrl-C."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from nlosrender.files.atomic_write import replacing
from nlosrender.files.deferred_error_file import DeferredErrorFile
from nlosrender.files.file_kinds import CAPTURE
from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.interruption import uninterrupted


def failing_after(limit: int) -> Callable[[int, bytes, int], int]:
    """Return a stand-in for os.pwrite that takes no byte beyond ``limit``, and less than asked for before it."""
    true_write = os.pwrite

    def write(descriptor: int, content: bytes, offset: int) -> int:
        if offset >= limit:
            raise OSError(28, "No space left on device")
        return true_write(descriptor, content[: min(len(content), limit - offset, 1000)], offset)

    return write


@pytest.mark.parametrize("limit", [0, 1, 700, 5000, 12_000])
def test_a_full_disk_goes_unnoticed_until_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    """However early the disk fills, HDF5 reads back all it wrote, and the error is kept."""
    monkeypatch.setattr(os, "pwrite", failing_after(limit))
    values = np.random.default_rng(0).random((9, 14, 11))
    stream = DeferredErrorFile(tmp_path / "a")
    with h5py.File(stream, "w", rdcc_nbytes=0) as file:  # without a cache chunks are written and read back at once
        data = file.create_dataset("x", values.shape, "f4", chunks=(4, 5, 3))
        for index in range(0, 9, 2):
            data[index : index + 2] = values[index : index + 2]
        np.testing.assert_array_equal(data[()], values.astype("f4"))
        file.attrs["text"] = "long" * 1000
        assert file.attrs["text"] == "long" * 1000
    with pytest.raises(OSError, match="No space left"):
        stream.raise_error()
    stream.close()
    stream.close()


def test_partial_writes_are_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A system that takes 1000 bytes at a time still gets all of them."""
    monkeypatch.setattr(os, "pwrite", failing_after(10**9))
    stream = DeferredErrorFile(tmp_path / "a")
    with h5py.File(stream, "w") as file:
        file["x"] = np.arange(5000)
    stream.raise_error()
    stream.close()
    with h5py.File(tmp_path / "a") as file:
        np.testing.assert_array_equal(file["x"][()], np.arange(5000))


def test_interrupts_wait() -> None:
    """Ctrl-C inside the block arrives after it, once the block is done."""
    done = []

    def work() -> None:
        with uninterrupted():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            done.append("work")
        done.append("not reached")

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["work"]
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupted_write_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle of HDF5's own writing ends the writer as Ctrl-C anywhere else does."""
    true_write = os.pwrite
    events: list[str] = []

    def interrupted(descriptor: int, content: bytes, offset: int) -> int:
        events.append("begin")
        signal.raise_signal(signal.SIGINT)
        events.append("end")
        return true_write(descriptor, content, offset)

    def render() -> None:
        # no cache: every chunk is written at once
        with replacing(tmp_path / "a.hdf5", CAPTURE) as partial, HDF5Writer(partial, cache_bytes=0) as writer:
            samples = writer.file.create_dataset("data", (20, 50_000), "f4", chunks=(1, 50_000))
            monkeypatch.setattr(os, "pwrite", interrupted)
            for _ in range(3):
                writer.fill(samples, np.s_[:], np.ones((20, 50_000)))

    with pytest.raises(KeyboardInterrupt):
        render()
    assert events[:2] == ["begin", "end"]  # HDF5's call was not cut off
    assert list(tmp_path.iterdir()) == []
