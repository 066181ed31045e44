"""``python -m pytest_pafot requirements``: print what was asked, how far it was tested, what is open, and whose it is.

pytest collects the tests and runs none. What is known of their failures is in the saved scenarios, and in the results
of earlier sessions, the files of ``--pafot-json``.
"""

from __future__ import annotations

import argparse
import csv
import io
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any

from pytest_pafot.extending import Inventory, Saved, Session, Severity
from pytest_pafot.support.errors import RequestError, day_argument, flag
from pytest_pafot.support.markup import code, plain
from pytest_pafot.support.proportions import interval_text
from pytest_pafot.support.text import (
    ascii_text,
    csv_text,
    markdown_table,
    one_line,
    plural,
    spreadsheet_cell,
    visible,
    wrapped_to,
)
from pytest_pafot.support.traced import Traced

HEADS = ("id", "requirement", "requirement id")
"""The names of the first column by which a list of requirements shows that its first line has none."""

OPEN, ACCEPTED, FLAKY, DRIFTED, FIXED = "open", "accepted", "flaky", "drifted", "fixed"
STATES = (OPEN, ACCEPTED, FLAKY, DRIFTED, FIXED)
"""The states of a failure. ``open`` is one that fails, or that no given session has replayed."""

BROKE_OFF = "not tested, the session broke off"
"""The state of a requirement whose tests did not all come to an end in the last session that began them."""

FAILED = ("failed", "error")
"""The results of items that fail."""

_STATE_OF: Mapping[str, str] = {
    "passes": FIXED, "fixed": FIXED, "fixed before": FIXED, "drifted": DRIFTED, "judged otherwise": DRIFTED,
    "flaky": FLAKY,
}  # fmt: skip
"""The state by the status of a finding in the results, unless its item fails; any other status is open."""


def _passes(entry: Mapping[str, Any]) -> bool:
    """Return whether the saved scenario of an entry passed. Its item fails even so if its failure was accepted."""
    return entry.get("status") in ("passes", "fixed", "fixed before", "still failing elsewhere") or (
        entry.get("status") in (DRIFTED, "judged otherwise") and not entry.get("headline")
    )


def _state_in(entry: Mapping[str, Any]) -> str:
    """Return the state of a finding in a session: the result of its item, and only then the label of its replay."""
    if entry.get("result") == "xfailed":
        return ACCEPTED
    state = _STATE_OF.get(entry.get("status", ""), OPEN)
    return OPEN if entry.get("result") in FAILED and state != FIXED else state


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.usage = "%(prog)s [RESULTS.json ...] [options] [-- ARGUMENT OF PYTEST ...]"
    of_results = f"results of sessions, from {flag('json')}"
    parser.add_argument("results", nargs="*", type=Path, metavar="RESULTS.json", help=of_results)
    of_format = "how to print it (default: text)"
    parser.add_argument("--format", choices=("text", "markdown", "csv"), default="text", help=of_format)
    of_course = "print a row for each requirement and day: new, open and fixed failures, and the rate of random ones"
    parser.add_argument("--course", action="store_true", help=of_course)
    of_list = "all requirements that there are: a line for each, with its id, and if wanted its title and owner"
    parser.add_argument("--list", type=Path, metavar="FILE.csv", help=of_list)
    of_today = "the day with which last days of accepted failures are compared (default: today)"
    parser.add_argument("--today", type=day_argument, default=None, metavar="YYYY-MM-DD", help=of_today)
    parser.add_argument("--fail-on", choices=(OPEN,), help="end with exit code 1 if a requirement has an open failure")


def run(arguments: argparse.Namespace, _: Sequence[str]) -> int:
    """Print what is known of each requirement; return the exit code, 1 if one is open and ``--fail-on`` asks for it."""
    read = {path: Session.read(path) for path in arguments.results}
    undated = [visible(str(path)) for path, session in read.items() if not session.day]
    if 0 < len(undated) < len(read):
        sys.stderr.write(
            f"requirements: without a day, and so counted as older than all others: {', '.join(undated)}; run their "
            f"session with {flag('today')}\n"
        )
    sessions = Session.grouped(read.values())
    listed = {} if arguments.list is None else listed_in(arguments.list)
    inventory = Inventory.collected(arguments.pytest)
    if inventory.problem:
        sys.stderr.write(f"requirements: some tests could not be collected, and are missing:\n{inventory.problem}\n")
    table = Table.of(inventory, sessions, listed, today=arguments.today or date.today())
    writers = {"text": text_lines, "markdown": markdown_lines, "csv": csv_lines}
    lines = writers[arguments.format](table, course=arguments.course)
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    # A table that lacks tests cannot say that nothing is open.
    is_open = bool(inventory.problem) or any(each.failures(OPEN) or each.broke_off for each in table.requirements)
    return int(arguments.fail_on == OPEN and is_open)


