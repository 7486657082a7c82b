"""Parts put together are the whole, bit for bit; what does not belong together is refused by name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import CONFIG, part_of, validate_file, write_part

from nlosrender.capture.part import WHOLE, Part, Selection
from nlosrender.errors import FileError, OptionError
from nlosrender.files.partial.work_item_log import CHECKSUM_RANGE, placed_checksum
from nlosrender.files.parts.merge import merge_captures

SMALL_CHUNKS = 7 * 2 * 3  # tiles of 2 x 3 of the 4 x 5 sensors, so that there are units


def write_shards(folder: Path, header, block, count: int, **options) -> list[Path]:
    paths = [folder / f"part{number}.hdf5" for number in range(1, count + 1)]
    for number, path in enumerate(paths, 1):
        write_part(path, header, block, Selection(shard=(number, count)), **options)
    return paths


@pytest.mark.parametrize(
    ("scan_type", "count", "compression"),
    [
        *(("exhaustive", 1, "none"), ("exhaustive", 4, "gzip"), ("exhaustive", 6, "none"), ("exhaustive", 8, "gzip")),
        *(("single", 3, "gzip"), ("confocal", 8, "none")),
    ],
)
def test_shards_add_up_to_the_whole(
    tmp_path: Path, header_of: Callable, block_of: Callable, scan_type: str, count: int, compression: str
) -> None:
    """Lasers dealt out, or rows of the sensor grid where there are more shards than lasers: the result is the same."""
    header = header_of(scan_type, n_channels=3)
    block = np.where(block_of(header) < 0.2, 0, block_of(header))
    block[:, 0, ..., :2, :3, :] = 0  # a dark chunk
    write_part(tmp_path / "whole.hdf5", header, block, compression=compression)
    paths = write_shards(tmp_path, header, block, count, compression=compression)
    report = merge_captures([*paths[1:], paths[0]], tmp_path / "merged.hdf5")
    assert report.parts == count
    assert validate_file(tmp_path / "merged.hdf5") == []
    with h5py.File(tmp_path / "whole.hdf5") as whole, h5py.File(tmp_path / "merged.hdf5") as merged:
        assert set(whole) == set(merged)
        for name in whole:
            np.testing.assert_array_equal(whole[name][()], merged[name][()])
            assert dict(whole[name].attrs).keys() == dict(merged[name].attrs).keys()
        assert whole["data"].id.get_num_chunks() == merged["data"].id.get_num_chunks()
        differing = {
            name for name in {*whole.attrs, *merged.attrs} if str(whole.attrs.get(name)) != str(merged.attrs.get(name))
        }
        assert differing <= {"created", "seconds", "config", "config_hash"}
        assert json.loads(merged.attrs["config"])["output"]["path"] == str(tmp_path / "merged.hdf5")
        assert json.loads(merged.attrs["seconds"])["render"] == 0.5 * count


def test_laser_ranges_of_any_length(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """--lasers A:B cuts where the user likes, across rows of the laser grid too."""
    header = header_of()
    block = block_of(header)
    paths = []
    for first, last in ((0, 1), (1, 5), (5, 6)):
        paths.append(tmp_path / f"{first}.hdf5")
        write_part(paths[-1], header, block, Selection(lasers=(first, last)))
    merge_captures(paths, tmp_path / "merged.hdf5")
    with h5py.File(tmp_path / "merged.hdf5") as file:
        np.testing.assert_array_equal(np.transpose(file["data"][0], (1, 4, 5, 2, 3, 0))[:2], block[0])


def test_warnings_and_omitted_work_of_all_parts_are_kept(tmp_path: Path, shards: list[Path]) -> None:
    """Each text once, in the order of the parts."""
    for number, path in enumerate(shards):
        with h5py.File(path, "r+") as file:
            file.attrs["warnings"] = json.dumps(["of all", f"of part {number}"])
            file.attrs["omitted_work"] = json.dumps(["colour"])
    merge_captures(shards, tmp_path / "merged.hdf5")
    with h5py.File(tmp_path / "merged.hdf5") as file:
        expected = ["of all", *(f"of part {number}" for number in range(len(shards)))]
        assert json.loads(file.attrs["warnings"]) == expected
        assert json.loads(file.attrs["omitted_work"]) == ["colour"]


def test_a_shard_says_what_it_holds(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """Alone it is a valid file, dark where other shards are lit, and its attributes say so."""
    header = header_of()
    block = block_of(header)
    (path, *_) = write_shards(tmp_path, header, block, 2)
    assert validate_file(path) == []
    with h5py.File(path) as file:
        stored = np.transpose(file["data"][0], (1, 4, 5, 2, 3, 0))[:2]
        np.testing.assert_array_equal(stored[:, :1], block[0, :, :1])
        assert not stored[:, 1:].any()
        assert json.loads(file.attrs["part"]) == {"lasers": [0, 3], "strips": [0, 8], "sensor_tiles": [[0, 4, 0, 5]]}
        assert "nlosrender merge" in file.attrs["incomplete"]


def test_strips_are_dealt_tile_after_tile(header_of: Callable) -> None:
    """Ranges of strips of a 4 x 5 grid in tiles of 2 x 3 name the rows they mean."""
    from support.partial_captures import tiling_of

    tiling = tiling_of(header_of("single"))
    assert (tiling.rows, tiling.columns, tiling.n_strips) == (2, 3, 8)
    cells = [(c.y0, c.y1, c.x0, c.x1) for c in tiling.cells((1, 6))]
    assert cells == [(1, 2, 0, 3), (0, 2, 3, 5), (2, 4, 0, 3)]


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 6, 8])
def test_shards_cover_everything_once(header_of: Callable, scan_type: str, count: int) -> None:
    """Whatever their number, every pair of a laser and a strip is in one shard, and none is empty."""
    header = header_of(scan_type)
    whole = part_of(header, WHOLE)
    seen = np.zeros((whole.lasers[1], whole.strips[1]), dtype=int)
    for number in range(1, count + 1):
        part = part_of(header, Selection(shard=(number, count)))
        seen[slice(*part.lasers), slice(*part.strips)] += 1
        assert part.lasers[0] < part.lasers[1]
        assert part.strips[0] < part.strips[1]
    assert (seen == 1).all()


@pytest.mark.parametrize(
    ("scan_type", "selection", "message"),
    [
        ("exhaustive", Selection(shard=(1, 9)), "--shard 1/9: this capture can be cut into at most 8 shards"),
        ("exhaustive", Selection(shard=(3, 2)), "--shard 3/2: need I/N with 1 <= I <= N"),
        ("exhaustive", Selection(shard=(0, 2)), "--shard 0/2: need I/N"),
        ("exhaustive", Selection(lasers=(2, 7)), "--lasers 2:7: need A < B, and the laser points .* are 0:6"),
        ("exhaustive", Selection(lasers=(2, 2)), "--lasers 2:2: need A < B"),
        ("confocal", Selection(lasers=(0, 4)), "are 0:1; cut it with --shard"),
    ],
)
def test_parts_that_do_not_exist(header_of: Callable, scan_type: str, selection: Selection, message: str) -> None:
    """A part that the capture does not have is refused with what it has."""
    with pytest.raises(OptionError, match=message):
        part_of(header_of(scan_type), selection)


def test_parts_are_kept_as_text() -> None:
    """Ranges come back from JSON, and nonsense does not."""
    part = Part((2, 5), (0, 3))
    assert Part.from_json(json.loads(json.dumps(part.as_json()))) == part
    for nonsense in ({}, {"lasers": [0, 1]}, {"lasers": [3, 2], "strips": [0, 1]}, {"lasers": "01", "strips": [0, 1]}):
        with pytest.raises(ValueError, match="need a range"):
            Part.from_json(nonsense)


# --- refusals ---


@pytest.fixture
def shards(tmp_path: Path, header_of: Callable, block_of: Callable) -> list[Path]:
    """Four shards of 2 x 3 lasers: 0:1, 1:3, 3:4, 4:6."""
    header = header_of()
    return write_shards(tmp_path, header, block_of(header), 4)


def refused(paths: list[Path], output: Path, message: str) -> None:
    before = sorted(output.parent.iterdir())
    with pytest.raises(FileError, match=message):
        merge_captures(paths, output)
    assert sorted(output.parent.iterdir()) == before


def test_gaps_are_named(tmp_path: Path, shards: list[Path]) -> None:
    """What no file holds is listed."""
    refused([shards[0], shards[2]], tmp_path / "m.hdf5", r"missing: lasers 1:3 \(of 6 .*\n?.*missing: lasers 4:6")


def test_overlaps_are_named(tmp_path: Path, shards: list[Path], header_of: Callable, block_of: Callable) -> None:
    """Both files and what they share."""
    write_part(tmp_path / "more.hdf5", header_of(), block_of(header_of()), Selection(lasers=(2, 4)))
    message = r"more.hdf5 \(lasers 2:4, strips 0:8\) overlaps .*part2.hdf5 \(lasers 1:3, strips 0:8\) in lasers 2:3"
    refused([*shards, tmp_path / "more.hdf5"], tmp_path / "m.hdf5", message)
    refused([*shards, shards[1]], tmp_path / "m.hdf5", r"part2.hdf5 .*overlaps .*part2.hdf5")


def test_strangers_are_named(tmp_path: Path, shards: list[Path], header_of: Callable, block_of: Callable) -> None:
    """A shard of another capture, with the key that differs; a whole capture; no capture at all."""
    header = header_of()
    other = tmp_path / "other.hdf5"
    config = {**CONFIG, "render": {"spp": 16}}
    write_part(other, header, block_of(header), Selection(shard=(4, 4)), config=config)
    refused([*shards[:3], other], tmp_path / "m.hdf5", r"other.hdf5: belongs to another .*render.spp: 16, there 8")
    write_part(other, header, block_of(header), resume=False)
    refused([*shards[:3], other], tmp_path / "m.hdf5", r"other.hdf5: is no part of a capture")
    other.write_text("text")
    refused([*shards[:3], other], tmp_path / "m.hdf5", r"other.hdf5: is not an HDF5 file")
    refused([*shards[:3], tmp_path / "none"], tmp_path / "m.hdf5", r"none: there is no such file")


def test_other_versions_and_meshes_are_named(tmp_path: Path, shards: list[Path]) -> None:
    """The same configuration rendered by something else, or of a mesh that has changed since."""
    with h5py.File(shards[1], "r+") as file:
        file.attrs["versions"] = json.dumps({**json.loads(file.attrs["versions"]), "mitsuba": "2.0"})
    refused(shards, tmp_path / "m.hdf5", r"part2.hdf5: was rendered otherwise than .*part1.hdf5 \(mitsuba: 2.0, there")
    with h5py.File(shards[1], "r+") as file, h5py.File(shards[0]) as first:
        file.attrs["versions"] = first.attrs["versions"]
        file.attrs["capture_hash"] = "0" * 64
    refused(shards, tmp_path / "m.hdf5", r"part2.hdf5: belongs to another .*a mesh or texture .* has changed")


@pytest.mark.parametrize("number", [0, 2])
def test_a_damaged_shard_is_named(tmp_path: Path, shards: list[Path], number: int) -> None:
    """One flipped bit in the samples, whichever shard it is in, or a chunk that is gone."""
    whole = shards[number].read_bytes()
    with h5py.File(shards[number]) as file:
        place = file["variance"].id.get_chunk_info(3)
    content = bytearray(whole)
    content[place.byte_offset + place.size // 2] ^= 1
    shards[number].write_bytes(content)
    refused(shards, tmp_path / "m.hdf5", rf"part{number + 1}.hdf5 \(lasers .*\): is damaged: its variance is not what")
    shards[number].write_bytes(whole[: len(whole) // 2])
    refused(shards, tmp_path / "m.hdf5", rf"part{number + 1}.hdf5: cannot be read")
    shards[number].write_bytes(whole)
    with h5py.File(shards[number], "r+") as file:
        file.attrs["part_sums"] = "{}"
    refused(shards, tmp_path / "m.hdf5", rf"part{number + 1}.hdf5: is damaged: no sums of a capture")


def test_a_chunk_that_is_gone_is_missed(tmp_path: Path, shards: list[Path]) -> None:
    """HDF5 reads a missing chunk as zeros; the checksums know better."""
    with h5py.File(shards[1]) as old, h5py.File(tmp_path / "new.hdf5", "w") as new:
        for name in old:
            old.copy(name, new)
        for name, value in old.attrs.items():
            new.attrs[name] = value
        del new["data"]
        data = old["data"]
        empty = new.create_dataset("data", data.shape, data.dtype, chunks=data.chunks, compression="gzip", shuffle=True)
        for name, value in data.attrs.items():
            empty.attrs[name] = value
    shutil.move(tmp_path / "new.hdf5", shards[1])
    refused(shards, tmp_path / "m.hdf5", r"part2.hdf5 \(lasers 1:3, strips 0:8\): is damaged: its data is not what")


def test_a_part_is_not_overwritten(tmp_path: Path, shards: list[Path]) -> None:
    """The output must not be one of the inputs."""
    refused(shards, shards[2], "is read for this and would be replaced")


def test_chunks_that_changed_places_do_not_add_up() -> None:
    """A checksum is mixed with the place of its chunk."""
    places, sums = [(0, 0, 1, 4, 3), (0, 0, 1, 3, 4)], [12345, 67890]
    straight = sum(placed_checksum(place, checksum) for place, checksum in zip(places, sums, strict=True))
    crossed = sum(placed_checksum(place, checksum) for place, checksum in zip(places, sums[::-1], strict=True))
    assert straight % CHECKSUM_RANGE != crossed % CHECKSUM_RANGE
