"""What is not ours is never replaced; what is ours is replaced by the same command again, and by nothing else."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
from support.partial_captures import CONFIG, Stopped, write_part
from support.point_captures import cells, points_header, write_points

from nlosrender.analysis.frames import FrameOptions, write_frames
from nlosrender.analysis.plots import plot_capture
from nlosrender.analysis.reconstruction.reconstruct import ReconstructionSettings, reconstruct_capture
from nlosrender.analysis.reconstruction.volume_file import write_volume
from nlosrender.bench.bench_report import write_json
from nlosrender.bench.generated_meshes import write_ply
from nlosrender.capture.part import Selection
from nlosrender.config.dataset_section import DatasetConfig
from nlosrender.errors import EXIT_FAILURE, DiskError, FileError
from nlosrender.files.atomic_write import partial_folder, replacing
from nlosrender.files.dataset_index import write_index, write_table
from nlosrender.files.export.export import export_capture
from nlosrender.files.file_kinds import CAPTURE, PLY
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.parts.merge import merge_captures
from nlosrender.files.reading.reader import open_capture, read_header

THESIS = "\\documentclass{thesis} ten years of work"
OTHER = {**CONFIG, "render": {"spp": 16}}


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """A confocal capture of one point."""
    (tmp_path / "in").mkdir(exist_ok=True)
    return write_points(tmp_path / "in/wall.hdf5", points_header("confocal", cells(5, 3, 1.0, 0.8)), [(0, 0, 0.8)])


@pytest.fixture
def view(tmp_path: Path) -> Path:
    """A capture of a camera."""
    (tmp_path / "in").mkdir(exist_ok=True)
    header = points_header("line_of_sight", cells(5, 3, 1.0, 0.8), np.zeros((1, 1, 3)), bins=(0.0, 0.02, 200))
    return write_points(tmp_path / "in/view.hdf5", header, [(0, 0, 0.8)])


SWEEP: Any = SimpleNamespace(source="a.yaml", keys=("render.seed",), dataset=DatasetConfig())
BESIDE = {"index.json": ["index.csv"]}  # written with it
WRITERS: dict[str, Callable[[Path, Path, Path], object]] = {
    "plot.png": lambda out, wall, view: plot_capture(wall, out),
    "plot.svg": lambda out, wall, view: plot_capture(wall, out),
    "plot.pdf": lambda out, wall, view: plot_capture(wall, out),
    "tal.hdf5": lambda out, wall, view: export_capture(wall, out, "tal"),
    "fk.mat": lambda out, wall, view: export_capture(wall, out, "fk"),
    "view.gif": lambda out, wall, view: write_frames(view, out, FrameOptions("gif")),
    "index.json": lambda out, wall, view: write_index(out, SWEEP, []),
    "index.csv": lambda out, wall, view: write_table(out, []),
    "bench.json": lambda out, wall, view: write_json(out, {"facts": {}, "scenes": []}),
    "mesh.ply": lambda out, wall, view: write_ply(out, np.zeros((3, 3)), np.array([[0, 1, 2]])),
}

SLOW = ("plot.svg", "plot.pdf")  # drawn as plot.png is


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in WRITERS]
)
def test_only_files_of_its_kind_are_replaced(name: str, tmp_path: Path, capture: Path, view: Path) -> None:
    """Every writer leaves a text alone, a finished capture too, and writes over its own files and empty ones."""
    out = tmp_path / name
    for precious in (THESIS.encode(), capture.read_bytes()):
        out.write_bytes(precious)
        with pytest.raises(FileError, match=r"exists and is not an? .*: it is not replaced\. Name another output"):
            WRITERS[name](out, capture, view)
        assert out.read_bytes() == precious
    out.write_bytes(b"")
    for _ in range(2):
        WRITERS[name](out, capture, view)
        assert out.stat().st_size > 0
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["in", name, *BESIDE.get(name, [])])


def test_frames_replace_frames_alone(tmp_path: Path, view: Path) -> None:
    """No file of a folder is replaced, or removed for what its name looks like, where one of them is no picture."""
    folder = tmp_path / "frames"
    folder.mkdir()
    (folder / "frame-00001.png").write_text(THESIS)
    (folder / "frame-99999.png").write_text(THESIS)
    with pytest.raises(FileError, match=r"frame-00001.png: exists and is not a PNG picture"):
        write_frames(view, folder, FrameOptions("png", every=10))
    assert sorted(path.name for path in folder.iterdir()) == ["frame-00001.png", "frame-99999.png"]
    (folder / "frame-00001.png").unlink()
    write_frames(view, folder, FrameOptions("png", every=10))
    assert (folder / "frame-99999.png").read_text() == THESIS


@pytest.mark.parametrize("resume", [None, False])
def test_a_text_is_never_a_capture(
    tmp_path: Path, header_of: Callable, block_of: Callable, resume: bool | None
) -> None:
    """Not with --overwrite either; the same holds for an HDF5 file of somebody else."""
    path = tmp_path / "thesis.tex"
    path.write_text(THESIS)
    header = header_of()
    with pytest.raises(FileError, match=r"thesis.tex: exists and is not a capture by nlosrender .* it is not replaced"):
        write_part(path, header, block_of(header), resume=resume)
    assert path.read_text() == THESIS
    with h5py.File(path, "w") as file:
        file["data"] = np.ones(7)
    with pytest.raises(FileError, match=r"is not a capture by nlosrender \(it holds data\)"):
        write_part(path, header, block_of(header), resume=resume)
    assert [entry.name for entry in tmp_path.iterdir()] == ["thesis.tex"]


def test_another_capture_is_replaced_by_overwrite(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """Another configuration or part of a capture, and a capture of which this is a part; the same one needs nothing."""
    header, path = header_of(), tmp_path / "a.hdf5"
    block = block_of(header)
    write_part(path, header, block)
    write_part(path, header, block)
    before = path.read_bytes()
    with pytest.raises(FileError, match=r"holds another capture \(render.spp: 8 there, 16 now.*\)\. Use --overwrite"):
        write_part(path, header, block, config=OTHER)
    first = Selection(shard=(1, 2))
    with pytest.raises(FileError, match=r"\(the whole capture there, --shard 1/2 now\)\. Use --overwrite"):
        write_part(path, header, block, first)
    assert path.read_bytes() == before
    write_part(path, header, block, first, resume=False)
    write_part(path, header, block, first)
    with pytest.raises(FileError, match=r"\(--shard 1/2 there, --shard 2/2 now\)\. Use --overwrite"):
        write_part(path, header, block, Selection(shard=(2, 2)))
    write_part(path, header, block, config=OTHER, resume=False)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.hdf5"]


def test_a_permission_to_overwrite_is_remembered(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """A render that was begun with --overwrite and stopped goes on without it, which would throw its units away."""
    header, path = header_of(), tmp_path / "a.hdf5"
    block = block_of(header)
    write_part(path, header, block)
    with pytest.raises(Stopped):
        write_part(path, header, block, config=OTHER, resume=False, stop_after=3)
    assert write_part(path, header, block, config=OTHER) == 3


def test_what_comes_to_lie_there_meanwhile_stays(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """A render may take days: what is at the output at its end counts, and the finished units are kept."""
    header, path = header_of(), tmp_path / "a.hdf5"
    block = block_of(header)
    with pytest.raises(Stopped):
        write_part(path, header, block, stop_after=2)
    identity = {"config": CONFIG, "variant": "none", "replicas": 2, "part": "the whole capture"}
    with PartialCapture.claim(path, identity) as partial:
        partial.open(header, {}, "gzip", store_variance=True)
        path.write_text(THESIS)
        with pytest.raises(FileError, match="exists and is not a capture"):
            partial.publish({})
    assert path.read_text() == THESIS
    path.unlink()
    assert write_part(path, header, block) == 2


def test_a_damaged_capture_of_ours_is_mended(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """What was cut short and can be read by nothing is rendered again by the same command."""
    header, path = header_of(), tmp_path / "a.hdf5"
    write_part(path, header, block_of(header))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(FileError):
        read_header(path)
    write_part(path, header, block_of(header))
    assert read_header(path).has_variance


def test_merging_replaces_what_was_merged(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """The same parts again; another capture needs --overwrite."""
    header, merged = header_of(), tmp_path / "m.hdf5"
    parts = [tmp_path / f"part{number}.hdf5" for number in (1, 2)]
    for number, part in enumerate(parts, 1):
        write_part(part, header, block_of(header), Selection(shard=(number, 2)))
    merge_captures(parts, merged)
    merge_captures(parts, merged)
    write_part(merged, header, block_of(header), config=OTHER, resume=False)
    with pytest.raises(FileError, match=r"m.hdf5: holds another capture \(render.spp: 16 there, 8 now\)"):
        merge_captures(parts, merged)
    merge_captures(parts, merged, overwrite=True)
    merged.write_text(THESIS)
    with pytest.raises(FileError, match="it is not replaced"):
        merge_captures(parts, merged, overwrite=True)
    assert merged.read_text() == THESIS


@pytest.mark.parametrize("place", ["folder", "journal", "samples.0.hdf5", "samples.7.hdf5", "hard journal"])
def test_links_in_an_unfinished_capture_are_not_followed(
    tmp_path: Path, header_of: Callable, block_of: Callable, place: str
) -> None:
    """Whoever may write beside the output must not choose what a render deletes or writes over."""
    header, path = header_of(), tmp_path / "a.hdf5"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    victims = [elsewhere / name for name in ("journal", "samples.0.hdf5", "samples.txt")]
    for victim in victims:
        victim.write_text(THESIS)
    folder = partial_folder(path)
    if place == "folder":
        folder.symlink_to(elsewhere)
    else:
        folder.mkdir()
        if place == "hard journal":
            (folder / "journal").hardlink_to(victims[0])
        else:
            (folder / place).symlink_to(victims[0])
    for resume in (None, False):
        with pytest.raises(FileError, match=r"is a link or .*Remove it, or name another output"):
            write_part(path, header, block_of(header), resume=resume)
    assert [victim.read_text() for victim in victims] == [THESIS] * 3


def test_a_folder_of_another_user_is_refused(
    tmp_path: Path, header_of: Callable, block_of: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its owner could change what was rendered; what counts is the owner that our own files have there."""
    path = tmp_path / "a.hdf5"
    partial_folder(path).mkdir()
    if os.geteuid() == 0:
        os.chown(partial_folder(path), 12345, -1)
    else:
        true_lstat = Path.lstat

        def lstat(self: Path) -> os.stat_result:
            found = true_lstat(self)
            return os.stat_result((*found[:4], 12345, *found[5:])) if self == partial_folder(path) else found

        monkeypatch.setattr(Path, "lstat", lstat)
    with pytest.raises(FileError, match="belongs to another user, number 12345"):
        write_part(path, header_of(), block_of(header_of()))


