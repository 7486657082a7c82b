"""Synthetic captures whose axes all have different lengths, so that no transposition can pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import support.partial_captures

from nlosrender.files.capture_header import CaptureHeader
from nlosrender.scene.pose import Pose

N_ROWS, N_COLUMNS, LASER_ROWS, LASER_COLUMNS, N_BINS = 4, 5, 2, 3, 7


def grid(rows: int, columns: int, width: float, height: float) -> np.ndarray:
    """Return cell centres (rows, columns, 3) on the plane z = 0."""
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * height
    return np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.zeros((rows, columns))], axis=-1)


def make_header(scan_type: str = "exhaustive", /, **changes: object) -> CaptureHeader:
    """Return a header with 4 x 5 sensors, 2 x 3 lasers (exhaustive), 7 bins and bounces 2 and 3."""
    sensors = grid(N_ROWS, N_COLUMNS, 2.0, 1.6)
    lasers = {"single": grid(1, 1, 1.0, 1.0) + np.array([0.1, -0.2, 0.0]), "confocal": sensors}.get(
        scan_type, grid(LASER_ROWS, LASER_COLUMNS, 1.2, 0.8)
    )
    header = CaptureHeader(
        scan_type=scan_type,
        sensor_positions=sensors,
        sensor_normals=np.broadcast_to([0.0, 0.0, 1.0], sensors.shape),
        laser_positions=lasers,
        laser_normals=np.broadcast_to([0.0, 0.0, 1.0], lasers.shape),
        sensor_position=np.array([0.3, 0.2, 1.5]),
        laser_position=np.array([-0.5, 0.1, 0.25]),
        sensor_grid_size=(2.0, 1.6),
        laser_grid_size=(1.2, 0.8),
        n_bins=N_BINS,
        bin_width_opl=0.003,
        start_opl=0.7,
        n_channels=1,
        bounce_indices=(0, 1),
        max_bounces=3,
        split_bounces=True,
        account_first_and_last_bounces=True,
        hidden_bounds=(np.array([-0.1, -0.2, 0.7]), np.array([0.3, 0.4, 1.2])),
        pose=Pose.from_normal_up([1.0, 2.0, 3.0], [1.0, 0.5, -0.2], [0.1, 1.0, 0.3]),
    )
    return replace(header, **changes)


def make_block(header: CaptureHeader, seed: int = 0) -> np.ndarray:
    """Return random samples (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin), all > 0, float32."""
    sizes = header.sizes
    shape = [sizes[a] for a in ("channel", "bounce", "laser_y", "laser_x", "sensor_y", "sensor_x", "bin")]
    return np.random.default_rng(seed).uniform(0.1, 1.0, shape).astype(np.float32)


WriteCapture = Callable[..., np.ndarray]


@pytest.fixture
def header_of(request: pytest.FixtureRequest) -> Callable[..., CaptureHeader]:
    """Builder of headers: ``header_of(scan_type, **changed_fields)``; a module's SMALL_CHUNKS are its chunk_samples."""
    chunks = {"chunk_samples": request.module.SMALL_CHUNKS} if hasattr(request.module, "SMALL_CHUNKS") else {}
    return lambda scan_type="exhaustive", /, **changes: make_header(scan_type, **(chunks | changes))


@pytest.fixture
def block_of() -> Callable[..., np.ndarray]:
    """Builder of random samples that fit a header."""
    return make_block


@pytest.fixture
def write_capture() -> WriteCapture:
    """Writer of a whole random capture: ``write_capture(path, header, attributes, **options)``; returns its block."""

    def write(path: Path, header: CaptureHeader, attributes: dict | None = None, **options: object) -> np.ndarray:
        block = make_block(header)
        variance = block**2 if options.pop("store_variance", False) else None
        support.partial_captures.write_capture(path, header, block, variance, attributes, **options)
        return block

    return write
