"""Where the crash records of a project lie, and what processes that died have left there for nobody."""

from __future__ import annotations

from pathlib import Path

import pytest

from pytest_pafot.campaign.options import Settings
from pytest_pafot.corpus.layout import corpus_root


def records_folder(item: pytest.Item, settings: Settings) -> Path:
    """A folder in pytest's cache, which no repository keeps; without a cache the corpus."""
    return _cached_folder(item.config) or corpus_root(item.path, settings.corpus, item.config.rootpath)


def unclaimed(config: pytest.Config) -> list[str]:
    """What died processes have left behind that no test of this session took up."""
    folder = _cached_folder(config)
    if folder is None:
        return []
    from pytest_pafot.execution.crash_records import CrashRecordError, leftovers  # noqa: PLC0415  (imports numpy)

    try:
        found = leftovers(folder)
    except CrashRecordError as error:
        return [str(error)]
    return [
        f"a process (pid {each.pid}) died while {each.owner or 'an unknown test'} ran {each.scenario or 'a scenario'}; "
        f"that test takes it up when it runs, or delete {each.path}"
        for each in found
    ]


def _cached_folder(config: pytest.Config) -> Path | None:
    try:
        return Path(config.cache.mkdir("pafot"))
    except (AttributeError, OSError):  # No cache plugin, or a read-only checkout: the record itself says what is wrong.
        return None
