"""Running an item: a search calls the test function for each simulated run, a replay for one."""

from __future__ import annotations

import pytest

from pytest_pafot.plugin.collection import is_search, saved_of
from pytest_pafot.plugin.item_checks import REQUEST
from pytest_pafot.plugin.item_properties import set_of_saved
from pytest_pafot.plugin.merge_item import MERGES, run_merge
from pytest_pafot.plugin.session import SHARED


class Execution:
    """The hooks that run items and call test functions."""

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        """Count searches that begin, whether they are skipped or not: they no longer wait for their time.

        What an item of a saved scenario is called and where it lies is known whatever becomes of it.
        """
        saved = saved_of(item)
        if saved is not None:
            set_of_saved(item, saved)
        if is_search(item):
            item.config.stash[SHARED].begun.add(item.nodeid)

    @pytest.hookimpl(tryfirst=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> bool | None:
        """Search, merge or replay in place of the one call that pytest would make."""
        request = pyfuncitem.stash.get(REQUEST, None)
        if request is None:
            return None
        from pytest_pafot.campaign.request import RequestError  # noqa: PLC0415
        from pytest_pafot.plugin.replay_item import run_replay  # noqa: PLC0415
        from pytest_pafot.plugin.search_item import run_search  # noqa: PLC0415
        from pytest_pafot.plugin.stuck_ads import session_ends_if_stuck  # noqa: PLC0415

        saved = saved_of(pyfuncitem)
        try:
            with session_ends_if_stuck(pyfuncitem):
                if MERGES in pyfuncitem.config.stash:
                    run_merge(pyfuncitem, request)
                elif saved is None:
                    run_search(pyfuncitem, request)
                else:
                    run_replay(pyfuncitem, request, saved)
        except RequestError as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        return True
