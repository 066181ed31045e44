"""What holds for the whole session: the fresh base seed, and what xdist workers must share with it."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

WORKER_KEY = "pafot"
SAVED_PART = "saved-"
SEARCH_PART = "search"

TERMINAL_SECONDS, LOG_SECONDS = 0.25, 10.0
"""How often a search reports its progress, on a terminal and in a log."""


class Shared:
    """Values that the controller decides and every worker uses.

    Attributes:
        fresh_seed: base seed where no option gives one.
        progress_seconds: between two reports of progress.
        width: of the terminal, in columns, which a worker cannot ask.
        began: when the session did, by ``time.monotonic`` of this process [s].
        begun: node ids of the searches that this process has begun.
        frozen: node ids of the saved scenarios that the first workers collected; a worker that replaces a crashed
            one collects these and no files that were written since. None before.
    """

    def __init__(
        self,
        *,
        fresh_seed: int,
        progress_seconds: float,
        width: int,
        began: float,
        frozen: frozenset[str] | None = None,
    ) -> None:
        self.fresh_seed = fresh_seed
        self.progress_seconds = progress_seconds
        self.width = width
        self.began = began
        self.begun: set[str] = set()
        self.frozen = frozen


class Explicit:
    """Corpus files that were given on the command line.

    Attributes:
        files: resolved paths.
        modules: test files that are collected for their sake alone.
    """

    def __init__(self) -> None:
        self.files: set[Path] = set()
        self.modules: set[Path] = set()


class Seen:
    """What a session collected, before any selection.

    Attributes:
        folders: corpus folders of the items.
        roots: corpora of the items, with the folder of the test files that each serves.
        classes: node ids of the classes that exist in collected places.
        opened: node ids of the classes whose members were collected.
    """

    def __init__(self) -> None:
        self.folders: set[Path] = set()
        self.roots: dict[Path, Path] = {}
        self.classes: set[str] = set()
        self.opened: set[str] = set()


SHARED = pytest.StashKey[Shared]()
EXPLICIT = pytest.StashKey[Explicit]()


def terminal_width() -> int:
    """Columns of the terminal, as pytest counts them."""
    columns = shutil.get_terminal_size((80, 24)).columns
    return columns if columns >= 40 else 80


def is_worker(config: pytest.Config) -> bool:
    """Whether this process is a worker of pytest-xdist."""
    return hasattr(config, "workerinput")


def base_line(config: pytest.Config) -> str:
    """The profile and the base seed of searches whose mark gives none, in one line; empty when none runs."""
    from pytest_pafot.campaign.options import OptionError  # noqa: PLC0415
    from pytest_pafot.plugin.options import resolve  # noqa: PLC0415

    try:
        settings = resolve(config, {}, config.stash[SHARED].fresh_seed)
    except OptionError as error:
        return str(error)
    if settings.generations == 0:
        return ""
    return f"profile {settings.profile}, base seed {settings.seed} (repeat with --pafot-seed={settings.seed})"


def start(config: pytest.Config) -> None:
    """Decide the shared values, or take over the controller's."""
    received = getattr(config, "workerinput", {}).get(WORKER_KEY)
    if received is None:
        config.stash[SHARED] = Shared(
            fresh_seed=int.from_bytes(os.urandom(4), "big"),
            progress_seconds=LOG_SECONDS,
            width=terminal_width(),
            began=time.monotonic(),
        )
        return
    frozen = received["frozen"]
    config.stash[SHARED] = Shared(
        fresh_seed=received["fresh_seed"],
        progress_seconds=received["progress_seconds"],
        width=received["width"],
        began=time.monotonic() - max(0.0, time.time() - received["began"]),
        frozen=None if frozen is None else frozenset(frozen),
    )


class Sharing:
    """Hooks of pytest-xdist, on the controller."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Give a worker what it shares with this session, as plain data."""
        shared = self._config.stash[SHARED]
        node.workerinput[WORKER_KEY] = {
            "fresh_seed": shared.fresh_seed,
            "progress_seconds": shared.progress_seconds,
            "width": shared.width,
            "began": time.time() - (time.monotonic() - shared.began),  # a clock that another process has too
            "frozen": None if shared.frozen is None else sorted(shared.frozen),
        }

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Remember which saved scenarios the first workers collected."""
        shared = self._config.stash[SHARED]
        if shared.frozen is None:
            # Under --dist=loadgroup the name of the group is appended.
            names = (node_id[: node_id.rfind("]") + 1] for node_id in ids)
            shared.frozen = frozenset(name for name in names if SAVED_PART in name)
