"""Renders of the product held against the reference: true error, energies per bounce, what was stated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from reference.convert import load_task

from nlosrender.config.load import load_config
from nlosrender.pipeline import render_capture


@dataclass(frozen=True, eq=False)
class Verdict:
    """One scene: ``true`` and ``stated`` relative L2 errors (NaN: unknown), and what the reference itself knows."""

    name: str
    engine: str
    asked: float
    stated: float
    true: float
    noise: float  # relative L2 error of the reference, taken out of ``true``
    energy: tuple[float, ...]  # of the product over the reference's, per bounce from 2; NaN without light
    energy_noise: tuple[float, ...]
    energy_sigmas: tuple[float, ...]  # difference of the energies in standard errors of both; NaN: not known
    seconds: float
    warnings: tuple[str, ...]

    @property
    def is_unknown(self) -> bool:
        """Whether the render said that it does not know its error."""
        return bool(np.isnan(self.stated))

    @property
    def is_within_two(self) -> bool:
        """Whether the stated error is within 2x of the truth, as far as the reference can tell."""
        slack = self.noise / 2  # of the difference of squares that ``true`` is
        return self.stated <= 2 * (self.true + slack) and self.true - slack <= 2 * self.stated

    @property
    def worst_energy(self) -> float:
        """Largest difference of a bounce's energy in standard errors; 0 where none is known."""
        return max((z for z in self.energy_sigmas if not np.isnan(z)), default=0.0)

    def __str__(self) -> str:
        ratios = " ".join(
            "-" if np.isnan(r) else f"{r:.3f}+-{s:.3f}" for r, s in zip(self.energy, self.energy_noise, strict=True)
        )
        verdict = "unknown" if self.is_unknown else "ok" if self.is_within_two else "OFF"
        return (
            f"{verdict:8}{self.name:44} {self.engine:15} asked {self.asked:.3f} stated {self.stated:.4f} "
            f"true {self.true:.4f} (ref {self.noise:.4f}) energy {ratios} ({self.worst_energy:.1f} sigma)"
            f" {self.seconds:.0f}s"
        )


def judge(path: Path, samples: int, output: Path, overrides: tuple[str, ...] = ()) -> Verdict:
    """Render a configuration with the product and the reference, and compare."""
    task = load_task(path)
    reference = task.render(samples, replicas=8, seed=12345)
    config = load_config(path, [f"output.path={output}", "output.frame=scene", *overrides])
    report = render_capture(config, resume=False)
    with h5py.File(output) as file:
        data = np.asarray(file["data"], dtype=np.float64).mean(axis=0)  # bins, bounces, sensors y, x, lasers y, x
    n_bins, n_bounces = data.shape[:2]
    axes = (1, 4, 5, 2, 3, 0) if data.ndim == 6 else (1, 2, 3, 0)
    data = data.transpose(axes).reshape(n_bounces, -1, n_bins)  # as the reference's pairs
    slots = reference.mean.shape[0]
    assert not data[slots:].any()
    mean, variance = reference.mean, reference.variance
    square = max(float((mean.sum(0) ** 2).sum() - variance.sum()), 1e-300)
    difference = float(((data[:slots].sum(0) - mean.sum(0)) ** 2).sum())
    true = np.sqrt(max(difference - variance.sum(), 0.0) / square)
    energy, sigma = mean.sum((1, 2)), np.sqrt(variance.sum((1, 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(energy > 0, data[:slots].sum((1, 2)) / energy, np.nan)
        spread = np.where(energy > 0, sigma / energy, np.nan)
    known = [report.energy_error_per_bounce.get(str(2 + slot)) for slot in range(slots)]
    own = np.array([np.nan if e is None else e for e in known])
    with np.errstate(divide="ignore", invalid="ignore"):
        # float32 samples: 1e-6 of the sum
        sigmas = np.abs(data[:slots].sum((1, 2)) - energy) / np.sqrt(own**2 + sigma**2 + (1e-6 * energy) ** 2)
    stated = report.error_estimate
    return Verdict(
        name=path.parent.name + "/" + path.stem,
        engine=report.engine,
        asked=config.render.target_error or np.nan,
        stated=np.nan if stated is None else float(stated),
        true=float(true),
        noise=float(np.sqrt(variance.sum() / square)),
        energy=tuple(ratio.tolist()),
        energy_noise=tuple(spread.tolist()),
        energy_sigmas=tuple(sigmas.tolist()),
        seconds=sum(report.seconds.values()) if hasattr(report.seconds, "values") else float("nan"),
        warnings=report.warnings,
    )
