"""How a wrong value is refused: one plain sentence, with the value found and what is allowed.

Validators of the config raise what this module builds; ``translate`` makes a ``ValidationIssue`` of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from nlosrender.config.encodable import encodable
from nlosrender.errors import KeyPath

FAULT = "fault"  # error type of everything built here, so that it is told from pydantic's own

_LONGEST_SHOWN = 60  # characters of a wrong value that still help


@dataclass(frozen=True)
class Fault:
    """One mistake inside a section of the config.

    Parameters
    ----------
    path
        Keys from the section down to the mistake.
    message
        What was found, what is allowed, what to do.
    at
        Whether the file position of the value or of the key is shown.
    needs
        Key paths (from the section) this judgement relies on; it is dropped when one of them is itself wrong.
    """

    path: KeyPath
    message: str
    at: Literal["value", "key"] = "value"
    needs: tuple[KeyPath, ...] = ()

    def as_error(self) -> PydanticCustomError:
        """Return the fault in the form a pydantic validator may raise."""
        message = encodable(self.message)  # pydantic cannot hold names of files as they are
        context = {"message": message, "at": self.at, "needs": self.needs, "depth": len(self.path)}
        return PydanticCustomError(FAULT, "{message}", context)


def refuse(value: object, need: str, advice: str = "") -> PydanticCustomError:
    """Return the error a leaf validator raises: what was found, what is needed, what to do."""
    return Fault((), refusal(value, need, advice)).as_error()


def refusal(value: object, need: str, advice: str = "") -> str:
    """Return the sentence ``got <value>, need <need>. <advice>``."""
    return f"got {shown(value)}, need {need}." + (f" {advice}" if advice else "")


def raise_faults(title: str, faults: Iterable[Fault]) -> None:
    """Raise all ``faults`` at once; return when there are none.

    Raises
    ------
    pydantic.ValidationError
        There is at least one fault.
    """
    details = [InitErrorDetails(type=fault.as_error(), loc=fault.path, input=None) for fault in faults]
    if details:
        raise ValidationError.from_exception_data(title, details)


def shown(value: object) -> str:
    """Return ``value`` as a user wrote it, with its type where that is the mistake, cut to a readable length."""
    if value is None:
        return "nothing (null)"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"{_cut(value)!r} (text)"
    if isinstance(value, Mapping):
        return f"a mapping with {', '.join(map(str, list(value)[:5]))}" if value else "an empty mapping"
    if isinstance(value, (list, tuple)):
        return _cut("[" + ", ".join(_element(item) for item in value[:12]) + (", ..." if len(value) > 12 else "") + "]")
    return f"{value:.12g}" if isinstance(value, float) else _cut(str(value))


def _element(value: object) -> str:
    if isinstance(value, str):
        return repr(_cut(value))
    if isinstance(value, Mapping):
        return "{...}"
    return "null" if value is None else shown(value)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 3] + "..."


def listed(names: Iterable[object]) -> str:
    """Return names as a comma-separated list for a message."""
    return ", ".join(str(name) for name in names)