# Reading the list of all requirements.


def listed_in(path: Path) -> dict[str, Traced]:
    """Read the list of all requirements: in each line an id, then a title and an owner if there are any.

    Raises:
        RequestError: if the file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        head = text.partition("\n")[0]
        delimiter = ";" if ";" in head and "," not in head else ","  # as spreadsheets write it in some countries
        rows = list(csv.reader(io.StringIO(text, newline=""), delimiter=delimiter))
    except (OSError, ValueError, csv.Error) as error:
        why = getattr(error, "strerror", None) or type(error).__name__
        raise RequestError(f"{visible(str(path))}: expected a list of requirements as CSV, received {why}") from None
    if rows and rows[0] and rows[0][0].strip().lower() in HEADS:
        rows = rows[1:]
    padded = ([cell.strip() for cell in [*row, "", ""]] for row in rows)
    return {id_: Traced(requirements=(id_,), title=title, owner=owner) for id_, title, owner, *_ in padded if id_}


# The state of each failure and each requirement.


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A failure of a requirement: a finding, or a test that fails without one.

    Attributes:
        id: id of the finding, or the name of the test.
        state: one of ``STATES``.
        detail: what else is known of the state, such as ``issue 12, until 2027-01-31``; may be empty.
        severity, responsible: how bad it is, and who is responsible, as the last session measured it, or else as its
            file has it.
        since: day and commit of the session since which it fails; empty if that is not known.
    """

    id: str
    state: str
    detail: str = ""
    severity: Severity | None = None
    responsible: str = "none"
    since: str = ""

    @property
    def rank(self) -> tuple[Any, ...]:
        """The key that sorts failures, the worst first."""
        return STATES.index(self.state), *Severity.worst_first(self.responsible, self.severity, None), self.id

    def __str__(self) -> str:
        measured = "" if self.severity is None else f" {self.severity}"
        since = f", since {self.since}" if self.since else ""
        return f"{self.id}{measured}{since}{f' ({self.detail})' if self.detail else ''}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Day:
    """A requirement in one session: runs, failures, and random scenarios in which the test failed.

    ``new`` counts those failures that were not open in the session before, ``drifted`` those that were, and ``fixed``
    those that were open at some time before and not fixed since.
    """

    session: Session
    runs: int
    new: int
    open: int
    fixed: int
    drifted: int
    random_failing: int
    random_runs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Requirement:
    """A requirement with its tests, its failures and its course.

    ``days`` has the sessions that saw its tests or their findings, the last one at the end. ``broke_off`` says which
    session did not come to the end of its tests, if none has since; otherwise it is empty.
    """

    traced: Traced
    tests: tuple[str, ...] = ()
    all_failures: tuple[Failure, ...] = ()
    days: tuple[Day, ...] = ()
    broke_off: str = ""

    def failures(self, state: str) -> list[Failure]:
        """Return the failures in a state, the worst first."""
        return sorted((each for each in self.all_failures if each.state == state), key=lambda each: each.rank)

    @property
    def runs(self) -> int:
        """The number of runs of all given sessions."""
        return sum(day.runs for day in self.days)

    @property
    def searched(self) -> Day | None:
        """The last session that searched; None if none did."""
        return next((day for day in reversed(self.days) if day.runs), None)

    @property
    def state(self) -> str:
        """The state of the requirement in a few words."""
        if self.broke_off and not self.failures(OPEN):
            return BROKE_OFF
        for state in (OPEN, ACCEPTED, FLAKY, DRIFTED):
            if self.failures(state):
                return state
        return "no test" if not self.tests else "no failure known" if self.days else "not tested"

    @property
    def rank(self) -> tuple[Any, ...]:
        """The key that sorts requirements, the one with the worst open failure first."""
        first = min((each.rank for each in self.all_failures), default=(len(STATES),))
        if self.broke_off and self.state == BROKE_OFF:
            first = (STATES.index(OPEN) + 0.5,)
        return first[0], *first[1:-1], self.traced.ids


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """All requirements, the worst first; the tests that name none, files whose test is gone, and the sessions."""

    requirements: tuple[Requirement, ...]
    without: tuple[str, ...] = ()
    orphans: tuple[str, ...] = ()
    sessions: tuple[Session, ...] = ()

    @classmethod
    def of(
        cls,
        inventory: Inventory,
        sessions: Sequence[Session],
        listed: Mapping[str, Traced],
        *,
        today: date,
    ) -> Table:
        """Join what the tests, the saved scenarios, the sessions and a list say of each requirement."""
        course = Course.of(inventory, sessions)
        tests: dict[str, list[str]] = {}
        for test, told in inventory.tests.items():
            for id_ in told.requirements:
                tests.setdefault(id_, []).append(test)
        saved = {
            (test, each.id): each
            for file, test in inventory.files.items()
            for each in [Saved.read(inventory.root / file)]
        }
        known: dict[str, list[Failure]] = {}
        for key in {**saved, **course.events}:
            file = saved.get(key)
            names = {event.entry.get("file") or "" for event in course.events.get(key, {}).values()}
            is_file = any(name and (inventory.root / name).is_file() for name in names)
            failure = course.failure(key, file, is_file=is_file, today=today)
            if failure is not None:
                for id_ in course.by_test.get(key[0], ()):
                    known.setdefault(id_, []).append(failure)
        requirements = [
            Requirement(
                traced=_traced(id_, [inventory.tests[test] for test in tests.get(id_, ())], course.named, listed),
                tests=tuple(sorted(tests.get(id_, ()))),
                all_failures=tuple(known.get(id_, ())),
                days=tuple(course.days(id_)),
                broke_off=course.broke_off(tests.get(id_, ())),
            )
            for id_ in {**tests, **course.named, **listed}
        ]
        return cls(
            requirements=tuple(sorted(requirements, key=lambda each: each.rank)),
            without=tuple(sorted(test for test, told in inventory.tests.items() if not told.requirements)),
            orphans=tuple(sorted(inventory.orphans)),
            sessions=tuple(sessions),
        )


