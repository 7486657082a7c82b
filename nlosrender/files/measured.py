"""Measured captures: a detector in front of a capture file, some sensor points at a time.

Counts go into a file of their own (``measure_capture``) or, in a render, into a dataset beside the ideal samples
(``add_counts``). Random numbers are those of the seed, the laser point and the first point of a block; blocks
follow from the grid and the detector's bins alone. So counts do not depend on who measures what when.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import h5py
import numpy as np
from numpy.random import Generator, Philox
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nlosrender.config.sensor import SensorConfig, ZonesConfig, misfits, stored_sensor
from nlosrender.errors import ConfigError, FileError
from nlosrender.files import layout
from nlosrender.files.atomic_write import check_writable, replacing
from nlosrender.files.attributes import json_object, set_attributes, text_list
from nlosrender.files.capture_header import CaptureHeader
from nlosrender.files.capture_results import OMITTED, UNSAMPLED, WARNINGS, ZERO
from nlosrender.files.chunking import Chunker, PackedChunk
from nlosrender.files.file_kinds import CAPTURE, MEASURED
from nlosrender.files.hdf5_writer import HDF5Writer
from nlosrender.files.header_writer import create_capture
from nlosrender.files.parts.shards import PART
from nlosrender.files.reading.reader import StoredCapture, finite, open_capture
from nlosrender.files.reading.scan import hidden_box, moved, wall_frame, wall_pose
from nlosrender.files.reading.stored_header import StoredHeader, intensity
from nlosrender.files.thread_pool import in_order
from nlosrender.sensor.detector import (
    Detector,
    Totals,
    detector_of,
    detector_warnings,
    measurement_of,
    physical_scale,
)
from nlosrender.sensor.rebinning import TimeBins
from nlosrender.sensor.zones import zone_of_points, zone_sums

SENSOR, MEASUREMENT, CORRECTIONS = "sensor", "measurement", "corrections"  # attributes
BLOCK_SAMPLES = 2**21  # of light or counts at a time and thread: some ten arrays of 16 MB
# of the ideal capture's attributes, what stays true of its counts
KEPT = (
    "config",
    "config_hash",
    "versions",
    "render_engine",
    "engine_reason",
    "meshes",
    UNSAMPLED,
    ZERO,
    OMITTED,
    WARNINGS,
)
CORRECTABLE = ("pile_up", "background")
LARGE_NOISE = 10  # signal over noise of the sum of a histogram

Block = tuple[tuple[int, int], slice, slice]  # laser point, rows and columns of sensor points or of zones
Progress = Callable[[float], None]
Warn = Callable[[str], None]


@dataclass(frozen=True)
class MeasureReport:
    """What was measured."""

    output: Path
    measurement: Mapping[str, object]  # as ``measurement_of`` returns it


def measure_capture(
    path: str | Path,
    output: str | Path,
    config: SensorConfig | None,
    progress: Progress = lambda share: None,
    warn: Warn = lambda text: None,
    *,
    corrections: tuple[str, ...] = (),
    overwrite: bool = False,
    threads: int | None = None,
) -> MeasureReport:
    """Write a capture whose ``data`` are what a detector counts of another one.

    Parameters
    ----------
    path
        A Z-NLOS file by any writer; or one that was measured, to be corrected.
    output
        File to write.
    config
        The detector; None: that of the file.
    progress, warn
        Called with the share of the work done, and with warnings.
    corrections
        Some of ``CORRECTABLE``: what is undone of the counts.
    overwrite
        Whether a capture may be replaced that holds no counts.
    threads
        That measure; None: one per core. Counts are the same.

    Raises
    ------
    ConfigError
        The detector does not fit the capture.
    FileError
        The file cannot be measured, or the output not be written.
    """
    output = Path(output)
    kind = CAPTURE if overwrite else MEASURED
    check_writable(output, kind, [path])
    with open_capture(path) as capture:
        measurement = _measurement(capture, config, corrections).scaled(threads)
        header = capture.header
        compression = "none" if header.compression == "none" else "gzip"
        with replacing(output, kind, [path]) as partial, HDF5Writer(partial) as writer:
            with writer.writing():
                create_capture(writer.file, measurement.header, {}, compression, store_variance=False)
                kept = {name: header.attributes[name] for name in KEPT if name in header.attributes}
                kept |= {
                    "measured_from": Path(path).name,
                    "ideal_error_estimate": header.attributes.get("error_estimate", np.nan),
                }
                set_attributes(writer.file, kept)
                if measurement.zones is None:  # which have a grid of their own
                    capture.copy_ground_truth(writer.file)
            data = writer.file[layout.DATA]
            found = measurement.write(writer, data, progress, warn, threads)
            with writer.writing():
                set_attributes(writer.file, measurement.attributes(found))
                set_attributes(data, {"unit": layout.COUNTS_UNIT, "meaning": "counts per bin, of all bounces"})
    return MeasureReport(output, found)


def add_counts(
    writer: HDF5Writer, path: Path, config: SensorConfig | None = None, *, warn: Warn = lambda text: None
) -> dict[str, object]:
    """Add a dataset ``counts`` to a complete capture that is open for writing; no config: by the sensor of its own.

    It has the axes of ``data``; one that is there already is replaced.

    Returns
    -------
    dict
        Attributes for the file.

    Raises
    ------
    ConfigError, FileError, OSError
        As ``measure_capture``.
    """
    capture = StoredCapture(writer.file, path)
    measurement = _measurement(capture, config, ()).scaled()
    header = measurement.header
    gzip = capture.header.compression != "none"
    with writer.writing():
        if layout.COUNTS in writer.file:
            del writer.file[layout.COUNTS]
        shape = layout.data_shape(header.sizes, header.confocal)
        filters = {"compression": "gzip", "shuffle": True} if gzip else {}
        dataset = writer.file.create_dataset(
            layout.COUNTS, shape, layout.FLOAT, chunks=header.chunks, fillvalue=0.0, **filters
        )
        set_attributes(
            dataset,
            {
                "unit": layout.COUNTS_UNIT,
                "meaning": f"counts per bin, of all bounces, in index {layout.SUMMED_INDEX} of the bounce axis",
                "axes": " ".join(layout.file_axes(header.confocal)),
                "t0": header.start_opl,
                "deltaT": header.bin_width_opl,
            },
        )
    return measurement.attributes(measurement.write(writer, dataset, lambda share: None, warn))


def sensor_of(header: StoredHeader) -> SensorConfig | None:
    """Return the sensor that a file was measured with, or that its configuration has; None: there is none.

    Raises
    ------
    FileError
        It cannot be used: its measured response lies elsewhere by now, or another program wrote it.
    """
    stored = json_object(header.attributes.get(SENSOR))
    values = stored or json_object(header.attributes.get("config")).get("sensor")
    if not isinstance(values, Mapping) or not values:
        return None
    sensor = stored_sensor(values)
    wrong = [*sensor.issues(("sensor",), SensorConfig)]
    if wrong:
        raise FileError(f"{header.path}: its sensor cannot be used: {wrong[0]} Name another one with --sensor.")
    return sensor


def few_counts(header: StoredHeader) -> Iterator[str]:
    """Yield a warning where the shot noise of a measured file's histograms is large beside their signal."""
    stated = json_object(header.attributes.get(MEASUREMENT))
    counts, ratio = stated.get("counts_per_histogram"), stated.get("signal_to_background")
    if header.is_measured and isinstance(counts, (int, float)) and counts >= 0:
        signal = counts * ratio / (1 + ratio) if isinstance(ratio, (int, float)) and ratio >= 0 else counts
        if signal < LARGE_NOISE * math.sqrt(counts) or not counts:
            yield (
                f"{header.path}: holds {signal:.3g} counts of light per histogram among {counts:.3g}: shot noise is "
                f"more than {1 / LARGE_NOISE:.0%} of their sum. Measure longer (sensor.exposure_time)."
            )


