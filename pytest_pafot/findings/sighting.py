"""A session's results for a finding, new or replayed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Any, Literal, Self, assert_never

from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import RUNS, Expect, FailureRate, Finding
from pytest_pafot.findings.verdict import (
    IN_MEMORY,
    PROCESS_CRASH,
    Severity,
    Signature,
    Verdict,
)
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.proportions import none_text
from pytest_pafot.support.text import plural

# The label that a session gives to a saved scenario.
Label = Literal["error", "still failing", "drifted", "flaky", "accepted", "passes", "fixed"]
UNREAD: Label = "error"  # of a file that could not be read, or a scenario that could not be run
# The labels of new findings. A finding that is `no worse` does not count, because the reference fails as often.
New = Literal["new", "no worse"]

# The titles of the groups of findings in a summary, by label or result, the most urgent group first.
GROUPS: Mapping[str, str] = MappingProxyType({
    "new": "New",
    "no worse": "New, but no worse: the reference fails as often, in other scenarios",
    "error": "Could not be read or run",
    "still failing": "Known, still failing",
    "drifted": "Drifted: the run differs from the file, so it does not show a fix",
    "flaky": "Flaky",
    "accepted": "Accepted for now",
    "passed (found in another scenario)": "Pass, but a search found the same failure in another scenario",
    "passed": "Pass, and no search of this session looked for the same failure",
    "passed (not found again)": "Pass, and a search did not find the same failure again",
})  # fmt: skip


# How a run of a scenario ended: one of the following classes.


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A finished run of which only the verdict is known here, because another process made the run."""

    verdict: Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished(Judged):
    """A finished run and its verdict. Other processes receive it as :class:`Judged`."""

    run: Run = field(compare=False, repr=False, metadata=IN_MEMORY)


@dataclass(frozen=True, slots=True, kw_only=True)
class Died:
    """The death of a run's process, or a hang that ended the process."""

    end: str  # how the process ended, such as `was ended by SIGSEGV`
    pid: int = 0  # id of the process; 0 if it is unknown
    is_hang: bool = False

    @property
    def signature(self) -> Signature:
        """The identity of the failure, as in the file of such a death."""
        outcome = Outcome.HANG if self.is_hang else Outcome.ADS_ERROR
        return Expect(failure=PROCESS_CRASH, outcome=outcome, time=0.0).signature


@dataclass(frozen=True, slots=True, kw_only=True)
class NotMade:
    """A run that was not made: it would end this process, or it needs a reference and there is none."""


class Which(StrEnum):
    """The runs of a replay, in the order in which they are made."""

    AS_SAVED = "as saved"  # to the end of the file
    CONTINUED = "continued"  # past the end of the file, after a pass
    # to the end of the file, because the process died past the end
    AS_SAVED_AGAIN = "as saved again"
    CONTINUED_AGAIN = "continued again"  # to confirm a failure past the end
    # One of the runs that measure the rate, which only files of policies that draw random numbers have: with another
    # seed, or with the same one if the file is flaky.
    REPEATED = "repeated"


class Shows(StrEnum):
    """The result of comparing one run with the file."""

    SAME = "the saved failure"
    OTHER = "another failure"
    HANDLED = "the saved situation without a failure"
    # Two results of a run past the end of the file that do not make the replay fail: a failure that is not the file's,
    # and the saved collision if the test accepts it there.
    ONLY_NOTED = "another failure, past the end"
    STILL_COLLIDES = "the saved collision, soon after the end"
    NOTHING = "nothing that concerns the file"


@dataclass(frozen=True, slots=True)
class Try:
    """One run of a replay, and what it shows."""

    which: Which
    ended: Finished | Judged | Died | NotMade
    shows: Shows
    # False if the policy drove, or the test judged, an earlier run of the same scenario differently
    repeats: bool = True

    @property
    def fails(self) -> bool:
        """True if this run makes the replay fail."""
        return self.shows in (Shows.SAME, Shows.OTHER)

    @property
    def is_judged(self) -> bool:
        return isinstance(self.ended, Judged)

    @property
    def severity(self) -> Severity | None:
        """The severity of the failure; None if the run passes, or if nothing measures it."""
        if isinstance(self.ended, Judged):
            return self.ended.verdict.severity
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Beyond:
    """A failure that differs from the one that the file accepts."""

    why: str  # how it differs


# Whether a file accepts the failure of its replay today.
Acceptance = Literal["not accepted", "accepted"] | Beyond


# What the search of this session says about the failure of a replay that passes: one of the following classes.


