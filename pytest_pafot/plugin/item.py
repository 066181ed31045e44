"""What searches and replays share: an item's messages, its properties, its failure report, and its harness."""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, MutableSequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, takewhile
from os import getpid
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import pytest

from pytest_pafot.attribution.sentences import ALSO
from pytest_pafot.corpus.layout import (
    chosen_folder,
    folder_of_test,
    link_below,
    refusal,
    relative,
)
from pytest_pafot.corpus.reader import Saved
from pytest_pafot.execution.crash_records import records_of
from pytest_pafot.execution.runner import ExecutionError
from pytest_pafot.findings.decisions import sentences_of
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.oracle.run import Check, Run
from pytest_pafot.plugin.collection import (
    RUN,
    WORLD_FIXTURE,
    base_id,
    is_driven,
    qualified_name,
    saved_node_id,
    saved_of,
)
from pytest_pafot.plugin.reporter import LiveTerminal
from pytest_pafot.plugin.session import AS_SAVED, PHASE, SHARED, is_worker, report_on
from pytest_pafot.report.messages import plain
from pytest_pafot.searches.events import Note
from pytest_pafot.searches.harness import (
    Harness,
    PlainFailure,
    Test,
    checked_factory,
    collision_in_short,
    reference_of,
    source_file,
)
from pytest_pafot.searches.options import BY_NAME, Settings
from pytest_pafot.searches.request import Request, build_world
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.files import remove_unfinished
from pytest_pafot.support.process import REPLACED, installed_versions
from pytest_pafot.support.text import MARKER, fitted_lines, visible, visible_lines
from pytest_pafot.world.driving.policy import Policy

if TYPE_CHECKING:
    from pytest_pafot.execution.runner import Cluster
    from pytest_pafot.model.trace import Trace
    from pytest_pafot.report.messages import Event


def packed(value: object) -> str:
    """Encode a value as ASCII JSON, because pytest-xdist cannot send invalid characters."""
    return json.dumps(plain(value))


def send(item: pytest.Item, event: Event, **more: Any) -> None:
    """Send an event of a running item to the controller, with additional JSON-compatible data."""
    message = (type(event).__name__, packed(event), more)
    report = report_on(item, PHASE, pafot=message)
    item.ihook.pytest_runtest_logreport(report=report)


def send_seen(
    item: pytest.Item,
    settings: Settings,
    seen: Seen,
    *,
    check: Check | None = None,
    note: str = "",
    **more: Any,
) -> None:
    """Send a new or replayed finding to the controller.

    Args:
        item: the item that found or replayed the finding.
        settings: the settings of the item.
        seen: the finding, with this session's observations.
        check: the check that failed, or None.
        note: an addition to the headline on the page.
        more: more data for the terminal.
    """
    sentences: tuple[str, ...] = ()
    if seen.headline and seen.run is not None:
        sentences = sentences_of(seen.run, seen.finding.expect)
        # The sentences are about the collision, not about the check.
        if sentences and check is not None:
            sentences = (f"{ALSO} {collision_in_short(seen.run)}.",)
    seen = replace(seen, sentences=sentences)
    # The view of the page is large, so it is created only if a page was requested.
    if settings.report is not None and seen.headline:
        from pytest_pafot.report.views import finding_view  # noqa: PLC0415

        view = finding_view(seen, note=note, check=check)
        more["view"] = json.dumps(view, allow_nan=False)
    send(item, seen, **more)


# Properties of items, which appear in files for other tools, such as the file of ``--junitxml``.
#
# They are stored as pytest's own ``record_property`` stores them, so workers of pytest-xdist pass them on. The prefix
# ``pafot_`` distinguishes them from the user's properties.

PREFIX = "pafot_"

Properties = MutableSequence[tuple[str, Any]]


