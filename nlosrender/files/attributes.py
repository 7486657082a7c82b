"""Values as HDF5 attributes that every reader copes with.

Text and plain numbers only: h5py would store a Python bool as an enumeration, which MATLAB loaders refuse, and one
loader passes every text *dataset* through YAML, so that text belongs into attributes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np

from nlosrender.config.encodable import encodable

# An object header holds an attribute of at most 64 KiB. Variable-length text lies in the heap and is not bound by
# it; arrays are, and go there as JSON text when they are larger.
MAX_STORED_BYTES = 2**24  # larger attributes, by any writer, are not read
MAX_ARRAY_BYTES = 60_000


def attribute_value(value: object) -> str | int | float | np.ndarray:
    """Return ``value`` as what is stored: text, a number, or a numeric array.

    Booleans become 0 / 1. Infinity, None, mappings, sequences of anything but finite numbers and large arrays become
    text (JSON where there is structure). A single NaN stays a number: it stands for one that is not known.
    """
    if isinstance(value, str):
        return _clean(value)
    if value is None:
        return "none"
    if isinstance(value, (bool, np.bool_)):
        return int(value)
    if isinstance(value, (int, np.integer)):
        number = int(value)
        return number if -(2**63) <= number < 2**63 else str(number)
    if isinstance(value, (float, np.floating)):
        return str(float(value)) if math.isinf(value) else float(value)
    if isinstance(value, Mapping):
        return _clean(json.dumps(_plain(value), ensure_ascii=False))
    if isinstance(value, (list, tuple, np.ndarray)):
        return _array(value)
    return _clean(str(value))


def set_attributes(target: h5py.Group | h5py.Dataset, values: Mapping[str, object]) -> None:
    """Store ``values`` as attributes of ``target``, replacing those of the same name."""
    for name, value in values.items():
        target.attrs[name] = attribute_value(value)


def get_attributes(source: h5py.Group | h5py.Dataset) -> dict[str, object]:
    """Return the attributes of ``source`` as Python text, numbers and lists; those h5py cannot read,
    of more than 16 MiB, or of ragged arrays, are left out."""
    found: dict[str, object] = {}
    for name in source.attrs:
        try:
            stored = source.attrs.get_id(name)
            if not _is_ragged(stored.get_type()) and stored.get_storage_size() <= MAX_STORED_BYTES:
                found[str(name)] = _native(source.attrs[name])
        except (OSError, TypeError, ValueError, RuntimeError, KeyError):
            continue  # written by someone else in a type that has no meaning here
    return found


def text_list(attributes: Mapping[str, object], name: str) -> tuple[str, ...]:
    """Return an attribute that holds a list of texts as JSON; an empty one where it is missing or does not."""
    try:
        found = json.loads(str(attributes.get(name, "[]")))
    except (ValueError, RecursionError):
        return ()
    return tuple(str(text) for text in found) if isinstance(found, list) else ()


def json_object(text: object) -> dict[str, Any]:
    """Return the mapping in an attribute that should hold one as JSON; an empty one where it does not."""
    try:
        found = json.loads(str(text))
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _is_ragged(kind: h5py.h5t.TypeID) -> bool:
    """Return whether a type has arrays of variable length, which end the process when they are damaged text."""
    if isinstance(kind, h5py.h5t.TypeCompoundID):
        return any(_is_ragged(kind.get_member_type(index)) for index in range(kind.get_nmembers()))
    if isinstance(kind, h5py.h5t.TypeArrayID):
        return _is_ragged(kind.get_super())
    return isinstance(kind, h5py.h5t.TypeVlenID)


def _array(values: object) -> str | np.ndarray:
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different length
        array = np.empty(0, dtype=object)
    numeric = array.dtype.kind in "iuf" and array.size > 0
    if numeric and array.nbytes <= MAX_ARRAY_BYTES and bool(np.isfinite(array).all()):
        return array
    return _clean(json.dumps(_plain(values), ensure_ascii=False))


def _plain(value: object) -> object:
    """Return ``value`` with everything in it as JSON knows it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if isinstance(value, (str, int, float, type(None))) else str(value)


def _clean(text: str) -> str:
    return encodable(text).replace("\0", "\\0")  # HDF5's text ends at a zero byte


def _native(value: object) -> object:
    if isinstance(value, bytes):
        return value.decode("utf-8", "backslashreplace")
    if isinstance(value, np.generic):
        return _native(value.item())
    if isinstance(value, np.ndarray):
        return [_native(entry) for entry in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [_native(entry) for entry in value]
    return value if isinstance(value, (str, int, float)) else str(value)
