"""The engines there are, as types: those that trace paths until a budget is met, and all."""

from __future__ import annotations

from typing import TypeAlias

from nlosrender.engine.line_of_sight.engine import LineOfSightEngine
from nlosrender.engine.path.engine import PathEngine
from nlosrender.engine.virtual_lights.engine import VirtualLightEngine

SamplingEngine: TypeAlias = PathEngine | LineOfSightEngine
Engine: TypeAlias = SamplingEngine | VirtualLightEngine
