"""The numbers in a Mitsuba scene: finite, of a size that float32 can square, and none that makes light of nothing."""

from __future__ import annotations

import re
from xml.etree.ElementTree import Element

from nlosrender.config.fields import MAX_LENGTH

_NUMERIC = {  # element: the attributes that hold numbers
    "float": ("value",),
    "integer": ("value",),
    "lookat": ("origin", "target", "up"),
    "matrix": ("value",),
    "point": ("value", "x", "y", "z"),
    "rgb": ("value",),
    "rotate": ("value", "x", "y", "z", "angle"),
    "scale": ("value", "x", "y", "z"),
    "spectrum": ("value",),
    "translate": ("value", "x", "y", "z"),
    "vector": ("value", "x", "y", "z"),
}
_LIGHT = ("rgb", "spectrum")
_SEPARATOR = re.compile(r"[\s,:]+")  # a spectrum is a list of wavelength:value


def check_numbers(element: Element) -> None:
    """Refuse numbers that are not finite or absurdly large, negative light, and reflectances above 1.

    What is no number at all is left to Mitsuba, which says so.

    Raises
    ------
    ValueError
        Says which element, and what is allowed.
    """
    name = element.get("name", "")
    is_light = element.tag in _LIGHT or name in ("radiance", "intensity", "irradiance")
    is_share = name in ("reflectance", "albedo", "diffuse") or name.endswith(("_reflectance", "_transmittance"))
    for key in _NUMERIC.get(element.tag, ()):
        for text in _SEPARATOR.split(element.get(key, "").strip()):
            try:
                number = float(text)
            except ValueError:
                continue
            shown = f"<{element.tag} {key}={element.get(key)!r:.60}>"
            if not abs(number) <= MAX_LENGTH:
                raise ValueError(f"{shown} holds {text}, need finite numbers up to {MAX_LENGTH:g}")
            if number < 0 and (is_light or is_share):
                raise ValueError(f"{shown} holds {text}, need numbers >= 0")
            # of a spectrum's pairs the wavelengths are larger
            if is_share and number > 1 and ":" not in element.get(key, ""):
                raise ValueError(f"{shown} holds {text}, need numbers from 0 to 1 for {name}")
