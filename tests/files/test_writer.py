"""What reaches the file, checked with h5py alone."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from nlosrender.errors import FileError, RenderError
from nlosrender.files.file_kinds import CAPTURE
from nlosrender.files.provenance import provenance_attributes
from nlosrender.files.writer import CaptureWriter, check_writable
from nlosrender.scene.pose import Pose

FLOATS = [
    "data",
    "cameraGridPositions",
    "cameraGridNormals",
    "laserGridPositions",
    "laserGridNormals",
    "cameraPosition",
    "laserPosition",
    "cameraGridSize",
    "laserGridSize",
    "cameraGridPoints",
    "laserGridPoints",
    "t0",
    "deltaT",
    "hiddenVolumePosition",
    "hiddenVolumeRotation",
    "hiddenVolumeSize",
]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("compression", ["gzip", "none"])
def test_every_sample_lands_where_the_layout_says(
    tmp_path: Path, header_of: Callable, block_of: Callable, channels: int, compression: str
) -> None:
    """data[c, t, file index, sy, sx, ly, lx] is block[c, slot, ly, lx, sy, sx, t]; all other bounces are zero."""
    header = header_of("exhaustive", n_channels=channels, bounce_indices=(1, 3), max_bounces=5)
    block = block_of(header)
    with CaptureWriter(tmp_path / "a.hdf5", header, attributes={}, compression=compression) as writer:
        writer.write(block)
    with h5py.File(tmp_path / "a.hdf5") as file:
        stored = file["data"][()]
    assert stored.shape == (channels, 7, 6, 4, 5, 2, 3)
    expected = np.zeros_like(stored)
    for c, slot, ly, lx, sy, sx, t in np.ndindex(block.shape):
        expected[c, t, (1, 3)[slot], sy, sx, ly, lx] = block[c, slot, ly, lx, sy, sx, t]
    np.testing.assert_array_equal(stored, expected)


@pytest.mark.parametrize(("scan_type", "shape"), [("single", (1, 7, 6, 4, 5, 1, 1)), ("confocal", (1, 7, 6, 4, 5))])
def test_rank_of_single_and_confocal(
    tmp_path: Path, header_of: Callable, write_capture: Callable, scan_type: str, shape: tuple
) -> None:
    """A single capture keeps both laser axes, a confocal one has none."""
    block = write_capture(tmp_path / "a.hdf5", header_of(scan_type))
    with h5py.File(tmp_path / "a.hdf5") as file:
        stored = file["data"][()]
        assert file["isConfocal"][()] == (scan_type == "confocal")
        assert file["laserGridPositions"].shape == ((3, 4, 5) if scan_type == "confocal" else (3, 1, 1))
        assert file["laserGridPoints"][()].tolist() == ([5, 4] if scan_type == "confocal" else [1, 1])
    assert stored.shape == shape
    np.testing.assert_array_equal(stored.reshape(7, 6, 4, 5)[:, :2], np.moveaxis(block[0, :, 0, 0], -1, 0))


def test_pieces_in_any_order_give_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable, block_of: Callable
) -> None:
    """Blocks of one laser and parts of the sensor grid, shuffled and smaller than the chunks, add up to the whole."""
    monkeypatch.setattr("nlosrender.files.chunks.CHUNK_SAMPLES", 7 * 2 * 3)  # tiles of 2 x 3 of the 4 x 5 sensors
    header = header_of()
    block = block_of(header)
    pieces = [(ly, lx, sy, sx) for ly in range(2) for lx in range(3) for sy in (0, 1) for sx in (0, 2, 4)]
    np.random.default_rng(3).shuffle(pieces)
    with CaptureWriter(tmp_path / "a.hdf5", header, store_variance=True) as writer:
        for ly, lx, sy, sx in pieces:
            rows, columns = (slice(0, 1), slice(1, 4))[sy], slice(sx, min(sx + 2, 5))
            piece = block[:, :, ly : ly + 1, lx : lx + 1, rows, columns].astype(np.float64)
            writer.write(piece, laser_at=(ly, lx), sensor_at=(rows.start, sx), variance=2 * piece)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"].chunks == (1, 7, 1, 2, 3, 1, 1)
        for name, factor in (("data", 1), ("variance", 2)):
            stored = np.transpose(file[name][()], (0, 2, 5, 6, 3, 4, 1))
            np.testing.assert_array_equal(stored[:, :2], np.float32(factor) * block)
            assert not stored[:, 2:].any()


def test_long_histograms_are_cut_along_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable
) -> None:
    """Bins beyond a chunk's length go into further chunks."""
    monkeypatch.setattr("nlosrender.files.chunks.CHUNK_SAMPLES", 3)
    header = header_of("single")
    block = np.random.default_rng(5).random((1, 2, 1, 1, 4, 5, 7))
    with CaptureWriter(tmp_path / "a.hdf5", header) as writer:
        writer.write(block)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"].chunks == (1, 3, 1, 1, 1, 1, 1)
        np.testing.assert_array_equal(file["data"][0, :, 1, 2, 3, 0, 0], block[0, 1, 0, 0, 2, 3].astype(np.float32))