def _traced(
    id_: str, of_tests: Sequence[Traced], of_sessions: Mapping[str, Traced], listed: Mapping[str, Traced]
) -> Traced:
    """Return title and owner of a requirement: from the list, else from its tests, else from the last session."""
    first = listed.get(id_, Traced())
    # The title of a test that checks only this requirement is more likely to be its own.
    others = sorted(of_tests, key=lambda each: len(each.requirements)) or [of_sessions.get(id_, Traced())]
    owners = ", ".join(dict.fromkeys(each.owner for each in others if each.owner))
    title = next((each.title for each in (first, *others) if each.title), "")
    return Traced(requirements=(id_,), title=title, owner=first.owner or owners)


Key = tuple[str, str]
"""A finding: the node id of its test, and its id."""


@dataclass(frozen=True, slots=True)
class Event:
    """The state of a finding, or of a test that failed without one, in one session, with its entry in the results."""

    state: str
    entry: Mapping[str, Any]


@dataclass(slots=True)
class Course:
    """The course of each finding through the sessions.

    Attributes:
        sessions: in their order; sessions are named by their numbers.
        events: for each finding what a session saw of it, by the session. Of shards that differ, the worst counts.
        searched: for each test the sessions in which it ran, and was not only replayed or skipped.
        unended: for each test the sessions in which it did not come to an end, or in which its search could not begin,
            each with the reason.
        named: the requirements that the results name, as in the last session that names them.
        by_test: the requirements of each test: as its marks say now, or as the last results say if the test is gone.
    """

    sessions: Sequence[Session]
    events: dict[Key, dict[int, Event]] = field(default_factory=dict)
    searched: dict[str, set[int]] = field(default_factory=dict)
    unended: dict[str, dict[int, str]] = field(default_factory=dict)
    named: dict[str, Traced] = field(default_factory=dict)
    by_test: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, inventory: Inventory, sessions: Sequence[Session]) -> Course:
        """Follow each finding and each failing test through the sessions."""
        course = cls(sessions)
        for number, session in enumerate(sessions):
            # A shard that only replayed does not know what the search of the same test found in another shard.
            found = {(test, signature) for test, each in session.searched for signature in each.get("failures", ())}
            for entry in session.findings:
                test = course._names(entry["test"] if entry.get("test") else entry["node_id"], entry)
                state = _state_in(entry)
                is_elsewhere = state == FIXED and (test, entry.get("signature")) in found
                course._see((test, entry.get("id", "")), number, Event(OPEN if is_elsewhere else state, entry))
            for test, entry in (*session.searched, *((entry["node_id"], entry) for entry in session.tests)):
                course._names(test, entry)
                result, has_findings = entry.get("result", ""), entry.get("finds") or entry.get("unsaved")
                # A search without a run was refused: its stored state is of other versions, or its world cannot be
                # made. It says nothing of the requirement, and when it runs again, nothing was fixed.
                is_refused = "runs" in entry and not entry["runs"] and result in FAILED and not has_findings
                if not result or is_refused:
                    for each in course._begun(test, inventory):
                        course.unended.setdefault(each, {})[number] = one_line(entry.get("message", ""))
                if result in ("", "skipped") or is_refused:
                    continue
                course.searched.setdefault(test, set()).add(number)
                # A search that has findings fails because of them, and they are in the results on their own.
                failed = result in FAILED and not has_findings
                if failed or (test, "") in course.events:
                    state = OPEN if failed else ACCEPTED if result == "xfailed" else FIXED
                    course._see((test, ""), number, Event(state, entry))
        course.by_test.update((test, each.requirements) for test, each in inventory.tests.items())
        return course

    def _begun(self, node_id: str, inventory: Inventory) -> Iterable[str]:
        """Return the tests of an item that did not end. A replay's item may be any of those of its function."""
        if node_id in inventory.tests:
            return [node_id]
        function = node_id.partition("[")[0]
        return [test for test in inventory.tests if test.partition("[")[0] == function]

    def broke_off(self, tests: Sequence[str]) -> str:
        """Return which session began some tests last and did not end all of them, and why; empty if it ended all."""
        later: set[str] = set()  # the tests that a later session has ended
        for number in range(len(self.sessions) - 1, -1, -1):
            # That another test has ended since says nothing of a test that began and did not end.
            reasons = [
                self.unended[each][number]
                for each in tests
                if number in self.unended.get(each, {}) and each not in later
            ]
            ended = {test for test in tests if number in self.searched.get(test, ())}
            if reasons or (self.sessions[number].broke_off and not later and len(ended) < len(tests)):
                told = next(filter(None, reasons), "the session did not come to its end")
                return ": ".join(filter(None, [self.sessions[number].name, told]))
            later |= ended
        return ""

    def _names(self, test: str, entry: Mapping[str, Any]) -> str:
        """Note the requirements that an entry names; return its test."""
        self.by_test[test] = tuple(entry.get("requirements", ()))
        for id_ in self.by_test[test]:
            self.named[id_] = Traced(requirements=(id_,), title=entry.get("title", ""), owner=entry.get("owner", ""))
        return test

    def _see(self, key: Key, number: int, event: Event) -> None:
        known = self.events.setdefault(key, {})
        if number not in known or STATES.index(event.state) < STATES.index(known[number].state):
            known[number] = event

    def failure(self, key: Key, saved: Saved | None, *, is_file: bool, today: date) -> Failure | None:
        """Return a finding with its present state; None if it has no file here and its test ran without it since.

        ``is_file`` is True if its file is in the corpus, although no test that was collected replays it.
        """
        test, id_ = key
        events = self.events.get(key, {})
        last = max(events, default=-1)
        if saved is None and last < max(self.searched.get(test, ()), default=-1):
            return None  # Its file was removed, or it was fixed without one.
        state = events[last].state if events else OPEN
        entry = events[last].entry if events else {}
        finding = None if saved is None else saved.finding
        detail = "not replayed by a given session" if not events else ""
        if saved is None and id_:
            detail = "its test was not collected here" if is_file else "not in the corpus here"
        if entry.get("status") in ("still failing, nearby", "still failing elsewhere", "error"):
            detail = ": ".join(filter(None, [entry["status"], entry.get("elsewhere", "")]))
        if not id_:
            detail = one_line(entry.get("message", ""))
        is_beyond = entry.get("result") in FAILED and not _passes(entry)
        if finding is not None and finding.is_accepted(today) and is_beyond:
            state, detail = OPEN, f"not the failure that is accepted: {finding.accepted}"
        elif finding is not None and finding.is_accepted(today):
            passes = "; it passes now, so remove the line" if state == FIXED and not finding.xfail_flaky else ""
            state, detail = ACCEPTED, f"{finding.accepted}{passes}"
        elif finding is not None and finding.xfail is not None:
            state = OPEN if state == ACCEPTED else state
            detail = f"accepted, {finding.accepted}, which is over"
        elif finding is not None and finding.flaky is not None and not is_beyond:
            state = FLAKY
        elif saved is not None and finding is None:
            state, detail = OPEN, "the file cannot be read"
        measured = next((events[n].entry for n in sorted(events, reverse=True) if events[n].entry.get("severity")), {})
        return Failure(
            id=id_ or test,
            state=state,
            detail=detail,
            severity=_severity(measured.get("severity"))
            or (None if finding is None else Severity.in_file(finding.expect)),
            responsible=measured.get("responsible", "none") if finding is None else finding.expect.responsibility,
            since="" if state in (FIXED, DRIFTED) else self._since(key),
        )

    def _since(self, key: Key) -> str:
        """Return the session since which a finding fails in each session that saw it; empty if it does not fail."""
        events, searched = self.events.get(key, {}), self.searched.get(key[0], set())
        first = None
        for number in sorted(events.keys() | searched):
            fails = number in events and events[number].state in (OPEN, ACCEPTED)
            first = (number if first is None else first) if fails else None
        return "" if first is None else self.sessions[first].name

    def days(self, id_: str) -> Iterator[Day]:
        """Yield the course of a requirement: a value for each session that saw one of its tests or findings."""
        failing: set[Key] = set()
        unfixed: set[Key] = set()
        own = {key: events for key, events in self.events.items() if id_ in self.by_test.get(key[0], ())}
        tests = {test for test, ids in self.by_test.items() if id_ in ids}
        for number, session in enumerate(self.sessions):
            ran = {test for test in tests if number in self.searched.get(test, ())}
            seen = {key: events[number].state for key, events in own.items() if number in events}
            searches = [each for test, each in session.searched if test in tests]
            if not ran and not seen and not any(each.get("runs") for each in searches):
                continue  # nothing but skipped tests
            before = failing
            # What was open stays so until it is seen again, or until its test ran without it.
            failing = {key for key in before if key not in seen and key[0] not in ran}
            failing |= {key for key, state in seen.items() if state == OPEN}
            fixed = {key for key, state in seen.items() if state == FIXED and key in unfixed}
            unfixed = (unfixed | failing) - fixed
            drawn = [each for each in searches if not each.get("given")]  # else saved scenarios came first
            yield Day(
                session=session,
                runs=sum(each.get("runs", 0) for each in searches),
                new=len(failing - before),
                open=len(failing),
                fixed=len(fixed),
                drifted=sum(state == DRIFTED and key in before for key, state in seen.items()),
                random_failing=sum(each.get("random_failing", 0) + each.get("random_otherwise", 0) for each in drawn),
                random_runs=sum(each.get("random_runs", 0) for each in drawn),
            )


