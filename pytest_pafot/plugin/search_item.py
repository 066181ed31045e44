"""The item for a search, and the hooks that check and run the items of searches and saved scenarios."""

from __future__ import annotations

import inspect
import math
import os
import sys
import threading
import traceback
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from pytest_pafot.algorithms.evaluation import GenerationFinished
from pytest_pafot.corpus.layout import SEARCH_PART, SUFFIX, files_in, relative
from pytest_pafot.execution.crash_records import left_by, records_of
from pytest_pafot.execution.pool import GRACE
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.oracle.run import CheckFailed
from pytest_pafot.plugin.collection import (
    ANY_MARK,
    COLLECTED,
    DEFAULT_ADS,
    POSITIONAL,
    REQUEST,
    RUN,
    SEARCH_MARK,
    WORLD_FIXTURE,
    arguments_of,
    base_id,
    is_driven,
    is_search,
    saved_name,
    saved_of,
)
from pytest_pafot.plugin.item import (
    OF_ONE_RUN,
    OUTPUT,
    exception_for_pytest,
    finding_properties,
    harness_of,
    send,
    send_seen,
    set_properties,
    watch_again,
)
from pytest_pafot.plugin.replay_item import run_replay
from pytest_pafot.plugin.session import SHARED, is_worker, report_on, resolve, uncaptured
from pytest_pafot.report.terminal import failure_message
from pytest_pafot.searches.events import (
    Ending,
    Note,
    Progress,
    Search,
    SearchEvent,
    SearchStarted,
)
from pytest_pafot.searches.options import BUDGETS, BY_NAME, Settings, is_ci
from pytest_pafot.searches.replays import Replays
from pytest_pafot.searches.request import AgainstError, Request, check_names, checked_request
from pytest_pafot.searches.search_session import (
    AFTER_A_DEATH,
    Events,
    SearchSession,
    isolated_after_a_death,
    prepared,
)
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import RequestError, asserts_run, flag
from pytest_pafot.support.process import REPLACED
from pytest_pafot.support.text import plural, suggest, visible, wrapped_to
from pytest_pafot.world.guard.hang_guard import LastResort, last_resort

IDLE = "replay only"
"""The reason for skipping a search without runs."""


class Checks:
    """Hooks that check a marked item, and report errors as failures of the item."""

    # Neither tryfirst nor trylast: it must run after pytest reads the skip marks and before it sets up the fixtures.
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Fail an item that cannot run as written, and skip a search without runs."""
        # No __tracebackhide__: pytest 9 adds a line about hidden frames to a failure that has no other frame.
        arguments = arguments_of(item)
        if arguments is None:
            # The mark that selects tests does not make a test a search. Only the decorator does.
            is_selected = item.get_closest_marker(ANY_MARK) is not None
            if is_selected and RUN in getattr(item, "fixturenames", ()):
                pytest.fail(
                    f"expected the decorator @pafot.search, received the mark @pytest.mark.{ANY_MARK}. This mark only "
                    f"selects tests, as in `pytest -m {ANY_MARK}`. Write `import pytest_pafot as pafot` and "
                    "@pafot.search(...)",
                    pytrace=False,
                )
            return
        try:
            _check_function(item)
            request = request_of_mark(item.config, arguments)
            _check_parameters(item, request)
        except RequestError as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None  # otherwise twice
        item.stash[REQUEST] = request
        # A search without runs still has to run a scenario in which an earlier session died.
        is_idle = is_search(item) and not request.settings.is_search
        with REPLACED.shown(False):  # a fixture of the module may have replaced functions
            is_idle = is_idle and not left_by(base_id(item), records_of(item.config.rootpath))
        if is_idle:
            option = BY_NAME["runs" if request.settings.runs == 0 else "generations"]
            if item.config.getoption(option.key) is None:  # easily forgotten, unlike an option
                why = f"no search ran, because {option.key} is 0 in the configuration file"
                send(item, Note(why))
            pytest.skip(f"{IDLE}: {flag(option.name, 0)}")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Explain the failure if the policy's fixture is missing, and report skipped items on CI."""
        report = yield
        if call.when != "setup":
            return report
        if report.outcome == "skipped" and is_driven(item) and is_ci(os.environ):
            reason = visible(str(getattr(call.excinfo, "value", "")))
            if not reason.startswith(IDLE) and not hasattr(report, "wasxfail"):
                text = f"the policy of {base_id(item)} was not tested, because the test was skipped: {reason}"
                send(item, Note(text, "warning"))
        request = item.stash.get(REQUEST, None)
        error = getattr(call.excinfo, "value", None)
        if request is None or not isinstance(error, pytest.FixtureLookupError):
            return report
        if error.argname in (request.ads, DEFAULT_ADS):
            message = getattr(report.longrepr, "errorstring", "")
            _, _, names = message.partition("available fixtures: ")
            available = names.partition("\n")[0].split(", ")
            width = item.config.stash[SHARED].width
            report.longrepr = _missing_ads(str(error.argname), available, width)
        return report


