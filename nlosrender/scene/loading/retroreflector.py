"""Retroreflector: a BSDF plugin of our own, whose lobe lies around the direction that the light comes from.

Cat's eyes, corner cubes and beads of glass, on traffic signs, vests and targets, send light back to where it came from:

    f(wi, wo) = albedo D(wi . wo) h(cos_i) h(cos_o) + diffuse / pi,    D(w) = k exp(-k (1 - w)) / (2 pi (1 - exp(-2 k)))

D is the density of von Mises and Fisher on the sphere (Fisher 1953) and falls to one half at the observation angle
``width``: k = ln 2 / (1 - cos width). f is symmetric for any function h, and this h sends the share ``albedo`` back at
every incidence:

    h(cos_i) int D(wi . wo) h(cos_o) cos_o dwo = 1    for all wi above the surface                                  (1)

Far above the horizon h = (1 + 3 / (16 k) + 1 / (16 k cos^2)) / sqrt(cos) (expansion for narrow lobes); at the horizon,
where half of D lies below the surface, h is finite. Division by max(cos_i, cos_o) loses half of the light at grazing
incidence, and by sqrt(cos_i cos_o) makes light there without bound. (1) is the scaling of a symmetric positive matrix
(Sinkhorn 1964), which has one solution. Integrated around the normal, with a and b the elevations of wi and wo, D is
k exp(-k (1 - cos(a - b))) i0e(k cos a cos b) / (1 - exp(-2 k)), i0e(x) = exp(-x) I0(x).

Patches need not be smaller than the lobe: docs/retroreflectors.md.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import i0e

from nlosrender.scene.loading.bsdf_plugin import eval_alone, pdf_alone, register_once
from nlosrender.scene.pose import Float64

# All three measured: the directional albedo is right to 1.3e-5 for widths of 0.01 to 60 degrees, at every incidence.
NODES = 256  # of the table of h; half of them: 5e-5
REACH = 16.0  # the elevation in 1 / sqrt(k) above which h is its expansion, whose next term falls with the 4th power
ITERATIONS = 20  # of (1); 10: 1.8e-5


def concentration(width: float) -> float:
    """Return k of the lobe that falls to one half at ``width`` degrees from its axis."""
    return math.log(2) / (2 * math.sin(math.radians(width) / 2) ** 2)


def scaling(k: float) -> Float64:
    """Return h sqrt(c + u) (``NODES``,), u = 1 / sqrt(k), at cosines c = u t / (1 - t), t even from 0 to 1 / (1 + u).

    It goes smoothly from 2.4 at the horizon to near 1, so that it may be interpolated linearly in t.
    """
    u = k**-0.5
    end = min(math.pi / 2, (REACH + 6) * u)  # D is below 1e-7 of its peak 6 u away
    solved = REACH * u if end < math.pi / 2 else end
    edges = np.linspace(0, end, math.ceil(end / u) + 1)
    points, weights = np.polynomial.legendre.leggauss(8)
    elevation = (edges[:-1, None] + np.diff(edges)[:, None] * (points + 1) / 2).ravel()
    weights = (np.diff(edges)[:, None] * weights / 2).ravel() * np.sin(elevation) * np.cos(elevation)

    def kernel(at: Float64) -> Float64:
        lobe = np.exp(-2 * k * np.sin((at[:, None] - elevation) / 2) ** 2) / -math.expm1(-2 * k)
        return k * lobe * i0e(k * np.cos(at)[:, None] * np.cos(elevation)) * weights

    def expansion(at: Float64) -> Float64:
        cosine = np.maximum(np.sin(at), u)
        return (1 + 3 / (16 * k) + 1 / (16 * k * cosine**2)) / np.sqrt(cosine)

    h, light = expansion(elevation), kernel(elevation)
    for _ in range(ITERATIONS):
        h = np.where(elevation < solved, np.sqrt(h / (light @ h)), h)
    t = np.linspace(0, 1 / (1 + u), NODES)
    cosine = np.minimum(u * t / (1 - t), 1)
    at = np.arcsin(cosine)
    return np.where(at <= solved, 1 / np.maximum(kernel(at) @ h, 1e-9), expansion(at)) * np.sqrt(cosine + u)


def register_retroreflector() -> None:
    """Make the BSDF known to the active variant of Mitsuba, under the name ``retroreflector``."""
    register_once("retroreflector", _define)


def _define() -> type[mi.BSDF]:
    class Retroreflector(mi.BSDF):  # type: ignore[misc]  # each variant has a base class of its own
        """Parameters: ``width`` [degrees], the textures ``albedo`` and ``diffuse``; light leaves it unpolarised.

        Where the textures' sum is above 1, ``diffuse`` gives way.
        """

        eval, pdf = eval_alone, pdf_alone

        def __init__(self, properties: mi.Properties) -> None:
            mi.BSDF.__init__(self, properties)
            self.width = mi.Float(properties["width"])
            self.albedo = properties.get_texture("albedo")
            self.diffuse = properties.get_texture("diffuse", 0.0)
            lobe, rest = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection
            self.m_components = [lobe | mi.BSDFFlags.FrontSide, rest | mi.BSDFFlags.FrontSide]
            self.m_flags = lobe | rest | mi.BSDFFlags.FrontSide
            self.parameters_changed([])

        def parameters_changed(self, keys: list[str]) -> None:
            k = concentration(float(self.width[0]))
            self.k, self.table = mi.Float(k), mi.Float(scaling(k).astype(np.float32))
            dr.make_opaque(self.width, self.k, self.table)  # else each width would be a kernel of its own

        def traverse(self, callback: Any) -> None:
            callback.put("width", self.width, mi.ParamFlags.NonDifferentiable)
            callback.put("albedo", self.albedo, mi.ParamFlags.Differentiable)
            callback.put("diffuse", self.diffuse, mi.ParamFlags.Differentiable)

        def eval_pdf(
            self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            albedo, diffuse, share = self._shares(context, si, active)
            active = active & (si.wi.z > 0) & (wo.z > 0)
            # 1 - cos by the difference: float32 has no cosines near 1
            norm = 0.5 * dr.inv_pi * self.k / (1 - dr.exp(-2 * self.k))
            lobe = norm * dr.exp(-0.5 * self.k * dr.squared_norm(wo - si.wi))
            value = (albedo * (lobe * self._scaling(si.wi.z) * self._scaling(wo.z)) + diffuse * dr.inv_pi) * wo.z
            density = share * lobe * (1 + dr.exp(-2 * self.k * si.wi.z * wo.z)) + (1 - share) * wo.z * dr.inv_pi
            value = dr.select(active, value, 0)
            return mi.depolarizer(value) if mi.is_polarized else value, dr.select(active, density, 0)

        def sample(
            self,
            context: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            share = self._shares(context, si, active)[2]
            is_lobe = sample1 < share
            below = -dr.log(1 - sample2.x * (1 - dr.exp(-2 * self.k))) / self.k  # 1 - cos of the angle to wi
            sin, cos = dr.sincos(2 * dr.pi * sample2.y)
            radius = dr.sqrt(dr.maximum(below * (2 - below), 0))
            back = mi.Frame3f(si.wi).to_world(mi.Vector3f(radius * cos, radius * sin, 1 - below))
            back.z = dr.abs(back.z)  # what would go below the surface is sent to its mirror image
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = dr.select(is_lobe, back, mi.warp.square_to_cosine_hemisphere(sample2))
            value, bs.pdf = self.eval_pdf(context, si, bs.wo, active)
            bs.eta = 1
            bs.sampled_type = dr.select(is_lobe, +mi.BSDFFlags.GlossyReflection, +mi.BSDFFlags.DiffuseReflection)
            bs.sampled_component = dr.select(is_lobe, mi.UInt32(0), 1)
            return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

        def _shares(
            self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, active: mi.Bool = True
        ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum, mi.Float]:
            """Return albedo and diffuse share, 0 where not asked for, and the probability of sampling the lobe."""
            albedo = self.albedo.eval(si, active)
            diffuse = dr.minimum(self.diffuse.eval(si, active), 1 - albedo)
            albedo = albedo * float(context.is_enabled(mi.BSDFFlags.GlossyReflection, 0))
            diffuse = diffuse * float(context.is_enabled(mi.BSDFFlags.DiffuseReflection, 1))
            total = dr.mean(albedo + diffuse)
            return albedo, diffuse, dr.select(total > 0, dr.mean(albedo) / total, 0)

        def _scaling(self, cosine: mi.Float) -> mi.Float:
            u = dr.rsqrt(self.k)
            place = dr.clip(cosine * (1 + u) / (cosine + u), 0, 1) * (NODES - 1)
            index = dr.minimum(mi.UInt32(place), NODES - 2)
            low, high = (dr.gather(mi.Float, self.table, index + step) for step in (0, 1))
            return dr.lerp(low, high, place - index) * dr.rsqrt(dr.maximum(cosine, 0) + u)

        def to_string(self) -> str:
            return f"Retroreflector[width={self.width[0]:g}, albedo={self.albedo}, diffuse={self.diffuse}]"

        def class_name(self) -> str:
            return "Retroreflector"

    return Retroreflector
