"""Findings as stored in the corpus, and rules for interpreting their replays."""

from __future__ import annotations

import linecache
import math
import os
import re
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from datetime import date
from itertools import islice
from types import TracebackType
from typing import Any

from pytest_pafot.attribution.responsibility import (
    Fault,
    Manoeuvre,
    Mistake,
    Responsibility,
    manoeuvre_before,
)
from pytest_pafot.attribution.sentences import impact, responsible_sentence
from pytest_pafot.findings.shrink import Shrunk
from pytest_pafot.findings.situation import (
    BEFORE,
    Situation,
    ZoneSituation,
    missed,
    seconds_after,
    situation_of,
)
from pytest_pafot.findings.verdict import (
    AT_ZONES,
    CHECK_FAILED,
    IN_MEMORY,
    PROCESS_CRASH,
    Failure,
    Severity,
    Signature,
    normalised,
    severity_of,
    zone_in_words,
)
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.scenario import MAX_SEED, Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Outcome, Side, Trace, first_difference
from pytest_pafot.oracle.run import Check, CheckFailed, Run
from pytest_pafot.support.errors import FieldError, plain_number
from pytest_pafot.support.text import capitalised, visible

# Everything that differs between processes is removed from error messages, so that equal seeds lead to equal files.

_ADDRESS = re.compile(r"(?<=\bat )0x[0-9a-fA-F]+|\b0x[0-9a-fA-F]{9,}\b")
_PROCESS_ID = re.compile(r"(?i)(\b(?:pid|tid|process id|thread id|started(?: daemon)?)[ =:]+)\d+")
_FOLDERS = r"(?:[^\s\"'<>|*?:\\/]+[\\/])*"
_TO_PACKAGES = re.compile(
    # A match can start only at the first character of a path. Otherwise, a long path would take quadratic time.
    rf"(?<![\w.])(?:[A-Za-z]:)?[\\/]{_FOLDERS}(?=(?:site|dist)-packages[\\/]|python3\.\d+[\\/](?!site|dist))"
)
_TEMPORARY = re.compile(
    r"(?<![\w.])(?:(?:/private)?/(?:var/)?tmp|(?:/private)?/var/folders/\w+/\w+/T"
    rf"|[A-Za-z]:\\Users\\\w+\\AppData\\Local\\Temp)[\\/]{_FOLDERS}(?P<name>[^\s\"'<>|*?:\\/]*)"
)
_RANDOM = re.compile(r"(?<=[\\/])(?:tmp[a-z0-9_]{8}(?!\w)|pytest-of-[^\\/]+[\\/]pytest-\d+)")


def portable(text: str, root: str = "") -> str:
    """Replace the parts of a string that differ between processes or checkouts."""
    # paths become relative to the project here, and to the folder of installed packages below
    if root:
        text = text.replace(root.rstrip("\\/") + os.sep, "")
    text = _TO_PACKAGES.sub("", text)
    text = _TEMPORARY.sub(r"TMP/\g<name>", _RANDOM.sub("tmp", text))
    return _PROCESS_ID.sub(r"\g<1>N", _ADDRESS.sub("ADDRESS", text))


MAX_MESSAGE = 300
MAX_TRACEBACK = 8000
MAX_KEY = 64
MAX_DEPTH = 16
MAX_NUMBER = 1e9
RUNS = 10  # the number of runs, each with another seed, that measure how often a policy fails

# If at least this many of ten runs failed, ten runs without a failure show a fix. If 30 % of all runs fail, the chance
# that none of ten runs fails is 0.7 ** 10, less than 3 %.
ENOUGH = 3

