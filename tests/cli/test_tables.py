"""Tables of labelled values: whole in pipes and logs, wrapped on terminals."""

from __future__ import annotations

from nlosrender.cli.tables import table_text

NAME = "[bold]caf\udce9[/bold] :warning: " + "long " * 60 + "end"  # brackets, colons and a byte that is no text


def test_a_row_is_one_line_where_nothing_bounds_it() -> None:
    """Values come out whole, byte for byte, without spaces after them."""
    assert table_text([("file", NAME), ("sensor points", "5 x 4")]) == f"file           {NAME}\nsensor points  5 x 4"


def test_a_terminal_wraps_values_and_keeps_labels() -> None:
    """No line is wider than the terminal, and a wrapped value stays in its column."""
    lines = table_text([("file", NAME), ("sensor points", "5 x 4")], width=40, indent=2).splitlines()
    assert max(map(len, lines)) <= 40
    assert all(line.startswith(" " * 17) for line in lines[1:-1])
    assert "".join(line[17:] for line in lines[:-1]).replace(" ", "") == NAME.replace(" ", "")


def test_numbers_line_up_on_the_right() -> None:
    """Below a header every column but the first holds numbers."""
    assert table_text([("3", "1.5"), ("all", "-20")], header=("bounce", "energy")) == (
        "bounce  energy\n3          1.5\nall        -20"
    )