MOST_SEVERE = 1e9
"""A limit of the figures of a severity, which also leaves out what is no number."""


def _severity(data: Any) -> Severity | None:
    """Return the severity in the results; None if they have none, or something else."""
    try:
        severity = Severity(**data)
        texts, numbers = (severity.kind, severity.unit, severity.name), (severity.value, severity.margin)
        is_right = all(isinstance(each, str) for each in texts) and all(
            each is None or (isinstance(each, (int, float)) and abs(each) < MOST_SEVERE) for each in numbers
        )
    except (TypeError, AttributeError):
        return None
    return severity if is_right else None


# The table as text, Markdown and CSV.

MOST_NAMED = 5
"""The largest number of failures of one state, and of tests, that the text names. Any more are counted."""

COLUMNS = (
    "requirement",
    "title",
    "owner",
    "state",
    *STATES,
    "worst",
    "since",
    "runs",
    "last searched",
    "random failures",
    "tests",
)
COURSE = ("requirement", "day", "commit", "runs", "new", "open", "fixed", "drifted", "random failures")


def _rate(failing: int, runs: int) -> str:
    return f"{failing} of {runs}, {interval_text(failing, runs)}" if runs else ""


def _cells(requirement: Requirement) -> list[object]:
    """Return the cells of a requirement's row, in the order of the columns."""
    told, last = requirement.traced, requirement.searched
    worst = next((each for state in STATES[:-1] for each in requirement.failures(state)), None)
    return [
        told.ids,
        told.title,
        told.owner,
        requirement.state,
        *(len(requirement.failures(state)) for state in STATES),
        "" if worst is None else f"{worst.id} {worst.severity or ''}".rstrip(),
        min((each.since for each in requirement.failures(OPEN) if each.since), default=""),
        requirement.runs,
        "" if last is None else last.session.name or "yes",
        "" if last is None else _rate(last.random_failing, last.random_runs),
        ", ".join(requirement.tests),
    ]


