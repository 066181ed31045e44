"""A sighting: a finding as a session saw it, when its search found it or when its saved scenario was replayed."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import IN_MEMORY, Finding
from pytest_pafot.findings.labels import Label, Observed, label
from pytest_pafot.findings.severity import Severity
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.proportions import none_text
from pytest_pafot.support.text import ascii_text, plural

CONDITIONS = 6
"""The largest number of conditions of a decision in a report."""
NOT_REPEATED, ENDED_OTHERWISE = "running it again gave a different run", "a later run of it ended differently"
"""How the difference begins of a policy that drives the same scenario in different ways."""


def on_search(searched: int, drawn: int, elsewhere: str) -> str:
    """Say where a search found the failure of a saved scenario that passes, or in how many runs it did not find it.

    Some of the runs are random. The text is empty if there was no search.
    """
    if elsewhere or not searched:
        return elsewhere and f"elsewhere: {elsewhere} fails in the same way"
    if not drawn:
        return f"no such failure in {plural(searched, 'run')}"
    others = f"; nor in {plural(searched - drawn, 'other run')}" if drawn < searched else ""
    return f"no such failure in {plural(drawn, 'random run')}{none_text(drawn)}{others}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A finding as this session saw it, new or replayed. All reports of a session are written from it.

    As an event of a search it reports a new finding. The event is repeated with each detail that becomes known; only
    the last event of a finding is valid. The last attributes, from ``is_first`` on, stay in the process of the item.

    Attributes:
        finding: the content of its file.
        node_id: node id of the item that replays it, in this session or, if it is new, from the next one on.
        test: node id of the test of a replayed one, as it is in this session.
        observed: what the runs of a replay showed, from which its label follows; None for a new finding.
        is_no_worse: True if it is new and does not count in a comparison.
        headline: how the run failed; empty if it passes.
        path: path of its file; empty if a new finding has none.
        detail: why a new finding has no file or does not count, or what differs from the file of a replayed one; may be
            empty.
        difference: what differed when the scenario of a new finding was run again; empty if nothing did.
        is_timed: True if the failure depends on wall-clock time.
        unshrunk: why a new finding is not yet fully shrunk; empty if it is.
        moment: the last decision that could have avoided it; None if that was not examined, or none is known.
        severity: severity of the failure; None if it passes, nothing measures it, or there is no run.
        severity_before: severity with the reference of a replay; None if there is none.
        repeats: number of other runs of the search that failed in the same way.
        against: the reference that a replay is compared with; empty without one.
        sentences: who did what in a collision; empty without one, and until an item reports it.
        command: the command that runs it again; empty until an item reports it.
        is_first: True if it is reported for the first time.
        unwritten: why the file of a new finding is as it was before, without what shrinking changed; usually empty.
        exception: what the test function raised in the run of a new finding, or what stands for the death of its
            process; None for a replay, and beyond that process.
        run: the run of the scenario in the file; None if its process died or hung.
        file: the file; None if a new finding has none.
        content: the content of a file that could not be written, or empty.
        number: the number of its run in the search, from 1; 0 if the search did not run it.
    """

    finding: Finding
    node_id: str
    test: str = ""
    observed: Observed | None = None
    is_no_worse: bool = False
    headline: str = ""
    path: str = ""
    detail: str = ""
    difference: str = ""
    is_timed: bool = False
    unshrunk: str = ""
    moment: Moment | None = None
    severity: Severity | None = None
    severity_before: Severity | None = None
    repeats: int = 0
    against: str = ""
    sentences: tuple[str, ...] = ()
    command: str = ""
    is_first: bool = True
    unwritten: str = field(default="", compare=False, repr=False, metadata=IN_MEMORY)
    exception: BaseException | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)
    run: Run | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)
    file: Path | None = field(default=None, compare=False, repr=False, metadata=IN_MEMORY)
    content: str = field(default="", compare=False, repr=False, metadata=IN_MEMORY)
    number: int = field(default=0, compare=False, repr=False, metadata=IN_MEMORY)

    @property
    def id(self) -> str:
        """The name of its file without the suffix."""
        return self.finding.id

    @property
    def raised(self) -> BaseException:
        """The exception of a new finding.

        Raises:
            ValueError: for a replay, or in another process than that of the search.
        """
        if self.exception is None:
            raise ValueError(f"sighting: expected a new finding in the process of its search, received {self.id!r}")
        return self.exception

    @property
    def responsible(self) -> str:
        """The side that is responsible for the collision, as in its file."""
        return self.finding.expect.responsibility

    @property
    def is_flaky(self) -> bool:
        """True if running the scenario again gave a different run."""
        return bool(self.difference)

    @property
    def is_firm(self) -> bool:
        """True if its scenario is expected to give the same run each time."""
        return not (self.is_flaky or self.is_timed or self.finding.expect.is_crash)

    @property
    def is_random(self) -> bool:
        """True if the policy draws random numbers, so that the finding has a rate: its runs differ, or have drawn.

        If it is flaky for another reason, the same seed gives the same run here, and no rate can be measured.
        """
        is_other = self.difference.startswith((NOT_REPEATED, ENDED_OTHERWISE))
        has_drawn = self.run is not None and (is_other or (self.run.trace.drew and not self.is_flaky))
        return (self.finding.rate is not None or has_drawn) and not self.is_timed

    @property
    def label(self) -> Label | Literal["new", "no worse"]:
        """The label of a replay, ``new``, or ``no worse``."""
        if self.observed is None:
            return "no worse" if self.is_no_worse else "new"
        return label(self.observed)

    @property
    def compared(self) -> Literal["", "introduced", "common", "fixed"]:
        """How a replay compares with that of its reference; empty if that is not known, or nothing changed."""
        now = self.observed
        if now is None or now.reference_passes is None or now.is_unsteady:
            return ""
        if now.fails:
            return "introduced" if now.reference_passes else "common"
        return "" if now.reference_passes or self.label == "drifted" else "fixed"

    @property
    def on_search(self) -> str:
        """What the search of its test says of a replay that passes; empty for any other, and without a search."""
        now = self.observed or Observed()
        return on_search(now.searched, now.drawn, now.elsewhere)

    @property
    def remark(self) -> str:
        """Remarks on the finding, such as that it is flaky; empty if there are none."""
        flaky = f"flaky: {self.difference}" if self.is_flaky else ""
        timed = "depends on wall-clock time" if self.is_timed else ""
        return "; ".join(filter(None, [flaky, self.finding.on_rate, timed, self.unshrunk]))

    def on_decisions(self) -> list[str]:
        """Return lines on the policy's decisions, each with a title of ten letters at most, or indented below one."""
        if self.moment is None:
            return []
        return [f"moment     {self.moment}", *(f"  {each}" for each in self.moment.condition_lines(CONDITIONS))]

    @property
    def summary(self) -> str:
        """The headline of the finding in one line, with its remarks."""
        return ascii_text(f"{self.headline} ({self.remark})" if self.remark else self.headline)
