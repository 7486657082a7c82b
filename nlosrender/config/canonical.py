"""One hash for configurations that differ only in writing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any


def tree_hash(tree: Mapping[str, Any]) -> str:
    """Return the SHA-256 (hex) of the canonical JSON of plain values."""
    canonical = json.dumps(tree, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()
