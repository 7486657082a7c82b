"""What loaders by others do with a file, step by step, with h5py and numpy alone."""

from __future__ import annotations

from math import prod

import h5py
import numpy as np
import pytest
from patch_captures import BIN_WIDTH, GRIDS, N_BINS, START_OPL, PatchCapture, arrival_bins, lit_bins

BOUNCES, THIRD = 6, 1
INTEGERS = {"t", "isConfocal"}
# the 18 that the authors' C++ loaders open, with their ranks, but for the samples
RANKS = {
    **dict.fromkeys(("cameraGridPositions", "cameraGridNormals", "laserGridPositions", "laserGridNormals"), 3),
    **dict.fromkeys(("cameraPosition", "laserPosition", "hiddenVolumePosition", "hiddenVolumeRotation"), 1),
    **dict.fromkeys(("cameraGridSize", "laserGridSize", "cameraGridPoints", "laserGridPoints"), 1),
    **dict.fromkeys(("t", "t0", "deltaT", "hiddenVolumeSize", "isConfocal"), 0),
}
SAMPLE_RANK = {"single": 7, "confocal": 5, "exhaustive": 7}  # MATLAB's NLOSData takes 4 to 7


def buffer_of(dataset: h5py.Dataset) -> np.ndarray:
    """Read a dataset as C++ does: one flat buffer of floats or ints, chosen by the class of the stored number."""
    is_float = dataset.id.get_type().get_class() == h5py.h5t.FLOAT
    buffer = np.full(prod(dataset.shape), -1, dtype=np.float32 if is_float else np.int32)
    native = h5py.h5t.NATIVE_FLOAT if is_float else h5py.h5t.NATIVE_INT32
    dataset.id.read(h5py.h5s.ALL, h5py.h5s.ALL, buffer.reshape(dataset.shape), mtype=native)
    return buffer


def assert_arrivals(third: np.ndarray, lasers: np.ndarray, sensors: np.ndarray) -> None:
    """Check that histograms (bin, ...) are lit when points (..., 3) [m] say: each sample belongs to its points."""
    earliest, latest = arrival_bins(lasers, sensors, START_OPL, BIN_WIDTH)
    first, last = lit_bins(third)
    assert first.shape == earliest.shape
    assert (first >= earliest).all()
    assert (last <= latest).all()


def test_netf(captures: dict[str, PatchCapture]) -> None:
    """NeTF: bounce index 1 of colour 0 of a 5-D file, pixels and positions both flattened in the file's order."""
    with h5py.File(captures["confocal"].path) as file:
        third = file["data"][:][0, :, THIRD].reshape(N_BINS, -1)
        points = file["cameraGridPositions"][:].reshape(3, -1).T
        assert file["cameraGridPoints"][:].tolist() == [6, 6]
        np.testing.assert_allclose(file["cameraGridSize"][:], [1.9, 1.4], rtol=1e-7)
    assert_arrivals(third, points, points)


def test_totri(captures: dict[str, PatchCapture]) -> None:
    """totri: flat buffers of a confocal file seen as (1, T, 6, Ny, Nx) and (1, 3, Ny, Nx)."""
    with h5py.File(captures["confocal"].path) as file:
        n_bins, (nx, ny) = int(file["t"][()]), file["cameraGridPoints"][:].astype(int)
        samples = buffer_of(file["data"]).reshape(1, n_bins, BOUNCES, ny, nx)
        points, normals = (
            buffer_of(file[f"cameraGrid{name}"]).reshape(1, 3, ny, nx)[0] for name in ("Positions", "Normals")
        )
    assert not np.delete(samples, THIRD, axis=2).any()
    assert (normals[1] == -1).all()
    assert_arrivals(samples[0, :, THIRD], points.transpose(1, 2, 0), points.transpose(1, 2, 0))


@pytest.mark.parametrize("name", ["single", "exhaustive"])
def test_column_major_indices(captures: dict[str, PatchCapture], name: str) -> None:
    """The authors' C++: laser x runs fastest in the flat buffer, then laser y, sensor x, sensor y, bounce, bin."""
    with h5py.File(captures[name].path) as file:
        (nx, ny), (lx, ly) = (file[f"{grid}GridPoints"][:].astype(int) for grid in ("camera", "laser"))
        samples = buffer_of(file["data"])
        sensors, lasers = (buffer_of(file[f"{grid}GridPositions"]) for grid in ("camera", "laser"))
    bins = np.arange(N_BINS)
    for x, y, laser_x, laser_y in np.ndindex(nx, ny, lx, ly):
        pixel = (bins * BOUNCES + THIRD) * ny * nx + y * nx + x
        histogram = samples[(pixel * ly + laser_y) * lx + laser_x]
        sensor = sensors[np.arange(3) * ny * nx + y * nx + x]
        laser = lasers[np.arange(3) * ly * lx + laser_y * lx + laser_x]
        assert_arrivals(histogram, laser, sensor)


@pytest.mark.parametrize("name", GRIDS)
def test_every_dataset_has_its_rank_and_class(captures: dict[str, PatchCapture], name: str) -> None:
    """C++ opens all 18 by name and reads by class; MATLAB stumbles over booleans and enumerations, others over text."""
    ranks = RANKS | {"data": SAMPLE_RANK[name]}
    with h5py.File(captures[name].path) as file:
        assert {key: file[key].ndim for key in ranks} == ranks
        for key, item in file.items():
            stored = item.id.get_type()
            assert stored.get_class() == (h5py.h5t.INTEGER if key in INTEGERS else h5py.h5t.FLOAT), key
            assert stored.get_size() == 4, key
        assert buffer_of(file["t"]) == N_BINS
        assert buffer_of(file["isConfocal"]) == (name == "confocal")
        np.testing.assert_allclose([buffer_of(file["t0"])[0], buffer_of(file["deltaT"])[0]], [START_OPL, BIN_WIDTH])


@pytest.mark.parametrize("name", GRIDS)
def test_filters_every_hdf5_has(captures: dict[str, PatchCapture], name: str) -> None:
    """Only gzip and shuffle are in every build of HDF5."""
    used = set()

    def collect(_: str, item: h5py.Dataset) -> None:
        plist = item.id.get_create_plist()
        used.update(plist.get_filter(index)[0] for index in range(plist.get_nfilters()))

    with h5py.File(captures[name].path) as file:
        file.visititems(collect)
    assert used == {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}
