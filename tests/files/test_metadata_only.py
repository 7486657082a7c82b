"""``nlosrender info`` reads metadata only: as quick for 100 GiB as for a kilobyte."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import h5py

from nlosrender.analysis.summary import summarise

GIB = 2**30


def read_bytes() -> int:
    """Bytes this process has read from files so far, from the page cache or not."""
    fields = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(fields["rchar"])


def test_a_large_file_is_described_in_no_time(tmp_path: Path) -> None:
    """100 GiB of samples, 64 MiB of them on disk, take less than a second and less than a megabyte of reading."""
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", (1, 2048, 6, 64, 64, 16, 34), "f4", chunks=(1, 2048, 1, 8, 16, 1, 1))
        # 64 chunks of one MiB, allocated and not filled: their place in the file is all that metadata could visit
        space = data.id.get_space()
        assert space.get_simple_extent_npoints() * 4 >= 100 * GIB
        piece = bytes(2**20)
        for chunk in range(64):
            data.id.write_direct_chunk((0, 0, 1, 8 * (chunk % 8), 0, chunk // 8, 0), piece)
        file["deltaT"] = 0.003
    before, begun = read_bytes(), time.process_time()
    summary = summarise(path)
    assert time.process_time() - begun < 1
    assert read_bytes() - before < 2**20
    assert summary["size_of_samples"] >= 100 * GIB
    assert summary["size_on_disk"] > 64 * 2**20


def test_damaged_samples_do_not_matter(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """With every byte of every chunk overwritten the summary is the same: none of them was looked at."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of("exhaustive"), store_variance=True)
    before = summarise(path)
    with h5py.File(path) as file:
        datasets = [file["data"].id, file["variance"].id]
        chunks = [dataset.get_chunk_info(i) for dataset in datasets for i in range(dataset.get_num_chunks())]
    with path.open("r+b") as stream:
        for chunk in chunks:
            stream.seek(chunk.byte_offset)
            stream.write(b"\xff" * chunk.size)
    assert len(chunks) == 2 * 2 * 6  # data and variance, two bounces, 2 x 3 lasers
    assert summarise(path) == before
