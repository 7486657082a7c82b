"""What all figures share: where configurations and results lie, and how captures are rendered and read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from nlosrender import pipeline
from nlosrender.config.document import Config
from nlosrender.config.load import load_config
from nlosrender.errors import FileError
from nlosrender.files.layout import VARIANCE
from nlosrender.files.reading.reader import open_capture
from nlosrender.rendering.render_report import RenderReport

Float64 = NDArray[np.float64]
Progress = Callable[[str], None]  # called with what is being done
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Rendered:
    """A capture on disk and how it came about."""

    path: Path
    report: RenderReport

    @property
    def seconds(self) -> float:
        """Seconds of the render alone: no start of the program, no writing."""
        return self.report.seconds["render"]

    def summed(self, axes: int | tuple[int, ...], dataset: str = "data") -> Float64:
        """Return a dataset (channel, bounce, laser_y, laser_x, sensor_y, sensor_x, bin) summed over ``axes``."""
        with open_capture(self.path) as capture:
            return capture.read_block(dataset=dataset).sum(axis=axes, dtype=np.float64)

    def light(self) -> Float64:
        """Return H (laser_y, laser_x, sensor_y, sensor_x, bin), summed over channels and bounces."""
        return self.summed((0, 1))

    def variance(self) -> Float64:
        """Return the variance of ``light``; bounces and channels add up."""
        return self.summed((0, 1), VARIANCE)

    def bin_edges(self) -> Float64:
        """Return the edges of the bins (n + 1,) [m of optical path]."""
        with open_capture(self.path) as capture:
            header = capture.header
            return np.asarray(header.start_opl + header.bin_width_opl * np.arange(header.sizes["bin"] + 1.0))


@dataclass(frozen=True)
class Study:
    """One run of the reproduction.

    Parameters
    ----------
    configs
        Folder of the paper's configurations.
    folder
        Where results go.
    quick
        Fewer points and samples: minutes instead of an hour.
    seed
        Of every render.
    progress
        Called with what is being done.
    """

    configs: Path
    folder: Path
    quick: bool
    seed: int = 0
    progress: Progress = lambda what: None

    def pick(self, quick: T, full: T) -> T:
        """Return one of two settings."""
        return quick if self.quick else full

    def config(self, name: str, *overrides: str) -> Config:
        """Load ``name``.yaml with overrides, ``a.b.c=VALUE`` each.

        Raises
        ------
        ConfigError
            It is missing or wrong.
        """
        return load_config(self.configs / f"{name}.yaml", overrides)

    def render(self, name: str, label: str, *overrides: str) -> Rendered:
        """Render a configuration into ``captures/LABEL.hdf5``, anew.

        Raises
        ------
        NlosError
            As ``pipeline.render_capture``.
        """
        path = self.folder / "captures" / f"{label}.hdf5"
        self.progress(label)
        seeded = () if any(item.startswith("render.seed=") for item in overrides) else (f"render.seed={self.seed}",)
        config = self.config(name, f"output.path={path}", *seeded, *overrides)
        return Rendered(path, pipeline.render_capture(config, resume=False))

    def half_width(self, name: str) -> float:
        """Return half the width of a configuration's relay wall [m]; 1 where it has none."""
        wall = self.config(name).scene.relay_wall
        return 1.0 if wall is None else wall.extent[0] / 2

    def picture(self, name: str) -> Path:
        """Return the path of a picture."""
        return self.folder / "pictures" / f"{name}.png"

    def make_folders(self) -> None:
        """Create the folders of results.

        Raises
        ------
        FileError
            They cannot be created.
        """
        try:
            for part in ("captures", "pictures", "meshes"):
                (self.folder / part).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise FileError(f"{self.folder}: cannot be created ({error.strerror})") from error


def sensor_grid(nx: int, ny: int | None = None) -> str:
    """Return the override of a configuration's sensor grid; square without ``ny``."""
    return f"capture.sensor_grid={{nx: {nx}, ny: {ny or nx}}}"


def relative_error(light: Float64, reference: Float64) -> float:
    """Return the relative L2 error of H."""
    return float(np.linalg.norm(light - reference) / np.linalg.norm(reference))
