"""A session's results for a finding, new or replayed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import IN_MEMORY, FailureRate, Finding
from pytest_pafot.findings.verdict import Severity, Verdict
from pytest_pafot.model.trace import Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.proportions import none_text
from pytest_pafot.support.text import plural

# The label that a session gives to a saved scenario.
Label = Literal["error", "still failing", "drifted", "flaky", "accepted", "passes", "fixed"]
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The results of a finding's runs in this session."""

    # `new` for a new finding, `no worse` if it does not count in a comparison; empty for a replay.
    new: New | Literal[""] = ""
    is_error: bool = False  # the file could not be read, or its scenario could not be run
    fails: bool = False  # a run fails, or its process dies
    is_same: bool = False  # it fails as the file states
    # only the second run failed, which continues after the end of the saved run
    is_later: bool = False
    # the runs differ for a reason other than the chance that a rate measures
    is_unsteady: bool = False
    is_handled: bool = False  # a run passes, and the situation of the file occurred in it
    # It was run with other package versions, or in a world or with a perception that differs from the test's.
    is_elsewhere: bool = False
    # the failure occurs by chance, and so rarely that ten passing runs do not show a fix
    is_rare: bool = False
    is_accepted: bool = False  # the file accepts its failure today
    beyond: str = ""  # how the failure differs from the one that the file accepts, or empty
    # whether the reference passes the same scenario; None without a reference
    reference_passes: bool | None = None
    against: str = ""  # the reference that a replay is compared with, or empty
    # None if it passes, if nothing measures it, or if there is no run
    severity: Severity | None = None
    before: Severity | None = None  # for a replay, the severity with the reference, or None
    # the sentences on a collision; empty until an item reports the finding
    sentences: tuple[str, ...] = ()
    # If the replay passes, number of runs of a complete search of this session that found no such failure; otherwise 0.
    searched: int = 0
    drawn: int = 0  # number of random scenarios among `searched`
    # id of a finding of this session's search that fails as the file states, or empty
    elsewhere: str = ""
    rate: FailureRate | None = None  # how often it fails now; None unless the file has a rate
    note: str = ""  # a note on the time after the end of the saved run, or on the rate
    # A process died or hung in that time. The crash record must stay, because without it the next session would run the
    # scenario in its own process, and die.
    is_lost: bool = False
    # The policy drew random numbers in the run that showed a new finding.
    has_drawn: bool = field(default=False, compare=False, repr=False, metadata=IN_MEMORY)
    # The run that shows the failure, or the first passing run; None if the process died or hung.
    run: Run | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)
    # The verdict on that run; None outside the process of the item.
    verdict: Verdict | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)

    @property
    def ran(self) -> tuple[Run, Verdict]:
        """The run and its verdict.

        Raises:
            ValueError: if no run finished in this process.
        """
        if self.run is None or self.verdict is None:
            raise ValueError(
                f"run: expected a run that finished in this process, received {self!r:.100}"
            )
        return self.run, self.verdict


