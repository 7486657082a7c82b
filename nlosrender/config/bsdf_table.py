"""The BSDF and texture plugins of Mitsuba 3.9, and our retroreflector, with the parameters of the common ones, as data.

Static, so that validating a config does not start Mitsuba; checked against the plugins by hand (each parameter was
loaded once with Mitsuba 3.9.1).
"""

from __future__ import annotations

from enum import Enum


class Kind(Enum):
    """What a BSDF parameter may hold."""

    REFLECTANCE = "a number from 0 to 1, [r, g, b] with each from 0 to 1, or a texture"
    UNIT = "a number from 0 to 1, or a texture"
    UNIT_NUMBER = "a number from 0 to 1"
    SPECTRUM = "a number >= 0, [r, g, b] with each >= 0, or a spectrum"
    IOR = "a number > 0 or the name of a medium, such as bk7 or water"
    IOR_NUMBER = "a number > 0"
    WIDTH = "a number of degrees from 0.01 to 60"
    MATERIAL = "the name of a metal, such as Au, Ag, Cu or none"
    DISTRIBUTION = "beckmann or ggx"
    FLAG = "true or false"


def _names(words: str) -> tuple[str, ...]:
    return tuple(words.split())


BSDF_TYPES = _names(
    "blendbsdf bumpmap circular conductor dielectric diffuse hair mask measured measured_polarized normalmap null "
    "plastic polarizer pplastic principled principledthin retarder retroreflector roughconductor roughdielectric "
    "roughplastic thindielectric twosided"
)
# Without blackbody, regular and irregular, which need a spectral variant, and volume, which needs a plugin that is no
# texture: without it Mitsuba ends the process.
TEXTURE_TYPES = _names("bitmap checkerboard d65 mesh_attribute rawconstant rgb spectrum srgb uniform")
# Mitsuba crashes the process (bitmap) or fails late without these.
TEXTURE_REQUIRED: dict[str, tuple[str, ...]] = {
    "bitmap": ("filename",),
    "mesh_attribute": ("name",),
    "rgb": ("value",),
    "srgb": ("color",),
    "uniform": ("value",),
}
NO_METAL = "none"  # the material of a conductor that is no metal but a perfect mirror; every metal has a colour
METALS = _names(  # what Mitsuba brings along the index of
    "Ag Al AlAs AlAs_palik AlSb AlSb_palik Au Be Be_palik Cr CsI CsI_palik Cu Cu2O Cu2O_palik CuO CuO_palik "
    "Cu_palik Hg HgTe HgTe_palik Hg_palik Ir Ir_palik K K_palik Li Li_palik MgO MgO_palik Mo Mo_palik Na_palik Nb "
    "Nb_palik Ni_palik Rh Rh_palik Se Se-e Se-e_palik Se_palik SiC SiC_palik SnTe SnTe_palik Ta Ta_palik Te Te-e "
    "Te-e_palik Te_palik ThF4 ThF4_palik TiC TiC_palik TiN TiN_palik TiO2 TiO2-e TiO2-e_palik TiO2_palik VC "
    "VC_palik VN VN_palik V_palik W a-C d-C d-C_palik"
)
MEDIA = (  # media whose index Mitsuba knows; capitals do not matter
    *_names(
        "vacuum helium hydrogen air water acetone ethanol glycerol benzene bromine pyrex polypropylene bk7 amber pet"
    ),
    *("diamond", "carbon dioxide", "carbon tetrachloride", "silicone oil", "water ice", "fused quartz"),
    *("acrylic glass", "sodium chloride"),
)
COLORED_TYPES = ("bitmap", "d65", "hair", "measured", "mesh_attribute")

_CONDUCTOR = {
    "material": Kind.MATERIAL,
    "eta": Kind.SPECTRUM,
    "k": Kind.SPECTRUM,
    "specular_reflectance": Kind.REFLECTANCE,
}
_DIELECTRIC = {
    "int_ior": Kind.IOR,
    "ext_ior": Kind.IOR,
    "specular_reflectance": Kind.REFLECTANCE,
    "specular_transmittance": Kind.REFLECTANCE,
}
_MICROFACETS = {
    "distribution": Kind.DISTRIBUTION,
    "alpha": Kind.UNIT,
    "alpha_u": Kind.UNIT,
    "alpha_v": Kind.UNIT,
    "sample_visible": Kind.FLAG,
}
_PLASTIC = {
    "diffuse_reflectance": Kind.REFLECTANCE,
    "specular_reflectance": Kind.REFLECTANCE,
    "int_ior": Kind.IOR,
    "ext_ior": Kind.IOR,
    "nonlinear": Kind.FLAG,
}
_UNIT_PRINCIPLED = _names(
    "anisotropic metallic spec_trans spec_tint sheen sheen_tint flatness clearcoat clearcoat_gloss"
)
_PRINCIPLED_RATES = _names("main_specular_sampling_rate clearcoat_sampling_rate diffuse_reflectance_sampling_rate")

BSDF_PARAMETERS: dict[str, dict[str, Kind]] = {
    "diffuse": {"reflectance": Kind.REFLECTANCE},
    "conductor": _CONDUCTOR,
    "roughconductor": {**_CONDUCTOR, **_MICROFACETS},
    "dielectric": _DIELECTRIC,
    "thindielectric": _DIELECTRIC,
    "roughdielectric": {**_DIELECTRIC, **_MICROFACETS},
    "plastic": _PLASTIC,
    "roughplastic": {
        **_PLASTIC,
        "distribution": Kind.DISTRIBUTION,
        "alpha": Kind.UNIT_NUMBER,
        "sample_visible": Kind.FLAG,
    },
    "principled": {
        "base_color": Kind.REFLECTANCE,
        "roughness": Kind.UNIT,
        **dict.fromkeys(_UNIT_PRINCIPLED, Kind.UNIT),
        "eta": Kind.IOR_NUMBER,
        "specular": Kind.UNIT_NUMBER,
        **dict.fromkeys(_PRINCIPLED_RATES, Kind.UNIT_NUMBER),
    },
    "retroreflector": {"width": Kind.WIDTH, "albedo": Kind.REFLECTANCE, "diffuse": Kind.REFLECTANCE},
    "twosided": {},
    "mask": {"opacity": Kind.UNIT},
    "blendbsdf": {"weight": Kind.UNIT},
}
BSDF_REQUIRED: dict[str, tuple[str, ...]] = {
    "blendbsdf": ("weight",),
    "measured": ("filename",),
    "retroreflector": ("width", "albedo"),
}
NESTED_BSDFS: dict[str, tuple[int, int]] = {  # how few and how many BSDFs it holds, under any key
    "twosided": (1, 2),
    "mask": (1, 1),
    "blendbsdf": (2, 2),
    "bumpmap": (1, 1),
    "normalmap": (1, 1),
}
# Only materials that reflect may be wrapped: Mitsuba refuses the others inside twosided.
TRANSMITTING = ("dielectric", "roughdielectric", "thindielectric", "null", "mask", "twosided", "polarizer", "retarder")
SHAPE_TYPES = _names(
    "bsplinecurve cube cylinder disk ellipsoids ellipsoidsmesh linearcurve obj ply rectangle sdfgrid serialized sphere"
)
