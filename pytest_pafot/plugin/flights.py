"""Records of the scenario in flight: where they lie, and what a process that died has left behind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.plugin import places
from pytest_pafot.plugin.marks import SAVED_MARK

if TYPE_CHECKING:
    from pytest_pafot.findings.inflight import Leftover
    from pytest_pafot.plugin.request import Request

FOLDER = "pafot"


def flight_folder(item: pytest.Item, request: Request) -> Path:
    """In pytest's cache, which no repository keeps; without a cache in the corpus."""
    cache = getattr(item.config, "cache", None)
    try:
        if cache is not None:
            return Path(cache.mkdir(FOLDER))
    except OSError:
        pass  # A read-only checkout: the record itself will say that it cannot be written.
    return places.corpus_root(item.path, request.settings.corpus, item.config.rootpath)


def left_behind(item: pytest.Item, request: Request, owner: str = "") -> list[Leftover]:
    """What was in flight for an item when a process died.

    Args:
        item: of this session.
        request: the item's.
        owner: of the records; without it the item's own.
    """
    folder = flight_folder(item, request)
    if not folder.is_dir() or not any(folder.iterdir()):
        return []
    from pytest_pafot.findings.inflight import InFlightError, leftovers  # noqa: PLC0415

    owner = owner or owner_of(item)
    try:
        return [leftover for leftover in leftovers(folder) if leftover.owner == owner]
    except InFlightError:
        return []  # Writing a record into the same folder fails as well, and says so.


def owner_of(item: pytest.Item) -> str:
    """Under which name an item's records are kept: the same for a search in each session."""
    return item.nodeid if item.get_closest_marker(SAVED_MARK) else places.base_id(item)