@dataclass(slots=True)
class OfOneRun:
    """The properties that a test records with ``record_property`` in one run."""

    properties: Properties  # of the item
    # from the last call, also in `properties`
    _shown: list[tuple[str, Any]] = field(default_factory=list)
    # by trace, because a run may be replaced by one with the same trace and more facts
    _recorded: WeakKeyDictionary[Trace, list[tuple[str, Any]]] = field(
        default_factory=WeakKeyDictionary
    )

    @contextmanager
    def call(self, run: Run) -> Iterator[None]:
        """Replace the properties of the previous run with those that are recorded in this context."""
        self.show(None)
        count = len(self.properties)
        try:
            yield
        finally:
            self._shown = self._recorded[run.trace] = list(self.properties[count:])

    def show(self, run: Run | None, properties: Properties | None = None) -> None:
        """Replace the last call's properties with the properties of ``run``, or remove them if ``run`` is None.

        ``properties`` is the list to change, by default the item's.
        """
        changed = self.properties if properties is None else properties
        shown: list[tuple[str, Any]] = []
        if run is not None:
            shown = self._recorded.get(run.trace, [])
        # by identity, because a fixture may have recorded an equal one before
        ours = set(map(id, self._shown))
        others = [each for each in changed if id(each) not in ours]
        changed[:] = [*others, *shown]
        if properties is None:
            self._shown = shown


OF_ONE_RUN: pytest.StashKey[OfOneRun] = pytest.StashKey()


def set_properties(properties: Properties, **values: object) -> None:
    """Set properties of an item or a report. Replace earlier values, and skip empty ones."""
    names = {
        f"{PREFIX}{name}": visible(str(value))
        for name, value in values.items()
        if value not in (None, "")
    }
    others = [each for each in properties if each[0] not in names]
    properties[:] = [*others, *names.items()]


def finding_properties(sightings: Iterable[Seen]) -> dict[str, str]:
    """Return the properties that describe findings, as lists separated by commas."""
    seen = list(sightings)
    columns = {
        "id": [each.id for each in seen],
        "signature": [each.finding.signature.text for each in seen],
        "file": [each.path for each in seen],
        "severity": [str(each.severity or "none") for each in seen],
    }
    return {name: ", ".join(filter(None, column)) for name, column in columns.items()}


# The failure report of an item, and its output.

REPLAYED = pytest.StashKey[bool]()
"""True if the item's saved scenario was replayed."""

NOT_ACCEPTED = pytest.StashKey[str]()
"""The difference between the failure in a replay and the accepted failure."""

OUTPUT_END = 10_000
"""The number of characters of captured output that a report keeps from each end."""

# A colour code, with which pytest marks differences. In other places, it could hide a message.
_COLOUR = re.compile("\x1b\\[[0-9;]*m")


class KeptOutput:
    """The start and the end of an item's captured output."""

    def __init__(self, item: pytest.Item) -> None:
        self._item = item
        # None if another plugin replaces it
        self._capture = item.config.pluginmanager.get_plugin("capturemanager")
        self._process = getpid()
        # pytest keeps the output of each item until the session ends, and a policy that prints at each decision prints
        # gigabytes. So only the start, the end, and the number of characters between them are kept.
        self._texts = {"stdout": ("", "", 0), "stderr": ("", "", 0)}

    def read(self) -> None:
        if self._capture is None or getpid() != self._process:
            # This process was forked. The original process reads the file, to which both write.
            return
        for key, text in zip(self._texts, self._capture.read_global_capture(), strict=True):
            begin, end, left_out = self._texts[key]
            room = OUTPUT_END - len(begin)
            end += text[room:]
            too_long = max(0, len(end) - 2 * OUTPUT_END)
            self._texts[key] = begin + text[:room], end[too_long:], left_out + too_long

    def give_back(self) -> None:
        """Add the output to the item's report, as pytest does."""
        self.read()
        for key, (begin, end, left_out) in self._texts.items():
            text = f"{begin}{end}"
            if left_out:
                text = _shortened(begin, end[-OUTPUT_END:], left_out + len(end) - OUTPUT_END)
            self._item.add_report_section("call", key, text)


OUTPUT = pytest.StashKey[KeptOutput]()


