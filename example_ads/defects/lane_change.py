"""Defects in how a driver changes lanes: it does not look, or not everywhere."""

from __future__ import annotations

from typing import Any

from .driver import Driver


class LooksOnlyAhead(Driver):
    """Checks the vehicle ahead in the lane that it enters, and never the one behind.

    Why it happens: there is no rear sensor, or the check of the follower was left for later since all tests had
    traffic in front only.
    """

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """Nobody behind in other lanes."""
        return ahead, behind if lane_index == self.lane_index else None


class ChangesLanesUnchecked(Driver):
    """Every eight seconds it changes lanes without looking; in between it looks.

    Why it happens: the route demands a lane change, and when its timer runs out the wish overrules the check.
    """

    SECONDS = 8.0

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._due = self.SECONDS

    def mobil(self, lane_index: Any) -> bool:
        """MOBIL, unless the time has come."""
        if self.clock < self._due:
            return bool(super().mobil(lane_index))
        self._due += self.SECONDS
        return True


class TrustsAnyGapBehind(Driver):
    """Takes 1.5 m to the one behind in the lane that it enters for enough, however fast that one is.

    Why it happens: the check of the gap was written for a queue, where all drive alike, and knows no speeds.
    """

    ENOUGH = 1.5

    def neighbours(self, lane_index: Any, ahead: Any, behind: Any) -> tuple[Any, Any]:
        """In other lanes only the one behind that is too near even for a queue."""
        if lane_index == self.lane_index or behind is None:
            return ahead, behind
        gap = -self.relative(behind)[0] - self.LENGTH
        return ahead, behind if gap < self.ENOUGH else None
