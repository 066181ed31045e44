"""What must be right before an item runs, checked before its fixtures."""

from __future__ import annotations

from collections.abc import Generator
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.plugin.collection import is_search
from pytest_pafot.plugin.marks import ANY_MARK, DEFAULT_ADS, DEFAULT_ARG, arguments_of
from pytest_pafot.plugin.session import SHARED

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request

REQUEST: pytest.StashKey[Request] = pytest.StashKey()


class Checks:
    """Hooks that turn whatever is wrong with a marked item into its own failure."""

    # Neither tryfirst nor trylast: after the skip marks are looked at, before pytest sets the fixtures up.
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Refuse an item that cannot run as it is written; skip a search without generations."""
        # Not hidden: pytest 9 adds a line on hidden frames to a failure that has no other frame.
        arguments = arguments_of(item)
        if arguments is None:
            _refuse_raw_mark(item)
            return
        from pytest_pafot.campaign.request import RequestError  # noqa: PLC0415
        from pytest_pafot.plugin.crash_folder import left_behind  # noqa: PLC0415
        from pytest_pafot.plugin.refusals import checked  # noqa: PLC0415

        problem = ""
        try:
            request = checked(item, arguments)
        except RequestError as error:
            problem = str(error)
        if problem:  # Outside of the handler, so that the same is not shown twice.
            pytest.fail(problem, pytrace=False)
        item.stash[REQUEST] = request
        if is_search(item) and request.settings.generations == 0 and not left_behind(item, request):
            pytest.skip("replay only: --pafot-generations=0")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Say what to do where the fixture of the ADS does not exist."""
        report = yield
        request = item.stash.get(REQUEST, None)
        if request is None or call.when != "setup" or call.excinfo is None:
            return report
        error = call.excinfo.value
        if isinstance(error, pytest.FixtureLookupError) and error.argname in (request.ads, DEFAULT_ADS):
            from pytest_pafot.plugin.refusals import missing_ads  # noqa: PLC0415

            told = getattr(report.longrepr, "errorstring", "")
            available = told.partition("available fixtures: ")[2].partition("\n")[0].split(", ")
            report.longrepr = missing_ads(str(error.argname), available, item.config.stash[SHARED].width)
        return report


def _refuse_raw_mark(item: pytest.Item) -> None:
    """The mark by which pytest selects searched tests makes none: that is the decorator's work."""
    names = getattr(item, "fixturenames", ())
    if item.get_closest_marker(ANY_MARK) is not None and DEFAULT_ARG in names:
        pytest.fail(
            f"expected the decorator @pafot.search, received the mark @pytest.mark.{ANY_MARK}, which only "
            f"selects tests, as in `pytest -m {ANY_MARK}`; write `import pytest_pafot as pafot` and @pafot.search(...)",
            pytrace=False,
        )