class Failures:
    """Hooks that shorten the reports of failing items and the captured output of all items."""

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> Generator[None, object, object]:
        if not is_driven(pyfuncitem):
            return (yield)
        output = pyfuncitem.stash[OUTPUT] = KeptOutput(pyfuncitem)
        try:
            return (yield)
        finally:
            output.give_back()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, Any, Any]:
        if not is_driven(item):
            return (yield)
        if call.excinfo is None:
            report = yield
            _shorten_output(report)
            return report
        option = item.config.option
        # declared by pytest's terminal plugin, which may be off
        style = getattr(option, "tbstyle", None)
        # A search may find dozens of failures, and pytest prints each several times. With -v, frames are complete.
        # the saved file has the rest
        if item.config.get_verbosity() <= 0 and call.when == "call" and style == "auto":
            option.tbstyle = "short"
        try:
            report = yield
        finally:
            if style is not None:
                option.tbstyle = style
        _shorten_output(report)
        saved = saved_of(item)
        if saved is not None:
            if not call.excinfo.errisinstance(pytest.xfail.Exception):
                _count_unless_accepted(item, saved, report)
            file = relative(saved.path, item.config.rootpath)
            entry = {"id": saved.id, "file": file, "test": base_id(item)}
            setattr(report, AS_SAVED, json.dumps(entry))
        _make_visible(report)
        _fit(report.longrepr, item.config.stash[SHARED].width)
        return report


def _shorten_output(report: pytest.TestReport) -> None:
    for number, (title, text) in enumerate(report.sections):
        left_out = len(text) - 2 * OUTPUT_END
        if left_out > OUTPUT_END:
            short = _shortened(text[:OUTPUT_END], text[-OUTPUT_END:], left_out)
            report.sections[number] = title, short


def _shortened(begin: str, end: str, left_out: int) -> str:
    line = f"[{left_out} characters of output are omitted. Run pytest -s without workers to see the complete output]"
    return f"{begin}\n{line}\n{end}"


def _count_unless_accepted(item: pytest.Item, saved: Saved, report: pytest.TestReport) -> None:
    """Count an item as failed if its failure differs from the accepted one."""
    # The mark xfail would also accept an error in a fixture or in the factory.
    is_other = REPLAYED not in item.stash or NOT_ACCEPTED in item.stash
    is_accepted = saved.is_accepted(item.config.stash[SHARED].day)
    if is_accepted and is_other and hasattr(report, "wasxfail"):
        report.outcome = "failed"
        del report.wasxfail


def _make_visible(report: pytest.TestReport) -> None:
    match report.longrepr:
        case str() as text:
            report.longrepr = visible_lines(text)
        case (path, line, why):
            report.longrepr = (path, line, visible_lines(why))
    if hasattr(report, "wasxfail"):
        report.wasxfail = visible_lines(report.wasxfail)
    crash = getattr(report.longrepr, "reprcrash", None)
    if crash is not None:  # pytest's short summary shows its first line
        crash.message = visible_lines(_COLOUR.sub("", crash.message))


def _fit(longrepr: Any, width: int) -> None:
    """Wrap the lines of a failure message, except for code, and escape unprintable characters."""
    tracebacks = [each[0] for each in getattr(longrepr, "chain", ())]
    if not tracebacks and hasattr(longrepr, "reprtraceback"):
        tracebacks = [longrepr.reprtraceback]
    for entry in chain.from_iterable(each.reprentries for each in tracebacks):
        lines = [_COLOUR.sub("", line) for line in entry.lines]
        code: list[str] = []
        if entry.style != "value":
            code = list(takewhile(lambda line: not line.startswith(MARKER), lines))
        message = fitted_lines(lines[len(code) :], width)
        entry.lines = [*map(visible_lines, code), *message]
        values = getattr(entry, "reprlocals", None)
        if values is not None:
            values.lines = list(map(visible_lines, values.lines))
        arguments = getattr(entry, "reprfuncargs", None)
        if arguments is not None:
            arguments.args = [(name, visible(str(value))) for name, value in arguments.args]


# The harness of an item, with which its search or replay runs scenarios.

TIDIED: pytest.StashKey[set[Path]] = pytest.StashKey()
"""The folders from which this session has removed unfinished files."""

