"""Omitted work: what a render leaves out because the scene does not need it, and why (backend started)."""

from __future__ import annotations

from collections.abc import Iterator

from nlosrender.capture.bounces import LINE_OF_SIGHT
from nlosrender.engine.interface import Engine, OmittedWork

STOKES = 4  # channels of polarised light


def omitted_work(engine: Engine, *, scene_is_colored: bool) -> tuple[OmittedWork, ...]:
    """Return what ``engine``, as set up for the capture, leaves out.

    ``scene_is_colored``: whether something in the scene has a colour.
    """
    return (*_bounces(engine), *engine.omitted_work(), *_color(engine.options.channels, scene_is_colored))


def _bounces(engine: Engine) -> Iterator[OmittedWork]:
    highest, is_view = engine.options.bounces.max_bounces, engine.capture.scan_type == LINE_OF_SIGHT
    if not is_view and engine.built.wall.is_planar:
        yield OmittedWork("second bounce", "no light goes straight from a point of a planar wall to another")
    if highest is not None:
        what = f"paths of more than {highest} surface interactions" if is_view else f"bounces above {highest}"
        yield OmittedWork(what, f"render.max_bounces is {highest}")


def _color(channels: int, scene_is_colored: bool) -> Iterator[OmittedWork]:
    if channels == 1:
        yield OmittedWork("colour", "render.color is grey" if scene_is_colored else "everything in the scene is grey")
    elif channels == STOKES and scene_is_colored:
        yield OmittedWork("colour", "polarised light is rendered in grey")


def shared_samples(engine: Engine) -> str:
    """Return which samples of a capture have errors in common, in words for its file; empty where none have."""
    what = engine.shared_samples()
    where = "their errors are correlated. The error of sums is in the file's energy_error_per_bounce"
    return f"{what}: {where}" if what else ""
