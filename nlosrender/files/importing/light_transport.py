"""What mitransient's settings mean here: its integrator and its film, which y-tal's YAML names otherwise.

Bounces: surface number d of a path is at depth d - 1 of its loop, which goes on while depth + 1 < ``max_depth``. A
connection to the laser point adds a surface, and two to the depth that ``filter_depth`` is compared with; without laser
sampling it adds none. So ``filter_bounces`` (``filter_depth`` - 1) of 3 is not the third bounce.
"""

from __future__ import annotations

from nlosrender.config.render import DEFAULT_TARGET_ERROR
from nlosrender.errors import did_you_mean
from nlosrender.files.importing.translation import Keys

_NOISE = "how paths are found: it changes the noise, not the result"
_DROPPED = {
    "integrator.rr_depth": _NOISE,
    "integrator.block_size": "how the work is cut",
    "integrator.samples_per_pass": "how the work is cut",
    "integrator.hide_emitters": "no emitter is seen directly",
    "integrator.nlos_hidden_geometry_sampling": _NOISE,
    "integrator.nlos_hidden_geometry_sampling_do_rroulette": _NOISE,
    "integrator.nlos_hidden_geometry_sampling_max_depth": _NOISE,
    "integrator.nlos_hidden_geometry_sampling_includes_relay_wall": _NOISE,
    "integrator.gaussian_stddev": "bins are boxes here",
    "sampler.type": "random numbers of another program",
    "sampler.seed": "random numbers of another program; render.seed is ours",
    "film.sample_border": "histograms are not filtered across points",
    **dict.fromkeys(
        ("film.pixel_format", "film.component_format", "film.file_format", "film.compensate"),
        "how their file is stored",
    ),
}
_CROPS = ("film.crop_width", "film.crop_height", "film.crop_offset_x", "film.crop_offset_y")
_CROPPED = (
    "a part of a film is not read: mitransient 1.3 stretches it over the whole wall, and aims confocal lasers by the "
    "whole film. Set width and height to what is measured"
)
_ENERGY = (
    "H is in J m^-2 sr^-1 per joule of pulse; mitransient's depends on where its projector looks: compare with one "
    "factor per laser point"
)
_MIXED = (
    "mitransient mixes hidden geometry and BSDF sampling without weights: each hidden surface on a path doubles its "
    "light there"
)
_OCCLUDED = (
    "mitransient weights a sampled hidden point that is occluded by the surface in front of it: hidden surfaces behind "
    "or close to others are too bright there"
)
_WITHOUT_WALL = (
    "mitransient samples the hidden geometry alone, not the relay wall: light that meets the wall in between "
    "(bounces 5 and up) is mostly missing there, and is here"
)


def translate_bounces(keys: Keys, *, of_ytal: bool) -> None:
    """Judge the keys of an NLOS integrator; where the file is silent, y-tal means other values than mitransient."""
    sampled = keys.value("integrator.nlos_laser_sampling", of_ytal, bool)
    most = keys.value("integrator.max_depth", -1 if of_ytal else 6, int)
    highest = None if most == -1 else most - (0 if sampled else 1)
    name, bounce = _only_bounce(keys, sampled=sampled)
    if bounce is None:
        counts = "counts surfaces, the wall's two included"
        keys.take("integrator.max_depth", "render.max_bounces", highest, "" if highest is None else counts)
    elif bounce < 2 or (highest is not None and bounce > highest):
        keys.refuse(name, f"keeps bounce {bounce} alone, of which there is no light there")
    else:
        keys.drop("integrator.max_depth", f"{keys.name(name)} keeps one bounce")
        where = f"what it keeps is bounce {bounce}, index {bounce - 2} of the file; export --bounces {bounce}"
        keys.take(name, "render.max_bounces", bounce, where, changed=True)
    for name in ("integrator.discard_direct_paths", "integrator.discard_direct_light"):
        if keys.value(name, False, bool):
            first = 3 if sampled else 4
            keys.change(name, f"bounces below {first} are missing there; here each has its index in the file")
        keys.drop(name, "nothing is discarded")
    spot = _NOISE if sampled else "the laser lights a point here, there the square its fov makes (laser_spot_radius)"
    keys.drop("integrator.nlos_laser_sampling", spot)
    if keys.value("integrator.camera_unwarp", False, bool):
        keys.refuse("integrator.camera_unwarp", "is for cameras; account_first_and_last_bounces is what is meant")
    keys.drop("integrator.camera_unwarp", "is for cameras")
    _legs(keys)
    _say_biases(keys, of_ytal=of_ytal)
    drop_noise(keys)


