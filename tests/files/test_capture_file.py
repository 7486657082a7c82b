"""What reaches the file, checked with h5py alone."""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from support.partial_captures import write_capture as write_samples

from nlosrender.errors import FileError, RenderError
from nlosrender.files.atomic_write import check_writable
from nlosrender.files.chunking import Chunker
from nlosrender.files.file_kinds import CAPTURE
from nlosrender.files.partial.partial_capture import PartialCapture
from nlosrender.files.provenance import provenance_attributes
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
    write_samples(tmp_path / "a.hdf5", header, block, compression=compression)
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


def test_long_histograms_are_cut_along_time(tmp_path: Path, header_of: Callable) -> None:
    """Bins beyond a chunk's length go into further chunks."""
    header = header_of("single", chunk_samples=3)
    block = np.random.default_rng(5).random((1, 2, 1, 1, 4, 5, 7))
    write_samples(tmp_path / "a.hdf5", header, block)
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
    with pytest.raises(ValueError, match="attributes: engine, frame already set"):
        write_samples(tmp_path / "a.hdf5", header_of(), attributes={"frame": "x", "engine": "path"})
    with PartialCapture.claim(tmp_path / "a.hdf5", {}) as partial:
        partial.open(header_of(), {}, "gzip", store_variance=False)
        with pytest.raises(ValueError, match="units already set"):
            partial.publish({"units": "feet"})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("value", "word"), [(np.nan, "nan"), (np.inf, "inf"), (-np.inf, "-inf"), (1e39, "inf")])
def test_non_finite_samples_are_named_and_leave_no_file(
    tmp_path: Path, header_of: Callable, block_of: Callable, value: float, word: str
) -> None:
    """NaN, infinity and what becomes infinity in float32 stop the write, with their place."""
    block = block_of(header_of()).astype(np.float64)[:, :, 1:, 1:, 1:, 2:]
    block[0, 1, 0, 1, 2, 1, 6] = value
    message = rf"data is {word} at laser \(1, 2\), sensor \(3, 3\), bin 6, bounce 3, channel 0"
    with pytest.raises(RenderError, match=message):
        list(Chunker(header_of(), "gzip").pack({"data": block}, laser_at=(1, 1), sensor_at=(1, 2)))
    whole = np.full((1, 2, 2, 3, 4, 5, 7), value)
    with pytest.raises(RenderError, match=f"data is {word} at laser"):
        write_samples(tmp_path / "a.hdf5", header_of(), whole)
    assert list(tmp_path.iterdir()) == []


def test_non_finite_variance_is_refused(tmp_path: Path, header_of: Callable, block_of: Callable) -> None:
    """The variance is held to the same rule, also where its chunk is dark in data."""
    block = block_of(header_of())
    variance = block * np.float32(np.nan)
    with pytest.raises(RenderError, match="variance is nan at laser"):
        write_samples(tmp_path / "a.hdf5", header_of(), 0 * block, variance)


@pytest.mark.parametrize("failure", [RuntimeError("engine"), KeyboardInterrupt()])
def test_failure_keeps_the_earlier_file(
    tmp_path: Path, header_of: Callable, write_capture: Callable, failure: BaseException
) -> None:
    """When a render stops half-way the old output is intact and nothing else is left."""
    path = tmp_path / "a.hdf5"
    write_capture(path, header_of())
    before = path.read_bytes()

    def render() -> None:
        with PartialCapture.claim(path, {}, resume=False) as partial:
            partial.open(header_of("confocal"), {}, "gzip", store_variance=False)
            raise failure

    with pytest.raises(type(failure)):
        render()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_file_appears_only_when_complete(tmp_path: Path, header_of: Callable) -> None:
    """While it is written the file has another name, in the same folder."""
    path = tmp_path / "a.hdf5"
    with PartialCapture.claim(path, {}) as partial:
        partial.open(header_of(), {}, "gzip", store_variance=False)
        assert [entry.name for entry in tmp_path.iterdir()] == [".a.hdf5.partial"]
        partial.publish({})
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.hdf5"]


def test_a_symbolic_link_stays_one(tmp_path: Path, header_of: Callable, write_capture: Callable) -> None:
    """Writing through a link replaces the file it points to."""
    (tmp_path / "disk").mkdir()
    link = tmp_path / "a.hdf5"
    link.symlink_to(tmp_path / "disk" / "real.hdf5")
    write_capture(link, header_of())
    assert link.is_symlink()
    assert h5py.is_hdf5(tmp_path / "disk" / "real.hdf5")


def test_an_unknown_compression_is_refused(header_of: Callable) -> None:
    """Only what every HDF5 build reads."""
    with pytest.raises(ValueError, match="compression: got 'lzf', need one of gzip, none"):
        Chunker(header_of(), compression="lzf")


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
    """Each is found before anything long starts, with advice, and by the writer of captures too."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("text")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match=message):
        check_writable(tmp_path / name, CAPTURE)
    with pytest.raises(FileError, match=message):
        write_samples(tmp_path / name, header_of())


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(tmp_path: Path) -> None:
    """A folder that may not be written to is named, with advice."""
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(FileError, match="Name an output in a folder you may write to"):
            check_writable(tmp_path / "a.hdf5", CAPTURE)
    finally:
        tmp_path.chmod(0o700)


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
        with pytest.raises(FileError, match=r"a\.hdf5: cannot be written: File too large\. Free some space"):
            write_samples(tmp_path / "a.hdf5", header, noise, compression="none")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)
    assert list(tmp_path.iterdir()) == []