def label(observed: Observed) -> Label | New:
    """Return the label of a finding. Only this function decides it."""
    if observed.new:
        return observed.new
    if observed.is_error:
        return "error"
    if observed.is_accepted and (observed.fails or observed.is_unsteady):
        return "accepted"
    if observed.is_unsteady:
        return "flaky"
    if observed.fails:
        return "still failing" if observed.is_same else "drifted"
    # If the reference fails, both policies drove the same scenario under the same conditions.
    is_other = (
        observed.is_elsewhere or observed.is_rare
    ) and observed.reference_passes is not False
    if is_other or not observed.is_handled:
        return "drifted"
    if observed.elsewhere:
        return "still failing"
    return "fixed" if observed.searched else "passes"


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
        # The other runs come after these.
        is_worse = other.severity is not None and (
            self.severity is None or self.severity < other.severity
        )
        worst, least = (
            other if is_worse else self,
            min(filter(None, [self.least, other.least]), default=None),
        )
        return replace(worst, runs=self.runs + other.runs, least=least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """A finding with its results in this session."""

    # All reports of a session are written from this class. It is also an event of a search, which is repeated with each
    # new detail, so only the last event of a finding is valid.

    finding: Finding  # the content of the file
    # node id of the item that replays it in this session or, for a new finding, in the next one
    node_id: str
    test: str = ""  # for a replay, the node id of its test in this session
    # the facts of its runs, which determine the label
    observed: Observed = field(default_factory=Observed)
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
    def run(self) -> Run | None:
        return self.observed.run

    @property
    def raised(self) -> BaseException:
        """The exception of a new finding, in the process that found it."""
        if self.observed.verdict is None or self.observed.verdict.exception is None:
            raise ValueError(
                f"seen: expected a new finding in the process of its search, received {self.id!r}"
            )
        return self.observed.verdict.exception

    @property
    def severity(self) -> Severity | None:
        return self.observed.severity

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
        return bool(self.observed.new) or self.observed.is_same

    @property
    def is_firm(self) -> bool:
        """True if every run of the scenario is expected to give the same result."""
        return not (self.is_flaky or self.is_timed or self.finding.expect.is_crash)

    @property
    def is_random(self) -> bool:
        """True if the policy draws random numbers."""
        # If a finding is flaky for any other reason, equal seeds give equal runs here, so no rate can be measured.
        is_other = (self.finding.flaky or "").startswith((NOT_REPEATED, ENDED_OTHERWISE))
        has_drawn = is_other or (self.observed.has_drawn and not self.is_flaky)
        return (self.finding.rate is not None or has_drawn) and not (
            self.is_timed or self.finding.expect.is_crash
        )

    @property
    def label(self) -> Label | New:
        """The label of a replay, or ``new`` or ``no worse`` for a new finding."""
        return label(self.observed)

    @property
    def result(self) -> str:
        """The label for summaries, which report only facts: ``passed (not found again)`` instead of ``fixed``."""
        is_elsewhere = self.label == "still failing" and not self.observed.fails
        words = (
            "found in another scenario"
            if is_elsewhere
            else "not found again" * (self.label == "fixed")
        )
        return (
            f"passed ({words})"
            if words
            else "passed"
            if self.label == "passes"
            else str(self.label)
        )

    @property
    def compared(self) -> Literal["", "introduced", "common", "fixed"]:
        """The result of comparing a replay with the reference, or an empty string."""
        now = self.observed
        if now.reference_passes is None or now.is_unsteady:
            return ""
        if now.fails:
            return "introduced" if now.reference_passes else "common"
        return "" if now.reference_passes or self.label == "drifted" else "fixed"

    @property
    def on_search(self) -> str:
        """The result of this session's search for a failure that its replay did not show, or an empty string."""
        searched, drawn, elsewhere = (
            self.observed.searched,
            self.observed.drawn,
            self.observed.elsewhere,
        )
        if elsewhere or not searched:
            return elsewhere and f"{elsewhere} fails in the same way"
        if not drawn:
            return f"the failure did not occur in {plural(searched, 'run')}"
        others = (
            f"; it also did not occur in {plural(searched - drawn, 'other run')}"
            if drawn < searched
            else ""
        )
        return (
            f"the failure did not occur in {plural(drawn, 'random run')}{none_text(drawn)}{others}"
        )

    @property
    def worst(self) -> str:
        """A note on the worst other run with this failure, or an empty string."""
        worst, own = self.alike.severity, self.severity
        if worst is None or (own is not None and (not own < worst or worst.figure == own.figure)):
            return ""
        return f"the worst one {worst}"

    @property
    def impacts(self) -> str:
        """The range of severities among the runs with this failure, or an empty string."""
        worst, least = self.alike.severity or self.severity, self.alike.least or self.severity
        if worst is None or least is None or None in (worst.value, least.value):
            return ""
        low = f"{least.figure} to " if least.figure != worst.figure else ""
        how = "closing at" if worst.kind == "collision" else "violating the bound by"
        return f", {how} {low}{worst.figure} {worst.unit}".rstrip()

    @property
    def remark(self) -> str:
        """Notes on the finding, such as its failure rate."""
        flaky = f"flaky: {self.finding.flaky}" if self.is_flaky else ""
        timed = "the result depends on wall-clock time" if self.is_timed else ""
        return "; ".join(filter(None, [flaky, self.finding.on_rate, timed, self.unshrunk]))
