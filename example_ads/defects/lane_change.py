"""Drivers that change lanes without checking all vehicles in the new lane."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class LooksOnlyAhead(Driver):
    """A driver that checks the vehicle ahead in the lane that it enters, but never the vehicle behind.

    Why it happens: there is no rear sensor, or the rear check was postponed because no test had traffic behind.
    """

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Return the vehicles ahead and behind, but none behind in another lane."""
        return ahead, behind if lane_index == self.lane_index else None


class ChangesLanesUnchecked(Driver):
    """A driver that changes lanes without looking every eight seconds. Its other lane changes are healthy.

    Why it happens: the route requires a lane change, and when a timer expires, this request overrides the check.
    """

    SECONDS = 8.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._due = self.SECONDS

    def mobil(self, lane_index: Any) -> bool:
        """Return MOBIL's decision or, every eight seconds, True."""
        if self.clock < self._due:
            return bool(super().mobil(lane_index))
        self._due += self.SECONDS
        return True


class TrustsAnyGapBehind(Driver):
    """A driver that accepts a gap of 1.5 m to the vehicle behind in the lane that it enters, at any speed.

    Why it happens: the check of the gap ignores speeds, because it was written for queues.
    """

    ENOUGH = 1.5

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Return the vehicles ahead and behind. In another lane, a vehicle behind counts only if it is very near."""
        if lane_index == self.lane_index or behind is None:
            return ahead, behind
        gap = -self.relative(behind)[0] - self.LENGTH
        return ahead, behind if gap < self.ENOUGH else None
