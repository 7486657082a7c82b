"""The one definition of a bounce.

Bounce k is the k-th surface interaction between laser and sensor, the relay wall's two included:

- bounce 2: laser point -> sensor point, straight (zero on a planar wall);
- bounce 3: wall, hidden surface, wall ("third bounce");
- bounce k: k - 2 further interactions between the laser point and the sensor point.

Z-NLOS files keep six bounce indices: index i holds bounce i + 2, and the last one everything above.

Line-of-sight captures count surface interactions alone: bounce 0 is an emitter seen directly, and index i of their
files holds bounce i.
"""

from __future__ import annotations

from dataclasses import dataclass

LINE_OF_SIGHT = "line_of_sight"  # the scan type without relay wall
FIRST_BOUNCE = 2  # a path has at least the laser point and the sensor point
THIRD_BOUNCE = 3
FILE_BOUNCES = 6  # length of the bounce axis of a Z-NLOS file
LAST_FILE_BOUNCE = FIRST_BOUNCE + FILE_BOUNCES - 1  # 7: bounces above it add into its index


@dataclass(frozen=True)
class BounceAxis:
    """The bounces a render computes and the index on the bounce axis each one is added to.

    Parameters
    ----------
    max_bounces
        Highest bounce computed, >= 2; None for no limit.
    split
        Give each bounce its own index; otherwise the axis has a single index that holds their sum.
    first
        Lowest bounce there is: 2, or 0 for line-of-sight captures.
    """

    max_bounces: int | None
    split: bool
    first: int = FIRST_BOUNCE

    @property
    def n_slots(self) -> int:
        """Length of the in-memory bounce axis."""
        if not self.split:
            return 1
        last = self.first + FILE_BOUNCES - 1
        highest = last if self.max_bounces is None else min(self.max_bounces, last)
        return highest - self.first + 1

    def slot(self, bounce: int) -> int:
        """Return the index of ``bounce`` on the in-memory bounce axis.

        Raises
        ------
        ValueError
            ``bounce`` is below the first.
        """
        if bounce < self.first:
            raise ValueError(f"bounce {bounce}: a path has at least {self.first} interactions")
        return min(bounce - self.first, self.n_slots - 1)

    @property
    def file_indices(self) -> tuple[int, ...]:
        """Return, for each in-memory slot, its index on the bounce axis of a Z-NLOS file.

        Unsplit light goes to index 1, the third bounce's, where every loader looks.
        """
        return tuple(range(self.n_slots)) if self.split else (THIRD_BOUNCE - FIRST_BOUNCE,)

    def name(self, slot: int) -> str:
        """Return what an in-memory slot holds: a bounce number, "7 and above", or "all"."""
        if not self.split:
            return "all"
        bounce = slot + self.first
        has_more = self.max_bounces is None or self.max_bounces > bounce
        last = slot == FILE_BOUNCES - 1
        return f"{bounce} and above" if last and has_more else str(bounce)


def first_bounce_of(scan_type: str) -> int:
    """Return the lowest bounce of a scan type, which index 0 of a file holds."""
    return 0 if scan_type == LINE_OF_SIGHT else FIRST_BOUNCE
