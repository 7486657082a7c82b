"""``sensor``: what a detector reports of the ideal histogram, as counts per bin."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ValidationInfo

from nlosrender.config.fields import (
    Area,
    Checked,
    Coordinate,
    Delay,
    DelayOrZero,
    Flag,
    Length,
    NonNegative,
    Photons,
    Positive,
    Rate,
    RateOrZero,
    Seed,
    Share,
    SolidAngle,
    Wavelength,
    as_finite,
    finite_numbers,
    integer,
)
from nlosrender.config.issues import Wrong, invalid_value, mismatch, shown
from nlosrender.config.plugin_check import config_folder
from nlosrender.config.section import ONE_OF, Section
from nlosrender.config.yaml_tree import read_document
from nlosrender.constants import SPEED_OF_LIGHT
from nlosrender.errors import ConfigError, ValidationIssue, did_you_mean

PROFILES = Path(__file__).parent.parent / "sensor" / "profiles"
MAX_PULSES, MAX_BINS = 10**12, 2**24  # a day at 11 MHz; beyond them they are slips of the pen
PLANCK = 6.62607015e-34  # J s, exact by definition of the kilogram
OPL_PER_PS = SPEED_OF_LIGHT * 1e-12
# Other names of keys: those of y-tal's noise simulation, and times where metres of optical path are the rule.
ALIASES: dict[str, tuple[str, float]] = {
    "laser_jitter_FWHM": ("laser_jitter_fwhm_ps", 1.0),
    "time_jitter_FWHM": ("jitter_fwhm_ps", 1.0),
    "time_jitter_tail": ("jitter_tail_ps", 1.0),
    "time_jitter_tail_scale": ("jitter_tail_share", 1.0),
    "time_jitter_path": ("jitter_file", 1.0),
    "external_noise_rate": ("ambient_rate", 1.0),
    "frequency": ("repetition_rate", 1e6),
    "dead_time": ("dead_time_ps", 1.0),
    "start": ("start_opl", 1.0),
    "bin_width_ps": ("bin_width_opl", OPL_PER_PS),
}


def misfits(sensor: SensorConfig, scan_type: str) -> Iterator[tuple[str, str]]:
    """Yield key and sentence for what of a sensor makes no sense with a scan type."""
    if sensor.zones is not None and scan_type in ("confocal", "line_of_sight"):
        reason = {
            "confocal": "each sensor point of a confocal scan is measured with a laser point of its own",
            "line_of_sight": "a camera has its pixels",
        }[scan_type]
        yield "zones", f"got zones with scan type {scan_type}: {reason}. Need single or exhaustive, or no zones."
    if sensor.photons_per_pulse is None and scan_type == "line_of_sight":
        message = "missing: the radiance of a line_of_sight capture is that of steady lamps, which have no energy per "
        yield "photons_per_pulse", message + "pulse; need {brightest: x} or {mean: x}."


def stored_sensor(values: Mapping[str, Any]) -> SensorConfig:
    """Return the sensor of a file, from its values with all defaults filled in; its profile is a name by now."""
    sensor = SensorConfig.model_validate({key: value for key, value in values.items() if key != "profile"})
    return sensor.model_copy(update={"profile": values.get("profile")})


def profile_names() -> list[str]:
    """Return the names of the sensors that come with the program."""
    return sorted(path.stem for path in PROFILES.glob("*.yaml"))


def _profile(value: object) -> str:
    if not isinstance(value, str) or not value.strip():
        raise invalid_value(value, f"one of {', '.join(profile_names())}, or a YAML file")
    return value


def _span(value: object) -> tuple[float, ...]:
    numbers = finite_numbers(value, 2)
    if numbers is None or numbers[0] >= numbers[1]:
        raise invalid_value(value, "[from, to] in m of optical path, from < to")
    return tuple(numbers)


def _decays(value: object) -> tuple[float, ...]:
    items = value if isinstance(value, (list, tuple)) else [value]
    numbers = [as_finite(item) for item in items]
    if not numbers or not all(number is not None and 1e-3 <= number <= 1e9 for number in numbers):
        raise invalid_value(value, "a number from 0.001 to 1e9 ps, or a list of them")
    return tuple(float(number) for number in numbers if number is not None)


def _file(value: object, validation: ValidationInfo) -> Path:
    if not isinstance(value, str) or not value.strip():
        raise invalid_value(value, "the name of a .csv, .npy or .hdf5 file")
    path = config_folder(validation) / value
    if path.suffix.lower() not in (".csv", ".txt", ".npy", ".hdf5", ".h5"):
        raise invalid_value(value, "the name of a .csv, .txt, .npy, .hdf5 or .h5 file")
    if not path.is_file():
        raise invalid_value(value, "a file", f"There is no {path}.")
    return path


_NUMBERS = {"type": "array", "items": {"type": "number"}}
Span = Annotated[tuple[float, float], Checked(_span, {**_NUMBERS, "minItems": 2, "maxItems": 2})]
Decays = Annotated[
    tuple[float, ...],
    Checked(_decays, {"anyOf": [{"type": "number", "exclusiveMinimum": 0}, {**_NUMBERS, "minItems": 1}]}),
]
CurveFile = Annotated[Path, Checked(_file, {"type": "string"}, with_context=True)]
ProfileName = Annotated[str, Checked(_profile, {"type": "string"})]
PulseCount = Annotated[int, integer("an integer >= 1", 1, MAX_PULSES, f"at most {MAX_PULSES:_}")]
ZoneCount = Annotated[int, integer("an integer >= 1", 1, 4096, "at most 4096")]
DetectorBins = Annotated[int, integer("an integer >= 1, or null", 1, MAX_BINS, f"at most {MAX_BINS:_}")]


class RelativeBrightness(Section):
    """Photons that reach the detector per pulse, over all bins of a histogram: the capture is scaled to it."""

    brightest: Photons | None = None
    """photons per pulse, of the brightest histogram of the capture"""
    mean: Photons | None = None
    """photons per pulse, of all histograms of the capture, on average"""

    def rule_one_of_them(self) -> Iterator[ValidationIssue]:
        """There is one scale."""
        if (self.brightest is None) == (self.mean is None):
            yield ValidationIssue((), "need one of the two: {brightest: x} or {mean: x}, photons per pulse.", "key")


class CrosstalkConfig(Section):
    """Light that takes a short way from the laser to the detector, such as through a cover glass."""

    share: NonNegative
    """of the photons of the histogram, before the response"""
    delay_opl: Coordinate = 0.0
    """m of optical path, when it arrives"""


class ZonesConfig(Section):
    """Sensor points summed into zones, as many as the detector has: rectangles seen from it, or on the wall."""

    nx: ZoneCount
    """zones along the wall's x axis"""
    ny: ZoneCount
    """zones along the wall's y axis"""
    width_deg: Positive | None = None
    """degrees along x, field of view of all zones, as the sensor sees it; with height_deg"""
    height_deg: Positive | None = None
    """degrees along y"""
    width: Length | None = None
    """m along x on the wall; with height; null, without degrees: the whole sensor grid"""
    height: Length | None = None
    """m along y on the wall"""

    def rule_extent(self) -> Iterator[ValidationIssue]:
        """Both sides are given in the same way, or none."""
        for one, other in (("width", "height"), ("width_deg", "height_deg")):
            if (getattr(self, one) is None) != (getattr(self, other) is None):
                missing = one if getattr(self, one) is None else other
                yield ValidationIssue((missing,), f"missing beside {one if missing == other else other}.")
        if self.width is not None and self.width_deg is not None:
            yield ValidationIssue(("width",), "stands beside width_deg; keep metres or degrees.", "key")
        for name, value in (("width_deg", self.width_deg), ("height_deg", self.height_deg)):
            if value is not None and value >= 180:
                yield ValidationIssue((name,), mismatch(value, "less than 180"))


