"""What holds for the whole session: the fresh base seed, and what xdist workers must share with it."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

WORKER_KEY = "pafot"
SAVED_PART = "saved-"
SEARCH_PART = "search"

TERMINAL_SECONDS, LOG_SECONDS = 0.25, 10.0
"""How often a search reports its progress, on a terminal and in a log."""


@dataclass(slots=True, kw_only=True)
class Shared:
    """Values that the controller decides and every worker uses.

    Attributes:
        fresh_seed: base seed where no option gives one.
        progress_seconds: between two reports of progress.
        frozen: node ids of the saved scenarios that the first workers collected; a worker that replaces a crashed
            one collects these and no files that were written since. None before.
    """

    fresh_seed: int
    progress_seconds: float
    frozen: frozenset[str] | None = None

    def to_plain(self) -> dict[str, Any]:
        """For xdist's worker input, which takes plain data only."""
        frozen = None if self.frozen is None else sorted(self.frozen)
        return {"fresh_seed": self.fresh_seed, "progress_seconds": self.progress_seconds, "frozen": frozen}


@dataclass(slots=True)
class Explicit:
    """Corpus files that were given on the command line.

    Attributes:
        files: resolved paths.
        modules: test files that are collected for their sake alone.
    """

    files: set[Path] = field(default_factory=set)
    modules: set[Path] = field(default_factory=set)


SHARED = pytest.StashKey[Shared]()
EXPLICIT = pytest.StashKey[Explicit]()


def is_worker(config: pytest.Config) -> bool:
    """Whether this process is a worker of pytest-xdist."""
    return hasattr(config, "workerinput")


def start(config: pytest.Config) -> None:
    """Decide the shared values, or take over the controller's."""
    received = getattr(config, "workerinput", {}).get(WORKER_KEY)
    if received is None:
        config.stash[SHARED] = Shared(fresh_seed=int.from_bytes(os.urandom(4), "big"), progress_seconds=LOG_SECONDS)
        return
    frozen = received["frozen"]
    config.stash[SHARED] = Shared(
        fresh_seed=received["fresh_seed"],
        progress_seconds=received["progress_seconds"],
        frozen=None if frozen is None else frozenset(frozen),
    )


class Sharing:
    """Hooks of pytest-xdist, on the controller."""

    def __init__(self, config: pytest.Config) -> None:
        self._shared = config.stash[SHARED]

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Give a worker what it shares with this session."""
        node.workerinput[WORKER_KEY] = self._shared.to_plain()

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Remember which saved scenarios the first workers collected."""
        if self._shared.frozen is None:
            self._shared.frozen = frozenset(node_id for node_id in ids if SAVED_PART in node_id)
