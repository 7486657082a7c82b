"""Text and UTF-8: the bytes of a file's name that are no text reach Python as surrogates, which UTF-8 cannot hold."""

from __future__ import annotations


def is_encodable(text: str) -> bool:
    """Return whether UTF-8 can hold ``text``."""
    return not any(0xD800 <= ord(character) < 0xE000 for character in text)


def encodable(text: str) -> str:
    """Return ``text`` with what UTF-8 cannot hold written out, such as ``caf\\udce9``."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def joined(text: str) -> str:
    r"""Return ``text`` with pairs of surrogates as the characters they stand for: JSON writes emoji as two ``\u``."""
    if is_encodable(text):
        return text
    return text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass")
