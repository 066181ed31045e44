"""What the runs of a replay showed, and the label that follows from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from pytest_pafot.findings.failure_rate import FailureRate
from pytest_pafot.findings.finding import IN_MEMORY
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.oracle.run import Run

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
    """What the run of a new finding or the runs of a replay showed, and what its session knows besides.

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
