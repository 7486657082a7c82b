"""Immutable mappings for the parts of the config that Mitsuba defines: BSDFs and shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn


class FrozenDict(dict[str, Any]):
    """A dict that cannot be changed after construction; hashable, picklable, and JSON-dumpable like any dict.

    A dict rather than a proxy: ``json.dumps`` and Mitsuba's dictionary loader take it as it is.
    """

    def _refuse(self, *_args: object, **_kwargs: object) -> NoReturn:
        raise TypeError("the config is frozen; change the YAML or use --set")

    __setitem__ = __delitem__ = __ior__ = _refuse
    clear = pop = popitem = setdefault = update = _refuse

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[type[FrozenDict], tuple[dict[str, Any]]]:
        # A dict subclass is otherwise unpickled through __setitem__, which refuses.
        return (FrozenDict, (dict(self),))


def freeze(value: Any) -> Any:
    """Return ``value`` with every mapping in it as :class:`FrozenDict` and every list as a tuple."""
    if isinstance(value, Mapping):
        return FrozenDict({key: freeze(item) for key, item in value.items()})
    if isinstance(value, (list, tuple)):
        return tuple(freeze(item) for item in value)
    return value
