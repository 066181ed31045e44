"""The options, shared values and messages of a session."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
import traceback
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from datetime import date, timedelta
from functools import partial
from os import getpid
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest

from pytest_pafot.report.session import Session
from pytest_pafot.searches.options import BUDGETS, BY_NAME, OPTIONS, RUNS, Option, Settings, is_ci
from pytest_pafot.support.errors import RequestError, flag

_INI_TYPES: Mapping[str, Literal["int", "float", "bool"]] = {
    "integer": "int",
    "seconds": "float",
    "switch": "bool",
}
"""The types of ini keys that are not strings, by kind of option."""
_LAST = r"(?<=')[^']*(?='$)|[^\s']+$"
"""A pattern for the value in pytest's error message about an ini key."""


def add_options(parser: pytest.Parser) -> None:
    """Declare all options of the plugin to pytest."""
    group = parser.getgroup(
        "pafot", "search for traffic in which a driving policy crashes (pytest-pafot)"
    )
    for option in OPTIONS:
        value: dict[str, Any] = {"type": option.read, "metavar": option.metavar}
        if option.kind == "switch":
            value = {"action": "store_true"}
        group.addoption(option.flag, dest=option.key, default=None, help=option.help, **value)
        if option.everywhere:
            text = f"Same as {option.flag}."
            parser.addini(
                option.key, text, type=_INI_TYPES.get(option.kind, "string"), default=None
            )


def resolve(config: pytest.Config, marker: Mapping[str, object]) -> Settings:
    """Return the values of all options for an item, given its mark's arguments.

    Raises:
        RequestError: if a value is invalid. The message names its source.
    """
    # A wrong argument is an error even if the command line replaces it today.
    for option in OPTIONS:
        if option.is_argument:
            _read(option, f"@pafot.search({option.name}=...)", marker.get(option.name))
    values = {
        option.name: option_value(config, option, marker) for option in OPTIONS if option.everywhere
    }
    # The first source that sets a budget decides both.
    runs, generations = (list(_values(config, BY_NAME[name], marker)) for name in BUDGETS)
    budgets = zip(runs, generations, strict=True)
    given = next((budget for budget in budgets if budget != (None, None)), (RUNS, None))
    # A number of generations selects the paper's algorithm, even if an earlier source sets the number of runs.
    if any(generations):
        values["algorithm"] = values["algorithm"] or "pafot"
    return Settings(**values | dict(zip(BUDGETS, given, strict=True)))


def option_value(config: pytest.Config, option: Option, marker: Mapping[str, object]) -> Any:
    """Return the value of an option, given the arguments of a mark.

    Raises:
        RequestError: if the value is invalid. The message names its source.
    """
    values = _values(config, option, marker)
    return next((value for value in values if value is not None), option.default)


def value_if_right(config: pytest.Config, name: str) -> Any:
    """Return the session's value of an option, or None if it is invalid. Each search reports an invalid value."""
    try:
        return option_value(config, BY_NAME[name], {})
    except RequestError:
        return None


def _values(config: pytest.Config, option: Option, marker: Mapping[str, object]) -> Iterator[Any]:
    """Yield the value on the command line, in the mark and in the configuration file."""
    yield _read(option, option.flag, config.getoption(option.key))
    if option.is_argument:
        yield _read(option, f"@pafot.search({option.name}=...)", marker.get(option.name))
    else:
        yield None
    try:
        value = config.getini(option.key)
    except (TypeError, ValueError, pytest.UsageError) as error:  # the message ends with the value
        value = "".join(re.findall(_LAST, str(error)))
    yield _read(option, f"ini key {option.key}", value)


def _read(option: Option, place: str, value: object) -> Any:
    if value is None:
        return None
    try:
        return option.read(value)
    except RequestError as error:
        raise RequestError(f"{place}: {error}") from None


LOG_SECONDS = 10.0  # the interval between reports of a search's progress in a log [s]


def terminal_width() -> int:
    """Return the width of the terminal [columns]."""
    columns = shutil.get_terminal_size((80, 24)).columns
    # A smaller number is probably wrong.
    return columns if columns >= 40 else 80