def test_number_classes(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """C++ loaders pick the type they read by its class: floats everywhere but t and isConfocal; no enumerations."""
    write_capture(tmp_path / "a.hdf5", header_of())
    with h5py.File(tmp_path / "a.hdf5") as file:
        classes = {name: (file[name].id.get_type().get_class(), file[name].id.get_type().get_size()) for name in file}
        assert {name for name in file if file[name].shape == ()} == {
            "t",
            "t0",
            "deltaT",
            "isConfocal",
            "hiddenVolumeSize",
        }
        assert file["cameraGridPoints"][()].tolist() == [5, 4]
        assert file["laserGridPoints"][()].tolist() == [3, 2]
        kinds = {file.attrs.get_id(name).get_type().get_class() for name in file.attrs}
    assert classes == dict.fromkeys(FLOATS, (h5py.h5t.FLOAT, 4)) | {
        "t": (h5py.h5t.INTEGER, 4),
        "isConfocal": (h5py.h5t.INTEGER, 4),
    }
    assert kinds <= {h5py.h5t.STRING, h5py.h5t.FLOAT, h5py.h5t.INTEGER}


def test_positions_in_the_znlos_frame(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """(X, Y, Z) = (x, -z, y) for points, normals and the hidden volume; float32 is all that is lost."""
    header = header_of()
    write_capture(tmp_path / "a.hdf5", header)
    with h5py.File(tmp_path / "a.hdf5") as file:
        for name, local in (("cameraGrid", header.sensor_positions), ("laserGrid", header.laser_positions)):
            x, y, z = np.moveaxis(local, -1, 0)
            np.testing.assert_array_equal(file[f"{name}Positions"][()], np.stack([x, -z, y]).astype(np.float32))
        assert file["cameraGridPositions"].shape == (3, 4, 5)
        assert (file["laserGridNormals"][1] == -1).all()
        np.testing.assert_allclose(file["laserPosition"][()], [-0.5, -0.25, 0.1], rtol=1e-7)
        np.testing.assert_allclose(file["cameraPosition"][()], [0.3, -1.5, 0.2], rtol=1e-7)
        # bounds x -0.1..0.3, y -0.2..0.4, z 0.7..1.2: edges 0.4, 0.6, 0.5; in the order X, Y = -z, Z = y
        np.testing.assert_allclose(file["hiddenVolumePosition"][()], [0.1, -0.95, 0.1], rtol=1e-6)
        np.testing.assert_allclose(file["hiddenVolumeSize"][()], 0.6, rtol=1e-7)
        np.testing.assert_allclose(file["hiddenVolumeSize"].attrs["exact"], [0.4, 0.5, 0.6], rtol=1e-14)
        assert not file["hiddenVolumeRotation"][()].any()


def test_positions_in_the_scenes_frame(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Points are where the pose puts them; the hidden box's angles rebuild the pose's rotation."""
    from nlosrender.scene.pose import euler_xyz

    header = header_of(frame="scene")
    write_capture(tmp_path / "a.hdf5", header)
    with h5py.File(tmp_path / "a.hdf5") as file:
        points = np.moveaxis(file["cameraGridPositions"][()], 0, -1)
        np.testing.assert_allclose(points, header.pose.to_scene(header.sensor_positions), rtol=1e-6)
        normals = np.moveaxis(file["laserGridNormals"][()], 0, -1)
        np.testing.assert_allclose(normals, np.broadcast_to(header.pose.rotation[:, 2], (2, 3, 3)), rtol=1e-6)
        np.testing.assert_allclose(file["hiddenVolumePosition"][()], header.pose.to_scene([0.1, 0.1, 0.95]), rtol=1e-6)
        # three float32 angles of up to pi: 2e-7 each
        turned = euler_xyz(np.degrees(file["hiddenVolumeRotation"][()].astype(np.float64)))
        np.testing.assert_allclose(turned, header.pose.rotation, atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_angles_of_a_wall_turned_along_its_own_y(
    tmp_path: Path, header_of: Callable, write_capture: Callable, sign: int
) -> None:
    """Where two of the three angles fall together (a quarter turn about y) they still rebuild the rotation."""
    from nlosrender.scene.pose import euler_xyz

    pose = Pose(np.round(euler_xyz([0.0, sign * 90.0, 90.0])), np.zeros(3))  # exact zeros
    write_capture(tmp_path / "a.hdf5", header_of(frame="scene", pose=pose))
    with h5py.File(tmp_path / "a.hdf5") as file:
        turned = euler_xyz(np.degrees(file["hiddenVolumeRotation"][()].astype(np.float64)))
    np.testing.assert_allclose(turned, pose.rotation, atol=1e-6)


def test_without_hidden_geometry_the_volume_is_empty(
    tmp_path: Path, header_of: Callable, write_capture: Callable
) -> None:
    """An empty scene has a hidden volume of size 0 at the origin."""
    write_capture(tmp_path / "a.hdf5", header_of(hidden_bounds=None))
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["hiddenVolumeSize"][()] == 0
        assert file["hiddenVolumePosition"][()].tolist() == [0, 0, 0]


def test_attributes(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """The file says what the arrays cannot: bounces, legs, frame, exact time axis, channels."""
    header = header_of(
        bounce_indices=tuple(range(6)), max_bounces=None, n_channels=3, account_first_and_last_bounces=False
    )
    write_capture(tmp_path / "a.hdf5", header, {"note": "mine"})
    with h5py.File(tmp_path / "a.hdf5") as file:
        root, samples = dict(file.attrs), dict(file["data"].attrs)
        assert (file["deltaT"].attrs["exact"], file["t0"].attrs["exact"]) == (0.003, 0.7)
        assert (file["t"][()], file["t0"][()], file["deltaT"][()]) == (7, np.float32(0.7), np.float32(0.003))
    assert (root["data order"], root["engine"], root["note"]) == ("column-major", "nlosrender", "mine")
    assert (root["nlosrender_format_version"], root["scan_type"], root["frame"]) == (1, "exhaustive", "znlos")
    assert (root["channels"], root["max_bounces"], root["split_bounces"], root["planar_wall"]) == (
        "rgb",
        "no limit",
        1,
        1,
    )
    assert root["account_first_and_last_bounces"] == 0
    assert root["first_and_last_legs"].startswith("NOT included")
    np.testing.assert_array_equal(root["relay_wall_to_scene"], header.pose.matrix())
    assert samples["third_bounce"] == 1
    assert samples["bounces"].endswith("bounces above 7 are added into index 5")
    assert samples["bounce_indices"].tolist() == [0, 1, 2, 3, 4, 5]
    assert samples["unit"] == "J m^-2 sr^-1"


def test_unsplit_light_is_named(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Unsplit bounces go where every loader looks, and the file says so."""
    write_capture(tmp_path / "a.hdf5", header_of(bounce_indices=(1,), split_bounces=False, max_bounces=9))
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"].attrs["bounces"] == "the sum of all bounces is in index 1"
        assert "channels" not in file.attrs


def test_layout_attributes_cannot_be_replaced(tmp_path: Path, header_of: Callable) -> None:
    """A caller's attribute that the layout owns is refused, early and late."""
    with (
        pytest.raises(ValueError, match="attributes: engine, frame already set"),
        CaptureWriter(tmp_path / "a.hdf5", header_of(), attributes={"frame": "x", "engine": "path"}),
    ):
        pass
    with (
        CaptureWriter(tmp_path / "a.hdf5", header_of()) as writer,
        pytest.raises(ValueError, match="units already set"),
    ):
        writer.set_attributes({"units": "feet"})


def test_dark_chunks_take_no_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, header_of: Callable) -> None:
    """Only chunks that hold light exist; zeros written over light do replace it."""
    monkeypatch.setattr("nlosrender.files.chunks.CHUNK_SAMPLES", 7 * 4)  # tiles of 2 x 2
    block = np.zeros((1, 2, 2, 3, 4, 5, 7), dtype=np.float32)
    block[0, 1, 1, 2, 3, 4, 6] = 1.0
    with CaptureWriter(tmp_path / "a.hdf5", header_of()) as writer:
        writer.write(block)
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert file["data"].id.get_num_chunks() == 1
        assert file["data"][()].sum() == 1
    with CaptureWriter(tmp_path / "b.hdf5", header_of()) as writer:
        writer.write(block)
        writer.write(np.zeros_like(block))
    with h5py.File(tmp_path / "b.hdf5") as file:
        assert file["data"][()].sum() == 0


@pytest.mark.parametrize(("value", "word"), [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf"), (1e39, "inf")])
def test_non_finite_samples_are_named_and_leave_no_file(
    tmp_path: Path, header_of: Callable, block_of: Callable, value: float, word: str
) -> None:
    """NaN, infinity and what becomes infinity in float32 stop the write, with their place."""
    block = block_of(header_of()).astype(np.float64)[:, :, 1:, 1:, 1:, 2:]
    block[0, 1, 0, 1, 2, 1, 6] = value
    message = rf"data is {word} at laser \(1, 2\), sensor \(3, 3\), bin 6, bounce 3, channel 0"
    with pytest.raises(RenderError, match=message), CaptureWriter(tmp_path / "a.hdf5", header_of()) as writer:
        writer.write(block, laser_at=(1, 1), sensor_at=(1, 2))
    assert list(tmp_path.iterdir()) == []


def test_non_finite_variance_is_refused(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """The variance is held to the same rule, also where its chunk is dark in data."""
    block = block_of(header_of())
    variance = block * np.float32(np.nan)
    with (
        pytest.raises(RenderError, match="variance is nan at laser"),
        CaptureWriter(tmp_path / "a.hdf5", header_of(), store_variance=True) as writer,
    ):
        writer.write(block, variance=variance)


@pytest.mark.parametrize("failure", [RuntimeError("engine"), KeyboardInterrupt()])
def test_failure_keeps_the_earlier_file(
    tmp_path: Path, header_of: Callable, write_capture: Callable, failure: BaseException
) -> None:
    """When a render stops half-way the old output is intact and nothing else is left."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of())
    before = path.read_bytes()

    def render() -> None:
        with CaptureWriter(path, header_of("confocal")) as writer:
            writer.write(np.ones((1, 2, 1, 1, 4, 5, 7)))
            raise failure

    with pytest.raises(type(failure)):
        render()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_file_appears_only_when_complete(tmp_path: Path, header_of: Callable) -> None:
    """While it is written the file has another name, in the same folder."""
    path = tmp_path / "a.hdf5"
    with CaptureWriter(path, header_of()):
        assert all(re.fullmatch(r"\.a\.hdf5\.\w+\.partial", entry.name) for entry in tmp_path.iterdir())
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.hdf5"]


def test_a_symbolic_link_stays_one(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Writing through a link replaces the file it points to."""
    (tmp_path / "disk").mkdir()
    link = tmp_path / "a.hdf5"
    link.symlink_to(tmp_path / "disk" / "real.hdf5")
    write_capture(link, header_of())
    assert link.is_symlink()
    assert h5py.is_hdf5(tmp_path / "disk" / "real.hdf5")


@pytest.mark.parametrize(
    ("shape", "laser_at", "sensor_at", "message"),
    [
        ((1, 2, 2, 3, 4, 5), (0, 0), (0, 0), "block: got float64"),
        ((1, 2, 1, 1, 4, 5, 6), (0, 0), (0, 0), "block: 6 from 0 along bin does not fit, its length is 7"),
        ((1, 1, 1, 1, 4, 5, 7), (0, 0), (0, 0), "along bounce"),
        ((1, 2, 1, 1, 4, 5, 7), (2, 0), (0, 0), "block: 1 from 2 along laser_y does not fit, its length is 2"),
        ((1, 2, 1, 2, 4, 5, 7), (0, 2), (0, 0), "block: 2 from 2 along laser_x"),
        ((1, 2, 1, 1, 4, 5, 7), (0, 0), (1, 0), "block: 4 from 1 along sensor_y"),
        ((1, 2, 1, 1, 1, 1, 7), (0, 0), (0, -1), "block: 1 from -1 along sensor_x"),
    ],
)
def test_blocks_that_do_not_fit(
    tmp_path: Path, header_of: Callable, shape: tuple, laser_at: tuple, sensor_at: tuple, message: str
) -> None:
    """A block outside the capture is refused, never clipped."""
    with CaptureWriter(tmp_path / "a.hdf5", header_of()) as writer, pytest.raises(ValueError, match=message):
        writer.write(np.ones(shape), laser_at=laser_at, sensor_at=sensor_at)


def test_integer_samples_and_stray_variance_are_refused(
    tmp_path: Path, header_of: Callable, block_of: Callable
) -> None:
    """Samples are floats; variance comes exactly when it is stored."""
    block = block_of(header_of())
    with CaptureWriter(tmp_path / "a.hdf5", header_of()) as writer:
        with pytest.raises(ValueError, match="block: got int64"):
            writer.write(np.ones(block.shape, dtype=np.int64))
        with pytest.raises(ValueError, match="variance: needed exactly when"):
            writer.write(block, variance=block)
    with CaptureWriter(tmp_path / "a.hdf5", header_of(), store_variance=True) as writer:
        with pytest.raises(ValueError, match="variance: needed exactly when"):
            writer.write(block)
        with pytest.raises(ValueError, match="variance: got shape"):
            writer.write(block, variance=block[..., :-1])
    with pytest.raises(ValueError, match="compression: got 'lzf', need one of gzip, none"):
        CaptureWriter(tmp_path / "a.hdf5", header_of(), compression="lzf")


def test_gzip_with_shuffle_only(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """The two filters every HDF5 build has, and no others."""
    write_capture(tmp_path / "a.hdf5", header_of(), compression="gzip")
    write_capture(tmp_path / "b.hdf5", header_of(), compression="none")
    with h5py.File(tmp_path / "a.hdf5") as zipped, h5py.File(tmp_path / "b.hdf5") as plain:
        creation = zipped["data"].id.get_create_plist()
        filters = [creation.get_filter(index)[0] for index in range(creation.get_nfilters())]
        assert filters == [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
        assert plain["data"].id.get_create_plist().get_nfilters() == 0


def test_long_configurations_fit(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """200 kB of configuration come back whole; an attribute's usual limit is 64 KiB."""
    config = {"scene": ["é" * 50 for _ in range(2000)], "seed": 3}
    write_capture(tmp_path / "a.hdf5", header_of(), provenance_attributes(config, "abc", engine="path", seed=3))
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert len(file.attrs["config"].encode()) > 200_000
        assert json.loads(file.attrs["config"]) == config
        assert (file.attrs["render_engine"], file.attrs["config_hash"], file.attrs["seed"]) == ("path", "abc", 3)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing/a.hdf5", "there is no folder .*missing. Create it"),
        ("folder", "is a folder. Name a file in it"),
        ("file/a.hdf5", "there is no folder|cannot be used as an output"),
        ("x" * 300 + ".hdf5", "File name too long"),
        ("a\0b.hdf5", "cannot be used as an output"),
        ("pipe", "is not a regular file"),
        ("/proc/a.hdf5", "cannot be written: .*"),  # takes no files, not even root's
    ],
)
def test_outputs_that_cannot_be_written(tmp_path: Path, header_of: Callable, name: str, message: str) -> None:
    """Each is found before anything long starts, with advice, and by the writer too."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("text")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match=message):
        check_writable(tmp_path / name, CAPTURE)
    with pytest.raises(FileError, match=message), CaptureWriter(tmp_path / name, header_of()):
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(tmp_path: Path) -> None:
    """A folder that may not be written to is named, with advice."""
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(FileError, match="Name an output in a folder you may write to"):
            check_writable(tmp_path / "a.hdf5", CAPTURE)
    finally:
        tmp_path.chmod(0o700)


def test_existing_files_are_kept_on_request(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """overwrite=False refuses an existing file and leaves it alone."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of())
    precious = path.read_bytes()
    with pytest.raises(FileError, match="exists already"):
        write_capture(path, header_of(), overwrite=False)
    assert path.read_bytes() == precious
    assert check_writable(path, CAPTURE) == path.resolve()
    assert path.read_bytes() == precious
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX limits")
def test_full_disk(tmp_path: Path, header_of: Callable) -> None:
    """When the disk takes no more the writer says so, names the file, and leaves nothing behind."""
    header = header_of("single", n_bins=20_000)
    noise = np.random.default_rng(0).random((1, 2, 1, 1, 4, 5, 20_000))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        # a limit on the size of files stands in for the full disk: the same error comes from the same call
        resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, hard))
        with pytest.raises(FileError, match=r"a\.hdf5: cannot be written: File too large\. Free some space"):  # noqa: SIM117
            with CaptureWriter(tmp_path / "a.hdf5", header, compression="none") as writer:
                writer.write(noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert list(tmp_path.iterdir()) == []
