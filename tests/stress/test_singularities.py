"""Laws where 1 / r^2 has no bound: surfaces that touch, cross or graze the wall, confocal points on their edges."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import Ledger
from stressed import relative_difference, rendered
from support.rendering import Rendering

TWO_SIDED = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": 1.0}}
UNIT = {"type": "rectangle", "width": 1.0, "height": 1.0}
# The columns of the sensor grid below stand at x = -0.5, -0.25, 0, 0.25, 0.5: on the edges of these surfaces.
SURFACES = {
    "at a right angle, touching": {**UNIT, "center": [0.5, 0.0, 0.5], "normal": [-1, 0, 0]},
    "through the wall": {**UNIT, "center": [0.1, 0.0, 0.0], "normal": [-1, 0, -0.3], "bsdf": TWO_SIDED},
    "an edge just off the wall": {**UNIT, "center": [0.0, 0.0, 0.1], "normal": [0.2, 0.0, -1.0]},
    "far and grazing": {"type": "rectangle", "width": 4.0, "height": 4.0, "center": [40, 0, 2.0], "normal": [-1, 0, 0]},
}
GRID = {"sensor_grid": {"nx": 5, "ny": 3, "width": 1.25, "height": 1.2}}


def on_edges(surface: str, scan: str, engine: str, **goal: object) -> Rendering:
    """Render one of the surfaces, with sensor points on its edges and one on the laser point."""
    capture = {**GRID, "laser_point": [0.25, 0.0]} if scan == "single" else GRID
    bins = (0.0, 0.25, 400) if "far" in surface else (0.0, 0.03125, 160)
    return rendered(SURFACES[surface], engine=engine, scan=scan, capture=capture, bins=bins, max_bounces=3, **goal)


@pytest.mark.stress
@pytest.mark.parametrize("scan", ["single", "confocal"])
@pytest.mark.parametrize("surface", SURFACES)
def test_errors_fall_and_nothing_flares_up(surface: str, scan: str, ledger: Ledger) -> None:
    """16 times the paths: a quarter of the error, and no bin that grows with them; both engines agree."""
    coarse, fine, finest = (on_edges(surface, scan, "path", spp=spp) for spp in (256, 4096, 65536))
    for less, more in ((coarse, fine), (fine, finest)):
        ratio = more.error_estimate / less.error_estimate
        # 1/4 where the variance has a bound; the estimates of two noisy errors differ by up to a factor of two
        ledger.check("16 times the paths: share of the error that is left", ratio, 0.5)
        ledger.check("16 times the paths: growth of the largest bin", float(more.mean.max() / less.mean.max()), 1.25)
    gathered = on_edges(surface, scan, "virtual_lights", target_error=0.01)
    allowed = 4 * finest.error_estimate + 0.03  # noise of the paths, three times the error asked of the gather
    ledger.check("engines agree on edges of the wall", relative_difference(gathered.mean, finest.mean), allowed)


def test_a_surface_in_the_plane_of_the_wall_gives_nothing(ledger: Ledger) -> None:
    """In the plane of the wall every cosine is 0: no light, and no 0 / 0."""
    for engine in ("path", "virtual_lights"):
        result = rendered({**UNIT, "center": [0.0, 0.0, 0.0]}, engine=engine, scan="confocal", max_bounces=3)
        ledger.check("light of a surface in the plane of the wall", float(result.mean.sum()), 0.0)


@pytest.mark.parametrize(
    ("engine", "height"),
    [
        ("path", 0.1),
        ("path", 0.01),
        ("path", 1e-3),
        ("virtual_lights", 0.1),
        ("virtual_lights", 0.01),
        pytest.param("virtual_lights", 1e-3, marks=pytest.mark.stress),
        pytest.param("virtual_lights", 1e-4, marks=pytest.mark.stress),
    ],
)
def test_a_plate_close_to_confocal_points_has_its_closed_form(engine: str, height: float, ledger: Ledger) -> None:
    """Before an endless parallel plate at h: H = integral of (cos^4 / pi^3 r^4) dA = 1 / (3 pi^2 h^2).

    The plate ends 0.4 m away: of the integral over r^-8 a share of (1 + (0.4 / h)^2)^-3 is missing, 2e-4 at 0.1 m.
    """
    goal: dict = {"spp": 4096} if engine == "path" else {"target_error": 0.01}
    capture = {"sensor_grid": {"nx": 2, "ny": 2, "width": 0.2, "height": 0.2}}
    result = rendered(
        {**UNIT, "center": [0.0, 0.0, height]},
        engine=engine,
        scan="confocal",
        sensors=(2, 2),
        bins=(0.0, 0.05, 80),
        max_bounces=3,
        capture=capture,
        **goal,
    )
    deviation = abs(float(np.mean(result.total.sum(axis=-1))) * 3 * np.pi**2 * height**2 - 1)
    # four standard errors of 4096 paths at each of 4 points (0.3 %), or the error asked for
    ledger.check(f"a plate at h from the wall: 1 / (3 pi^2 h^2), h = {height:g} m ({engine})", deviation, 0.013)
