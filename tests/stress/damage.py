"""Damage to the bytes of a file: cut short, bytes and numbers replaced, parts repeated or swapped."""

from __future__ import annotations

import random

_BYTES = (0, 1, 127, 128, 255, ord("-"), ord("9"), ord("\n"), ord(" "), ord("e"))
_WORDS = (
    b"-1",
    b"99999999999",
    b"nan",
    b"inf",
    b"1e400",
    b"0",
    b"//",
    b"end_header",
    b"element face 4000000000\n",
    b"f ",
)


def damaged(content: bytes, seed: int) -> bytes:
    """Return a copy with one to eight pieces of damage, the same for the same seed."""
    generator = random.Random(seed)
    found = bytearray(content)
    for _ in range(generator.choice((1, 1, 1, 2, 4, 8))):
        if not found:
            break
        at, length = generator.randrange(len(found)), generator.randrange(1, 32)
        match generator.randrange(7):
            case 0:
                del found[at:]
            case 1:
                del found[at : at + length]
            case 2:
                found[at:at] = found[at : at + length]
            case 3:
                found[at:at] = generator.choice(_WORDS)
            case 4:
                found[at : at + length] = generator.randbytes(length)
            case _:
                found[at] = generator.choice(_BYTES)
    return bytes(found)