class Shared:
    """The values that the controller chooses and every worker uses."""

    def __init__(self, **chosen: Any) -> None:
        self.progress_seconds = LOG_SECONDS  # interval between reports of progress [s]
        self.width = terminal_width()  # of the terminal, which a worker cannot query [columns]
        # the day with which the last days of accepted failures are compared, as a string that can be sent to workers
        self.today = date.today().isoformat()
        # node ids of the saved scenarios that the first workers collected, or None until then. A worker that replaces a
        # crashed one ignores newer files, because pytest-xdist needs the same items in all workers
        self.frozen: frozenset[str] | None = None
        vars(self).update(chosen)

    @property
    def day(self) -> date:
        """The value of ``today`` as a date."""
        return date.fromisoformat(self.today)


class Inventory(NamedTuple):
    """The collected items and files, as strings that pytest-xdist can send."""

    driven: set[str]  # node ids of the items that will run a policy
    corpora: set[str]  # the corpora of the collected tests
    deselected: set[str]  # the saved scenarios of deselected items, as reports name them
    unnamed: set[str]  # marked functions and classes that pytest does not collect as tests


def cause_of(config: pytest.Config) -> str:
    """Return the reason why a session must fail if something was not tested, or an empty string."""
    if is_ci(os.environ):
        return "CI is set"
    if value_if_right(config, "strict_health"):
        return f"{BY_NAME['strict_health'].flag} is set"
    return ""


def call_of(config: pytest.Config) -> list[str]:
    """Return pytest's command-line arguments, without those from its configuration file."""
    added = shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))
    return [*map(str, config.invocation_params.args), *added]


def path_of(config: pytest.Config, arg: str) -> Path:
    """Return the path in a command-line argument such as ``file.py::test``."""
    path, _, _ = arg.partition("::")
    return Path(os.path.normpath(config.invocation_params.dir / path))


SHARED = pytest.StashKey[Shared]()
INVENTORY = pytest.StashKey[Inventory]()
GIVEN = pytest.StashKey[list[str]]()
"""The paths and node ids on the command line."""
SESSION = pytest.StashKey[Session]()
"""The session's record, which stays empty in a worker."""


def uncaptured(config: pytest.Config) -> AbstractContextManager[None]:
    """Return a context in which a test's output reaches the terminal."""
    manager = config.pluginmanager.get_plugin("capturemanager")
    if manager is None:
        return nullcontext()
    silent: AbstractContextManager[None] = manager.global_and_fixture_disabled()
    return silent


def base_line(config: pytest.Config) -> str:
    """Return a line with the base seed of searches, or an empty string if there is no search."""
    try:
        settings = resolve(config, {})
    except RequestError as error:
        return str(error)
    if not settings.is_search:
        return ""
    return f"base seed {settings.seed} (for other scenarios: {flag('seed', settings.seed + 1)})"


def cost_line(config: pytest.Config, markers: Iterable[Mapping[str, object]]) -> str:
    """Return a line with the maximum number of runs, or an empty string if that number is unknown."""
    # The counts are upper limits: a search may end early.
    most = Counter[str]()
    for marker in markers:
        try:
            settings = resolve(config, marker)
        except RequestError:  # the search itself reports it
            return ""
        most.update({name: getattr(settings, name) or 0 for name in BUDGETS})
    counts = []
    for name, count in most.items():
        if count:
            noun = name.removesuffix("s") if count == 1 else name
            counts.append(f"{count:,} {noun}")
    if not counts:
        return ""
    upper = " and ".join(counts)
    return f"pafot: at most {upper}. Analysing failures roughly doubles the number of decisions"


def stale_day(asked: str, today: date) -> list[str]:
    """Return a warning if the day of ``--pafot-today`` is in the past in every time zone."""
    from pytest_pafot.support.text import day_of  # noqa: PLC0415  (few sessions have this option)

    day = day_of(asked)
    if day is None or day >= today - timedelta(days=1):
        return []
    return [
        f"{flag('today', asked)}: this day is in the past. Accepted failures whose last day has passed since then "
        "still count as accepted. Remove the option, or set it to the current day"
    ]


def end_in_order(config: pytest.Config) -> None:
    """Interrupt the session on SIGTERM and SIGHUP, so that it ends its processes and writes its results."""
    from pytest_pafot.support.process import interrupted_by_signals  # noqa: PLC0415
    from pytest_pafot.world.guard.hang_guard import note_interrupt  # noqa: PLC0415

    stack = ExitStack()
    config.add_cleanup(stack.close)
    stack.enter_context(interrupted_by_signals(note_interrupt))


