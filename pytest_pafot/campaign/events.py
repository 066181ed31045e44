"""The events of a search that its algorithm does not emit; its own are in :mod:`pytest_pafot.searching.events`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.severity import Severity
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.events import Event
from pytest_pafot.support.text import ascii_text

# Reports of a search: its progress, each new finding, and its summary.
#
# These values are sent between processes as plain data. ``report.terminal`` turns them into text.


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """The progress of a search, for a line on the terminal."""

    node_id: str
    generation: int  # the generation in progress, from 1
    generations: int | None  # requested generations; None if the number of runs decides
    runs: int
    failing: int  # runs in which the test failed
    finds: int  # distinct new findings
    seconds: float  # since the search began
    budget: int | None = None  # requested runs
    phase: str = ""  # the work after the generations, such as shrinking; empty while they run


@dataclass(frozen=True, slots=True, kw_only=True)
class Find:
    """A distinct new finding, as the terminal and the summary report it."""

    id: str
    node_id: str  # the node id under which the finding is reported
    headline: str
    path: str = ""  # the path of its file, or empty
    problem: str = ""  # why there is no file, or empty
    difference: str = ""  # what differed when the scenario was run again, or empty
    is_timed: bool = False  # True if the failure depends on wall-clock time
    unshrunk: str = ""  # why the finding is not yet fully shrunk, or empty
    severity: Severity | None = None  # None if nothing measures it, or if there is no run
    responsible: str = "none"  # who is responsible for the collision, as in its file
    repeats: int = 0  # number of other runs that failed in the same way

    @property
    def is_flaky(self) -> bool:
        """True if running the scenario again gave a different run."""
        return bool(self.difference)

    @property
    def remark(self) -> str:
        """Remarks on the finding, such as that it is flaky or not saved; empty if there are none."""
        flaky = f"flaky: {self.difference}" if self.is_flaky else ""
        timed = "depends on wall-clock time" if self.is_timed else ""
        return "; ".join(filter(None, [flaky, timed, self.unshrunk]))

    @property
    def summary(self) -> str:
        """The headline of the finding in one line, with its remarks."""
        return ascii_text(f"{self.headline} ({self.remark})" if self.remark else self.headline)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSummary:
    """The figures, findings and warnings of a search at its end."""

    node_id: str
    algorithm: str = "pafot"
    profile: str = ""  # the profile of the defaults
    base_seed: int = 0  # the base seed that was given, or a random one
    seed: int = 0  # the seed of this search, derived from the base seed and the node id
    generations: int = 0  # finished generations, of ``asked``
    asked: int | None = None  # requested generations
    budget: int | None = None  # requested runs
    reason: str = ""  # why the search ended
    seconds: float = 0.0
    runs: int = 0  # simulated scenarios
    known_runs: int = 0  # scenarios that were not simulated, because the result of an earlier run was reused
    # number of runs that are no failures: because NPCs touched; because an NPC is at fault; because no reference driver
    # avoids the failure; because the reference fails as well; because the test function rejected or skipped them
    invalid: int = 0
    npc: int = 0
    unpreventable: int = 0
    common: int = 0
    rejected: int = 0
    skipped: int = 0
    reached: float | None = None  # share of instructions whose cell, lane or zone was reached; None if it is unknown
    no_interaction: int = 0  # runs in which no NPC came near the ego
    failing: int = 0  # runs in which the test failed
    finds: tuple[Find, ...] = ()  # distinct new findings
    unsaved: Mapping[str, int] = field(default_factory=dict)  # runs of each finding above the limit of saved scenarios
    shrink_runs: int = 0  # runs used to shrink the findings, in addition to ``runs``
    known: Mapping[str, int] = field(default_factory=dict)  # failing runs by the id of the file that covers them
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # anything else to report once
    # notes on processes: how many were used and which died, which differs between machines and numbers of workers
    process_notes: tuple[str, ...] = ()
    against: str = ""  # the reference with which failures were compared, or empty
    # counts for the random scenarios at the beginning: runs with a collision for which the ego is responsible, alone or
    # with the NPC, and all runs that say something about the ego; then runs that failed in any other way
    random: tuple[int, int] = (0, 0)
    random_otherwise: int = 0
    drawn: str = ""  # one line on the space from which the scenarios were sampled
    coverage: str = ""  # one line on the instructions that the runs covered


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchStarted:
    """The beginning of a search; ``speed_limit`` is the highest target speed in its world [m/s]."""

    node_id: str
    seed: int
    speed_limit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """The event of a run of the search, with the verdict of the test function on the run."""

    run: Run
    verdict: Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class FindTold:
    """The event of a new finding. It may be sent again with more details; only the last event of a finding is valid."""

    finding: Finding
    find: Find
    origin: str  # one line on how it was found
    exception: BaseException
    run: Run | None = None  # the run of the scenario in the file; None if its process died or hung
    file: Path | None = None
    content: str = ""  # the content of a file that could not be written, or empty
    number: int = 0  # the number of its run in the search, from 1; 0 if the search did not run it
    is_new: bool = True  # True if it is reported for the first time

    @property
    def is_firm(self) -> bool:
        """True if the finding can be shrunk, because its scenario is expected to give the same run each time."""
        return not (self.find.is_flaky or self.find.is_timed or self.finding.expect.is_crash)


SearchEvent = SearchStarted | Judged | FindTold | Progress | SearchSummary | Event

Listener = Callable[[SearchEvent], None]
"""A function that receives the events of a search, one by one in their order."""
