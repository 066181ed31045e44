"""The pytest session of another revision: it sets up the fixtures of a test there, and drives the test's policy."""

from __future__ import annotations

import os
import sys
from collections.abc import Generator, Mapping
from typing import Any

import pytest

from pytest_pafot.extending import Policy, policy_of, searched_test
from pytest_pafot.extras.revisions.revision_process import NO_TEST, Served, begun, failed, serve
from pytest_pafot.support.errors import RevisionError

WITHOUT: Mapping[str, object] = {
    **dict.fromkeys(("xmlpath", "htmlpath", "basetemp", "report_log")),
    **dict.fromkeys(("maxfail", "usepdb", "collectonly", "timeout", "reruns"), 0),
    "pafot_runs": 1,
}
"""Values of options in place of the user's: this session searches nothing, writes nothing and has all the time."""


class Serving:
    """The hooks that select the test, and drive its policy in place of the test."""

    def __init__(self, served: Served) -> None:
        self.served, self.policy = served, served.policy
        self.failure: RevisionError | None = None
        self.is_served = False

    @pytest.hookimpl(tryfirst=True)
    def pytest_configure(self, config: pytest.Config) -> None:
        """Replace the options of the user's session that are not meant for this one."""
        own = [name for name in vars(config.option) if name.startswith("pafot_")]
        for name, value in {**dict.fromkeys(own), **WITHOUT}.items():
            if hasattr(config.option, name):
                setattr(config.option, name, value)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> Generator[None, None, None]:
        """Select the search of the test, whatever the user's own options select."""
        own = [each for each in items if searched_test(each) == self.policy.name]
        yield
        items[:] = own[:1]
        for item in items:
            if item.config.pluginmanager.has_plugin("timeout"):
                item.add_marker(pytest.mark.timeout(0), append=False)

    def pytest_exception_interact(self, call: pytest.CallInfo[Any]) -> None:
        """Remember the first error, which prevents the run of the test."""
        if call.excinfo is not None and self.failure is None:
            error = call.excinfo.value
            missing = f"fixture:{error.argname}" if isinstance(error, pytest.FixtureLookupError) else ""
            # pytest wraps what an import raises
            self.failure = failed(self.policy, error.__cause__ or error, missing)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember that the test is skipped in this revision."""
        if report.skipped and self.failure is None and not self.is_served:
            self.failure = failed(self.policy, f"a test that is skipped there: {report.longrepr}")

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> None:
        """Drive the policy of the test until the user's session has no more requests."""
        factory = policy_of(item)
        Policy(factory).preload()
        self.is_served = True
        serve(self.served, factory)
        pytest.skip("the user's session has ended")  # in place of the search of this revision


def main(descriptor: int) -> None:
    """Set up the fixtures of a test, and serve its policy."""
    os.environ.pop("GITHUB_STEP_SUMMARY", None)
    with begun(descriptor) as served:
        serving = Serving(served)
        code = pytest.main(list(served.policy.session), plugins=[serving])
        if serving.is_served:
            sys.exit(0)
        if serving.failure is None and code in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            serving.failure = failed(served.policy, "no such test", NO_TEST)
        if serving.failure is not None:
            served.connection.send(serving.failure)
        sys.exit(code)  # An error of pytest's own is in its last words.