def _check_function(item: pytest.Item) -> None:
    cls = getattr(item, "cls", None)
    unittest = sys.modules.get("unittest")
    if unittest is not None and inspect.isclass(cls) and issubclass(cls, unittest.TestCase):
        raise RequestError(
            f"expected a test function or a simple test class, received a method of {cls.__name__}, a "
            "unittest.TestCase, which cannot use fixtures. Move the test out of that class"
        )
    if not isinstance(item, pytest.Function):
        raise RequestError(f"expected a test function, received {item!r}")
    if getattr(item.obj, "is_hypothesis_test", False) or hasattr(item.obj, "hypothesis"):
        raise RequestError(
            "expected @pafot.search or @given, received both. Each of them calls the function many times. "
            "Use @given(scenario=pafot.strategies.scenarios()) with the fixture pafot_simulate"
        )
    if inspect.iscoroutinefunction(item.obj) or inspect.isasyncgenfunction(item.obj):
        raise RequestError(
            "expected a synchronous function, received an async function. Its assertions would never run. "
            "Write `def` instead of `async def`"
        )
    if not asserts_run(inspect.unwrap(item.obj)):
        raise RequestError(
            "expected a test whose assertions run, but Python skips them with -O or PYTHONOPTIMIZE. pytest does not "
            "rewrite this test, because --assert=plain is set or because the test is from another module. Run Python "
            "without -O and PYTHONOPTIMIZE"
        )


def _check_parameters(item: pytest.Item, request: Request) -> None:
    names = list(inspect.signature(item.obj).parameters)  # type: ignore[attr-defined]
    if RUN not in names:
        raise RequestError(
            f"expected a parameter {RUN!r} that receives the simulated run, received the parameters "
            f"({', '.join(names)}). Add it, as in `def {item.name.partition('[')[0]}({RUN})`"
        )
    parameters = item.name.removeprefix(item.originalname or "")  # type: ignore[attr-defined]
    if saved_of(item) is None and SEARCH_PART not in parameters:
        raise RequestError(
            f"expected the parameter {RUN!r} to be free for the simulated run, but the test is already parametrised "
            "with it. Rename the parameter"
        )
    for name in (request.ads, WORLD_FIXTURE):
        if isinstance(name, str) and name not in item.fixturenames:  # type: ignore[attr-defined]
            raise RequestError(
                f"the test does not use the fixture {name!r}. Mark the test with @pafot.search(...), which "
                f"requests the fixture, instead of @pytest.mark.{SEARCH_MARK}"
            )
    against = request.settings.against
    if isinstance(against, str) and ":" not in against and against not in item.fixturenames:  # type: ignore[attr-defined]
        raise RequestError(
            f"against: expected module:factory, such as planner_before:make, received {against!r}. Only "
            "@pafot.search(against=...) accepts the name of a fixture"
        )


