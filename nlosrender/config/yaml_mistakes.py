"""What is wrong with a text that is no YAML, in the words of somebody who writes one: what is there, what to do."""

from __future__ import annotations

import re

import yaml

from nlosrender.errors import ValidationIssue

_INDENT = (
    "the indentation does not fit the lines above: give all keys of a mapping, and all items of a list, the same "
    "number of spaces"
)
_QUOTES = "put the text in quotes"
# PyYAML's sentence -> ours; the first that is found counts
_WORDS: tuple[tuple[str, str], ...] = (
    (r"found character '\\t'", "there is a tab before the first word; indent with spaces"),
    (r"found character '([^']+)'", rf"a value cannot begin with \1; {_QUOTES}"),
    (
        "mapping values are not allowed",
        "a second colon in one line, or a key indented deeper than the one above; give keys of one mapping the same "
        f"number of spaces, and where the colon belongs to a text, {_QUOTES}",
    ),
    ("could not find expected ':'", "this line or the one above has no ': ' after its key; write key: value"),
    (
        "(sequence entries|mapping keys) are not allowed",
        "a list or a mapping cannot begin here; begin it in a new line",
    ),
    ("found unexpected end of stream", "a quoted text is not closed; add the quote at its end"),
    ("found unexpected document separator", "a quoted text is not closed before ---; add the quote at its end"),
    (
        r"found unknown escape character '(.*)'",
        r"\\\1 means nothing in double quotes; write \\\\ for a backslash, or use single quotes",
    ),
    ("expected escape sequence", r"digits are missing after \\x, \\u or \\U; write \\\\ for a backslash"),
    (
        r"expected ',' or '([\]}])', but got '(.*)'",
        r"a list or mapping in brackets is not closed; add , or \1 before this",
    ),
    ("expected (<block end>|'<document start>'), but found '(<block .*>|-)'", _INDENT),
    (
        "expected (<block end>|'<document start>'), but found",
        f"something stands behind a finished value; remove it, or, where it belongs to a text, {_QUOTES}",
    ),
    ("expected the node content, but found", "a value is missing before this; write it, or null for none"),
    (
        r"found undefined alias '?(.*?)'?$",
        r"nothing above is marked &\1; define it, or put text that begins with * in quotes",
    ),
    ("found duplicate anchor", "two values are marked with the same & name; rename one"),
    (
        "expected alphabetic or numeric character",
        f"after & or * a name is needed; where it belongs to a text, {_QUOTES}",
    ),
    ("but found another document", "there is a second document after ---; put one capture in a file"),
    ("unacceptable character|special characters are not allowed", "a control character; remove it"),
    (
        "indentation indicator",
        "after | or > only -, + or a digit from 1 to 9 may stand; begin the text in the next line",
    ),
    (r"expected a comment or a line break|expected chomping", f"something stands after | or >; {_QUOTES}"),
    (
        "undefined tag handle|parsing a tag|scanning a tag|directive",
        f"! and % begin marks that no configuration needs; {_QUOTES}",
    ),
)


def syntax_issue(error: yaml.MarkedYAMLError, source: str) -> ValidationIssue:
    """Return the issue of a text that PyYAML gave up on.

    Parameters
    ----------
    error
        As it was raised; a sentence of our own passes as it is.
    source
        What to call the text in the place.
    """
    begun, mark = error.context_mark, error.problem_mark or error.context_mark
    if begun and "end of stream" in str(error.problem):
        mark = begun  # of the file's end nobody learns which quote is the one
    place = f"{source}:{mark.line + 1}:{mark.column + 1}" if mark else source
    found = error.problem or "syntax error"
    for pattern, words in _WORDS:
        match = re.search(pattern, f"{found}\n{error.context or ''}", re.MULTILINE)
        if match:
            found = match.expand(words)
            break
    since = f" (it begins in line {begun.line + 1})" if mark and begun and begun.line != mark.line else ""
    return ValidationIssue((), f"not usable as YAML: {found}{since}.", place=place)
