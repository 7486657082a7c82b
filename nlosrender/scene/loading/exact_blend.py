"""Blend: Mitsuba's ``blendbsdf``, whose delta lobes keep their weights when they are sampled.

Mitsuba 3.9 adds the density of the other BSDF, which is per steradian, to the probability of a delta lobe, and takes
the quotient of the summed values and densities: half a mirror, half matt 0.7, reflects 0.47 like a mirror instead of
0.5, a tenth of a mirror 0.08. Here a delta lobe is sampled with its own weight; all else is as there.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from nlosrender.scene.loading.bsdf_plugin import eval_alone, pdf_alone, register_once

MITSUBA_NAME, NAME = "blendbsdf", "exactblend"  # the latter takes the place of the former in all scenes
ALL_COMPONENTS = 0xFFFFFFFF


def register_blend() -> None:
    """Make the BSDF known to the active variant of Mitsuba, under the name ``NAME``."""
    register_once(NAME, _define)


def _define() -> type[mi.BSDF]:
    class ExactBlend(mi.BSDF):  # type: ignore[misc]  # each variant has a base class of its own
        """Parameters: the texture ``weight`` of the second of two nested BSDFs."""

        eval, pdf = eval_alone, pdf_alone

        def __init__(self, properties: mi.Properties) -> None:
            mi.BSDF.__init__(self, properties)
            self.weight = properties.get_texture("weight")
            values = (properties[name] for name in properties.keys())  # noqa: SIM118  # no dict
            self.first, self.second = (value for value in values if isinstance(value, mi.BSDF))
            parts = self.first, self.second
            self.m_components = [part.flags(k) for part in parts for k in range(part.component_count())]
            self.m_flags = self.first.flags() | self.second.flags()

        def traverse(self, callback: Any) -> None:
            callback.put("weight", self.weight, mi.ParamFlags.Differentiable)
            callback.put("bsdf_0", self.first, mi.ParamFlags.Differentiable)
            callback.put("bsdf_1", self.second, mi.ParamFlags.Differentiable)

        def sample(
            self,
            context: mi.BSDFContext,
            si: mi.SurfaceInteraction3f,
            sample1: mi.Float,
            sample2: mi.Point2f,
            active: mi.Bool = True,
        ) -> tuple[mi.BSDFSample3f, mi.Spectrum]:
            weight, number = self._weight(si, active), self.first.component_count()
            if context.component != ALL_COMPONENTS:
                part, own, share = self._part(context, weight)
                bs, value = part.sample(own, si, sample1, sample2, active)
                bs.sampled_component = mi.UInt32(context.component)
                return bs, value * share
            by_second = sample1 <= weight
            one = self.first.sample(context, si, (sample1 - weight) / (1 - weight), sample2, active & ~by_second)
            two = self.second.sample(context, si, sample1 / weight, sample2, active & by_second)
            two[0].sampled_component += number
            bs, value = dr.select(by_second, two[0], one[0]), dr.select(by_second, two[1], one[1])
            share = dr.select(by_second, weight, 1 - weight)
            scatters = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            first = self.first.eval_pdf(context, si, bs.wo, scatters & by_second)
            second = self.second.eval_pdf(context, si, bs.wo, scatters & ~by_second)
            density = share * bs.pdf + (1 - share) * dr.select(by_second, first[1], second[1])
            total = value * (share * bs.pdf) + dr.select(by_second, first[0], second[0]) * (1 - share)
            mixed = dr.select(density > 0, total / density, 0)
            bs.pdf = dr.select(scatters, density, share * bs.pdf)
            return bs, dr.select(scatters, mixed, value)

        def eval_pdf(
            self, context: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[mi.Spectrum, mi.Float]:
            weight = self._weight(si, active)
            if context.component != ALL_COMPONENTS:
                part, own, share = self._part(context, weight)
                value, density = part.eval_pdf(own, si, wo, active)
                return value * share, density
            first = self.first.eval_pdf(context, si, wo, active)
            second = self.second.eval_pdf(context, si, wo, active)
            return first[0] * (1 - weight) + second[0] * weight, dr.lerp(first[1], second[1], weight)

        def eval_null_transmission(self, si: mi.SurfaceInteraction3f, active: mi.Bool = True) -> mi.Spectrum:
            weight = self._weight(si, active)
            first, second = (part.eval_null_transmission(si, active) for part in (self.first, self.second))
            return first * (1 - weight) + second * weight

        def _weight(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
            return dr.clip(self.weight.eval_1(si, active), 0, 1)

        def _part(self, context: mi.BSDFContext, weight: mi.Float) -> tuple[mi.BSDF, mi.BSDFContext, mi.Float]:
            """Return the BSDF that has the component asked for, that context for it, and its share."""
            number, own = self.first.component_count(), mi.BSDFContext(context.mode)
            own.type_mask = context.type_mask
            is_first = context.component < number
            own.component = context.component - (0 if is_first else number)
            return (self.first, own, 1 - weight) if is_first else (self.second, own, weight)

        def to_string(self) -> str:
            return f"ExactBlend[weight={self.weight}, {self.first}, {self.second}]"

        def class_name(self) -> str:
            return "BlendBSDF"

    return ExactBlend
