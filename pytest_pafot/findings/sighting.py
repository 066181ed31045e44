"""A finding as a session saw it, when its search found it or when its saved scenario was replayed."""

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

Label = Literal["error", "still failing", "drifted", "flaky", "accepted", "passes", "fixed"]
"""The word in which a session says what became of a saved scenario."""
New = Literal["new", "no worse"]
"""The word for a new finding, and for one that does not count because the reference fails as often."""

GROUPS: Mapping[str, str] = MappingProxyType({
    "new": "New",
    "no worse": "New, but no worse: the reference fails as often, elsewhere",
    "error": "Could not be read or run",
    "still failing": "Known, still failing",
    "drifted": "Drifted: the run differs from the file, so this is no fix",
    "flaky": "Flaky",
    "accepted": "Accepted for now",
    "passes": "Pass, and no search of this session looked for the same failure",
    "fixed": "Fixed",
})  # fmt: skip
"""The titles of the groups of findings in a summary, new ones and those with a label, the most urgent group first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Observed:
    """The facts that the run of a new finding or the runs of a replay showed, and those that its session adds.

    Attributes:
        new: ``new`` for a new finding, ``no worse`` if it does not count in a comparison; empty for a replay.
        is_error: True if the file could not be read, or its scenario not be run.
        fails: True if a run fails, or its process dies.
        is_same: True if it fails as the file says.
        is_later: True if only the second run failed, which is driven on after the end of the file.
        is_unsteady: True if its runs differ, other than by the chance that a rate measures.
        is_handled: True if a run passes, and the situation of the file came up in it.
        is_elsewhere: True if it was run under other versions, in another world than the test's, or with another sight.
        is_rare: True if the failure of the file occurs by chance, and so rarely that ten passing runs show no fix.
        is_accepted: True if the file accepts its failure today.
        beyond: how it goes beyond the failure that the file would accept; empty if it does not.
        reference_passes: whether the reference passes the same scenario; None without a reference.
        against: the reference that a replay is compared with; empty without one.
        severity: severity of the failure; None if it passes, nothing measures it, or there is no run.
        before: severity with the reference of a replay; None if there is none.
        sentences: who did what in a collision; empty without one, and until an item reports it.
        searched: number of runs of the search of its test that found no such failure, if it passes and that search ran
            to its end in this session; otherwise 0.
        drawn: number of random scenarios among these.
        elsewhere: id of the finding that this search shows and that fails as the file says; empty if there is none.
        rate: how often it fails now; None unless the file has a rate.
        note: a text on the time after the file's end, or on the rate; empty if nothing is to be said.
        is_lost: True if a process died or hung in that time. Then the crash record must stay, or the next session would
            drive on in its own process, and die.
        has_drawn: whether the policy drew random numbers in the run that showed a new finding.
        run: the run that shows the failure; the first run if all of them pass; None if the process died or hung.
        verdict: the verdict on that run; None in another process than that of the item.
    """

    new: New | Literal[""] = ""
    is_error: bool = False
    fails: bool = False
    is_same: bool = False
    is_later: bool = False
    is_unsteady: bool = False
    is_handled: bool = False
    is_elsewhere: bool = False
    is_rare: bool = False
    is_accepted: bool = False
    beyond: str = ""
    reference_passes: bool | None = None
    against: str = ""
    severity: Severity | None = None
    before: Severity | None = None
    sentences: tuple[str, ...] = ()
    searched: int = 0
    drawn: int = 0
    elsewhere: str = ""
    rate: FailureRate | None = None
    note: str = ""
    is_lost: bool = False
    has_drawn: bool = field(default=False, compare=False, repr=False, metadata=IN_MEMORY)
    run: Run | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)
    verdict: Verdict | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)

    @property
    def ran(self) -> tuple[Run, Verdict]:
        """The run and the verdict on it.

        Raises:
            ValueError: if the process of the run died or hung, or in another process than that of the item.
        """
        if self.run is None or self.verdict is None:
            raise ValueError(f"run: expected one that came to its end in this process, received {self!r:.100}")
        return self.run, self.verdict


def label(observed: Observed) -> Label | New:
    """Return the label of a finding. Nothing else decides it."""
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
    is_other = (observed.is_elsewhere or observed.is_rare) and observed.reference_passes is not False
    if is_other or not observed.is_handled:
        return "drifted"
    if observed.elsewhere:
        return "still failing"
    return "fixed" if observed.searched else "passes"


NOT_REPEATED, ENDED_OTHERWISE = "running it again gave a different run", "a later run of it ended differently"
"""How the difference begins of a policy that drives the same scenario in different ways."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alike:
    """The runs of a search that failed like a finding.

    Attributes:
        runs: the number of the runs; in what is seen of a finding, of all but the one that it was found in.
        number: the number of the worst of all these runs in the search, from 0.
        severity, least: how bad the worst one was, and the mildest; None if nothing measures it.
    """

    runs: int = 0
    number: int = 0
    severity: Severity | None = None
    least: Severity | None = None

    def __add__(self, other: Alike) -> Alike:
        """Return these runs and others, which come after these."""
        is_worse = other.severity is not None and (self.severity is None or self.severity < other.severity)
        worst, least = other if is_worse else self, min(filter(None, [self.least, other.least]), default=None)
        return replace(worst, runs=self.runs + other.runs, least=least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """A finding as this session saw it, new or replayed. All reports of a session are written from it.

    As an event of a search it reports a new finding. The event is repeated with each detail that becomes known; only
    the last event of a finding is valid.

    Attributes:
        finding: the content of its file.
        node_id: node id of the item that replays it, in this session or, if it is new, from the next one on.
        test: node id of the test of a replayed one, as it is in this session.
        observed: what the run of a new finding or the runs of a replay showed, from which its label follows.
        headline: how the run failed; empty if it passes.
        path: path of its file; empty if a new finding has none.
        detail: why a new finding has no file, or its file lacks what shrinking changed, or why the finding does not
            count; or what differs from the file of a replayed one; may be empty.
        unshrunk: why a new finding is not yet fully shrunk; empty if it is.
        moment: the last decision that could have avoided it; None if that was not examined, or none is known.
        alike: the runs of the search that failed like a new finding.
    """

    finding: Finding
    node_id: str
    test: str = ""
    observed: Observed = field(default_factory=Observed)
    headline: str = ""
    path: str = ""
    detail: str = ""
    unshrunk: str = ""
    moment: Moment | None = None
    alike: Alike = field(default_factory=Alike)

    @property
    def id(self) -> str:
        """The name of its file without the suffix."""
        return self.finding.id

    @property
    def run(self) -> Run | None:
        """The run of the scenario; None if its process died or hung, and in another process than that of the item."""
        return self.observed.run

    @property
    def raised(self) -> BaseException:
        """The exception of a new finding.

        Raises:
            ValueError: for a replay that passes, or in another process than that of the search.
        """
        if self.observed.verdict is None or self.observed.verdict.exception is None:
            raise ValueError(f"seen: expected a new finding in the process of its search, received {self.id!r}")
        return self.observed.verdict.exception

    @property
    def severity(self) -> Severity | None:
        """The severity of the failure; None if it passes, nothing measures it, or there is no run."""
        return self.observed.severity

    @property
    def rank(self) -> tuple[float | str, ...]:
        """The key that sorts findings: the worst first, then those with the most runs."""
        return *Severity.worst_first(self.responsible, self.severity), -self.alike.runs, self.node_id

    @property
    def responsible(self) -> str:
        """The side that is responsible for the collision, as in its file."""
        return self.finding.expect.responsibility

    @property
    def is_flaky(self) -> bool:
        """True if running the scenario again gave a different run."""
        return self.finding.flaky is not None

    @property
    def is_timed(self) -> bool:
        """True if the failure depends on wall-clock time."""
        return self.finding.expect.outcome is Outcome.HANG

    @property
    def is_as_saved(self) -> bool:
        """True if its run failed as its file says: of a new finding, or of a replay that fails alike."""
        return bool(self.observed.new) or self.observed.is_same

    @property
    def is_firm(self) -> bool:
        """True if its scenario is expected to give the same run each time."""
        return not (self.is_flaky or self.is_timed or self.finding.expect.is_crash)

    @property
    def is_random(self) -> bool:
        """True if the policy draws random numbers, so that the finding has a rate: its runs differ, or have drawn.

        If it is flaky for another reason, the same seed gives the same run here, and no rate can be measured.
        """
        is_other = (self.finding.flaky or "").startswith((NOT_REPEATED, ENDED_OTHERWISE))
        has_drawn = is_other or (self.observed.has_drawn and not self.is_flaky)
        return (self.finding.rate is not None or has_drawn) and not (self.is_timed or self.finding.expect.is_crash)

    @property
    def label(self) -> Label | New:
        """The label of a replay, ``new``, or ``no worse``."""
        return label(self.observed)

    @property
    def compared(self) -> Literal["", "introduced", "common", "fixed"]:
        """The comparison of a replay with that of its reference; empty if that is not known, or nothing changed."""
        now = self.observed
        if now.reference_passes is None or now.is_unsteady:
            return ""
        if now.fails:
            return "introduced" if now.reference_passes else "common"
        return "" if now.reference_passes or self.label == "drifted" else "fixed"

    @property
    def on_search(self) -> str:
        """The words on where the search of its test found the failure of a replay that passes, or in how many runs not.

        Some of the runs are random. The text is empty for any other replay, and without a search.
        """
        searched, drawn, elsewhere = self.observed.searched, self.observed.drawn, self.observed.elsewhere
        if elsewhere or not searched:
            return elsewhere and f"elsewhere: {elsewhere} fails in the same way"
        if not drawn:
            return f"no such failure in {plural(searched, 'run')}"
        others = f"; nor in {plural(searched - drawn, 'other run')}" if drawn < searched else ""
        return f"no such failure in {plural(drawn, 'random run')}{none_text(drawn)}{others}"

    @property
    def worst(self) -> str:
        """The worst of the runs that failed like it; empty if none was worse than the finding itself."""
        worst, number, own = self.alike.severity, self.alike.number, self.severity
        if worst is None or (own is not None and (not own < worst or worst.figure == own.figure)):
            return ""
        return f"the worst, number {number}, {worst}"

    @property
    def impacts(self) -> str:
        """The range of closing speeds, or of a check's excess, of the runs that failed like it; empty without one."""
        worst, least = self.alike.severity or self.severity, self.alike.least or self.severity
        if worst is None or least is None or None in (worst.value, least.value):
            return ""
        low = f"{least.figure} to " if least.figure != worst.figure else ""
        how = "closing at" if worst.kind == "collision" else "broken by"
        return f", {how} {low}{worst.figure} {worst.unit}".rstrip()

    @property
    def remark(self) -> str:
        """Remarks on the finding, such as that it is flaky; empty if there are none."""
        flaky = f"flaky: {self.finding.flaky}" if self.is_flaky else ""
        timed = "depends on wall-clock time" if self.is_timed else ""
        return "; ".join(filter(None, [flaky, self.finding.on_rate, timed, self.unshrunk]))
