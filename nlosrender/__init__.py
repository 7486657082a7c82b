"""Batch renderer for non-line-of-sight (NLOS) imaging datasets; docs/python.md has the Python API."""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from nlosrender.api.configuration import Configuration, Validation, load, plan, validate
    from nlosrender.api.opened_capture import Capture
    from nlosrender.api.opened_capture import Capture as open
    from nlosrender.api.renders import render, render_all
    from nlosrender.api.transient_light import Transient, transient
    from nlosrender.engine.backend.start import start_backend
    from nlosrender.errors import NlosError, NlosWarning

__all__ = [
    "Capture",
    "Configuration",
    "NlosError",
    "NlosWarning",
    "Transient",
    "Validation",
    "load",
    "open",
    "plan",
    "render",
    "render_all",
    "start_backend",
    "transient",
    "validate",
]
_PLACES = {  # imported when a name is first asked for: ``import nlosrender`` takes milliseconds
    "api.configuration": ("Configuration", "Validation", "load", "plan", "validate"),
    "api.opened_capture": ("Capture", "open"),
    "api.renders": ("render", "render_all"),
    "api.transient_light": ("Transient", "transient"),
    "engine.backend.start": ("start_backend",),
    "errors": ("NlosError", "NlosWarning"),
}


def __getattr__(name: str) -> object:
    import importlib

    for place, names in _PLACES.items():
        if name in names:
            module = importlib.import_module(f"nlosrender.{place}")
            return getattr(module, "Capture" if name == "open" else name)
    raise AttributeError(f"module 'nlosrender' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
