"""Defects in how a driver changes lanes: it does not look, or not everywhere."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class LooksOnlyAhead(Driver):
    """A driver that checks the vehicle ahead in the lane that it enters, but never the one behind.

    Why it happens: there is no rear sensor, or the check of the follower was postponed because all tests had traffic
    only in front.
    """

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Return no vehicle behind in other lanes."""
        return ahead, behind if lane_index == self.lane_index else None


class ChangesLanesUnchecked(Driver):
    """A driver that changes lanes without looking every eight seconds; in between it looks.

    Why it happens: the route requires a lane change, and when its timer expires, the request overrides the check.
    """

    SECONDS = 8.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._due = self.SECONDS

    def mobil(self, lane_index: Any) -> bool:
        """Return the decision of MOBIL, or True every eight seconds."""
        if self.clock < self._due:
            return bool(super().mobil(lane_index))
        self._due += self.SECONDS
        return True


class TrustsAnyGapBehind(Driver):
    """A driver that accepts a gap of 1.5 m to the follower in the lane that it enters, however fast that one is.

    Why it happens: the check of the gap was written for a queue, where all vehicles drive alike, and ignores speeds.
    """

    ENOUGH = 1.5

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Return a vehicle behind in another lane only if it is too near even for a queue."""
        if lane_index == self.lane_index or behind is None:
            return ahead, behind
        gap = -self.relative(behind)[0] - self.LENGTH
        return ahead, behind if gap < self.ENOUGH else None
