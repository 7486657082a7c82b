"""Whatever is in an HDF5 file: what it holds, or a message; no other file is opened, and no memory runs out."""

from __future__ import annotations

import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from conftest import Ledger
from containment import Containment
from damage import damaged
from support.partial_captures import validate_file
from support.rendering import flat_wall

from nlosrender.analysis.summary import summarise
from nlosrender.errors import FileError
from nlosrender.files.reading.reader import open_capture, read_header

SHAPE = (1, 4, 6, 3, 5)  # of a confocal capture


def capture(path: Path, **datasets: object) -> Path:
    """Write a small confocal file with the least that is read, and ``datasets`` (None: left out)."""
    with h5py.File(path, "w") as file:
        for name, value in ({"data": np.ones(SHAPE, "f4"), "deltaT": 0.003} | datasets).items():
            if value is not None:
                file[name] = value
    return path


@pytest.mark.parametrize("link", ["external", "soft", "storage", "virtual"])
@pytest.mark.parametrize("name", ["data", "deltaT", "variance", "cameraGridPositions"])
def test_numbers_in_other_files_are_not_read(name: str, link: str, tmp_path: Path) -> None:
    """Links out of the file, raw storage in any file of the disk, and virtual datasets are refused by name."""
    secret = capture(tmp_path / "secret.h5", secret=np.ones(SHAPE, "f4"))
    path = capture(tmp_path / "a.h5", **{name: None})
    with h5py.File(path, "a") as file:
        if link == "external":
            file[name] = h5py.ExternalLink(str(secret), "secret")
        elif link == "soft":
            file["elsewhere"] = h5py.ExternalLink(str(secret), "secret")
            file[name] = h5py.SoftLink("/elsewhere")
        elif link == "storage":
            raw = tmp_path / "raw"
            raw.write_bytes(b"\0" * 4096)
            file.create_dataset(name, SHAPE, "f4", external=[(str(raw), 0, 4096)])
        else:
            layout = h5py.VirtualLayout(SHAPE, "f4")
            layout[...] = h5py.VirtualSource(str(secret), "secret", SHAPE)
            file.create_virtual_dataset(name, layout)
    for reader in (read_header, summarise, validate_file):
        if reader is validate_file and name == "deltaT":
            with h5py.File(path, "a") as file:
                file["t"] = np.int32(4)
        with pytest.raises(FileError, match=f"{name} lies in another place or file"):
            reader(path)


def test_a_chunk_that_unpacks_to_gigabytes_is_refused(tmp_path: Path) -> None:
    """4 GB of zeros take 4 MB in a file, and 4 GB where they are read."""
    path = capture(tmp_path / "bomb.h5", data=None)
    with h5py.File(path, "a") as file:
        shape = (1, 400_000_000, 6, 1, 1)
        file.create_dataset("data", shape, "f4", chunks=(1, 300_000_000, 1, 1, 1), compression="gzip")
    with pytest.raises(FileError, match=r"data has chunks of shape \(1, 300000000, 1, 1, 1\), need at most 1 GiB"):
        read_header(path)


def test_claimed_samples_that_were_never_written_take_no_time(tmp_path: Path) -> None:
    """A petabyte without chunks, of which the file holds nothing, is checked at once."""
    path = capture(tmp_path / "a.h5", data=None)
    with h5py.File(path, "a") as file:
        properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        properties.set_alloc_time(h5py.h5d.ALLOC_TIME_LATE)
        space = h5py.h5s.create_simple((1, 10**9, 6, 200, 200))
        h5py.h5d.create(file.id, b"data", h5py.h5t.IEEE_F32LE, space, properties)
    begun = time.process_time()
    assert validate_file(path)
    assert time.process_time() - begun < 2


def test_a_damaged_text_attribute_does_not_end_the_process(tmp_path: Path, contained: Containment) -> None:
    """One byte of its type makes a ragged array of a text, and HDF5 reads where that leads."""
    path = capture(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file.attrs["frame"] = "a text of variable length"
    content = bytearray(path.read_bytes())
    kind = bytes((0x19, 0x01, 0x01, 0x00))  # class 9 (variable length), version 1; string, UTF-8
    at = content.index(kind, content.index(b"frame\0"))
    content[at + 1] = 0xFB
    path.write_bytes(content)
    assert contained.run("info", path).fault == ""
    with open_capture(path) as opened:
        assert "frame" not in opened.header.attributes


def test_a_large_attribute_is_left_alone(tmp_path: Path) -> None:
    """Attributes are read for what they say; one of 32 MiB says nothing."""
    path = capture(tmp_path / "a.h5", data=None)
    with h5py.File(path, "w", libver="latest") as file:
        file["data"], file["deltaT"] = np.ones(SHAPE, "f4"), 0.003
        file.attrs["seconds"] = np.zeros(2**22)
        file.attrs["engine"] = "other"
    with open_capture(path) as opened:
        assert opened.header.attributes == {"engine": "other"}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory, contained: Containment) -> dict[str, bytes]:
    """One capture of every scan type, as `render` writes them."""
    folder = tmp_path_factory.mktemp("captures")
    found = {}
    for scan in ("single", "confocal", "exhaustive"):
        plate = {"type": "rectangle", "width": 0.5, "height": 0.5, "center": [0, 0, 1]}
        config = folder / f"{scan}.yaml"
        config.write_text(yaml.safe_dump(flat_wall(plate, scan=scan, spp=64, bins=(0.0, 0.1, 40))))
        outcome = contained.run("render", config, "-o", folder / f"{scan}.hdf5")
        assert outcome.exit_code == 0, outcome
        found[scan] = (folder / f"{scan}.hdf5").read_bytes()
    return found


def commands_on_files() -> list[str]:
    """Return the commands that read captures, of those this program has."""
    import typer

    from nlosrender.cli.app import app

    known = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    return sorted(known & {"info", "plot", "compare", "merge", "reconstruct", "export"})


@pytest.mark.parametrize("cases", [6, pytest.param(600, marks=pytest.mark.stress)])
def test_damaged_captures_are_read_or_refused(
    cases: int, captures: dict[str, bytes], contained: Containment, ledger: Ledger, tmp_path: Path
) -> None:
    """Every command that reads captures survives random damage, within 4 GiB and a minute each."""
    kinds, commands = list(captures), commands_on_files()
    for seed in range(cases):
        bad, good = tmp_path / "bad.hdf5", tmp_path / "good.hdf5"
        good.write_bytes(captures[kinds[seed % 3]])
        bad.write_bytes(damaged(captures[kinds[seed % 3]], seed))
        lines = {"info": [bad], "plot": [bad, "-o", tmp_path / "a.png"], "compare": [good, bad]}
        lines |= {"merge": ["-o", tmp_path / "merged.hdf5", good, bad]}
        lines |= {"reconstruct": [bad, "-o", tmp_path / "volume.hdf5"]}
        lines |= {"export": [bad, "--format", "tal", "-o", tmp_path / "tal.hdf5"]}
        for command in dict.fromkeys(["info", "check", commands[seed % len(commands)]]):  # each once in a few files
            arguments = ["info", bad, "--check"] if command == "check" else [command, *lines.get(command, [bad])]
            outcome = contained.run(*arguments)
            name = "info --check" if command == "check" else command
            ledger.count(f"damaged captures, {name}", refused=outcome.exit_code not in (0, None), fault=outcome.fault)
            assert not outcome.fault, f"seed {seed}, {arguments}: {outcome.fault}\n{outcome.trace}"
