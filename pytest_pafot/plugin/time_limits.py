"""When a search must end: after its own limit of time, or after its share of the session's."""

from __future__ import annotations

import math

import pytest

from pytest_pafot.campaign.options import BY_NAME, Settings
from pytest_pafot.campaign.search import TimeLimit
from pytest_pafot.plugin.collection import is_search
from pytest_pafot.plugin.session import SHARED


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


def searches_left(item: pytest.Item) -> int:
    """Searches that this process has yet to run, that of the item included.

    A worker of pytest-xdist does not know which searches the others run: it counts on as many as they.
    """
    searches = sum(map(is_search, item.session.items))
    workers: int = getattr(item.config, "workerinput", {}).get("workercount", 1)
    begun = item.config.stash[SHARED].begun - {item.nodeid}
    return max(1, math.ceil(searches / workers) - len(begun))
