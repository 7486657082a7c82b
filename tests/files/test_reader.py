"""What was written comes back; what is not a capture is refused with words, never with a traceback."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import validate_file

from nlosrender.analysis.plots import plot_capture
from nlosrender.analysis.summary import summarise
from nlosrender.errors import FileError
from nlosrender.files.reading.reader import open_capture, read_header


@pytest.mark.parametrize("scan_type", ["single", "confocal", "exhaustive"])
@pytest.mark.parametrize("channels", [1, 3])
def test_round_trip(
    tmp_path: Path, header_of: Callable, write_capture: Callable, scan_type: str, channels: int
) -> None:
    """The samples come back in the in-memory order, bit for bit, and the header says what was written."""
    header = header_of(scan_type, n_channels=channels, bounce_indices=(1, 4), max_bounces=6)
    block = write_capture(tmp_path / "a.hdf5", header, store_variance=True)
    with open_capture(tmp_path / "a.hdf5") as capture:
        np.testing.assert_array_equal(capture.read_block(), block)
        np.testing.assert_array_equal(capture.read_block(dataset="variance"), block**2)
        whole = capture.read_block(bounces=range(6))
    assert whole.shape[1] == 6
    np.testing.assert_array_equal(whole[:, [1, 4]], block)
    assert not whole[:, [0, 2, 3, 5]].any()
    stored = read_header(tmp_path / "a.hdf5")
    assert (stored.scan_type, stored.n_bins, stored.bounce_indices) == (scan_type, 7, (1, 4))
    assert (stored.bin_width_opl, stored.start_opl) == (0.003, 0.7)  # exact, not the file's float32
    assert stored.sensor_grid == (4, 5)
    assert stored.laser_grid == {"single": (1, 1), "confocal": (4, 5), "exhaustive": (2, 3)}[scan_type]
    assert {**stored.sizes, "bounce": 2} == header.sizes
    assert stored.has_variance
    assert stored.split_bounces


def test_parts(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """An index keeps its axis, a slice takes its part, in any combination."""
    block = write_capture(tmp_path / "a.hdf5", header_of())
    with open_capture(tmp_path / "a.hdf5") as capture:
        part = capture.read_block(lasers=(1, slice(1, 3)), sensors=(slice(2, None), 4), bounces=[1])
        np.testing.assert_array_equal(part, block[:, 1:, 1:2, 1:3, 2:, 4:5])
        part = capture.read_block(lasers=(None, 0), sensors=(slice(-1, None), None))
        np.testing.assert_array_equal(part, block[:, :, :, :1, -1:])


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"lasers": (2, 0)}, "laser_y 2 is outside the capture, which has 0 to 1"),
        ({"lasers": (0, -1)}, "laser_x -1 is outside"),
        ({"sensors": (slice(4, 9), 0)}, "sensor_y slice"),
        ({"sensors": (slice(0, 4, 2), 0)}, "sensor_y slice"),
        ({"bounces": [6]}, "no bounce index"),
        ({"dataset": "variance"}, "has no dataset variance"),
    ],
)
def test_parts_outside(tmp_path: Path, header_of: Callable, write_capture: Callable, parts: dict, message: str) -> None:
    """What the file does not have is named."""
    write_capture(tmp_path / "a.hdf5", header_of())
    with open_capture(tmp_path / "a.hdf5") as capture, pytest.raises(FileError, match=message):
        capture.read_block(**parts)


def test_variance_of_another_shape(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """A variance that does not belong to the samples is refused, not read in part."""
    write_capture(tmp_path / "a.hdf5", header_of())
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        file["variance"] = np.zeros((1, 7, 6, 8, 9, 2, 3), "f4")
    with (
        open_capture(tmp_path / "a.hdf5") as capture,
        pytest.raises(FileError, match=r"variance has shape \(1, 7, 6, 8, 9, 2, 3\), data"),
    ):
        capture.read_block(dataset="variance")


def test_positions(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Points and normals come back as (rows, columns, 3) in the file's frame."""
    header = header_of(frame="scene")
    write_capture(tmp_path / "a.hdf5", header)
    with open_capture(tmp_path / "a.hdf5") as capture:
        positions = capture.positions
    # float32 of coordinates below 8: half a unit in the last place is 2.4e-7
    expected = header.pose.to_scene(header.laser_positions)
    np.testing.assert_allclose(positions.laser_positions, expected, atol=3e-7)
    assert positions.sensor_normals.shape == (4, 5, 3)


