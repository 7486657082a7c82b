"""Opens closed standard streams, and lets stdout print any file name, whatever the locale."""

from __future__ import annotations

import codecs
import io
import os
import sys
from contextlib import suppress

ERROR_HANDLER = "nlosrender.names"  # what Python's codecs call the handler


def open_closed_streams() -> None:
    """Open what the program was started without: the next file would be taken for it, and written into by libraries."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):  # each takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115  # for as long as we run


def give_up_stderr() -> None:
    """Redirect standard error to the null device: a failed flush at exit would end Python with code 120."""
    with suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def print_any_name() -> None:
    """Let standard output print a file's name byte for byte where it is no text, and else what the locale lacks as \\x.

    Messages on stderr need nothing: Python escapes there.
    """
    codecs.register_error(ERROR_HANDLER, _encoded)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors=ERROR_HANDLER)


def _encoded(error: UnicodeError) -> tuple[str | bytes, int]:
    try:
        # bytes of a name that are no text reach Python as surrogates; as bytes the name can be piped to other programs
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)
