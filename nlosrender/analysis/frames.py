"""A line-of-sight capture as pictures: one per range of bins, and the steady one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nlosrender.analysis.laser_view import lit_window
from nlosrender.analysis.pictures import SUFFIXES, save_animation, save_exr, save_png, stokes_panels, tone_mapped
from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.errors import FileError, OptionError
from nlosrender.files.atomic_write import check_writable, explained_write, filled_folder, replacing
from nlosrender.files.file_kinds import GIF, PICTURES
from nlosrender.files.layout import STOKES
from nlosrender.files.reading.reader import StoredCapture, open_capture
from nlosrender.readable import readable_size

Float32 = NDArray[np.float32]

DEFAULT_FRAMES = 120  # without --every, of the part of the time axis that holds light: 10 s at 12 pictures per second
MAX_FRAMES = 20_000  # 28 minutes at 12 pictures per second: more is a mistaken --every
MAX_BYTES = 4 * 2**30  # of all pictures together, which are held in memory
WHITE = 99.0  # percentile of the lit pixels of all frames that becomes white
WHITE_STEADY = 97.0  # of those of the steady picture, whose emitters outshine all they light


@dataclass(frozen=True)
class FrameOptions:
    """Which pictures to write.

    Raises
    ------
    OptionError
        A value is out of range; the option is named.
    """

    kind: str = "exr"  # one of SUFFIXES
    every: int | None = None  # bins per picture; None: so many that there are about 120 pictures
    start_opl: float | None = None  # m; None: where light begins
    end_opl: float | None = None  # m; None: where it ends
    frames_per_second: float = 12.0  # of an animation
    exposure: float = 0.0  # stops, of png and gif

    def __post_init__(self) -> None:
        if self.kind == "mp4":
            raise OptionError("--format: got 'mp4', which no installed package writes; use gif, or png and ffmpeg.")
        if self.kind not in SUFFIXES:
            raise OptionError(f"--format: got {self.kind!r}, need one of {', '.join(SUFFIXES)}")
        if self.every is not None and self.every < 1:
            raise OptionError(f"--every: got {self.every}, need at least 1 bin")
        for option, opl in (("--from", self.start_opl), ("--to", self.end_opl)):
            if opl is not None and not np.isfinite(opl):
                raise OptionError(f"{option}: got {opl}, need a finite optical path length in m")
        if not 0.1 <= self.frames_per_second <= 50:  # a GIF's clock ticks every 10 ms
            raise OptionError(f"--fps: got {self.frames_per_second:g}, need 0.1 to 50")
        if not -30 <= self.exposure <= 30:
            raise OptionError(f"--exposure: got {self.exposure:g}, need -30 to 30 stops")


def is_animation(output: str | Path) -> bool:
    """Return whether an output is the name of an animation, not of a folder."""
    return Path(output).suffix.lower() == SUFFIXES["gif"]


def write_frames(path: str | Path, output: str | Path, options: FrameOptions) -> list[Path]:
    """Write the pictures of a line-of-sight capture; all of them appear, or none.

    Pictures hold radiance [W m^-2 sr^-1] summed over their bins; .exr as float32 without any scaling, .png and .gif
    scaled together, so that frames can be compared. Rows run downwards, as in every picture.

    Parameters
    ----------
    path
        Capture file.
    output
        Folder where pictures go: frame-00000.exr and so on, in place of those of an earlier run, steady.exr,
        steady.png; an animation is frames.gif. Or a name that ends in .gif, for an animation alone.
    options
        Which pictures.

    Returns
    -------
    list of Path
        What was written, the steady pictures last.

    Raises
    ------
    FileError
        The capture is none of a camera, cannot be read or is too large, or a picture cannot be written.
    OptionError
        The options do not suit the capture.
    """
    output = Path(output)
    _check_output(output, path, options)
    with open_capture(path) as capture:
        if capture.header.scan_type != LINE_OF_SIGHT:
            raise FileError(
                f"{path}: is a capture of a relay wall ({capture.header.scan_type}), not what a camera sees. "
                "See `nlosrender plot`."
            )
        stokes = capture.header.attributes.get("channels") == STOKES
        ranges = _frame_ranges(capture, options)
        frames, steady = _pictures(capture, ranges)
    if is_animation(output):
        with replacing(output, GIF) as partial:
            save_animation(_shown(frames, stokes, options.exposure), partial, options.frames_per_second)
        return [output]
    with filled_folder(output) as folder:
        names = _write_all(frames, folder, options, stokes)
        save_exr(steady, folder / "steady.exr", stokes)
        save_png(_shown(steady[None], stokes, options.exposure, WHITE_STEADY)[0], folder / "steady.png")
    names += ["steady.exr", "steady.png"]
    _remove_earlier(output, SUFFIXES[options.kind], set(names))
    return [output / name for name in names]


def _check_output(output: Path, source: str | Path, options: FrameOptions) -> None:
    """Refuse an output that does not suit the format, before anything is read."""
    if is_animation(output):
        if options.kind != "gif":
            raise OptionError(
                f"--output: got {str(output)!r}, an animation, with --format {options.kind}; need a folder"
            )
        check_writable(output, GIF, [source])
    elif output.suffix.lower() in (*SUFFIXES.values(), ".mp4") and not output.is_dir():
        raise OptionError(
            f"--output: got {str(output)!r}, the name of one picture, but there are many; need a folder, or a name "
            "that ends in .gif for an animation"
        )


def _remove_earlier(folder: Path, suffix: str, written: set[str]) -> None:
    """Remove the frames of an earlier run, of which there were more: they would be taken for this one's."""
    with explained_write(folder):
        for file in folder.glob(f"frame-?????{suffix}"):
            if file.name in written or not file.stem.removeprefix("frame-").isdecimal():
                continue
            if file.is_file() and PICTURES[suffix].objection(file) is None:
                file.unlink()


