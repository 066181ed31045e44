"""What holds for the whole session, the same in the controller and in each worker of pytest-xdist."""

from __future__ import annotations

import difflib
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path

import pytest

from pytest_pafot.campaign.options import OPTIONS, OptionError, Settings
from pytest_pafot.corpus.layout import chosen_folder, corpus_root, link_below
from pytest_pafot.corpus.saved import refusal
from pytest_pafot.plugin.option_sources import resolve
from pytest_pafot.text import plural

LOG_SECONDS = 10.0  # how often a search reports its progress where nobody looks at a terminal [s]


HERE = "PAFOT_REPLAY_HERE"
"""Set in the environment of a session that was started to replay a file in its own process."""


def terminal_width() -> int:
    """Columns of the terminal, as pytest counts them."""
    columns = shutil.get_terminal_size((80, 24)).columns
    return columns if columns >= 40 else 80


@dataclass(slots=True, kw_only=True)
class Shared:
    """Values that the controller decides and every worker uses, at first those of a session that begins now."""

    fresh_seed: int = field(default_factory=lambda: int.from_bytes(os.urandom(4), "big"))  # base seed if none is given
    progress_seconds: float = field(default_factory=lambda: LOG_SECONDS)  # between two reports of progress
    width: int = field(default_factory=terminal_width)  # in columns, which a worker cannot ask
    began: float = field(default_factory=time.monotonic)  # when the session did, by the clock of this process [s]
    # The day by which last days of accepted failures are held, as text, which a worker can be sent
    today: str = field(default_factory=lambda: date.today().isoformat())
    # node ids of the saved scenarios that the first workers collected; a worker that replaces a crashed one collects
    # these and no files that were written since. None before
    frozen: frozenset[str] | None = None
    begun: set[str] = field(default_factory=set)  # node ids of the searches that this process has begun


@dataclass(frozen=True, slots=True)
class SummaryLines:
    """Lines for the summary of the session, on the controller."""

    problems: list[str] = field(default_factory=list)  # anything that went wrong beside the tests
    reports: list[str] = field(default_factory=list)  # where reports are

    @contextmanager
    def faults(self, work: str) -> Iterator[None]:
        """Tell of a fault in work at the end of a session, where pytest would lose the texts of all failures by it.

        An interrupt ends the work, which is given in a few words, and not the session, which ends by itself.
        """
        try:
            yield
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (whatever it is, the summary says so)
            self.problems.append(f"{work}: {type(error).__name__}: {error}")


SHARED = pytest.StashKey[Shared]()
SUMMARY_LINES = pytest.StashKey[SummaryLines]()


def base_line(config: pytest.Config) -> str:
    """The profile and the base seed of searches whose mark gives none, in one line; empty when none runs."""
    try:
        settings = resolve(config, {}, config.stash[SHARED].fresh_seed)
    except OptionError as error:
        return str(error)
    if not settings.is_search:
        return ""
    return f"profile {settings.profile}, base seed {settings.seed} (repeat with --pafot-seed={settings.seed})"


def records_folder(item: pytest.Item, settings: Settings) -> Path:
    """A folder in pytest's cache, which no repository keeps; without a cache the corpus.

    Where a link is on the way it is that, which is refused as a folder of records.
    """
    cached = _cached_folder(item.config)
    if cached is not None:
        return cached
    corpus = corpus_root(item.path, settings.corpus, item.config.rootpath)
    return link_below(chosen_folder(item.path, settings.corpus), corpus) or corpus


def misspelt(environ: Mapping[str, str]) -> list[str]:
    """Which variables have nearly the name of one that is read; those of other names may be somebody's own."""
    read = [*(option.variable for option in OPTIONS if option.everywhere), HERE, "PAFOT_KERNEL"]
    # Compared without what all begin with, by which any two would be near
    known = {name.removeprefix("PAFOT_"): name for name in read}
    others = sorted(name for name in environ if name.startswith("PAFOT_") and name not in read)
    near = {name: difflib.get_close_matches(name.removeprefix("PAFOT_"), known, n=1) for name in others}
    return [
        f"environment variable {name}: expected the variable of an option, received a name that nothing reads; "
        f"did you mean {known[found[0]]}?"
        for name, found in near.items()
        if found
    ]


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
    own = [
        f"a process (pid {each.pid}) died while {each.owner or 'an unknown test'} ran {each.scenario or 'a scenario'}; "
        f"that test takes it up when it runs, or delete {each.path}"
        for each in found
        if each.is_own
    ]
    others = [each.path for each in found if not each.is_own]
    if others:
        own.append(
            f"{others[0]}: expected a record that this user made on this machine, received "
            f"{plural(len(others), 'record')} from elsewhere or from before a restart; they are ignored: delete them"
        )
    return own


def refused_output(config: pytest.Config, name: str, folder: Path) -> str:
    """Return why an output of a relative name is not written, or an empty text: links may come with a checkout."""
    link = None if os.path.isabs(name) else link_below(config.rootpath, folder)  # noqa: PTH117  (a text of the user)
    return "" if link is None else refusal(link)


def _cached_folder(config: pytest.Config) -> Path | None:
    try:
        link = link_below(config.rootpath, config.rootpath / config.getini("cache_dir") / "d" / "pafot")
        return link or Path(config.cache.mkdir("pafot"))
    # No cache plugin, or a read-only checkout: the record itself says what is wrong.
    except (AttributeError, ValueError, OSError):
        return None