CLUSTER: pytest.StashKey[Cluster | ExecutionError] = pytest.StashKey()
"""The workers for ``--pafot-dask``, or the error from a failed connection."""

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
    world = build_world(request, item.funcargs[WORLD_FIXTURE])
    root, settings = item.config.rootpath, request.settings
    folder = folder_of_test(item.path, qualified_name(item), settings.corpus, root)
    link = link_below(chosen_folder(item.path, settings.corpus), folder)
    tidied = item.config.stash.setdefault(TIDIED, set())
    # once per session: listing thousands of files takes as long as a replay
    if link is None and folder not in tidied:
        tidied.add(folder)
        remove_unfinished(folder)
    # A search that saves nothing may read through a link.
    if link is not None and writes and settings.save != "none":
        raise RequestError(f"{flag('corpus')}: {refusal(link)}")
    # Otherwise, the number of processes would be the product of both numbers of workers.
    if settings.workers > 1 and is_worker(item.config):
        why = "which already runs tests in several processes"
        send(item, Note(f"{flag('workers')} is 1 under pytest-xdist, {why}"))
        request = replace(request, settings=replace(settings, workers=1))
    factory = request.ads
    if isinstance(factory, str):
        factory = checked_factory(item.funcargs[factory], factory)
    policy = Policy(factory)
    # Forked processes can evaluate runs if the test function takes only the run. Other fixtures may store something in
    # this process. A debugger and pytest-check also need all runs in this process.
    needs_only_run = set(inspect.signature(item.obj).parameters) <= {RUN}
    if "pytest_check" in sys.modules or item.config.getoption("usepdb", False):
        needs_only_run = False
    return Harness(
        request=request,
        world=world,
        policy=policy,
        test=bound_test(item),
        test_file=source_file(item.obj, str(item.path)),
        node_id=base_id(item),
        saved_node_id=partial(saved_node_id, item),
        folder=folder,
        records=records_of(root),
        root=root,
        versions=installed_versions(world.packages),
        against=reference_of(
            settings.against, lambda name: checked_factory(item.funcargs[name], name), policy
        ),
        cluster=_cluster_of(item.config),
        needs_only_run=needs_only_run,
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

        def tell(text: str) -> None:
            live.write(["", f"pafot: {text}"])

        connected = dask_cluster.connect(address, tell)
        stack = ExitStack()
        config.add_cleanup(stack.close)
        try:
            config.stash[CLUSTER] = stack.enter_context(connected)
        except ExecutionError as error:
            config.stash[CLUSTER] = error
    found = config.stash[CLUSTER]
    if isinstance(found, ExecutionError):
        pytest.fail(str(found), pytrace=False)
    return found


def bound_test(item: pytest.Function) -> Test:
    """Return a function that calls the test function with a run and the item's fixtures.

    Raises:
        RequestError: if a fixture collects failures instead of raising them, or works in only one call.
    """
    for name, value in item.funcargs.items():
        package = type(value).__module__.partition(".")[0]
        if isinstance(value, pytest.Subtests) or package == "pytest_subtests":
            raise RequestError(_no_collecting(f"the fixture {name!r}"))
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
    kinds = (pytest.LogCaptureFixture, pytest.WarningsRecorder)
    recorders = [value for value in item.funcargs.values() if isinstance(value, kinds)]

    def test(run: Any) -> Any:
        # No __tracebackhide__ is needed: pytest's traceback filter cuts everything above the user's function.
        try:
            with recorded.call(run), REPLACED.shown(True):
                result = item.obj(**{**fixed, RUN: run})
        finally:  # and not before the call, because the policy may have logged messages in this run
            for each in recorders:
                each.clear()
            item.stash[OUTPUT].read()
        check = sys.modules.get("pytest_check")
        if check is not None and check.any_failures():
            raise RequestError(_no_collecting("pytest-check"))
        return result

    return test


def _once(record: Any) -> Callable[[str, object], None]:
    recorded: set[tuple[str, str]] = set()

    def record_once(name: str, value: object) -> None:
        if (name, str(value)) not in recorded:
            record(name, value)
            recorded.add((name, str(value)))

    return record_once


def exception_for_pytest(exception: BaseException) -> BaseException:
    """Return the exception to raise in pytest, without a traceback for a :class:`PlainFailure`."""
    if isinstance(exception, PlainFailure):
        return pytest.fail.Exception(str(exception), pytrace=False)
    return exception


def _no_collecting(what: str) -> str:
    return (
        f"expected a test function that raises at its first failure, received one that uses {what}, which only "
        "collects failures. Such a function returns as if it had passed. Use `assert`, and write one test per property"
    )