def _missing_ads(name: str, available: Sequence[str], width: int) -> str:
    hint = suggest(name, available) or "."
    text = (
        f"the fixture {name!r}, which must return the policy's factory, was not found{hint}\n"
        "Define it in the test file or in conftest.py:\n\n"
        "    @pytest.fixture\n"
        f"    def {name}():\n"
        "        return lambda: MyPlanner()    # a new policy for each scenario\n\n"
        'Or name another fixture with @pafot.search(ads="..."), or pass a factory: @pafot.search(ads=MyPlanner).'
    )
    lines = []
    for line in text.splitlines():
        if line.startswith(" "):  # code
            lines.append(line)
        else:
            lines += wrapped_to(line, width)
    return "\n".join(lines)


def request_of_mark(config: pytest.Config, arguments: Mapping[str, Any]) -> Request:
    """Build and check the request for the arguments of a mark.

    Raises:
        RequestError: for the first invalid argument or option.
    """
    given = {"ads": DEFAULT_ADS, **arguments}
    positional = given.pop(POSITIONAL, ())
    if positional:
        example = "runs=20"
        if callable(positional[0]):
            name = getattr(positional[0], "__name__", "")
            example = f"ads={name}" if name.isidentifier() else "ads=..."
        raise RequestError(
            f"@pafot.search: expected only keyword arguments, received {positional!r:.200}. Write the argument's name, "
            f"as in @pafot.search({example})"
        )
    check_names(given)
    return checked_request(given, resolve(config, arguments))


# Running an item: a search calls the test function for each simulated run, and a replay for each of its tries.


