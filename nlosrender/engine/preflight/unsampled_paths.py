"""Unsampled paths: classes of light paths that no technique of a render samples and no error estimate includes.

Notation of Heckbert (1990): L laser (or lamp), D a surface that scatters, S one that reflects or transmits along one
direction only (mirrors, glass, smooth coats, masks), E sensor (or camera). The laser point and the sensor point are the
wall's own D. What the techniques sample:

- Paths start at the sensor. BSDF sampling follows every S and D, hidden geometry sampling every D of the wall.
- Laser sampling connects a vertex straight to the laser point. The BSDF of the connection is evaluated at both of its
  ends, and what lies between stops it: an S at either end, or a pane or mask between, is never found.
- Flat and convex mirrors show an image of the laser, which vertices are connected to: ``L D S D ...``.
- A laser spot (``capture.laser_spot_radius``) is an area which BSDF sampling finds by chance, through any S.
- Before a camera, emitters with an area are found by BSDF sampling; points, spots and suns by connections alone.

So ``L D S+ ...`` is missing with a laser point but for that image, ``L S ...`` (the wall mirrors the beam) always, and
the lamps' ``L S+ D ...`` before a camera. Whether a class carries energy is tried by ``specular_light``: mirrors that
the laser does not light, or whose light leaves the scene, needs more than ``max_bounces`` or comes after the time
window, are none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import mitsuba as mi

from nlosrender.engine.interface import Engine
from nlosrender.engine.preflight.specular_light import (
    SpecularLight,
    light_after_lamps,
    light_after_laser,
    light_mirrored_by_wall,
)
from nlosrender.scene.build import SceneWithoutWall
from nlosrender.scene.view import BuiltView

MAX_NAMED = 3  # items in a sentence
SPOT = "Give the laser a spot, such as capture.laser_spot_radius: 0.02 (m), which paths find by chance (slowly)"
ROUGH = "make the surface rough (roughconductor, roughdielectric, roughplastic)"


@dataclass(frozen=True)
class UnsampledPaths:
    """One class of paths that is missing."""

    notation: str  # "L D S+ D E"
    first_bounce: int  # the lowest that it adds to
    items: tuple[str, ...]  # "scene.hidden_geometry.0 (front)": what sends the light on
    what: str  # which light, in words
    advice: str

    @property
    def key(self) -> str:
        """Return where the configuration has the first item; empty for one of a Mitsuba scene."""
        key = self.items[0].split(" ")[0]
        return key if key.startswith("scene.") else ""

    @property
    def summary(self) -> str:
        """Return the class in a line, as files keep it."""
        return f"{self.notation}, bounce {self.first_bounce} and above: {self.what} ({_listed(self.items)})"

    @property
    def warning(self) -> str:
        """Return the warning."""
        return (
            f"{self.what} is missing, and the stated error unknown: no technique of this render samples the paths "
            f"{self.notation}, bounce {self.first_bounce} and above ({_listed(self.items)}). {self.advice}."
        )


def unsampled_paths(engine: Engine) -> tuple[UnsampledPaths, ...]:
    """Return the classes of paths that carry light in a scene and that ``engine`` does not sample.

    Parameters
    ----------
    engine
        As set up for the whole capture.
    """
    built, capture, time_axis = engine.built, engine.capture, engine.time_axis
    highest = engine.options.bounces.max_bounces
    if isinstance(built, BuiltView):
        found = light_after_lamps(built, capture, time_axis, highest)
        what = "light of lamps without extent that mirrors, glass or masks send on to a surface"
        return tuple(_classes("L S+ D (D|S)* E", found, what, f"Use a lamp with an area, or {ROUGH}"))
    classes: list[UnsampledPaths] = []
    if capture.laser_spot_radius == 0:
        can_have_spot = built.wall.is_planar and not mi.is_polarized
        advice = f"{SPOT}, or {ROUGH}" if can_have_spot else ROUGH[0].upper() + ROUGH[1:]
        found = light_after_laser(built, capture, time_axis, highest)
        for is_reflected, how in (
            (True, "reflected by mirrors or smooth coats"),
            (False, "let through by glass or masks"),
        ):
            of_kind = [light for light in found if light.is_reflected == is_reflected]
            classes += _classes("L D S+ (D|S)* D E", of_kind, f"light of the laser point {how}", advice)
    mirrored = light_mirrored_by_wall(built, capture, time_axis, highest)
    mirror = "the surface that it hits" if isinstance(built, SceneWithoutWall) else "the relay wall"
    what = f"the laser's beam as mirrored by {mirror}"
    classes += _classes("L S+ (D|S)* D E", mirrored, what, "Use a wall that is diffuse or rough")
    return tuple(classes)


def _classes(notation: str, found: Iterable[SpecularLight], what: str, advice: str) -> Iterator[UnsampledPaths]:
    packed = sorted(found, key=lambda light: (light.first_bounce, light.item))
    if packed:
        items = tuple(dict.fromkeys(light.item for light in packed))
        yield UnsampledPaths(notation, packed[0].first_bounce, items, what, advice)


def _listed(items: tuple[str, ...]) -> str:
    more = f" and {len(items) - MAX_NAMED} more" if len(items) > MAX_NAMED else ""
    return ", ".join(items[:MAX_NAMED]) + more
