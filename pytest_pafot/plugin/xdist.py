"""What the controller and the workers of pytest-xdist tell each other when a worker starts and when it ends.

What they tell while items run are messages, like those of a session without workers.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot.plugin.node_ids import SAVED_PART
from pytest_pafot.plugin.orphans import UNRUN
from pytest_pafot.plugin.session import SHARED, Shared

KEY = "pafot"  # of what this plugin adds to the input and the output of a worker


def is_worker(config: pytest.Config) -> bool:
    """Whether this process is a worker."""
    return hasattr(config, "workerinput")


def shared_by_controller(config: pytest.Config) -> Shared:
    """What the controller of a worker has decided."""
    # The wall clock is the one that both have; should it have been set back since, the session begins now.
    values = config.workerinput[KEY]  # type: ignore[attr-defined]
    return Shared(**values | {"began": time.monotonic() - max(0.0, time.time() - values["began"])})


class Controller:
    """Hooks of the controller."""

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Give a worker what it shares with this session, as plain data."""
        shared = node.config.stash[SHARED]
        node.workerinput[KEY] = asdict(shared) | {"began": time.time() - (time.monotonic() - shared.began)}

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, node: Any, ids: list[str]) -> None:
        """Remember which saved scenarios the first workers collected."""
        shared = node.config.stash[SHARED]
        if shared.frozen is None:
            # Under --dist=loadgroup the name of the group is appended.
            names = (node_id[: node_id.rfind("]") + 1] for node_id in ids)
            shared.frozen = frozenset(name for name in names if SAVED_PART in name)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any, error: object) -> None:
        """Take what a worker collected and no item runs."""
        told = getattr(node, "workeroutput", {}).get(KEY)
        if told is None:  # It died.
            return
        orphans, strays, unmerged = json.loads(told)
        unrun = node.config.stash[UNRUN]
        unrun.orphans.update((Path(folder), list(map(Path, files))) for folder, files in orphans.items())
        unrun.strays.update(strays)
        unrun.unmerged.update(unmerged)


class Worker:
    """Hooks of a worker."""

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Hand over what this worker collected and no item runs.

        It is JSON in ASCII: pytest-xdist sends no text with bytes in it that are no characters, as names of files may
        have, and replaces a worker that tries to by one that tries the same.
        """
        unrun = session.config.stash[UNRUN]
        orphans = {str(folder): list(map(str, files)) for folder, files in unrun.orphans.items()}
        told = json.dumps((orphans, unrun.strays, unrun.unmerged))
        session.config.workeroutput[KEY] = told  # type: ignore[attr-defined]
