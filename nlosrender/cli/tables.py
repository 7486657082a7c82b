"""Labelled lines and tables: wrapped to a terminal's width; in pipes and logs every row is one line, however long."""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Iterable, Sequence

import typer

UNBOUNDED = 10**6  # characters: longer than any row


def print_table(rows: Iterable[Sequence[str]], *, header: Sequence[str] = (), indent: int = 0) -> None:
    """Print rows in aligned columns, those of numbers below a ``header`` to the right."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else UNBOUNDED
    typer.echo(table_text(rows, header=header, indent=indent, width=width))


def table_text(
    rows: Iterable[Sequence[str]], *, header: Sequence[str] = (), indent: int = 0, width: int = UNBOUNDED
) -> str:
    """Return what ``print_table`` prints where ``width`` characters fit a line."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    lines = [*([header] if header else []), *rows]
    table = Table.grid(padding=(0, 2, 0, 0))
    for column in range(max(map(len, lines), default=0)):
        table.add_column(justify="right" if header and column else "left", no_wrap=column == 0, overflow="fold")
    for line in lines:
        table.add_row(*(Text(text) for text in line))  # text: brackets in a file's name are no markup
    content = io.StringIO()
    Console(file=content, width=max(width - indent, 20), color_system=None).print(table)
    return "\n".join(f"{'':{indent}}{line.rstrip()}" for line in content.getvalue().splitlines())