def _only_bounce(keys: Keys, *, sampled: bool) -> tuple[str, int | None]:
    """Return the key that keeps one bounce, and which; None for all of them."""
    found: tuple[str, int | None] = ("", None)
    for name, offset in (("integrator.filter_depth", 0), ("integrator.filter_bounces", 1)):
        depth = keys.value(name, -1, int)
        if depth == -1:
            keys.drop(name, "off: all bounces, each on an index of its own in the file")
        else:
            found = name, depth + offset + (0 if sampled else 1)
    return found


def _legs(keys: Keys) -> None:
    """Judge whether the first and last legs count; older files say so in the sensor."""
    name, old = (f"{part}.account_first_and_last_bounces" for part in ("integrator", "sensor"))
    is_old = old in keys and name not in keys
    legs = keys.value(old if is_old else name, False, bool)
    remark = "" if legs else "start_opl stays as it is; Z-NLOS loaders expect the legs, export --format tal does not"
    remark = "as versions mean it that have it here" if is_old else remark
    keys.take(old if is_old else name, "capture.account_first_and_last_bounces", legs, remark)
    keys.drop(old, "the integrator's decides")


def _say_biases(keys: Keys, *, of_ytal: bool) -> None:
    """Report how mitransient's result differs from what it stands for."""
    note, sampling = keys.translation.note, "integrator.nlos_hidden_geometry_sampling"
    note(_ENERGY)
    if not keys.value(sampling, False, bool):
        return
    note(_OCCLUDED)
    if keys.value(f"{sampling}_do_rroulette", False, bool):
        note(_MIXED)
    elif not keys.value(f"{sampling}_includes_relay_wall", of_ytal, bool):
        note(_WITHOUT_WALL)


def drop_noise(keys: Keys) -> None:
    """Judge what makes no difference to the result, of any integrator."""
    temporal = keys.value("integrator.temporal_filter", "", str)
    is_box = keys.value("rfilter.type", "gaussian", str) == "box" or "film.type" not in keys  # y-tal's always is
    if not is_box and "integrator.temporal_filter" not in keys:
        remark = "bins are boxes here; there the film's rfilter, a Gaussian unless it is a box, blurs them in time"
        keys.translation.line("default", "integrator.temporal_filter", "rfilter", "changed", remark)
    if temporal == "gaussian":
        keys.change("integrator.temporal_filter", "bins are boxes here; there a Gaussian blurs them in time")
    keys.keep("integrator.temporal_filter", "bins are boxes here")
    keys.drop_all(_DROPPED)


def translate_film(keys: Keys, default_bins: int) -> None:
    """Judge the time axis and the filters of a transient film."""
    for name, to, default, kind in (
        ("film.temporal_bins", "time_axis.n_bins", default_bins, int),
        ("film.bin_width_opl", "time_axis.bin_width_opl", 0.003, float),
        ("film.start_opl", "time_axis.start_opl", 0.0, float),
    ):
        keys.take(name, to, keys.value(name, default, kind))
    for name in _CROPS:
        if name in keys:
            keys.refuse(name, _CROPPED)
    blurred = keys.value("rfilter.type", "box", str) != "box"
    if blurred:
        keys.change("rfilter.type", "box: a point's light is its own here; there it spreads over its neighbours")
    keys.keep("rfilter.type", "a point's light is its own")
    for name in [name for name in keys.found if name.startswith("rfilter.")]:
        keys.drop(name, "of a filter that is not used")


def say_samples(keys: Keys, name: str, default: int | None = None) -> None:
    """Put the number of samples, which has no counterpart, beside the error that decides here."""
    samples = keys.value(name, default)
    if isinstance(samples, int):
        keys.translation.remarks["target_error"] = f"there {samples:_} samples per point"
    keys.drop(name, "render.target_error decides here; said beside it in a comment")
    keys.translation.put("render.target_error", DEFAULT_TARGET_ERROR, keys.translation.start)


def refuse_film(keys: Keys) -> None:
    """Refuse a film without a time axis."""
    kind = keys.value("film.type", None)
    if kind == "phasor_hdr_film":
        keys.refuse("film.type", "stores frequencies, which are not written yet; use transient_hdr_film")
        keys.drop_all({"film.wl_mean": "of frequencies", "film.wl_sigma": "of frequencies"})
    elif kind != "transient_hdr_film":
        hint = did_you_mean(kind, ("transient_hdr_film",))
        keys.refuse("film.type", f"no film with a time axis; need transient_hdr_film. {hint}".rstrip(" ."))
    keys.keep("film.type", "a histogram for each point")
