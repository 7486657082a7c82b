"""Families of items: ``count`` copies of a hidden item with draws of their own, placed without overlap, on a floor.

The three keys stand beside those of the item, in a file with a ``sweep`` only; the configs of its captures hold the
copies, where they lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from nlosrender.config.fields import as_finite
from nlosrender.config.issues import mismatch
from nlosrender.errors import ConfigError, KeyPath, ValidationIssue

if TYPE_CHECKING:
    from nlosrender.config.document import Config
    from nlosrender.config.hidden_geometry import HiddenItemConfig
    from nlosrender.config.yaml_tree import Document

FAMILY_KEYS = ("count", "no_overlap", "on_floor")
MAX_COPIES = 100  # of one item; each is placed beside all others
# Tries of one copy, and arrangements of all: in a room with five pieces of furniture (configs/dataset-rooms.yaml) one
# arrangement of 200 tries fails in 2 of 100 captures, of which a second one of 100 fails in none.
MAX_TRIES, ROUNDS = 100, 10
PLACES = ("translate", "center")
PLACING = (*PLACES, "rotate_deg")  # what another try draws anew; sizes and files keep their distribution
_ITEMS: KeyPath = ("scene", "hidden_geometry")
_SLACK = 1e-6  # m by which boxes may overlap: items on a floor touch it
_UP = 1  # y of the scene
FLOOR_GAP = 1e-3  # m from a floor to what stands on it: rays tell the two apart, the light between them is lost

Box = tuple[Any, Any]  # smallest and largest coordinates [m], scene coordinates
Measure = Callable[
    ["HiddenItemConfig"], Box | None
]  # the box around an item; None: it has none that could be in the way
Redraw = Callable[[int, int, int], Any]  # item of the file, copy, try -> the raw item


@dataclass(frozen=True)
class Member:
    """One copy of an item that is to be placed."""

    at: int  # in the capture's list
    item: int  # in the file's list
    copy: int  # from 0
    no_overlap: bool
    floor: float | None  # height of the floor that it stands on [m]; None: it keeps its own height


def family_items(tree: Any) -> list[int]:
    """Return which items of a document have keys of a family; whatever is wrong in it is left to the validation."""
    items = _items(tree)
    return [at for at, item in enumerate(items) if isinstance(item, dict) and any(key in item for key in FAMILY_KEYS)]


def with_copies(document: Document, redraw: Redraw) -> list[Member]:
    """Put the copies of families at the end of a document's items, and return what is to be placed.

    Parameters
    ----------
    document
        Changed in place; mistakes become issues of it.
    redraw
        Makes the raw items of further copies.
    """
    items, members, gone = _items(document.tree), [], []
    for at in family_items(document.tree):
        issues = [*_issues(items[at], (*_ITEMS, at))]
        document.issues += [document.issue(issue.path, issue.message) for issue in issues]
        count, no_overlap, floor = _taken(items[at]) if not issues else (1, False, None)
        for copy in range(count):
            place = at if copy == 0 else len(items)
            if copy:
                items.append(redraw(at, copy, 0))
                _taken(items[-1])
            if no_overlap or floor is not None:
                members.append(Member(place, at, copy, no_overlap, floor))
        gone += [at] * (count == 0)
    for at in reversed(gone):
        del items[at]
    return [replace(member, at=member.at - sum(at < member.at for at in gone)) for member in members]


def placed(
    document: Document,
    members: Sequence[Member],
    redraw: Redraw,
    measure: Measure,
    config_of: Callable[[Document], Config],
) -> None:
    """Give every member a place: on its floor, and where its box meets no other; those not yet placed do not count.

    Parameters
    ----------
    document
        Of one capture; changed in place.
    members, redraw
        Of ``with_copies``.
    measure
        Tells the box of an item.
    config_of
        Validates a document.

    Raises
    ------
    ConfigError
        No place is found, an item of this type stands on no floor, or cannot be measured.
    """
    waiting = {member.at for member in members}
    config = config_of(document)
    apart = any(member.no_overlap for member in members)
    fixed = [measure(item) for at, item in enumerate(config.scene.hidden_geometry) if at not in waiting and apart]
    crowded = members[0]
    for first_try in range(0, ROUNDS * MAX_TRIES, MAX_TRIES):
        boxes = [*fixed]
        for member in members:
            box = _free_box(document, member, boxes, first_try, redraw, measure, config_of)
            if not box:
                crowded = member
                break  # a new arrangement of all is found sooner than a place in this one
            boxes += box
        else:
            return
    message = f"found no place without overlap for copy {crowded.copy + 1} in {ROUNDS} arrangements of {MAX_TRIES} "
    message += "tries. Draw places from a larger region, smaller items or a lower count."
    raise ConfigError(document.issue((*_ITEMS, crowded.item), message, "key"))


def _free_box(
    document: Document,
    member: Member,
    boxes: Sequence[Box | None],
    first_try: int,
    redraw: Redraw,
    measure: Measure,
    config_of: Callable[[Document], Config],
) -> list[Box | None]:
    """Place one member apart from boxes; return its box alone, or nothing where no try finds a place."""
    items = _items(document.tree)
    for attempt in range(first_try, first_try + MAX_TRIES):
        if attempt:
            items[member.at] = redraw(member.item, member.copy, attempt)
            _taken(items[member.at])
        box = measure(config_of(document).scene.hidden_geometry[member.at])
        if member.floor is not None:
            box = _lifted(items[member.at], box, member)
        if not member.no_overlap or not any(_overlap(box, other) for other in boxes):
            return [box]
    return []


def _issues(item: dict[str, Any], path: KeyPath) -> Iterator[ValidationIssue]:
    count, floor = item.get("count", 1), item.get("on_floor")
    if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= MAX_COPIES:
        yield ValidationIssue((*path, "count"), mismatch(count, f"an integer from 0 to {MAX_COPIES}"))
    if not isinstance(item.get("no_overlap", False), bool):
        yield ValidationIssue((*path, "no_overlap"), mismatch(item["no_overlap"], "true or false"))
    if floor is not None and as_finite(floor) is None:
        yield ValidationIssue((*path, "on_floor"), mismatch(floor, "a height [m], or null"))
    if floor is not None and item.get("type") in ("room", "mitsuba"):
        yield ValidationIssue(
            (*path, "on_floor"), f"is not for {item['type']}, which has no place of its own; remove it."
        )


def _taken(item: Any) -> tuple[int, bool, float | None]:
    """Take the keys of a family out of a raw item; one that is no mapping, a mistake, has none."""
    if not isinstance(item, dict):
        return 1, False, None
    count, no_overlap, floor = (
        item.pop(key, default) for key, default in zip(FAMILY_KEYS, (1, False, None), strict=True)
    )
    return count, no_overlap, floor


def _lifted(item: dict[str, Any], box: Box | None, member: Member) -> Box:
    """Move a raw item up or down so that its box stands on the floor, and return the box then."""
    key = next((key for key in PLACES if key in item), "translate" if item.get("type") == "mesh" else None)
    if box is None or member.floor is None or key is None:
        raise ValueError(f"{item.get('type')} cannot stand on a floor")  # refused by ``_issues``
    rise = member.floor + FLOOR_GAP - float(box[0][_UP])
    place = [float(number) for number in item.get(key, (0.0, 0.0, 0.0))]
    place[_UP] += rise
    item[key] = place
    low, high = ([*map(float, corner)] for corner in box)
    low[_UP] += rise
    high[_UP] += rise
    return low, high


def _overlap(box: Box | None, other: Box | None) -> bool:
    if box is None or other is None:
        return False
    return all(box[0][x] < other[1][x] - _SLACK and other[0][x] < box[1][x] - _SLACK for x in range(3))


def _items(tree: Any) -> list[Any]:
    scene = tree.get("scene") if isinstance(tree, dict) else None
    items = scene.get("hidden_geometry") if isinstance(scene, dict) else None
    return items if isinstance(items, list) else []