@dataclass(frozen=True, eq=False)
class _Measurement:
    """A detector before a capture."""

    capture: StoredCapture
    detector: Detector
    header: CaptureHeader  # of the counts
    zones: csr_array | None  # (zones, points)
    corrections: tuple[str, ...]
    is_counts: bool  # the capture is measured already, and is corrected

    @cached_property
    def blocks(self) -> list[Block]:
        """Laser point, rows and columns of sensor points or of zones: whole chunks of the counts, or all zones."""
        sizes, chunk = (
            self.header.sizes,
            dict(zip(layout.file_axes(self.header.confocal), self.header.chunks, strict=True)),
        )
        rows, columns = sizes["sensor_y"], sizes["sensor_x"]
        if self.zones is None:
            points = max(BLOCK_SAMPLES // max(sizes["bin"], self.capture.header.n_bins), 1)
            tile_rows, tile_columns = chunk["sensor_y"], chunk["sensor_x"]
            columns = min(max(points // tile_rows // tile_columns, 1) * tile_columns, columns)
            rows = max(points // columns // tile_rows, 1) * tile_rows
        return [
            (
                (y, x),
                slice(row, min(row + rows, sizes["sensor_y"])),
                slice(column, min(column + columns, sizes["sensor_x"])),
            )
            for y, x in np.ndindex(sizes["laser_y"], sizes["laser_x"])
            for row in range(0, sizes["sensor_y"], rows)
            for column in range(0, sizes["sensor_x"], columns)
        ]

    def light(self, block: Block) -> NDArray[np.float32]:
        """Return the light of a block, (source bins, points)."""
        if self.zones is None:
            return self._light(*block).T
        found = np.zeros((self.zones.shape[0], self.capture.header.n_bins), np.float32)
        columns, done = self.capture.header.sizes["sensor_x"], 0
        step = max(BLOCK_SAMPLES // (columns * self.capture.header.n_bins), 1)
        for y in range(0, self.capture.header.sizes["sensor_y"], step):
            band = self._light(block[0], slice(y, y + step), None)
            found += self.zones[:, done : done + len(band)] @ band
            done += len(band)
        return found.T

    def _light(self, laser: tuple[int, int], rows: slice, columns: slice | None) -> NDArray[np.float32]:
        """Return (points, bins) of some sensor points, bounces summed, colours averaged."""
        capture = self.capture
        samples = finite(capture.path, capture.read_block(laser, (rows, columns)))
        light = intensity(capture.header, samples).sum(axis=0).reshape(-1, capture.header.n_bins)
        if light.min(initial=0.0) < 0 and not self.is_counts:
            raise FileError(
                f"{capture.path}: holds negative light, {light.min():.3g}, of which no photons can be counted."
            )
        return light

    def scaled(self, threads: int | None = None) -> _Measurement:
        """Return the same with the scale of the capture's light, all of which is looked at for a relative one."""
        return dataclasses.replace(self, detector=dataclasses.replace(self.detector, scale=self._scale(threads)))

    def write(
        self, writer: HDF5Writer, dataset: h5py.Dataset, progress: Progress, warn: Warn, threads: int | None = None
    ) -> Mapping[str, object]:
        """Measure all blocks into a dataset, and return what ``info`` shows."""
        for text in () if self.is_counts else detector_warnings(self.detector):
            warn(text)
        chunker, totals = Chunker(self.header, dataset.compression or "none"), Totals()
        results = in_order(lambda block: self._measured(block, chunker), self.blocks, threads)
        for number, (chunks, part) in enumerate(results):
            for chunk in chunks:
                writer.put_chunk(dataset, chunk.at, chunk.content)
            totals.add(part)
            progress((number + 1) / len(self.blocks))
        if totals.without_ready:
            warn(
                f"{totals.without_ready} histograms have bins after which no pulse was left: pile-up cannot be undone "
                "there, they are 0. Measure with less light."
            )
        if self.is_counts:
            return json_object(self.capture.header.attributes.get(MEASUREMENT))
        return measurement_of(self.detector, totals)

    def _measured(self, block: Block, chunker: Chunker) -> tuple[list[PackedChunk], Totals]:
        (y, x), rows, columns = block
        light, sizes = self.light(block), self.header.sizes
        if self.is_counts:
            counts, totals = light.astype(np.float64), Totals(light.shape[1])
        else:
            config = self.detector.config
            stream = Philox(key=[config.seed, y * sizes["laser_x"] + x], counter=[0, 0, columns.start, rows.start])
            counts, totals = self.detector.measure(light, Generator(stream) if config.shot_noise else None)
        counts, totals.without_ready = self.detector.corrected(counts, self.corrections)
        shaped = counts.reshape(1, 1, 1, 1, sizes["bin"], -1, columns.stop - columns.start)
        return [*chunker.pack({layout.DATA: np.moveaxis(shaped, 4, -1)}, (y, x), (rows.start, columns.start))], totals

    def _scale(self, threads: int | None) -> float:
        config = self.detector.config
        if self.is_counts:
            return 1.0
        header = self.capture.header
        if config.photons_per_pulse is None:
            if header.data_attributes.get("unit") != layout.DATA_UNIT:
                message = (
                    f"missing: {header.path} does not say that its data are in {layout.DATA_UNIT}, so they make no "
                )
                raise ConfigError.at("sensor.photons_per_pulse", message + "photons; need a relative scale.")
            area = float(np.prod(header.sensor_grid_size or 0.0)) / math.prod(header.sensor_grid)
            seen = header.footprint
            if seen is not None and seen[1] is not None:
                area = seen[1]
            elif config.footprint_area is None and (area <= 0 or header.whose_points):
                whose = header.whose_points
                lacks = f"points of {whose} have no cells" if whose else "the sensor grid has no size"
                raise ConfigError.at("sensor.footprint_area", f"missing: {lacks}, so give the area that is seen [m^2].")
            return physical_scale(config, area)
        sums = in_order(lambda block: self.light(block).sum(axis=0, dtype=np.float64), self.blocks, threads)
        total, brightest, points = 0.0, 0.0, 0
        for part in sums:
            total, brightest, points = total + float(part.sum()), max(brightest, float(part.max())), points + len(part)
        if not total > 0:
            return 0.0  # no light, which no scale makes photons of
        wanted = config.photons_per_pulse
        return wanted.brightest / brightest if wanted.brightest is not None else (wanted.mean or 0.0) * points / total

    def attributes(self, found: Mapping[str, object]) -> dict[str, object]:
        """Return the attributes that say how the counts came about, and what ``write`` returned."""
        done = text_list(self.capture.header.attributes, CORRECTIONS) if self.is_counts else ()
        described = {name: field.description for name, field in SensorConfig.model_fields.items()}
        return {
            SENSOR: json.dumps(self.detector.config.model_dump(mode="json")),
            "sensor_keys": json.dumps(described),
            MEASUREMENT: json.dumps(found),
        } | ({CORRECTIONS: [*done, *self.corrections]} if done or self.corrections else {})


def _measurement(capture: StoredCapture, config: SensorConfig | None, corrections: tuple[str, ...]) -> _Measurement:
    """Put a detector before a capture (ConfigError, FileError: it does not fit)."""
    header = capture.header
    counts = header.is_measured
    if counts and config is not None and corrections:
        raise FileError(f"{header.path}: counts are corrected by the sensor that counted them, which the file names.")
    config = config or sensor_of(header)
    if config is None:
        raise FileError(
            f"{header.path}: names no sensor. Use --sensor; nlosrender measure --list lists those there are."
        )
    _refuse(header, config, corrections, counts)
    detector = detector_of(config, TimeBins(header.start_opl, header.bin_width_opl, header.n_bins))
    zones = None if counts else config.zones
    described, sums = _counts_header(capture, detector, zones)
    return _Measurement(capture, detector, described, sums, corrections, counts)


def _refuse(header: StoredHeader, config: SensorConfig, corrections: tuple[str, ...], counts: bool) -> None:
    path, done = header.path, text_list(header.attributes, CORRECTIONS) if counts else ()
    if PART in header.attributes:
        raise FileError(f"{path}: is a part of a capture, whose brightness is not known yet. Merge the parts first.")
    if counts and not corrections:
        raise FileError(f"{path}: holds counts already. Measure the ideal capture, or name a --correct.")
    if set(done) & set(corrections):
        raise FileError(f"{path}: has been corrected for {', '.join(done)} already.")
    undone = "pile_up" not in (*corrections, *done)
    if "background" in corrections and config.pile_up != "none" and undone:
        raise FileError(f"{path}: background adds up where nothing is lost only: also use --correct pile_up.")
    if "pile_up" in corrections and config.afterpulse_probability:
        raise FileError(
            f"{path}: pile-up cannot be undone with afterpulses (sensor.afterpulse_probability) among the counts."
        )
    for key, message in () if counts else misfits(config, header.scan_type):
        raise ConfigError.at(f"sensor.{key}", message)
    if config.zones is not None and not counts and (whose := header.whose_points):
        message = f"add up the cells of a grid, and points of {whose} have none; need capture.sensor_grid, or no zones."
        raise ConfigError.at("sensor.zones", message)


def _counts_header(
    capture: StoredCapture, detector: Detector, zones: ZonesConfig | None
) -> tuple[CaptureHeader, csr_array | None]:
    """Describe the file of the counts: the capture's, with the detector's bins, and with zones for sensor points."""
    header, stored, to_wall = capture.header, capture.positions, wall_frame(capture.header)
    if (
        stored.sensor_normals is None
        or stored.laser_normals is None
        or header.sensor_position is None
        or header.laser_position is None
    ):
        raise FileError(
            f"{capture.path}: lacks normals, cameraPosition or laserPosition, which a Z-NLOS file of its counts needs."
        )
    turn = to_wall.copy()
    turn[:3, 3] = 0.0
    sensors, lasers = moved(stored.sensor_positions, to_wall), moved(stored.laser_positions, to_wall)
    normals, laser_normals = moved(stored.sensor_normals, turn), moved(stored.laser_normals, turn)
    sensor = moved(np.asarray(header.sensor_position), to_wall)
    size, sums = header.sensor_grid_size or (0.0, 0.0), None
    if zones is not None:
        sums = zone_sums(zone_of_points(zones, sensors, sensor, (size[0], size[1])), zones.nx * zones.ny)
        share = sums / sums.sum(axis=1)[:, None]
        shape = (zones.ny, zones.nx, 3)
        sensors = (share @ sensors.reshape(-1, 3)).reshape(shape)
        normals = (share @ normals.reshape(-1, 3)).reshape(shape)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    empty = empty_lasers = None
    if layout.EMPTY_POINTS in header.attributes:
        empty, empty_lasers = (np.asarray(~each.any(axis=-1)) for each in (normals, laser_normals))
        normals[empty] = laser_normals[empty_lasers] = (0.0, 0.0, 1.0)  # written as zeros again
    n_unlit = header.attributes.get(layout.UNLIT_POINTS, 0)
    laser_size = header.laser_grid_size or (0.0, 0.0)
    limit = header.attributes.get("max_bounces")
    frame = str(header.attributes.get("frame", "znlos"))
    spots = capture.laser_spots
    bins = detector.bins
    try:
        return CaptureHeader(
            scan_type=header.scan_type,
            sensor_positions=sensors,
            sensor_normals=normals,
            laser_positions=lasers,
            laser_normals=laser_normals,
            sensor_position=sensor,
            laser_position=moved(np.asarray(header.laser_position), to_wall),
            sensor_grid_size=(size[0], size[1]),
            laser_grid_size=(laser_size[0], laser_size[1]),
            n_bins=bins.count,
            bin_width_opl=bins.width,
            start_opl=bins.start,
            max_bounces=limit if isinstance(limit, int) else None,
            account_first_and_last_bounces=bool(header.attributes.get("account_first_and_last_bounces", True)),
            hidden_bounds=hidden_box(header, to_wall),
            pose=wall_pose(header),
            frame=frame if frame in layout.FRAMES else "znlos",
            planar_wall=bool(header.attributes.get("planar_wall", np.ptp(sensors[..., 2]) < 1e-6)),
            n_channels=1,
            bounce_indices=(layout.SUMMED_INDEX,),
            split_bounces=False,
            empty_sensors=empty,
            empty_lasers=empty_lasers,
            n_unlit_lasers=n_unlit if isinstance(n_unlit, int) else 0,
            footprint=header.footprint,
            laser_flash=str(header.attributes.get(layout.FLASH, "")),
            laser_spots=None if spots is None else (moved(spots[0], to_wall), spots[1]),
            point_lists=tuple(name for name in ("sensor", "laser") if header.is_list(name)),
            # a chunk is counted at once: of few bins as few points as of the many they are made of
            chunk_samples=max(layout.CHUNK_SAMPLES * bins.count // max(bins.count, header.n_bins), bins.count),
        ), sums
    except ValueError as error:
        raise FileError(f"{capture.path}: {error}") from error