@dataclass(frozen=True, slots=True, kw_only=True)
class NotSearched:
    """No complete search looked for the failure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NotFound:
    """A complete search did not find the failure."""

    runs: int  # number of its runs
    drawn: int  # number of random scenarios among them


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundElsewhere:
    """The search found the failure in another scenario."""

    id: str  # id of a finding of the search that fails as the file states


@dataclass(frozen=True, slots=True, kw_only=True)
class Discovery:
    """A new finding of a search, and the run that shows it."""

    label: New = "new"
    # `Finished` once a run in this process has shown the failure
    ended: Finished | Judged
    severity: Severity | None = None  # severity in the first run; None if nothing measures it
    # The policy drew random numbers in the run.
    has_drawn: bool = field(default=False, compare=False, repr=False, metadata=IN_MEMORY)


@dataclass(frozen=True, slots=True, kw_only=True)
class Replay:
    """The runs of a saved scenario in this session, and the other facts that its label depends on."""

    tries: tuple[Try, ...] = ()  # of the tested policy, in the order in which they were made
    # of the reference in the same scenario; empty without a reference, or if its run is invalid
    reference: tuple[Try, ...] = ()
    against: str = ""  # the reference, or empty
    is_flaky: bool = False  # the file says that its runs differ
    # The file's failure occurs by chance, and so rarely that ten passing runs do not show a fix.
    is_rare: bool = False
    # It was run with other package versions, or in a world or with a perception that differs from the test's.
    is_elsewhere: bool = False
    acceptance: Acceptance = "not accepted"
    search: NotSearched | NotFound | FoundElsewhere = NotSearched()

    # All other facts derive from the tries, here and nowhere else.

    @property
    def shown(self) -> Try:
        """The run that shows the failure, or else the first one."""
        # A replay ends when a process dies, so the death is its result, whatever earlier runs showed.
        last = self.tries[-1]
        if last.fails and not last.is_judged:
            return last
        failing = [each for each in self.tries if each.fails]
        # The saved failure counts more than any other failure, even if it is rarer.
        for each in failing:
            if each.shows is Shows.SAME:
                return each
        if failing:
            return failing[-1]
        return self.tries[0]

    @property
    def ran(self) -> Finished | Died:
        """The end of the run in :attr:`shown`.

        Raises:
            ValueError: if another process made that run.
        """
        ended = self.shown.ended
        # A run that was not made shows nothing, so another run is shown instead.
        if isinstance(ended, Finished | Died):
            return ended
        raise ValueError(f"run: expected a run of this process, received {self!r:.100}")

    @property
    def fails(self) -> bool:
        """True if a run fails, or its process dies."""
        return any(each.fails for each in self.tries)

    @property
    def is_same(self) -> bool:
        """True if it fails as the file states."""
        # A third run, which only confirms the second one, never shows a failure by itself.
        return self.fails and self.shown.shows is Shows.SAME

    @property
    def second(self) -> list[Try]:
        """The finished run that repeats or continues a pass, if there is one."""
        # If the process of the continued run died, a run to the end of the file takes its place.
        again = (Which.CONTINUED, Which.AS_SAVED_AGAIN)
        return [each for each in self.tries if each.which in again and each.is_judged]

    @property
    def is_later(self) -> bool:
        """True if it failed only after a first run that passed."""
        return any(each.fails for each in self.second)

    @property
    def rate(self) -> FailureRate | None:
        """How often it fails now; None unless the file has a rate, and no process died."""
        repeated = [each for each in self.tries if each.which is Which.REPEATED and each.is_judged]
        if len(repeated) < RUNS:
            return None  # A part of the runs would be a different sample than the file's.
        return FailureRate(failing=sum(each.fails for each in repeated))

    @property
    def is_unsteady(self) -> bool:
        """True if the runs differ for a reason other than the chance that a rate measures."""
        # A file with a rate expects that only some of its runs fail.
        if self.rate is not None and self.fails:
            return False
        # A flaky failure can be absent from both runs by chance, so even equal passes show nothing.
        if self.is_flaky and self.second:
            return True
        return not all(each.repeats for each in self.tries)

    @property
    def is_handled(self) -> bool:
        """True if a run passes, and the situation of the file occurred in it."""
        handled = [each.which for each in self.tries if each.shows is Shows.HANDLED]
        # The first run only ended too early to show the collision. For a rate, one of the repeated runs is enough,
        # because the situation need not occur with other seeds.
        if any(each.shows is Shows.STILL_COLLIDES for each in self.tries):
            return Which.REPEATED in handled
        return bool(handled)

    @property
    def reference_passes(self) -> bool | None:
        """Whether the reference passes the same scenario; None without a valid run of it."""
        if not self.reference:
            return None
        # The continued run decides only if it shows the failure that the comparison is about.
        return not any(each.fails for each in self.reference)

    @property
    def before(self) -> Severity | None:
        """The severity with the reference; None unless both policies fail."""
        # Past the end of the file, the reference is run only after a pass, so at most one of its runs fails.
        for each in self.reference:
            if self.fails and each.fails:
                return each.severity
        return None

    @property
    def keeps_record(self) -> bool:
        """True if the crash record of a run past the end of the file must stay."""
        # Without the record, the next session would make that run in its own process, and die. The record can go if
        # the item reports a death up to the end of the file.
        again = [each for each in self.tries if each.which is Which.AS_SAVED_AGAIN]
        past = [each for each in (*self.tries, *self.reference) if each.which is Which.CONTINUED]
        is_lost = any(not each.is_judged and not each.fails for each in past)
        return is_lost and all(each.is_judged for each in again)


def label(observed: Discovery | Replay) -> Label | New:
    """Return the label of a finding. Only this function decides it."""
    if isinstance(observed, Discovery):
        return observed.label
    replay = observed
    # An accepted flaky failure stays accepted when it passes by chance.
    if replay.acceptance == "accepted" and (replay.fails or replay.is_unsteady):
        return "accepted"
    # Chance also decides whether such a replay fails, and how, so this comes before any failure.
    if replay.is_unsteady:
        return "flaky"
    if replay.is_same:
        return "still failing"
    # A different failure hides whether the saved one would occur.
    if replay.fails:
        return "drifted"
    # Under other conditions, or if the failure is rare, a pass shows nothing. But if the reference fails, both policies
    # drove the same scenario under the same conditions.
    is_doubtful = replay.is_elsewhere or replay.is_rare
    if is_doubtful and replay.reference_passes is not False:
        return "drifted"
    # A pass in which the situation did not occur shows nothing either.
    if not replay.is_handled:
        return "drifted"
    match replay.search:
        case FoundElsewhere():
            return "still failing"
        case NotFound():
            return "fixed"
        case NotSearched():
            return "passes"
        case _:
            assert_never(replay.search)


# The first words of the difference if a policy drives the same scenario in different ways.
NOT_REPEATED, ENDED_OTHERWISE = (
    "running it again gave a different run",
    "a later run of it ended differently",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Alike:
    """The runs of a search that failed in the same way as a finding."""

    runs: int = 0  # number of these runs; for a finding, excluding the run that shows it
    number: int = 0  # number of the worst run in the search, from 0
    severity: Severity | None = None  # severity of the worst run; None if nothing measures it
    least: Severity | None = None  # severity of the mildest run, or None

    def __add__(self, other: Alike) -> Alike:
        worst, runs = self, self.runs + other.runs
        # The other runs come after these, so an equally severe one is not the worst.
        if other.severity is not None and (
            worst.severity is None or worst.severity < other.severity
        ):
            worst = other
        least = min(filter(None, [self.least, other.least]), default=None)
        return replace(worst, runs=runs, least=least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """A finding with its results in this session."""

    # All reports of a session are written from this class. It is also an event of a search, which is repeated with each
    # new detail, so only the last event of a finding is valid.

    finding: Finding  # the content of the file
    # node id of the item that replays it in this session or, for a new finding, in the next one
    node_id: str
    test: str = ""  # for a replay, the node id of its test in this session
    observed: Discovery | Replay  # its runs, which determine the label
    # the sentences on a collision; empty until an item reports the finding
    sentences: tuple[str, ...] = ()
    headline: str = ""  # how the run failed; empty if it passes
    path: str = ""  # path of the file; empty if a new finding has none
    # Why a new finding does not count, or why its file is missing or incomplete; for a replay, how it differs from the
    # file.
    detail: str = ""
    unshrunk: str = ""  # why a new finding is not yet fully shrunk, or empty
    # The last decision that could have avoided the failure; None if it is unknown or was not examined.
    moment: Moment | None = None
    # the runs of the search with the same failure as a new finding
    alike: Alike = field(default_factory=Alike)

    @property
    def id(self) -> str:
        return self.finding.id

    @property
    def is_new(self) -> bool:
        """True for a finding of a search, False for a replay."""
        return isinstance(self.observed, Discovery)

    @property
    def replay(self) -> Replay:
        """The replay; for a new finding, a replay without any run."""
        return Replay() if isinstance(self.observed, Discovery) else self.observed

    def with_observed(self, **changes: Any) -> Self:
        """Return a copy in which these fields of ``observed`` have changed."""
        return replace(self, observed=replace(self.observed, **changes))

    @property
    def shown(self) -> Discovery | Try:
        """The run that shows the result, with its severity."""
        return self.observed if isinstance(self.observed, Discovery) else self.observed.shown

    @property
    def run(self) -> Run | None:
        """The run that shows the result; None if there is none in this process."""
        ended = self.shown.ended
        return ended.run if isinstance(ended, Finished) else None

    @property
    def raised(self) -> BaseException:
        """The exception of a new finding, in the process that found it."""
        match self.observed:
            case Discovery(ended=Judged(verdict=Verdict(exception=BaseException() as raised))):
                return raised
        raise ValueError(
            f"seen: expected a new finding in the process of its search, received {self.id!r}"
        )

    @property
    def severity(self) -> Severity | None:
        return self.shown.severity

    @property
    def rank(self) -> tuple[float | str, ...]:
        """The sort key of findings: the worst come first, then those with the most runs."""
        return (
            *Severity.worst_first(self.responsible, self.severity),
            -self.alike.runs,
            self.node_id,
        )

    @property
    def responsible(self) -> str:
        """The party that is responsible for the collision, as stored in the corpus file."""
        return self.finding.expect.responsibility

    @property
    def is_flaky(self) -> bool:
        """True if another run of the same scenario gave a different result."""
        return self.finding.flaky is not None

    @property
    def is_timed(self) -> bool:
        return self.finding.expect.outcome is Outcome.HANG

    @property
    def is_as_saved(self) -> bool:
        """True for a new finding, and for a replay that failed as saved."""
        return self.is_new or self.replay.is_same

    @property
    def is_firm(self) -> bool:
        """True if every run of the scenario is expected to give the same result."""
        return not (self.is_flaky or self.is_timed or self.finding.expect.is_crash)

    @property
    def is_random(self) -> bool:
        """True if the policy draws random numbers."""
        # If a finding is flaky for any other reason, equal seeds give equal runs here, so no rate can be measured.
        if self.is_timed or self.finding.expect.is_crash:
            return False
        # A measured rate settles it, even if the runs of a flaky finding differ for another reason.
        if self.finding.flaky is not None and self.finding.rate is None:
            return self.finding.flaky.startswith((NOT_REPEATED, ENDED_OTHERWISE))
        has_drawn = isinstance(self.observed, Discovery) and self.observed.has_drawn
        return has_drawn or self.finding.rate is not None

    @property
    def label(self) -> Label | New:
        """The label of a replay, or ``new`` or ``no worse`` for a new finding."""
        return label(self.observed)

    @property
    def result(self) -> str:
        """The label for summaries, which report only facts: ``passed (not found again)`` instead of ``fixed``."""
        # Whether a pass is a fix is the reader's conclusion.
        match self.label:
            case "passes":
                return "passed"
            case "fixed":
                return "passed (not found again)"
            case "still failing" if not self.replay.fails:
                return "passed (found in another scenario)"
            case other:
                return other

    @property
    def compared(self) -> Literal["", "introduced", "common", "fixed"]:
        """The result of comparing a replay with the reference, or an empty string."""
        now = self.replay
        # If the runs differ by chance, so would the comparison.
        if now.reference_passes is None or now.is_unsteady:
            return ""
        if now.reference_passes:
            return "introduced" if now.fails else ""
        if now.fails:
            return "common"
        # A pass in which the situation did not occur is no fix, whatever the reference does.
        return "" if self.label == "drifted" else "fixed"

    @property
    def on_search(self) -> str:
        """The result of this session's search for a failure that its replay did not show, or an empty string."""
        match self.replay.search:
            case FoundElsewhere(id=other):
                return f"{other} fails in the same way"
            case NotSearched():
                return ""
            case NotFound(runs=runs, drawn=0):
                return f"the failure did not occur in {plural(runs, 'run')}"
            case NotFound(runs=runs, drawn=drawn):
                line = (
                    f"the failure did not occur in {plural(drawn, 'random run')}{none_text(drawn)}"
                )
                if drawn == runs:
                    return line
                return f"{line}; it also did not occur in {plural(runs - drawn, 'other run')}"
            case _:
                assert_never(self.replay.search)

    @property
    def worst(self) -> str:
        """A note on the worst other run with this failure, or an empty string."""
        worst, own = self.alike.severity, self.severity
        # A difference that the figures do not show is not worth a note.
        is_worse = own is None or worst is None or (own < worst and own.figure != worst.figure)
        if worst is None or not is_worse:
            return ""
        return f"the worst one {worst}"

    @property
    def impacts(self) -> str:
        """The range of severities among the runs with this failure, or an empty string."""
        worst, least = self.alike.severity or self.severity, self.alike.least or self.severity
        if worst is None or least is None or None in (worst.value, least.value):
            return ""
        figures, how = worst.figure, "violating the bound by"
        if least.figure != worst.figure:
            figures = f"{least.figure} to {figures}"
        if worst.kind == "collision":
            how = "closing at"
        return f", {how} {figures} {worst.unit}".rstrip()

    @property
    def remark(self) -> str:
        """Notes on the finding, such as its failure rate."""
        notes = [self.finding.on_rate]
        if self.is_flaky:
            notes.insert(0, f"flaky: {self.finding.flaky}")
        if self.is_timed:
            notes.append("the result depends on wall-clock time")
        return "; ".join(filter(None, [*notes, self.unshrunk]))