def test_a_name_for_the_unfinished_file_is_not_guessed(tmp_path: Path) -> None:
    """A link under the name that the file had by the number of the process leads nowhere."""
    victim = tmp_path / "victim"
    victim.write_text(THESIS)
    (tmp_path / f".a.hdf5.{os.getpid()}.partial").symlink_to(victim)
    with replacing(tmp_path / "a.hdf5", CAPTURE) as partial:
        partial.write_text("capture")
    assert victim.read_text() == THESIS


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_reading_needs_no_lock(capture: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """On a file system without locks HDF5 is told not to ask for one, however often a file is opened."""
    true_open, asked = h5py.File, []

    def refuse(*arguments: object) -> None:
        raise OSError(number, os.strerror(number))

    def opened(*arguments: object, locking: bool | None = None, **options: object) -> h5py.File:
        asked.append(locking)
        return true_open(*arguments, locking=locking, **options)

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(h5py, "File", opened)
    with open_capture(capture) as one, open_capture(capture) as other:
        np.testing.assert_array_equal(one.read_block(), other.read_block())
    assert asked == [False, False]


def test_a_full_disk_is_a_failure_with_its_name(tmp_path: Path) -> None:
    """Nothing is wrong with the input: exit code 1; the disk is named, and the earlier file stays."""
    out = tmp_path / "a.ply"
    write_ply(out, np.zeros((3, 3)), np.array([[0, 1, 2]]))
    before = out.read_bytes()
    message = r"a.ply: cannot be written: No space left on device\. Free some space on the disk /.* [kMGT]?B left\)"
    with pytest.raises(DiskError, match=message) as caught, replacing(out, PLY):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.exit_code == EXIT_FAILURE
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.ply", before)]


def test_a_volume_on_a_full_disk(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HDF5 does not see the failure, which would end the process; what is left is the earlier volume."""
    settings = ReconstructionSettings("backprojection", voxels=8)
    found = reconstruct_capture(capture, settings)
    out = write_volume(found, tmp_path / "volume.hdf5")
    before, true_write, left = out.read_bytes(), os.pwrite, [3000]

    def filling(descriptor: int, content: bytes, offset: int) -> int:
        if left[0] < len(content):
            raise OSError(errno.ENOSPC, "No space left on device")
        left[0] -= len(content)
        return true_write(descriptor, content, offset)

    monkeypatch.setattr(os, "pwrite", filling)
    with pytest.raises(DiskError, match=r"volume.hdf5: cannot be written: No space left"):
        write_volume(found, out)
    assert out.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "volume.hdf5"]
