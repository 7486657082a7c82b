"""``--json``: exactly one object on standard output, also when a command fails."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from nlosrender.analysis.json_values import finite_or_none
from nlosrender.errors import EXIT_OK, ValidationIssue

if TYPE_CHECKING:
    from collections.abc import Iterable

_PLACE = re.compile(r"(.*?):(\d+)(?::(\d+))?", re.DOTALL)  # of XML there is no column


class JsonOutput:
    """Whether the one object of this process was asked for, and printed."""

    def __init__(self) -> None:
        self.printed = False

    @staticmethod
    def asked(arguments: Sequence[str]) -> bool:
        """Return whether ``arguments`` ask for JSON; they may be no valid command line."""
        options = arguments[: arguments.index("--")] if "--" in arguments else arguments
        return "--json" in options

    def print(self, content: Mapping[str, Any], exit_code: int = EXIT_OK, indent: int | None = None) -> None:
        """Print the object: plain values, and ``exit_code`` unless it is 0; numbers that are not finite become null."""
        import json

        import typer

        self.printed = True
        failed = {"exit_code": exit_code} if exit_code != EXIT_OK else {}
        typer.echo(json.dumps(finite_or_none({**content, **failed}), indent=indent, allow_nan=False))

    def print_failure(self, messages: Iterable[str], exit_code: int, issues: Iterable[ValidationIssue] = ()) -> None:
        """Print why a command failed, unless it has printed its object before; only where ``--json`` asks for one."""
        if self.printed or not self.asked(sys.argv[1:]):
            return
        found = [issue_as_json(issue) for issue in issues]
        self.print({"exit_code": exit_code, "messages": list(messages), "problems": found})


def issue_as_json(issue: ValidationIssue) -> dict[str, Any]:
    """Return a mistake with its place in parts: ``file``, ``line`` and ``column`` are null where there is none."""
    file, line, column = issue.place or None, None, None
    match = _PLACE.fullmatch(issue.place)
    if issue.place.startswith("--set "):
        file = None
    elif match:
        file, line, column = match[1], int(match[2]), int(match[3]) if match[3] else None
    where = {"file": file, "line": line, "column": column}
    return {"place": issue.place, **where, "key": issue.key, "message": issue.message}


OUTPUT = JsonOutput()