class SensorConfig(Section):
    """Laser pulse, optics, detector and exposure."""

    profile: ProfileName | None = None
    """a sensor that comes with the program (nlosrender measure --list) or a YAML file; keys beside it win over its"""
    # --- photons ---
    photons_per_pulse: RelativeBrightness | None = None
    """scale the capture: {brightest: x} or {mean: x}; null: physical, by the four keys below"""
    wavelength_nm: Wavelength | None = None
    """nm, of the laser: energy of a photon"""
    aperture_solid_angle: SolidAngle | None = None
    """sr, of the detector's aperture seen from the wall"""
    footprint_area: Area | None = None
    """m^2 seen as one sensor point, projected along the line of sight; null: capture.footprint, else the grid's cell"""
    transmission: Share = 1.0
    """0..1, of filter and optics"""
    photon_detection_ratio: Share = 1.0
    """0..1, detections per photon"""
    # --- response ---
    laser_jitter_fwhm_ps: DelayOrZero = 0.0
    """ps, full width at half maximum of the laser pulse, a Gaussian"""
    jitter_fwhm_ps: DelayOrZero = 0.0
    """ps, the same of the detector's jitter"""
    jitter_tail_ps: DelayOrZero = 0.0
    """ps, decay constant of the jitter's exponential tail"""
    jitter_tail_share: Share | None = None
    """0..1, share of the detections that are in the tail; default 1 with jitter_tail_ps, else 0"""
    jitter_file: CurveFile | None = None
    """measured curve instead of jitter: .csv (time in ps, counts), .npy, or .hdf5 (counts, timebin_width_ps)"""
    jitter_file_bin_ps: Delay | None = None
    """ps, width of the cells of a curve whose file does not say: .npy, or one column of .csv"""
    zero_delay: Annotated[Literal["peak", "mean"], ONE_OF] = "peak"
    """what of the response counts as no delay"""
    # --- bins ---
    bin_width_opl: Length | None = None
    """m of optical path (or bin_width_ps); null: as the capture's"""
    n_bins: DetectorBins | None = None
    """number of bins; null: up to the end of the capture, or of the period"""
    start_opl: Coordinate | None = None
    """m of optical path, start of bin 0; null: as the capture's"""
    gate: Span | None = None
    """[from, to] in m of optical path: the detector is blind before and after; null: always on"""
    # --- exposure ---
    pulses: PulseCount | None = None
    """laser pulses per histogram; or:"""
    exposure_time: Positive | None = None
    """s per histogram; needs repetition_rate"""
    repetition_rate: Rate | None = None
    """1/s, of the laser (or frequency in MHz): later light is counted with the next pulse; null: pulses far apart"""
    ambient_rate: RateOrZero = 0.0
    """1/s, detections of ambient light"""
    dark_count_rate: RateOrZero = 0.0
    """1/s, detections without light"""
    # --- detection ---
    pile_up: Annotated[Literal["none", "first_photon", "dead_time"], ONE_OF] = "none"
    """none: every photon; first_photon: at most one detection a pulse; dead_time: blind for dead_time_ps after each"""
    dead_time_ps: Delay | None = None
    """ps, of a free-running detector that light in the meantime does not prolong"""
    afterpulse_probability: Share = 0.0
    """0..1, that a detection is followed by a false one, and that by the next"""
    afterpulse_decay_ps: Decays = (20_000.0,)
    """ps after the dead time: decay constant of the afterpulses, or several of equal share"""
    crosstalk: CrosstalkConfig | None = None
    """light on a short cut: {share: 0.1, delay_opl: 0}"""
    zones: ZonesConfig | None = None
    """sum sensor points: {nx: 3, ny: 3, width_deg: 41, height_deg: 52}, or width and height in m; null: none"""
    shot_noise: Flag = True
    """draw counts; false: their expectation"""
    seed: Seed = 0
    """start of the random numbers; the same seed gives the same counts"""

    @classmethod
    def with_defaults(cls, raw: dict[str, Any], validation: ValidationInfo) -> dict[str, Any]:
        """Put the profile below the keys, and other names and units of keys right."""
        raw = _renamed(raw)
        profile = raw.get("profile")
        if isinstance(profile, str) and profile.strip():
            try:
                raw = {**_renamed(_profile_values(profile, config_folder(validation))), **raw}
            except ConfigError as error:
                raw["profile"] = Wrong(ValidationIssue((), "; ".join(map(str, error.issues))))
        if raw.get("jitter_tail_share") is None:
            tail = as_finite(raw.get("jitter_tail_ps"))
            raw["jitter_tail_share"] = 1.0 if tail else 0.0
        return raw

    def rule_photons(self) -> Iterator[ValidationIssue]:
        """The photons per pulse are given in one way."""
        _ = self.profile  # a wrong one has the keys, or not
        physical = {key: getattr(self, key) for key in ("wavelength_nm", "aperture_solid_angle")}
        if self.photons_per_pulse is None and None in physical.values():
            missing = ", ".join(key for key, value in physical.items() if value is None)
            message = f"missing, such as {{mean: 0.05}}; or, for a physical scale, {missing}."
            yield ValidationIssue(("photons_per_pulse",), message)

    def rule_pulses(self) -> Iterator[ValidationIssue]:
        """Their number is given in one way."""
        _ = self.profile
        if self.pulses is not None and self.exposure_time is not None:
            message = f"got {shown(self.exposure_time)} beside pulses {self.pulses}; keep one."
            yield ValidationIssue(("exposure_time",), message, "key")
        elif self.pulses is None and self.exposure_time is None:
            yield ValidationIssue(("exposure_time",), "missing: seconds per histogram, or pulses instead.")
        elif self.exposure_time is not None and self.repetition_rate is None:
            yield ValidationIssue(("repetition_rate",), "missing beside exposure_time: laser pulses per second.")
        elif self.exposure_time is not None and not 1 <= self.n_pulses <= MAX_PULSES:
            message = mismatch(self.exposure_time, f"1 to {MAX_PULSES:.3g} pulses, and it makes {self.n_pulses:.3g}")
            yield ValidationIssue(("exposure_time",), message)

    def rule_rates(self) -> Iterator[ValidationIssue]:
        """Rates are of pulses."""
        if (self.ambient_rate or self.dark_count_rate) and self.pile_up == "dead_time" and self.repetition_rate is None:
            message = "missing: with background a free-running detector may be blind when a pulse begins."
            yield ValidationIssue(("repetition_rate",), message)

    def rule_response(self) -> Iterator[ValidationIssue]:
        """The jitter is given in one way."""
        if self.jitter_file is not None and (self.jitter_fwhm_ps or self.jitter_tail_ps):
            message = "stands beside jitter_fwhm_ps or jitter_tail_ps; a measured curve has them in it."
            yield ValidationIssue(("jitter_file",), message, "key")
        if self.jitter_tail_share and not self.jitter_tail_ps:
            message = mismatch(self.jitter_tail_share, "jitter_tail_ps beside it, the decay constant")
            yield ValidationIssue(("jitter_tail_share",), message)

    def rule_dead_time(self) -> Iterator[ValidationIssue]:
        """A dead time has a length."""
        if self.pile_up == "dead_time" and self.dead_time_ps is None:
            yield ValidationIssue(("dead_time_ps",), "missing, pile_up: dead_time needs it, such as 50_000.")
        if self.afterpulse_probability == 1:
            yield ValidationIssue(("afterpulse_probability",), "got 1, need less: each would be followed for ever.")

    @property
    def n_pulses(self) -> int:
        """Laser pulses per histogram."""
        return self.pulses or round((self.exposure_time or 0.0) * (self.repetition_rate or 0.0))

    @property
    def period_opl(self) -> float:
        """From pulse to pulse [m of optical path]; infinite where pulses are far apart."""
        return SPEED_OF_LIGHT / self.repetition_rate if self.repetition_rate else math.inf

    @property
    def background_rate(self) -> float:
        """Detections without the laser [1/s]."""
        return self.ambient_rate + self.dark_count_rate