class Execution:
    """Hooks that run the items of searches and saved scenarios."""

    def pytest_sessionfinish(self) -> None:
        """Close this process's simulators, so that the summary contains their warnings."""
        simulation = sys.modules.get("pytest_pafot.world.engines.simulation")
        if simulation is not None:
            simulation.Simulators.close_all()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        """Set the properties of a saved scenario's item before the item can fail or be skipped."""
        saved = saved_of(item)
        if saved is None:
            return
        seed, signature = None, None
        if saved.finding is not None:
            seed, signature = saved.finding.found.seed, saved.finding.signature.text
        file = relative(saved.path, item.config.rootpath)
        own = item.user_properties
        set_properties(own, seed=seed, id=saved.id, signature=signature, file=file)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Restore a failure that another hook has reported as passed."""
        report = yield
        if call.excinfo is not None and report.passed and is_driven(item):
            report.outcome = "failed"
            report.longrepr = report.longrepr or item.repr_failure(call.excinfo)
            text = "a pytest_runtest_makereport hook hid this failure. To accept it, use xfail or `corpus accept`"
            report.sections.append(("pafot", text))
        return report

    @pytest.hookimpl(tryfirst=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> bool | None:
        """Run the search or replay of a marked item instead of calling its function once."""
        request = pyfuncitem.stash.get(REQUEST, None)
        if request is None:
            return None
        saved = saved_of(pyfuncitem)
        try:
            with REPLACED.shown(False), session_ends_if_stuck(pyfuncitem):
                if saved is None:
                    run_search(pyfuncitem, request)
                else:
                    run_replay(pyfuncitem, request, saved)
        except RequestError as error:
            if isinstance(error, AgainstError):
                send(pyfuncitem, Note(pyfuncitem.nodeid, "incomparable"))
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        return True


# The end of a session if a policy ignores interrupts: the findings so far are reported, and the process ends.
#
# The scenario is already on disk, and the next session runs it. Under pytest-xdist, only the worker ends. It is
# replaced like a worker that crashed.

STATUS = pytest.ExitCode.INTERRUPTED
"""The exit status of a session that ended because the policy hung."""

# the maximum time for the summary, because plugins may wait for something that the policy holds [s]
FLUSH = 120.0
SHOWN = 6  # the number of innermost frames that are printed


@contextmanager
def session_ends_if_stuck(item: pytest.Item) -> Iterator[None]:
    """End the session if the policy hangs in this context and ignores interrupts."""
    main = threading.get_ident()
    file = _real_stderr(item.config)
    resort = LastResort(end=lambda: _end(item, main), grace=GRACE, file=file)
    try:
        with last_resort(resort):
            yield
    finally:
        if file is not None:
            with REPLACED.shown(False):  # the test function may have replaced it
                os.close(file)


def _end(item: pytest.Item, thread: int) -> None:
    # The session ends even if a report waits for something that the policy holds.
    limit = threading.Timer(FLUSH, os._exit, (STATUS,))
    limit.daemon = True
    limit.start()
    try:
        if not is_worker(item.config):
            frames = traceback.format_stack(sys._current_frames()[thread])
            with uncaptured(item.config):
                _flush(item, "".join(frames[-SHOWN:]))
    finally:
        with suppress(Exception):
            sys.stdout.flush()
        os._exit(STATUS)


def _flush(item: pytest.Item, stack: str) -> None:
    """Report the stuck item and end the session. This runs in another thread, because the item blocks its own."""
    reason = (
        f"{item.nodeid}: the policy or its environment exceeded the time limit and ignores interrupts, so "
        "this session must end. The next session will run the scenario again in a separate process, and save it. "
        f"With {flag('isolate')}, a search continues after such a hang"
    )
    told = f"{reason}.\n\nThe stack of the policy, innermost call last:\n{stack}"
    report = report_on(item, "call", outcome="failed", longrepr=told)
    item.ihook.pytest_runtest_logreport(report=report)
    try:
        pytest.exit(
            f"the policy or its environment hangs in {item.nodeid}. See the failure report",
            returncode=STATUS,
        )
    except pytest.exit.Exception:
        item.config.hook.pytest_keyboard_interrupt(excinfo=pytest.ExceptionInfo.from_current())
    item.session.exitstatus = STATUS
    item.config.hook.pytest_sessionfinish(session=item.session, exitstatus=STATUS)


def _real_stderr(config: pytest.Config) -> int | None:
    # faulthandler has only one timer, and pytest may use it for faulthandler_timeout.
    has_faulthandler = config.pluginmanager.has_plugin("faulthandler")
    if has_faulthandler and float(config.getini("faulthandler_timeout") or 0.0) > 0.0:
        return None
    with suppress(OSError), uncaptured(config):
        return os.dup(2)
    return None


# The search of an item.


def run_search(item: pytest.Function, request: Request) -> None:
    """Run a search, and fail the item if there is a new finding or the search tested too little."""
    __tracebackhide__ = True
    settings, shared = request.settings, item.config.stash[SHARED]
    limit = math.inf
    if settings.max_time is not None:
        limit = monotonic() + settings.max_time
    harness = harness_of(item, request)
    replays = Replays(harness=harness, today=shared.day)
    # If this policy has killed a process before, it runs in separate processes, which it may kill.
    chosen = isolated_after_a_death(harness, replays)
    now = chosen.request.settings
    is_elsewhere = now.isolate or now.workers > 1 or chosen.cluster is not None
    watch_again(item, is_elsewhere=is_elsewhere)
    messages_of_search = SearchMessages(item, settings)
    with prepared(chosen) as parts:
        session = SearchSession(
            watch=parts.watch(item.nodeid, limit, progress_seconds=shared.progress_seconds),
            replays=replace(replays, harness=chosen),
            process_notes=[] if chosen is harness else [AFTER_A_DEATH],
        )
        # An exception in the inner loop, such as an interrupt, is raised in the search, which reports its findings.
        events = Events(session.run())
        while not events.is_over:
            with events:
                for event in events:
                    messages_of_search.send(event)
    result = events.result
    # The item fails for an error in the set-up, new findings, failures without an item, or an empty search.
    summary = result.summary
    if result.fault is not None:
        raise exception_for_pytest(result.fault)
    if result.count:
        if item.config.getoption("usepdb", False) and result.first_exception is not None:
            first = exception_for_pytest(result.first_exception)
            first.add_note(failure_message(summary))
            raise first  # so that the debugger starts where the test function failed
        pytest.fail(failure_message(summary), pytrace=False)
    # Each failure needs an item that fails for it. A file saved after the collection has no item in this session.
    here = item.config.stash[COLLECTED].get(harness.folder, {})
    late = [file.name for file in files_in(harness.folder) if file.name not in here]
    ids = [name.removesuffix(SUFFIX) for name in late]
    counts = {id_: plural(summary.known[id_], "run") for id_ in ids if id_ in summary.known}
    if counts:
        what = "run pytest again, because these failures were saved after the collection"
        _fail(what, [f"{count} failed like {id_}" for id_, count in counts.items()])
    if summary.reason is Ending.REPLAYS:
        return
    if result.skip is not None:
        raise result.skip
    if result.is_vacuous:
        _fail("the search tested too little", summary.warnings)
    if summary.warnings and settings.strict_health:
        what = f"{flag('strict_health')} is set, and this search has warnings"
        _fail(what, summary.warnings)


@dataclass(frozen=True, slots=True)
class SearchMessages:
    """The sender of a search's events to the controller."""

    item: pytest.Function
    settings: Settings
    # the findings so far, by id, as they were last sent
    sent: dict[str, Seen] = field(default_factory=dict)

    def send(self, event: SearchEvent) -> None:
        item, base_seed = self.item, self.settings.seed
        match event:
            case SearchStarted(seed=seed):
                set_properties(item.user_properties, seed=seed, base_seed=base_seed)
                budgets = {name: getattr(self.settings, name) for name in BUDGETS}
                asked = {name: most for name, most in budgets.items() if most is not None}
                started = Search(node_id=item.nodeid, seed=seed, base_seed=base_seed, asked=asked)
                send(item, started)
            case GenerationFinished():  # its runs may have been evaluated in other processes
                item.stash[OUTPUT].read()
            case Seen():
                self._send_finding(event)
            case Search():
                set_properties(item.user_properties, **finding_properties(self.sent.values()))
                if self.sent:  # otherwise, keep the properties of the last run
                    first = next(iter(self.sent.values()))
                    item.stash[OF_ONE_RUN].show(first.run)
                send(item, event)
            case Progress():
                send(item, event)

    def _send_finding(self, seen: Seen) -> None:
        item, settings = self.item, self.settings
        if seen.label == "no worse":  # it was sent as new before, but gets no item
            self.sent.pop(seen.id, None)
            send_seen(item, settings, seen, note=seen.detail)
            return
        self.sent[seen.id] = seen  # even if an interrupt prevents the rest
        check = seen.raised.check if isinstance(seen.raised, CheckFailed) else None
        send_seen(item, settings, seen, check=check, report=_report(item, seen))


def _report(item: pytest.Item, seen: Seen) -> dict[str, Any]:
    """Return the serialised failure report of a new finding, with the node id of its future replay."""
    error = exception_for_pytest(seen.raised)
    context = error.__context__

    def fail() -> None:
        try:
            raise error
        finally:  # If an interrupt ends the search, Python has made it the context of the failure.
            error.__context__ = context

    # pytest's own hooks create the report, so marks of the test function, such as xfail, apply to it.
    call = pytest.CallInfo.from_call(fail, when="call")
    report: pytest.TestReport = item.ihook.pytest_runtest_makereport(item=item, call=call)
    report.nodeid = seen.node_id
    file, line, _ = report.location
    report.location = (file, line, saved_name(item, seen.id))
    item.stash[OF_ONE_RUN].show(seen.run, report.user_properties)
    set_properties(report.user_properties, **finding_properties([seen]))
    data: dict[str, Any] = item.config.hook.pytest_report_to_serializable(
        config=item.config, report=report
    )
    return data


def _fail(what: str, why: Sequence[str]) -> None:
    __tracebackhide__ = True
    pytest.fail("\n".join([f"{what}:", *why]), pytrace=False)