def foreign(path: Path, shape: tuple[int, ...] = (1, 9, 6, 4, 5), **datasets: object) -> None:
    """Write the bare minimum as another program might: other number types, arrays of one, no attributes."""
    with h5py.File(path, "w") as file:
        file["data"] = np.random.default_rng(0).random(shape)
        for name, value in {"deltaT": [0.01], "t0": 0, "t": 9.0, "isConfocal": True, **datasets}.items():
            if value is not None:
                file[name] = value


def test_files_by_others(tmp_path: Path) -> None:
    """Files without attributes, with doubles and arrays of one element, are still read; all six bounces count."""
    foreign(tmp_path / "a.hdf5")
    header = read_header(tmp_path / "a.hdf5")
    assert (header.scan_type, header.bin_width_opl, header.bounce_indices) == ("confocal", 0.01, tuple(range(6)))
    assert not header.bounces_known
    assert header.sensor_grid_size is None
    with open_capture(tmp_path / "a.hdf5") as capture:
        assert capture.read_block().shape == (1, 6, 1, 1, 4, 5, 9)
        with pytest.raises(FileError, match="has no dataset cameraGridPositions"):
            _ = capture.positions
    foreign(tmp_path / "b.hdf5", (1, 9, 6, 4, 5, 1, 1))
    foreign(tmp_path / "c.hdf5", (1, 9, 6, 4, 5, 2, 1))
    assert read_header(tmp_path / "b.hdf5").scan_type == "single"
    assert read_header(tmp_path / "c.hdf5").scan_type == "exhaustive"