def _renamed(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values by the names and in the units of the section."""
    found = {key: value for key, value in raw.items() if key not in ALIASES}
    for alias, (key, factor) in ALIASES.items():
        if alias not in raw:
            continue
        value = raw[alias]
        number = as_finite(value)
        if found.get(key) is not None:
            found[key] = Wrong(ValidationIssue((), f"stands beside {alias}, another name of it; keep one."))
        else:
            found[key] = value if number is None or factor == 1.0 else number * factor
    return found


def _profile_values(name: str, folder: Path) -> dict[str, Any]:
    """Return the keys of a profile (ConfigError: there is none of that name, or it cannot be read)."""
    built_in = name in profile_names()
    path = PROFILES / f"{name}.yaml" if built_in else folder / name
    if not built_in and path.suffix not in (".yaml", ".yml"):
        close = did_you_mean(name, profile_names())
        message = f"got {name!r}, need one of {', '.join(profile_names())}, or a .yaml file. {close}".strip()
        raise ConfigError.of_file("", message)
    try:
        document = read_document(path.read_text(encoding="utf-8"), str(path), path.parent)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError.of_file(str(path), f"cannot be read: {getattr(error, 'strerror', error)}.") from error
    if document.issues:
        raise ConfigError(document.issues)
    if not isinstance(document.tree, dict) or "profile" in document.tree:
        message = f"need a mapping of the keys of sensor, without profile: {', '.join(SensorConfig.model_fields)}."
        raise ConfigError.of_file(str(path), message)
    values = dict(document.tree.get("sensor", document.tree))
    for key in ("jitter_file", "time_jitter_path"):  # relative to the profile, not to the configuration
        if isinstance(values.get(key), str):
            values[key] = str(path.parent / values[key])
    return values