def _course_cells(requirement: Requirement) -> Iterator[list[object]]:
    for day in requirement.days:
        session, rate = day.session, _rate(day.random_failing, day.random_runs)
        figures = (day.runs, day.new, day.open, day.fixed, day.drifted)
        yield [requirement.traced.ids, session.day, session.commit[:10], *figures, rate]


def text_lines(table: Table, *, course: bool) -> Iterator[str]:
    """Yield the lines of the table for people: a block for each requirement, the worst first."""
    width = shutil.get_terminal_size().columns
    states = [each.state for each in table.requirements]
    counts = [f"{states.count(state)} {state}" for state in dict.fromkeys(states)]
    yield f"{plural(len(states), 'requirement')}{': ' if counts else ''}{', '.join(counts)}"
    for requirement in table.requirements:
        yield ""
        yield from wrapped_to(ascii_text(requirement.traced.described), width)
        for name, text in _parts(requirement):
            yield from wrapped_to(ascii_text(f"  {name:9} {text}"), width)
        if course or len(table.sessions) > 1:
            yield from _course_lines(requirement, width)
    for title, names in _left_over(table):
        yield ""
        yield from wrapped_to(ascii_text(f"{title}: {_named(names)}"), width)


def _course_lines(requirement: Requirement, width: int) -> list[str]:
    """Return the table of a requirement's days, without the intervals of the rates if it is wider than a width."""
    rows = [list(map(str, cells[1:])) for cells in (COURSE, *_course_cells(requirement))]
    lines: list[str] = []
    for parted in ("\n", " ("):  # a rate has no line break
        shown = [[*cells, rate.partition(parted)[0]] for *cells, rate in rows]
        widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
        padded = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in shown)
        lines = [line for row in padded for line in wrapped_to(ascii_text(f"    {row}"), width)]
        if len(lines) == len(rows):
            break
    return lines if len(rows) > 1 else []


