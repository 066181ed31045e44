"""The item for a search, which fails if there are new findings."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.algorithms.evaluation import GenerationFinished
from pytest_pafot.corpus.layout import (
    SUFFIX,
    chosen_folder,
    files_in,
    folder_of_test,
    link_below,
    refusal,
)
from pytest_pafot.execution.crash_records import records_of
from pytest_pafot.execution.runner import ExecutionError
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.oracle.run import CheckFailed
from pytest_pafot.plugin import collection, messages
from pytest_pafot.plugin.collection import COLLECTED, REQUEST, RUN
from pytest_pafot.plugin.messages import (
    OF_ONE_RUN,
    OUTPUT,
    OfOneRun,
    finding_properties,
    set_properties,
)
from pytest_pafot.plugin.reporter import LiveTerminal
from pytest_pafot.plugin.session import SHARED, is_worker
from pytest_pafot.report import terminal
from pytest_pafot.searches.events import (
    Ending,
    Note,
    Progress,
    Search,
    SearchEvent,
    SearchStarted,
)
from pytest_pafot.searches.harness import (
    Harness,
    PlainFailure,
    Test,
    checked_factory,
    reference_of,
    source_file,
)
from pytest_pafot.searches.options import BUDGETS, BY_NAME, Settings
from pytest_pafot.searches.replays import Replays
from pytest_pafot.searches.request import Request, build_world
from pytest_pafot.searches.search_session import (
    AFTER_A_DEATH,
    Events,
    SearchSession,
    isolated_after_a_death,
    prepared,
)
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.files import remove_unfinished
from pytest_pafot.support.process import REPLACED, installed_versions
from pytest_pafot.support.text import plural
from pytest_pafot.world.driving.policy import Policy

if TYPE_CHECKING:
    from pytest_pafot.execution.runner import Cluster

TIDIED: pytest.StashKey[set[Path]] = pytest.StashKey()
"""The folders from which this session has removed unfinished files."""

CLUSTER: pytest.StashKey[Cluster | ExecutionError] = pytest.StashKey()
"""The workers for ``--pafot-dask``, or the error from a failed connection."""

IN_WORKER = (
    f"{flag('workers')} is 1 under pytest-xdist, which already runs tests in several processes"
)


OF_SUITE = "record_testsuite_property"
"""The name of the fixture that records properties of the session."""

OF_ONE_CALL = {
    "pytest_benchmark": "can be called only once in a test",
    "pytest_codspeed": "can be called only once in a test",
    "syrupy": "numbers its snapshots across all calls in a test",
}
"""Packages with fixtures that work in only one call of the test function, each with the reason."""


def harness_of(item: pytest.Function, request: Request, *, writes: bool = True) -> Harness:
    """Return the harness for a marked item. The item's fixtures must be set up.

    ``writes`` is True if the item may save scenarios.

    Raises:
        RequestError: if a fixture returns an unusable value, or if scenarios would be saved behind a link.
    """
    # Build the world first, because the versions of its packages are part of the harness.
    world = build_world(request, item.funcargs[collection.WORLD_FIXTURE])
    name, root = collection.qualified_name(item), item.config.rootpath
    folder = folder_of_test(item.path, name, request.settings.corpus, root)
    against = request.settings.against
    link = link_below(chosen_folder(item.path, request.settings.corpus), folder)
    tidied = item.config.stash.setdefault(TIDIED, set())
    # once per session: listing thousands of files takes as long as a replay
    if link is None and folder not in tidied:
        tidied.add(folder)
        remove_unfinished(folder)
    # A search that saves nothing may read through a link.
    if link is not None and writes and request.settings.save != "none":
        raise RequestError(f"{flag('corpus')}: {refusal(link)}")
    # Otherwise, the number of processes would be the product of both numbers of workers.
    if request.settings.workers > 1 and is_worker(item.config):
        messages.send(item, Note(IN_WORKER))
        request = replace(request, settings=replace(request.settings, workers=1))
    policy = Policy(policy_of(item))
    return Harness(
        request=request,
        world=world,
        policy=policy,
        test=bound_test(item),
        test_file=source_file(item.obj, str(item.path)),
        node_id=collection.base_id(item),
        saved_node_id=partial(collection.saved_node_id, item),
        folder=folder,
        records=records_of(item.config.rootpath),
        root=item.config.rootpath,
        versions=installed_versions(world.packages),
        against=reference_of(
            against, lambda name: checked_factory(item.funcargs[name], name), policy
        ),
        cluster=_cluster_of(item.config),
        needs_only_run=_needs_only_run(item),
    )


def watch_again(item: pytest.Function, *, is_elsewhere: bool) -> None:
    """Make pytest-testmon run an item again in the next session if other processes run its scenarios."""
    collector = item.config.pluginmanager.get_plugin("TestmonCollect")
    if is_elsewhere and collector is not None:
        collector.testmon.discard_current()


def _cluster_of(config: pytest.Config) -> Cluster | None:
    address = config.getoption(BY_NAME["dask"].key)
    if address is None:
        return None
    if CLUSTER not in config.stash:
        from pytest_pafot.execution import dask_cluster  # noqa: PLC0415  (few sessions need it)

        live = LiveTerminal(config)
        connected = dask_cluster.connect(address, lambda text: live.write(["", f"pafot: {text}"]))
        stack = ExitStack()
        config.add_cleanup(stack.close)
        try:
            config.stash[CLUSTER] = stack.enter_context(connected)
        except ExecutionError as error:
            config.stash[CLUSTER] = error
    if isinstance(found := config.stash[CLUSTER], ExecutionError):
        pytest.fail(str(found), pytrace=False)
    return found


def policy_of(item: pytest.Item) -> Callable[..., Any]:
    """Return an item's policy factory. The item's fixtures must be set up.

    Raises:
        RequestError: if the policy's fixture does not return a factory.
    """
    ads = item.stash[REQUEST].ads
    return checked_factory(item.funcargs[ads], ads) if isinstance(ads, str) else ads  # type: ignore[attr-defined]


def bound_test(item: pytest.Function) -> Test:
    """Return a function that calls the test function with a run and the item's fixtures.

    Raises:
        RequestError: if a fixture collects failures instead of raising them, or works in only one call.
    """
    for name, value in item.funcargs.items():
        if (
            isinstance(value, pytest.Subtests)
            or type(value).__module__.partition(".")[0] == "pytest_subtests"
        ):
            raise RequestError(_no_collecting(f"the fixture {name!r}"))
        package = type(value).__module__.partition(".")[0]
        if package in OF_ONE_CALL:
            raise RequestError(
                f"expected a test function that can be called for many runs, received one that uses the fixture "
                f"{name!r} from {package}. This fixture {OF_ONE_CALL[package]}. Use it in a test without @pafot.search"
            )
    names = inspect.signature(item.obj).parameters
    fixed = {name: item.funcargs[name] for name in names if name in item.funcargs}
    if OF_SUITE in fixed:
        fixed[OF_SUITE] = _once(fixed[OF_SUITE])
    recorded = item.stash[OF_ONE_RUN] = OfOneRun(item.user_properties)
    recorders = (pytest.LogCaptureFixture, pytest.WarningsRecorder)
    recorders_here = [value for value in item.funcargs.values() if isinstance(value, recorders)]

    def test(run: Any) -> Any:
        # No __tracebackhide__ is needed: pytest's traceback filter cuts everything above the user's function.
        try:
            with recorded.call(run), REPLACED.shown(True):
                result = item.obj(**{**fixed, RUN: run})
        finally:  # and not before the call, because the policy may have logged messages in this run
            for each in recorders_here:
                each.clear()
            item.stash[OUTPUT].read()
        check = sys.modules.get("pytest_check")
        if check is not None and check.any_failures():
            raise RequestError(_no_collecting("pytest-check"))
        return result

    return test


def _needs_only_run(item: pytest.Function) -> bool:
    """Return whether the test function takes only the run, so that forked processes can evaluate runs."""
    # Other fixtures may store something in this process. A debugger and pytest-check also need all runs in this
    # process.
    is_plain = (
        set(inspect.signature(item.obj).parameters) <= {RUN} and "pytest_check" not in sys.modules
    )
    return is_plain and not item.config.getoption("usepdb", False)


def _once(record: Any) -> Callable[[str, object], None]:
    recorded: set[tuple[str, str]] = set()

    def record_once(name: str, value: object) -> None:
        if (name, str(value)) not in recorded:
            record(name, value)
            recorded.add((name, str(value)))

    return record_once


def run_search(item: pytest.Function, request: Request) -> None:
    """Run a search, and fail the item if there is a new finding or the search tested too little."""
    __tracebackhide__ = True
    settings, shared = request.settings, item.config.stash[SHARED]
    today = date.fromisoformat(shared.today)
    limit = math.inf if settings.max_time is None else monotonic() + settings.max_time
    harness = harness_of(item, request)
    replays = Replays(harness=harness, today=today)
    # If this policy has killed a process before, it runs in separate processes, which it may kill.
    chosen = isolated_after_a_death(harness, replays)
    now = chosen.request.settings
    watch_again(item, is_elsewhere=now.isolate or now.workers > 1 or chosen.cluster is not None)
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
            first.add_note(terminal.failure_message(summary))
            raise first  # so that the debugger starts where the test function failed
        pytest.fail(terminal.failure_message(summary), pytrace=False)
    # Each failure needs an item that fails for it. A file saved after the collection has no item in this session.
    here = item.config.stash[COLLECTED].get(harness.folder, {})
    late = [
        file.name.removesuffix(SUFFIX) for file in files_in(harness.folder) if file.name not in here
    ]
    alike = [
        f"{plural(summary.known[id_], 'run')} failed like {id_}"
        for id_ in late
        if id_ in summary.known
    ]
    if alike:
        _fail(
            item, "run pytest again, because these failures were saved after the collection", alike
        )
    if summary.reason is Ending.REPLAYS:
        return
    if result.skip is not None:
        raise result.skip
    if result.is_vacuous:
        _fail(item, "the search tested too little", summary.warnings)
    if summary.warnings and settings.strict_health:
        _fail(
            item, f"{flag('strict_health')} is set, and this search has warnings", summary.warnings
        )


def exception_for_pytest(exception: BaseException) -> BaseException:
    """Return the exception to raise in pytest, without a traceback for a :class:`PlainFailure`."""
    is_plain = isinstance(exception, PlainFailure)
    return pytest.fail.Exception(str(exception), pytrace=False) if is_plain else exception


@dataclass(frozen=True, slots=True)
class SearchMessages:
    """The sender of a search's events to the controller."""

    item: pytest.Function
    settings: Settings
    # the findings so far, by id, as they were last sent
    sent: dict[str, Seen] = field(default_factory=dict)

    def send(self, event: SearchEvent) -> None:
        if isinstance(event, SearchStarted):
            set_properties(self.item.user_properties, seed=event.seed, base_seed=self.settings.seed)
            asked = {
                name: most for name in BUDGETS if (most := getattr(self.settings, name)) is not None
            }
            node_id, base_seed = self.item.nodeid, self.settings.seed
            messages.send(
                self.item,
                Search(node_id=node_id, seed=event.seed, base_seed=base_seed, asked=asked),
            )
        # its runs may have been evaluated in other processes
        elif isinstance(event, GenerationFinished):
            self.item.stash[OUTPUT].read()
        elif isinstance(event, Seen):
            self._send_finding(event)
        elif isinstance(event, Search):
            set_properties(self.item.user_properties, **finding_properties(self.sent.values()))
            if self.sent:  # otherwise, keep the properties of the last run
                self.item.stash[OF_ONE_RUN].show(next(iter(self.sent.values())).run)
        if isinstance(event, (Progress, Search)):
            messages.send(self.item, event)

    def _send_finding(self, seen: Seen) -> None:
        item, settings = self.item, self.settings
        if seen.label == "no worse":  # it was sent as new before, but gets no item
            self.sent.pop(seen.id, None)
            messages.send_seen(item, settings, seen, note=seen.detail)
            return
        self.sent[seen.id] = seen  # even if an interrupt prevents the rest
        check = seen.raised.check if isinstance(seen.raised, CheckFailed) else None
        messages.send_seen(item, settings, seen, check=check, report=_report(item, seen))


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
    report.location = (*report.location[:2], collection.saved_name(item, seen.id))
    item.stash[OF_ONE_RUN].show(seen.run, report.user_properties)
    set_properties(report.user_properties, **finding_properties([seen]))
    data: dict[str, Any] = item.config.hook.pytest_report_to_serializable(
        config=item.config, report=report
    )
    return data


def _fail(item: pytest.Function, what: str, why: Sequence[str]) -> None:
    __tracebackhide__ = True
    pytest.fail("\n".join([f"{what}:", *why]), pytrace=False)


def _no_collecting(what: str) -> str:
    return (
        f"expected a test function that raises at its first failure, received one that uses {what}, which only "
        "collects failures. Such a function returns as if it had passed. Use `assert`, and write one test per property"
    )
