"""A uniform point on a triangle from two uniform numbers (Osada et al. 2002, Shape Distributions, Eq. 1)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def triangle_weights(u: Any, v: Any, sqrt: Callable[[Any], Any] = np.sqrt) -> tuple[Any, Any, Any]:
    """Return the barycentric coordinates (1 - sqrt u, sqrt u (1 - v), sqrt u v) of a point uniform by area.

    Parameters
    ----------
    u, v
        Uniform numbers in [0, 1), of numpy or Dr.Jit.
    sqrt
        ``dr.sqrt`` for Dr.Jit's; this module imports no Dr.Jit, for use without a renderer.
    """
    root = sqrt(u)
    return 1 - root, root * (1 - v), root * v