# Ids are part of file names and node ids on every platform.
_ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,119}")
ID_RULE = "1 to 120 ASCII letters, digits, '_', '-' and '.', with no '-' or '.' at the start and no '.' at the end"


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounded:
    """The value and the bounds of a failed check, in the check's unit."""

    # None if it was not a finite number, or if its magnitude was above a billion
    value: float | None = None
    at_most: float | None = None
    at_least: float | None = None
    unit: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Expect:
    """The result that a saved scenario gives until its failure is fixed.

    Attributes:
        failure: name of the exception class; `ProcessCrash` if the process died or hung.
        assertion: the normalised assertion, or the name of the failed check.
        check: value and bounds of the failed check, or None.
        message: first line of the exception's message; empty if ``assertion`` already states it.
        outcome: how the run ended.
        time: time [s] of the failed check, or else of the run's most important event.
        npc, cell: the NPC and its cell at the collision, or else at the smallest time to contact. For a failed check,
            the NPC that the check names.
        zone: zone in which the NPC crossed, such as ``crossing from the left``.
        side: side of the ego that was hit.
        closing_speed: closing speed [m/s] of the collision, or None if unknown.
        situation: situation from which the failure arose, or None. A replay in which it does not occur
            does not show a fix.
        responsibility: who is responsible for the collision.
        fault: rule that the ego broke.
        mistake: what the ego did wrong, for the fault ``entered-lane``.
        npc_manoeuvre, ego_manoeuvre: manoeuvres shortly before the collision.
        takeover: latest takeover by a careful driver that avoids the collision [s before the impact]; 0 if no takeover
            in the last 3 s avoids it, None if unknown.
        against: the reference that passed the scenario, such as ``module:factory``; empty if there was none.
        traceback: traceback of the ADS's exception, or empty.
    """

    failure: str
    assertion: str = ""
    check: Bounded | None = None
    message: str = ""
    outcome: Outcome
    time: float
    npc: int | None = None
    cell: Cell | None = None
    zone: str | None = None
    side: Side | None = None
    closing_speed: float | None = None
    responsibility: Responsibility = "none"
    fault: Fault | None = None
    mistake: Mistake | None = None
    npc_manoeuvre: Manoeuvre | None = None
    ego_manoeuvre: Manoeuvre | None = None
    situation: Situation | ZoneSituation | None = None
    takeover: float | None = None
    against: str = ""
    traceback: str = ""

    @property
    def is_crash(self) -> bool:
        return self.failure == PROCESS_CRASH

    @property
    def signature(self) -> Signature:
        # The identity of the failure, as far as these fields determine it.
        facts = {part.name: getattr(self, part.name, None) for part in fields(Signature)}
        return Signature.from_facts(**facts)

    @property
    def brief(self) -> str:
        """The failure in one line, such as the check with its value and bound."""
        if self.check is not None:
            told = asdict(self.check) | {"time": self.time, "npc": self.npc}
            if self.check.value is None:
                told["value"] = math.nan
            return str(Check(name=self.assertion, margin=-1.0, **told))
        if self.message:
            return f"{self.failure}: {self.message}"
        if self.is_crash:
            return self.failure
        if self.signature.is_property or self.outcome is Outcome.COMPLETED:
            what = self.assertion.removeprefix("assert ") or "the test function"
            if self.failure == AssertionError.__name__:
                return f"{what} fails"
            return f"{what} raises {self.failure}"
        if self.outcome is not Outcome.COLLISION:
            return f"{self.outcome} after {self.time:.1f} s"
        whence = (self.zone or "").partition(" ")[2]
        line = impact(self.time, self.npc, self.side, self.cell, whence, self.closing_speed)
        return capitalised(line)

    def is_of(self, run: Run) -> bool:
        """Return whether a run contains this finding's collision, at the same time and with the same NPC."""
        hit = run.collision
        return hit is not None and (round(hit.time, 3), hit.npc) == (self.time, self.npc)

    def sentences_on(self, run: Run) -> tuple[str, ...]:
        # If the run has this collision, the last sentence also states whether a careful driver could have avoided it.
        told = run.sentences
        if self.takeover is None or not self.is_of(run):
            return told
        responsible = run.attribution.responsibility
        return *told[:-1], responsible_sentence(responsible, self.npc, self.takeover)

    @classmethod
    def from_run(
        cls,
        run: Run,
        failure: Failure,
        *,
        takeover: float | None = None,
        against: str = "",
        root: str = "",
    ) -> Expect:
        # The result must be equal in every process, so times are rounded and texts are portable.
        hit, trace, event = run.collision, run.trace, event_of(run, failure)
        attribution, check = run.attribution, failure.check
        assertion = normalised(failure.assertion, failure.message)
        facts: dict[str, Any] = {}
        if check is not None:
            assertion = failure.assertion
            # The last digits of a measured value depend on the processor. Those of a bound do not, so more are kept.
            bounds = {name: _rounded(bound, 6) for name, bound in check.bounds.items()}
            facts["check"] = Bounded(value=_rounded(check.value, 3), unit=check.unit, **bounds)
        # An assertion already contains its message. An error of the ADS is known by its message alone.
        if run.ads_error is not None or not failure.assertion.strip():
            message = next(filter(None, map(str.strip, failure.message.splitlines())), "")
            facts["message"] = portable(message[: 4 * MAX_MESSAGE], root)[:MAX_MESSAGE]
        if hit is not None:
            facts["side"] = hit.side
            facts["closing_speed"] = _rounded(hit.closing_speed, 3)
            facts["ego_manoeuvre"] = manoeuvre_before(trace, 0, hit.tick)
            # In a zone, only the NPC's origin matters, and a fixed object does not move.
            if hit.npc is not None and not event.zone:
                facts["npc_manoeuvre"] = manoeuvre_before(trace, hit.npc + 1, hit.tick)
        # The mistake follows from any other fault.
        if attribution.fault == "entered-lane":
            facts["mistake"] = attribution.mistake
        # The last lines show where it was raised. The text is cut here and below, because making it portable is slow.
        text = portable(failure.traceback[-4 * MAX_TRACEBACK :], root)
        if len(text) > MAX_TRACEBACK:
            text = "...\n" + text[-MAX_TRACEBACK:].split("\n", 1)[-1]
        return cls(
            failure=failure.kind,
            assertion=assertion,
            outcome=run.outcome,
            time=round(event.time, 3),
            npc=event.npc,
            cell=event.cell,
            zone=event.zone,
            situation=situation_of(run, failure, event.time),
            responsibility=attribution.responsibility,
            fault=attribution.fault,
            takeover=takeover,
            against=against,
            traceback=text,
            **facts,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The origin of a finding.

    Attributes:
        seed: seed of the search, which depends on the base seed and the test, and cannot be passed to ``--pafot-seed``.
        generation: generation in which the search found the failure, counted from 0.
        algorithm: name of the search algorithm, or ``crash`` for a crash record.
        policy: name of the policy; None if it is unknown.
        worst_closing_speed: highest closing speed [m/s] of the same failure in that search; None without a
            collision.
        versions: versions of the packages on which the run depends.
    """

    seed: int
    generation: int
    algorithm: str
    policy: str | None = None
    worst_closing_speed: float | None = None
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureRate:
    """The numbers of failing runs and of all runs of one scenario."""

    failing: int
    runs: int = RUNS

    def __str__(self) -> str:
        return f"{self.failing or 'none'} of {self.runs}"


def with_other_seed(scenario: Scenario, number: int) -> Scenario:
    """Return a scenario with a different seed, or the scenario itself for the number 0."""
    return replace(scenario, seed=(scenario.seed + number) % (MAX_SEED + 1))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Finding:
    """A distinct failure, as stored in one file of the corpus.

    Attributes:
        id: name of the file without its suffix, which never changes: letters, digits, ``.``, ``_`` and ``-``.
        test: node id of the test, including its parameters.
        scenario: the scenario that fails.
        world: the world in which the scenario fails, as JSON-compatible data.
        expect: the result that the scenario gives until the failure is fixed.
        found: the origin of the finding.
        perception: limits and errors of the ADS's perception; None if it is perfect.
        shrunk: the result of shrinking, or None.
        rate: how many runs of the scenario fail, if the policy draws random numbers or the scenario is flaky;
            otherwise None.
        flaky: difference between two runs of the scenario, or None. A flaky finding is never reported as fixed.
        xfail: the user's reason for accepting the failure, or None.
        xfail_until: the last day on which the failure is accepted, or None.
        trace: trace of the failing run, if a search in this process recorded it; otherwise None.
    """

    id: str
    test: str
    scenario: Scenario
    world: Mapping[str, Any]
    expect: Expect
    found: Found
    perception: Sight | None = None
    shrunk: Shrunk | None = None
    rate: FailureRate | None = None
    flaky: str | None = None
    xfail: str | None = None
    xfail_until: date | None = None
    trace: Trace | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)

    def __post_init__(self) -> None:
        if not is_id(self.id):
            raise ValueError(f"id: expected {ID_RULE}, received {self.id!r}")
        check_plain("world", self.world)

    def __repr__(self) -> str:
        # One line that is safe to print, even if a file contains control characters.
        shown = (f"{each.name}={getattr(self, each.name)!r}" for each in fields(self) if each.repr)
        return visible(f"Finding({', '.join(shown)})")

    @property
    def longest_run(self) -> float:
        """The longest duration [s] of a run in the finding's world, or infinity if it is unknown."""
        seconds = plain_number(self.world.get("duration"))
        if seconds is None:
            return math.inf
        return seconds

    @property
    def signature(self) -> Signature:
        """The identity of the failure, as far as the corpus file determines it."""
        return self.expect.signature

    @property
    def drawn(self) -> str:
        """The noun for the rate: ``seeds`` if each run has a different seed, otherwise ``runs``."""
        return "seeds" if self.flaky is None else "runs"

    @property
    def on_rate(self) -> str:
        """The failure rate in words, or an empty string if none was measured."""
        if self.rate is None:
            return ""
        if self.flaky is None:
            return f"it fails with {self.rate} other {self.drawn}"
        return f"it fails in {self.rate} {self.drawn}"

    @property
    def accepted(self) -> str:
        """The reason for accepting the failure and the last day of acceptance, or an empty string."""
        if self.xfail is None:
            return ""
        return f"{self.xfail}, until {self.xfail_until}"

    def accepting(self, reason: str | None, until: date | None) -> Finding:
        """Return a copy of the finding with this reason for acceptance and this last day."""
        return replace(self, xfail=reason, xfail_until=until)

    def is_accepted(self, today: date) -> bool:
        """Return whether the failure is accepted on the given day."""
        return self.xfail_until is not None and today <= self.xfail_until

    @property
    def worst_known(self) -> float:
        """The highest known closing speed [m/s] of this failure, or infinity if none is known."""
        speeds = [self.expect.closing_speed, self.found.worst_closing_speed]
        return max((each for each in speeds if each is not None), default=math.inf)

    def with_sight(self, line: str) -> str:
        """Add the limits of perception, if there are any, to a line about the failure."""
        if self.perception is None:
            return line
        return f"{line}, found with {self.perception.described}"

    @classmethod
    def from_run(
        cls,
        run: Run,
        failure: Failure,
        *,
        test: str,
        world: Mapping[str, Any],
        found: Found,
        perception: Sight | None = None,
        against: str = "",
        root: str = "",
    ) -> Finding:
        # The id is derived from the signature and the executed scenario.
        expect = Expect.from_run(run, failure, against=against, root=root)
        id_ = f"{signature_of_failure(run, failure).slug}-{run.scenario.id}"
        return cls(
            id=id_,
            test=test,
            scenario=run.scenario,
            world=world,
            expect=expect,
            found=found,
            perception=perception,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureEvent:
    """The time [s] of a failure, and the NPC involved, with its cell or zone."""

    time: float
    npc: int | None = None
    cell: Cell | None = None
    zone: str | None = None


def event_of(run: Run, failure: Failure | None) -> FailureEvent:
    """Return the event of a failed check, or else the run's most important event."""
    time, npc, cell = run.event_time, run.event_npc, run.event_cell
    if failure is not None and failure.check is not None:
        if failure.check.time is not None:
            time = failure.check.time
        if run.collision is None:
            return FailureEvent(time=time, npc=failure.check.npc)
    if npc is not None and run.trace.zones:
        zone = run.trace.zones[npc]
        if zone is not None and (cell is None or run.attribution.fault in AT_ZONES):
            return FailureEvent(time=time, npc=npc, cell=cell, zone=zone_in_words(zone))
    # Without a cell, the NPC is too far away to matter.
    if cell is None:
        return FailureEvent(time=time)
    return FailureEvent(time=time, npc=npc, cell=cell)


def _rounded(value: float | None, digits: int) -> float | None:
    # Round to `digits` decimals, or below 1 to `digits` significant digits.
    if value is None or not abs(value) <= MAX_NUMBER:
        return None
    if abs(value) >= 1:
        return round(value, digits)
    return float(f"{value:.{digits}g}")


def signature_of_failure(run: Run, failure: Failure) -> Signature:
    """Return the signature of a run's failure."""
    return replace(Expect.from_run(run, failure), mistake=run.attribution.mistake).signature


def is_id(text: str) -> bool:
    """Return whether a string is a valid id."""
    return _ID.fullmatch(text) is not None and not text.endswith(".")


def ads_failure(run: Run) -> Failure | None:
    """Return the failure of the ADS itself, or None if the ADS did not fail."""
    # An ADS fails if it raises, returns an invalid action or hangs, regardless of the test function.
    error = run.ads_error
    if error is None:
        return None
    return Failure(kind=error.kind, message=error.message, traceback=error.traceback)


def raised_failure(exception: BaseException, test_file: str) -> Failure:
    """Return the failure for an exception that a test function raised."""
    # `test_file` is the path in code objects.
    if isinstance(exception, CheckFailed):
        check = exception.check
        return Failure(kind=CHECK_FAILED, message=str(check), assertion=check.name, check=check)
    told = getattr(exception, "assertion", None)
    if type(exception) is AssertionError and isinstance(told, str):  # see oracle/run.py:require
        return Failure(kind="AssertionError", message=message_of(exception), assertion=told)
    # The assertion is the failed `assert` statement, even in a helper module. Without one, it is the last statement of
    # the test file in the traceback, so that changes in third-party libraries do not change a signature.
    assertion = deepest = ""
    for deepest, file in _statements(exception.__traceback__):
        if file == test_file and deepest:
            assertion = deepest
    if isinstance(exception, AssertionError):
        # Other code can precede it on the same line, as in `if run.collision: assert ...`.
        asserted = re.search(r"(?:^|[:;] *)(assert\b.*)", deepest, re.DOTALL)
        if asserted is not None:
            assertion = asserted[1]
    kind = type(exception).__name__
    return Failure(kind=kind, message=message_of(exception), assertion=assertion)


def message_of(exception: BaseException) -> str:
    """Return the message of an exception, even if ``__str__`` raises."""
    return str(traceback.TracebackException(type(exception), exception, None, compact=True))


def check_plain(name: str, value: object, depth: int = 0) -> None:
    """Raise a ValueError if a corpus file cannot store a value. The message names the unsuitable part."""
    if value is None or isinstance(value, bool | int | str):
        return
    if isinstance(value, float) and not math.isnan(value):
        return
    if depth >= MAX_DEPTH:
        expected = f"at most {MAX_DEPTH} levels of nesting"
        raise FieldError(field=name, expected=expected, received="more")
    if isinstance(value, Mapping):
        for key, inner in value.items():
            if not isinstance(key, str) or len(key) > MAX_KEY:
                expected = f"strings of at most {MAX_KEY} characters as keys"
                raise FieldError(field=name, expected=expected, received=f"the key {key!r:.80}")
            check_plain(f"{name}.{key}", inner, depth + 1)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            check_plain(f"{name}[{index}]", inner, depth + 1)
    else:
        expected = "null, a Boolean, a number other than NaN, a string, a list or a mapping"
        received = f"the {type(value).__name__} {value!r:.60}"
        raise FieldError(field=name, expected=expected, received=received, fix="convert the value")


def _statements(tb: TracebackType | None) -> Iterator[tuple[str, str]]:
    # The source text, which can be empty, and the file of each entry of the traceback.
    while tb is not None:
        frame, code = tb.tb_frame, tb.tb_frame.f_code
        # A negative index stands for no instruction, for which there is no position either.
        positions = islice(code.co_positions(), max(tb.tb_lasti // 2, 0), None)
        start, end, *_ = next(positions, (None, None))
        if tb.tb_lasti < 0:
            start = end = None
        first = start or tb.tb_lineno or 0
        last = end or first
        numbers = range(first, min(last, first + 50) + 1)
        lines = [linecache.getline(code.co_filename, number, frame.f_globals) for number in numbers]
        yield "".join(lines).strip(), code.co_filename
        tb = tb.tb_next


# The meaning of a replay: whether a run shows the failure of a file, and whether a pass shows a fix.

# Two runs without contact count as the same if no position differs by more than this distance [m].
SAME_PLACE = 0.5

# largest difference between the times of two events that count as the same event [s]
SAME_TIME = 0.2

# A replay that passes continues for this time after the end of the saved run [s]. A saved run ends shortly after its
# failure, so a policy that only drives more slowly would pass before it makes the same mistake.
DRIVEN_ON = 10.0

# An accepted collision can be faster than the worst known one by at most this difference [m/s].
ACCEPTED_FASTER = 1.0

# Outcomes that are the event of the run. For any other outcome, the event is the most critical moment.
HAS_EVENT = frozenset({Outcome.COLLISION, Outcome.ADS_ERROR, Outcome.HANG, Outcome.OFF_ROAD})


def handles(finding: Finding, run: Run) -> bool:
    """Return whether the policy handled the saved situation in a run that passed."""
    expect = finding.expect
    if expect.is_crash:  # The process survived, whatever the run shows.
        return True
    situation = expect.situation
    # If a different party is responsible for the same event, the policy has changed and not the test.
    is_same_party = situation is None or run.responsibility == expect.responsibility
    if is_same_party and is_same_event(expect, run):
        return True
    if unhandled(finding, run):
        return False
    # A failed check is handled if the run continued after the time of the check.
    if expect.check is not None and run.duration > expect.time:
        return True
    # A run that another event ended did not drive the rest of the scenario.
    if run.collision is None:
        return run.ads_error is None and run.outcome not in ("invalid", "off_road")
    # A collision that is not a failure must be more than 2 s after the situation, and longer after it than the failure.
    after = seconds_after(situation, run)
    if situation is None or after is None:
        return False
    return after > max(expect.time - situation.time, BEFORE)


def unhandled(finding: Finding, run: Run) -> str:
    """Return why a run that passed did not handle the saved situation, or an empty string if it did."""
    expect, hit, ended = finding.expect, run.collision, run.trace.ended
    if ended and not run.trace.users_error_text and run.duration < expect.time:
        return f"{ended} ended the run after {run.duration:.1f} s, before the saved failure at {expect.time:.1f} s"
    why = missed(expect.situation, run)
    if why or expect.situation is None or hit is None or hit.npc != expect.situation.npc:
        return why
    is_collision = expect.outcome is Outcome.COLLISION and expect.check is None
    if not is_collision or finding.signature.is_property:
        return ""
    # The file is about a collision with this NPC.
    return f"the ego and NPC {hit.npc} still collide at {hit.time:.1f} s, but the test accepts this"


def is_same_event(expect: Expect, run: Run, failure: Failure | None = None) -> bool:
    """Return whether a run contains the saved event.

    The time can differ by 0.2 s. A collision that is the run's ``failure`` can be at any time.
    """
    if failure is not None and failure.kind != expect.failure:
        return False
    now = event_of(run, failure)
    is_then = abs(now.time - expect.time) <= SAME_TIME + 1e-9
    if expect.check is not None:
        if failure is None or failure.check is None or failure.check.name != expect.assertion:
            return False
        return is_then or failure.check.time is None
    side = None
    if run.collision is not None:
        side = run.collision.side
    if (run.outcome, now.npc, side) != (expect.outcome, expect.npc, expect.side):
        return False
    # A collision that is a `failure` can be at another time: it is the same if NPC and side are the same.
    is_failure = failure is not None and run.collision is not None
    return is_failure or (is_then and now.cell == expect.cell)


def is_same_failure(finding: Finding, run: Run, failure: Failure) -> bool:
    """Return whether a run fails in the same way as the saved scenario, at any time."""
    return signature_of_failure(run, failure) == finding.signature


def beyond_acceptance(finding: Finding, run: Run, failure: Failure, *, same_versions: bool) -> str:
    """Describe how a failure differs from the accepted failure, or return an empty string."""
    # The time, the cell and the responsible vehicle can differ.
    then, now, hit = finding.signature, signature_of_failure(run, failure), run.collision
    if now.failure != then.failure:
        return f"{now.failure} instead of {then.failure}"
    if now.assertion != then.assertion:
        here, there = (each.assertion or "no assertion" for each in (now, then))
        return f"{here!r} fails instead of {there!r}"
    if run.outcome is not finding.expect.outcome:
        return f"the run ends with `{run.outcome}` instead of `{finding.expect.outcome}`"
    if hit is None or not same_versions:  # other versions of packages may move vehicles
        return ""
    if finding.expect.npc is not None and hit.npc != finding.expect.npc:
        return f"a collision with NPC {hit.npc} instead of NPC {finding.expect.npc}"
    if is_faster(severity_of(run, failure), finding.worst_known):
        return f"a closing speed of {hit.closing_speed:.1f} m/s instead of at most {finding.worst_known:.1f} m/s"
    return ""


def is_faster(severity: Severity | None, known: float) -> bool:
    """Return whether a collision's closing speed is above the limit for an accepted collision."""
    # the speeds have three decimals
    return (speed_of(severity) or 0.0) > known + ACCEPTED_FASTER + 0.0005


def speed_of(severity: Severity | None) -> float | None:
    """Return a failure's closing speed [m/s], rounded as in corpus files, or None."""
    if severity is None or severity.kind != "collision" or severity.value is None:
        return None
    return round(severity.value, 3)


def has_time(run: Run, failure: Failure) -> bool:
    """Return whether a failure occurs at a specific time."""
    # A check without a time, or an assertion on a measure, may be about the complete run, such as the distance driven.
    # It cannot be evaluated in a run that continues.
    if failure.check is not None:
        return failure.check.time is not None
    return not signature_of_failure(run, failure).is_property


def ending(run: Run) -> str:
    """Describe how a run ended."""
    if run.outcome in HAS_EVENT:
        return f"{run.outcome} at {run.event_time:.1f} s"
    when = "for" if run.outcome is Outcome.COMPLETED else "after"
    return f"{run.outcome} {when} {run.duration:.1f} s"


def disagreement(first: Run, again: Run) -> str:
    """Describe how two runs of one scenario differ, or return an empty string."""
    # Times can differ by 0.2 s and positions by half a metre along x or y, because numpy and the C library round some
    # functions differently on some processors.
    if first.outcome != again.outcome:
        return f"{ending(first)}, then {ending(again)}"
    if first.collision is not None and again.collision is not None:
        one, other = first.collision, again.collision
        is_same = (one.npc, one.side, one.cell) == (other.npc, other.side, other.cell)
        if is_same and abs(one.time - other.time) <= SAME_TIME + 1e-9:
            return ""
        return f"{one!r}, then {other!r}"
    if abs(first.duration - again.duration) > SAME_TIME + 1e-9:
        return f"{first.outcome} after {first.duration:.1f} s, then after {again.duration:.1f} s"
    return first_difference(first.trace, again.trace, SAME_PLACE)