def _frame_ranges(capture: StoredCapture, options: FrameOptions) -> list[slice]:
    header = capture.header
    first, last = 0, header.n_bins - 1
    if options.start_opl is None or options.end_opl is None:
        first, last = lit_window(_light_over_time(capture))
    if options.start_opl is not None:
        first = int(np.floor((options.start_opl - header.start_opl) / header.bin_width_opl))
    if options.end_opl is not None:
        last = int(np.ceil((options.end_opl - header.start_opl) / header.bin_width_opl)) - 1
    first, last = max(first, 0), min(last, header.n_bins - 1)
    if first > last:
        window = f"{header.start_opl:g} to {header.end_opl:g} m"
        raise OptionError(f"--from, --to: no bin of the file lies between them; its time axis is {window}")
    every = options.every or max(1, round((last + 1 - first) / DEFAULT_FRAMES))
    count = -(-(last + 1 - first) // every)
    n_bytes = count * 4 * header.sizes["channel"] * header.sizes["sensor_y"] * header.sizes["sensor_x"]
    if count > MAX_FRAMES or n_bytes > MAX_BYTES:
        raise OptionError(
            f"--every: {count} pictures of {readable_size(n_bytes)} together are too many; use more bins each"
        )
    return [slice(start, min(start + every, last + 1)) for start in range(first, last + 1, every)]


def _light_over_time(capture: StoredCapture) -> NDArray[np.float64]:
    total = np.zeros(capture.header.n_bins)
    for _, band in capture.bands((0, 0)):
        total += band[0].sum(axis=0).sum(axis=(0, 1), dtype=np.float64)
    return total


def _pictures(capture: StoredCapture, ranges: list[slice]) -> tuple[Float32, Float32]:
    """Return (frame, row, column, channel) and the steady (row, column, channel), rows downwards."""
    sizes = capture.header.sizes
    shape = (sizes["sensor_y"], sizes["sensor_x"], sizes["channel"])
    frames, steady = np.zeros((len(ranges), *shape), np.float32), np.zeros(shape, np.float32)
    for rows, samples in capture.bands((0, 0)):
        band = samples.sum(axis=1)  # over bounces
        steady[rows] = np.moveaxis(band.sum(axis=-1, dtype=np.float64), 0, -1)
        for frame, bins in zip(frames, ranges, strict=True):
            frame[rows] = np.moveaxis(band[..., bins].sum(axis=-1, dtype=np.float64), 0, -1)
    return frames[:, ::-1], steady[::-1]


def _shown(frames: Float32, stokes: bool, exposure: float, white_percentile: float = WHITE) -> NDArray[np.uint8]:
    """Return frames (frame, row, column, 3) as they are shown, all on one scale."""
    light = frames[..., :1] if stokes else frames
    lit = light[light > 0]
    white = float(np.percentile(lit, white_percentile)) if lit.size else 1.0
    scale = 2.0**exposure / white
    return stokes_panels(frames, scale) if stokes else tone_mapped(frames * scale)


def _write_all(frames: Float32, folder: Path, options: FrameOptions, stokes: bool) -> list[str]:
    """Write the frames, or the animation of them, and return the names."""
    names = [f"frame-{index:05d}{SUFFIXES[options.kind]}" for index in range(len(frames))]
    if options.kind == "exr":
        for frame, name in zip(frames, names, strict=True):
            save_exr(frame, folder / name, stokes)
        return names
    shown = _shown(frames, stokes, options.exposure)
    if options.kind == "gif":
        save_animation(shown, folder / "frames.gif", options.frames_per_second)
        return ["frames.gif"]
    for picture, name in zip(shown, names, strict=True):
        save_png(picture, folder / name)
    return names
