"""BSDF plugins in Python: registration with each variant of Mitsuba; ``eval`` and ``pdf`` by way of ``eval_pdf``."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import mitsuba as mi


def register_once(name: str, define: Callable[[], type[mi.BSDF]]) -> None:
    """Make a BSDF known to the active variant of Mitsuba; ``define`` returns its class, with that variant's base."""
    _register(mi.variant(), name, define)


@cache  # a variant keeps what it knows
def _register(variant: str, name: str, define: Callable[[], type[mi.BSDF]]) -> None:
    mi.register_bsdf(name, define())


def eval_alone(
    bsdf: mi.BSDF, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
) -> mi.Spectrum:
    """Return the value of ``eval_pdf``: the method ``eval`` of a plugin."""
    return bsdf.eval_pdf(context, si, wo, active)[0]


def pdf_alone(
    bsdf: mi.BSDF, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
) -> mi.Float:
    """Return the density of ``eval_pdf``: the method ``pdf`` of a plugin."""
    return bsdf.eval_pdf(context, si, wo, active)[1]