def _parts(requirement: Requirement) -> Iterator[tuple[str, str]]:
    for state in STATES:
        failures = requirement.failures(state)
        if failures:
            yield state, f"{len(failures)}: {_named(map(str, failures), separator='; ')}"
    if requirement.broke_off:
        yield "broke off", requirement.broke_off
    last = requirement.searched
    if last is None:
        yield "searched", "not in a given session"
    else:
        when = f", last on {last.session.name}" if last.session.name else ""
        yield "searched", f"{plural(requirement.runs, 'run')}{when}"
        rate = _rate(last.random_failing, last.random_runs)
        yield "random", f"{rate} failed then" if rate else "no random scenario was drawn then"
    yield "tests", _named(requirement.tests) or "none"


def _left_over(table: Table) -> Iterator[tuple[str, Sequence[str]]]:
    """Yield what belongs to no requirement or has no test, each with its names."""
    untested = [each.traced.ids for each in table.requirements if not each.tests]
    for title, names in (
        ("requirements without a test", untested),
        ("tests without a requirement", table.without),
        ("saved scenarios whose test is gone", table.orphans),
    ):
        if names:
            yield title, names


def _named(names: Iterable[str], separator: str = ", ") -> str:
    listed = list(names)
    more = f" and {len(listed) - MOST_NAMED} more" if len(listed) > MOST_NAMED else ""
    return f"{separator.join(listed[:MOST_NAMED])}{more}"


def markdown_lines(table: Table, *, course: bool) -> Iterator[str]:
    """Yield the table as Markdown; nothing in texts from files, tests and results becomes markup or a link."""

    def escaped(cells: Iterable[object]) -> list[str]:
        return [plain(str(cell)) for cell in cells]

    if not course:
        yield markdown_table(COLUMNS, map(escaped, map(_cells, table.requirements)))
    if not course and len(table.sessions) > 1:
        yield ""
    if course or len(table.sessions) > 1:
        yield markdown_table(COURSE, (escaped(row) for each in table.requirements for row in _course_cells(each)))
    for title, names in _left_over(table):
        yield ""
        yield f"{title}: {', '.join(map(code, names))}"


def csv_lines(table: Table, *, course: bool) -> Iterator[str]:
    """Yield the table as CSV, with an empty requirement for tests that name none."""
    rows = [row for each in table.requirements for row in (_course_cells(each) if course else [_cells(each)])]
    if not course and table.without:
        rows.append(["", "", "", "no requirement", *[""] * (len(COLUMNS) - 5), ", ".join(table.without)])
    yield csv_text(COURSE if course else COLUMNS, (map(spreadsheet_cell, row) for row in rows)).rstrip("\n")
