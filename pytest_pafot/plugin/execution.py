"""Running an item: a search calls the test function for each simulated run, a replay for one."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.plugin.collection import is_search, saved_of
from pytest_pafot.plugin.item_checks import REQUEST
from pytest_pafot.plugin.session import SHARED

if TYPE_CHECKING:
    from pytest_pafot.campaign.harness import Bench
    from pytest_pafot.campaign.request import Request


class Execution:
    """The hooks that run items and call test functions."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        """Count searches that begin, whether they are skipped or not: they no longer wait for their time."""
        if is_search(item):
            item.config.stash[SHARED].begun.add(item.nodeid)

    @pytest.hookimpl(tryfirst=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> bool | None:
        """Search or replay in place of the one call that pytest would make."""
        request = pyfuncitem.stash.get(REQUEST, None)
        if request is None:
            return None
        from pytest_pafot.campaign.request import RequestError  # noqa: PLC0415

        problem = ""
        try:
            _run(pyfuncitem, request)
        except RequestError as error:
            problem = str(error)
        if problem:  # Outside of the handler, so that the same is not shown twice.
            pytest.fail(problem, pytrace=False)
        return True


def item_seed(base_seed: int, base_id: str) -> int:
    """The seed of a search: a function of the base seed and the node id, the same in every process."""
    import hashlib  # noqa: PLC0415

    digest = hashlib.sha256(f"{base_seed}:{base_id}".encode()).digest()
    return int.from_bytes(digest[:4], "big")


def _run(item: pytest.Function, request: Request) -> None:
    __tracebackhide__ = True
    from pytest_pafot.campaign.harness import Bench  # noqa: PLC0415
    from pytest_pafot.plugin.last_resort import seen_to  # noqa: PLC0415

    saved = saved_of(item)
    with seen_to(item):
        if saved is None:
            _search(Bench.of(item, request), request)
            return
        from pytest_pafot.campaign.replays import replay  # noqa: PLC0415

        replay(item, request, saved)


def _search(bench: Bench, request: Request) -> None:
    __tracebackhide__ = True
    from pytest_pafot.plugin import node_ids  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import AFTER_A_DEATH, Searching, isolated_after_a_death  # noqa: PLC0415

    seed = item_seed(request.settings.seed, node_ids.base_id(bench.item))
    chosen = isolated_after_a_death(bench)
    notes = [] if chosen is bench else [AFTER_A_DEATH]
    Searching(bench=chosen, seed=seed, clock=time.monotonic, notes=notes).run()