def _truncated(path: Path) -> None:
    foreign(path)
    os.truncate(path, path.stat().st_size // 2)


def _flipped(path: Path) -> None:
    foreign(path)
    content = bytearray(path.read_bytes())
    content[96:800] = b"\xff" * 704  # headers of the root group
    path.write_bytes(content)


def _hdf5(**content: object) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            for name, value in content.items():
                if isinstance(value, tuple):  # a shape that is claimed, not filled
                    file.create_dataset(name, shape=value, dtype="f4", chunks=tuple(1 for _ in value))
                elif value is dict:
                    file.create_group(name)
                else:
                    file[name] = value

    return write


HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda path: None, "there is no such file"),
    "folder": (lambda path: path.mkdir(), "is a folder"),
    "pipe": (os.mkfifo, "is not a regular file"),
    "empty": (lambda path: path.touch(), "is not an HDF5 file .it is empty"),
    "text": (lambda path: path.write_text("name: a"), "is not an HDF5 file .it starts with b'name: a'"),
    "garbage": (lambda path: path.write_bytes(os.urandom(4096)), "is not an HDF5 file|cannot be read"),
    "signature only": (lambda path: path.write_bytes(b"\x89HDF\r\n\x1a\n"), "cannot be read"),
    "truncated": (_truncated, "The file is cut short: copy it again"),
    "damaged": (_flipped, "cannot be read: .* may be damaged"),
    "no datasets": (_hdf5(), "has no dataset data .found: nothing"),
    "other datasets": (_hdf5(meas=[1.0]), "has no dataset data .found: meas"),
    "group": (_hdf5(data=dict), "has no dataset data"),
    "scalar": (_hdf5(data=1.0), "data has 0 axes"),
    "rank 4": (_hdf5(data=np.zeros((2, 3, 4, 5))), r"data has 4 axes \(2, 3, 4, 5\), need 5"),
    "text data": (_hdf5(data="numbers"), "data holds object, need numbers"),
    "empty data": (_hdf5(data=np.zeros((1, 0, 6, 4, 5))), "data is empty"),
    "no deltaT": (_hdf5(data=np.zeros((1, 2, 6, 4, 5))), "has no dataset deltaT"),
    "deltaT 0": (_hdf5(data=np.zeros((1, 2, 6, 4, 5)), deltaT=0.0), "deltaT is 0.0, need a length"),
    "deltaT nan": (_hdf5(data=np.zeros((1, 2, 6, 4, 5)), deltaT=np.nan), "deltaT is nan"),
    "deltaT text": (_hdf5(data=np.zeros((1, 2, 6, 4, 5)), deltaT="3 mm"), "deltaT is not what a capture has there"),
    "deltaT huge": (_hdf5(data=np.zeros((1, 2, 6, 4, 5)), deltaT=(10**12,)), "deltaT is not what a capture has"),
    "deltaT group": (_hdf5(data=np.zeros((1, 2, 6, 4, 5)), deltaT=dict), "deltaT is not what a capture has"),
    "t0 pair": (_hdf5(data=np.zeros((1, 2, 6, 4, 5)), deltaT=1.0, t0="x"), "t0 is not what a capture has there"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files(tmp_path: Path, case: str) -> None:
    """Everything that reads captures meets every bad file with a FileError that names it and what is wrong."""
    make, message = HOSTILE[case]
    path = tmp_path / "bad.hdf5"
    make(path)
    for read in (read_header, summarise, validate_file, lambda file: plot_capture(file, tmp_path / "a.png")):
        if read is validate_file and case.startswith(("no deltaT", "deltaT", "t0")):
            assert validate_file(path)  # those it lists
            continue
        with pytest.raises(FileError, match=rf"bad\.hdf5: .*({message})"):
            read(path)


def test_absurd_shapes(tmp_path: Path) -> None:
    """A file that claims a petabyte is described at once; reading it is refused before memory runs out."""
    path = tmp_path / "a.hdf5"
    _hdf5(data=(1, 10**6, 6, 10**4, 10**4), deltaT=0.003, cameraGridPositions=(3, 10**7, 10**7))(path)
    start = time.process_time()
    assert summarise(path)["size_of_samples"] == 4 * 6 * 10**14
    assert time.process_time() - start < 1
    with pytest.raises(FileError, match="too large for a picture: data has shape"):
        plot_capture(path, tmp_path / "a.png")
    with open_capture(path) as capture:
        with pytest.raises(FileError, match="claims to hold more than fits into memory"):
            capture.read_block()
        with pytest.raises(FileError, match="cameraGridPositions is float32"):
            _ = capture.positions


def test_damaged_samples(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Metadata of a file with a broken chunk is still read; the samples are refused with a message."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of("single"))
    with h5py.File(path) as file:
        chunk = file["data"].id.get_chunk_info(0)
    with path.open("r+b") as stream:
        stream.seek(chunk.byte_offset)
        stream.write(b"\xff" * chunk.size)
    assert summarise(path)["n_bins"] == 7
    for read in (validate_file, lambda file: plot_capture(file, tmp_path / "a.png")):
        with pytest.raises(FileError, match=r"cannot be read: .* The file may be damaged"):
            read(path)


def test_metadata_of_many_chunks_is_quick(tmp_path: Path) -> None:
    """A summary does not depend on the number of samples: 20 000 chunks take less than half a second."""
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", (1, 2, 6, 100, 200), "f4", chunks=(1, 2, 1, 1, 1))
        data[:, :, 1] = 1
        file["deltaT"] = 0.003
    start = time.process_time()
    assert summarise(path)["scan_type"] == "confocal"
    assert time.process_time() - start < 0.5


def test_a_file_with_a_bounce_axis_out_of_all_proportion_is_no_capture(tmp_path: Path) -> None:
    """A billion bounces would take gigabytes for their numbers alone."""
    path = tmp_path / "long.hdf5"
    with h5py.File(path, "w") as file:
        file.create_dataset("data", shape=(1, 10, 10**9, 3, 5), dtype="<f4", chunks=(1, 10, 1, 3, 5))
        file["deltaT"] = np.float32(0.003)
    with pytest.raises(FileError, match="1000000000 bounces, a capture has 6"):
        read_header(path)
