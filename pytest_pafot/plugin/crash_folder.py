"""Crash records: where they lie, and what a process that died has left behind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.corpus import layout
from pytest_pafot.plugin import node_ids
from pytest_pafot.plugin.marks import SAVED_MARK

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request
    from pytest_pafot.execution.crash_records import Leftover

FOLDER = "pafot"


def records_folder(item: pytest.Item, request: Request) -> Path:
    """In pytest's cache, which no repository keeps; without a cache in the corpus."""
    cached = _cached_folder(item.config)
    return cached or layout.corpus_root(item.path, request.settings.corpus, item.config.rootpath)


def unclaimed(config: pytest.Config) -> list[str]:
    """What died processes have left behind that no test of this session took up."""
    folder = _cached_folder(config)
    if folder is None or _is_empty(folder):
        return []
    from pytest_pafot.execution.crash_records import CrashRecordError, leftovers  # noqa: PLC0415

    try:
        found = leftovers(folder)
    except CrashRecordError as error:
        return [str(error)]
    return [
        f"a process (pid {each.pid}) died while {each.owner or 'an unknown test'} ran {each.scenario or 'a scenario'}; "
        f"that test takes it up when it runs, or delete {each.path}"
        for each in found
    ]


def left_behind(item: pytest.Item, request: Request, owner: str = "") -> list[Leftover]:
    """What was in flight for an item when a process died.

    Args:
        item: of this session.
        request: the item's.
        owner: of the records; without it the item's own.
    """
    folder = records_folder(item, request)
    if _is_empty(folder):
        return []
    from pytest_pafot.execution.crash_records import left_by  # noqa: PLC0415

    return left_by(owner or owner_of(item), folder)


def _is_empty(folder: Path) -> bool:
    """Whether there is certainly no record: told without what reads them, which a session may never need."""
    try:
        return not any(folder.iterdir())
    except FileNotFoundError:
        return True
    except OSError:
        return False  # Whoever reads it says what is wrong with it.


def _cached_folder(config: pytest.Config) -> Path | None:
    cache = getattr(config, "cache", None)
    if cache is None:
        return None
    try:
        return Path(cache.mkdir(FOLDER))
    except OSError:
        return None  # A read-only checkout: the record itself will say that it cannot be written.


def owner_of(item: pytest.Item) -> str:
    """Under which name an item's records are kept: the same for a search in each session."""
    return item.nodeid if item.get_closest_marker(SAVED_MARK) else node_ids.base_id(item)
