"""When a search must end: after its own limit of time, or after its share of the session's."""

from __future__ import annotations

import math
from typing import NamedTuple

from pytest_pafot.campaign.options import BY_NAME, Settings


class TimeLimit(NamedTuple):
    """A moment, and the option that it comes from.

    Attributes:
        flag: of the option, for what is told of a search that this cuts.
        until: the moment [s], by the clock of the search; infinite without a limit.
    """

    flag: str
    until: float


def time_limit(settings: Settings, *, now: float, began: float, left: int) -> TimeLimit:
    """The limit of a search that begins now, whichever comes first.

    Args:
        settings: of the search.
        now: the moment [s].
        began: the moment at which the session began [s].
        left: searches that this process has yet to run, this one included; each gets as much of the session's time.
    """
    own = TimeLimit(BY_NAME["max_time"].flag, now + (math.inf if settings.max_time is None else settings.max_time))
    if settings.total_time is None:
        return own
    share = max(0.0, began + settings.total_time - now) / left
    return min(own, TimeLimit(BY_NAME["total_time"].flag, now + share), key=lambda limit: limit.until)