def guard_exits(config: pytest.Config) -> None:
    """Make the session fail if a policy calls ``os._exit`` or ``os.exec*`` in this process."""
    # After the session the functions stay replaced, because a thread or an exit function may still call them.
    if isinstance(os._exit, partial):
        return  # this session runs inside a test of another session
    owner, plugins = getpid(), config.pluginmanager
    own = {name: vars(os)[name] for name in ("_exit", "abort", "execv", "execve")}

    def code() -> int:  # 0 until all tests have run
        return int(getattr(plugins.get_plugin("session"), "exitstatus", pytest.ExitCode.OK))

    def end(name: str, /, *given: Any, **named: Any) -> None:
        # Before the collection, only _exit is an error: a conftest.py may call exec to restart pytest.
        is_early = name == "_exit" and not getattr(plugins.get_plugin("session"), "items", ())
        is_own = getpid() == owner and not is_worker(config)
        if is_own and (is_early or plugins.has_plugin("pafot-messages")):
            if not code():
                caller = traceback.format_stack(limit=2)[0].strip()
                note = f"pafot: this call ends the session. Use {flag('isolate')} to prevent that"
                with uncaptured(config):
                    print(f"\n{note}\n  {caller}", flush=True)
            status, *_ = [*given, *named.values(), 1]  # os.abort has none
            if name.startswith("exec") or status % 256 == 0:
                own["_exit"](code() or int(pytest.ExitCode.INTERRUPTED))
        own[name](*given, **named)

    def finished() -> None:
        if not code() or not plugins.has_plugin("pafot-messages"):
            vars(os).update(own)
        elif code() == pytest.ExitCode.INTERRUPTED:
            from pytest_pafot.support.process import exit_soon  # noqa: PLC0415

            exit_soon(code())

    config.add_cleanup(finished)
    vars(os).update({name: partial(end, name) for name in own})


def exit_code(session: pytest.Session) -> int:
    """Return the exit code of an ending session."""
    # A second Ctrl-C may arrive before pytest has handled the first one.
    if isinstance(sys.exc_info()[1], KeyboardInterrupt):
        return int(pytest.ExitCode.INTERRUPTED)
    return int(session.exitstatus)


def is_worker(config: pytest.Config) -> bool:
    """Return whether this process is a worker of pytest-xdist."""
    return hasattr(config, "workerinput")


class Header:
    """The hook for the header of a verbose session."""

    def pytest_report_header(self) -> str:
        """Return a line that states whether the simulation kernel is compiled."""
        from pytest_pafot.support.compiled import why_interpreted  # noqa: PLC0415  (most sessions are not verbose)

        reason = why_interpreted()
        if reason:
            return f"pafot: kernel interpreted ({reason})"
        return "pafot: kernel compiled"


# Messages from a running item to the controller.
#
# A message is a test report of a phase that only this plugin knows. pytest-xdist sends it to the controller
# immediately, like every report. To other plugins, it looks like the report of a passed phase without output.

PHASE = "pafot"  # the phase of a report that is a message

AS_SAVED = "pafot_saved"
"""The name of a report's attribute with the id and file of a failing saved scenario, as ASCII JSON."""


class Messages:
    """Hooks for the messages to the controller."""

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_logreport(self) -> Generator[None, object, object]:
        """Postpone an interrupt until all plugins have received a report."""
        from pytest_pafot.support.process import postponed  # noqa: PLC0415  (slow to import; few sessions have marked tests)

        with postponed():
            return (yield)

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(
        self, report: pytest.TestReport | pytest.CollectReport
    ) -> tuple[str, str, str] | None:
        """Hide messages from pytest's results."""
        if getattr(report, "when", None) == PHASE:
            return "", "", ""
        return None


def report_on(item: pytest.Item | pytest.TestReport, when: str, **given: Any) -> pytest.TestReport:
    """Return a report on one phase of an item, by default a passed phase."""
    facts = {"nodeid": item.nodeid, "location": item.location, "when": when}
    passed: dict[str, Any] = {"keywords": {}, "outcome": "passed", "longrepr": None}
    return pytest.TestReport(**facts | passed | given)
