"""The blocks of code of a page, as somebody copies them."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def blocks_of(page: str, language: str) -> list[str]:
    """Return the fenced blocks of a page in a language, and for ``sh`` those that are indented, in their order."""
    text = (DOCS / page).read_text(encoding="utf-8")
    fenced = r"^```" + language + r"\n(.*?)^```"
    pattern = rf"{fenced}|((?:^ {{4}}[^\n]*\n)+)" if language == "sh" else fenced
    found = []
    for match in re.finditer(pattern, text, re.DOTALL | re.MULTILINE):
        indented = match.group(2) if language == "sh" else None
        found.append(re.sub(r"^ {4}", "", indented, flags=re.MULTILINE) if indented else match.group(1))
    return found


def block_with(page: str, language: str, words: str) -> str:
    """Return the one block of a page that has ``words`` in it."""
    (block,) = [block for block in blocks_of(page, language) if words in block]
    return block


def shell(block: str, folder: Path, environment: dict[str, str], **how: object) -> subprocess.CompletedProcess[str]:
    """Run a block in bash as a runner of continuous integration does: the first command that fails ends it."""
    command = ["bash", "-e", "-o", "pipefail", "-c", block]
    options: dict[str, object] = {"capture_output": True, "stdin": subprocess.DEVNULL, **how}
    return subprocess.run(command, cwd=folder, env=environment, text=True, timeout=300, check=False, **options)  # type: ignore[call-overload]
