"""What a search tells as it goes on, besides the events of its algorithm (:mod:`pytest_pafot.searching.events`)."""

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

# What is told of a search: where it is, each find that is new, and how it went.
#
# Values that travel between processes as plain data. How they read on a terminal is in ``report.terminal``.


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Where a search is."""

    node_id: str
    generation: int  # that is in progress, from 1
    generations: int | None  # that were asked for; None where the runs decide
    runs: int
    failing: int  # runs that the test rejected
    finds: int  # distinct ones that are new
    seconds: float  # since the search began
    budget: int | None = None  # runs that were asked for
    phase: str = ""  # what goes on after the generations, such as shrinking; empty while they run


@dataclass(frozen=True, slots=True, kw_only=True)
class Find:
    """A distinct find that is new."""

    id: str
    node_id: str  # under which it is reported
    headline: str
    path: str = ""  # of its file, or empty
    problem: str = ""  # why there is no file, or empty
    difference: str = ""  # what differed when it was run again, or empty
    is_timed: bool = False  # it depends on wall-clock time
    unshrunk: str = ""  # why it is not yet as simple as it is to be, or empty
    severity: Severity | None = None  # None where nothing measures it, or no run is there
    responsible: str = "none"  # for the collision, as in its file
    repeats: int = 0  # further runs that failed in the same way

    @property
    def is_flaky(self) -> bool:
        """Whether running it again gave another run."""
        return bool(self.difference)

    @property
    def remark(self) -> str:
        """What a reader must know besides, or nothing."""
        flaky = f"flaky: {self.difference}" if self.is_flaky else ""
        timed = "depends on wall-clock time" if self.is_timed else ""
        return "; ".join(filter(None, [flaky, timed, self.unshrunk]))

    @property
    def summary(self) -> str:
        """One line on it, with what a reader must know besides."""
        return ascii_text(f"{self.headline} ({self.remark})" if self.remark else self.headline)


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSummary:
    """How a search went."""

    node_id: str
    algorithm: str = "pafot"
    profile: str = ""  # that the defaults came from
    base_seed: int = 0  # that was given, or fresh
    seed: int = 0  # of this search, derived from the base seed and the node id
    generations: int = 0  # finished, of ``asked``
    asked: int | None = None  # generations that were asked for
    budget: int | None = None  # runs that were asked for
    reason: str = ""  # why it ended
    seconds: float = 0.0
    runs: int = 0  # simulated scenarios
    known_runs: int = 0  # scenarios that were not simulated, since an earlier run showed what they do
    invalid: int = 0  # runs that are no failures, by kind, as the next five
    npc: int = 0
    unpreventable: int = 0
    common: int = 0
    rejected: int = 0
    skipped: int = 0
    reached: float | None = None  # share of Position-Instructions whose cell was reached; None where no run tells
    no_interaction: int = 0  # runs in which no NPC came near the ego
    failing: int = 0  # runs that the test rejected
    finds: tuple[Find, ...] = ()  # distinct ones that are new
    unsaved: Mapping[str, int] = field(default_factory=dict)  # runs of those that the limit of saved ones left out
    shrink_runs: int = 0  # taken to simplify the finds, beside ``runs``
    known: Mapping[str, int] = field(default_factory=dict)  # failing runs by the id of the file that covers them
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # anything else to be told once
    against: str = ""  # the reference that failures were held against, or empty
    # random scenarios at its beginning: runs that failed in a collision which the ego answers for, alone or with the
    # NPC, and all that say something of the ego; and those that failed in any other way
    random: tuple[int, int] = (0, 0)
    random_otherwise: int = 0
    drawn: str = ""  # from what the scenarios were drawn, in one line
    coverage: str = ""  # one line on the Position-Instructions that the runs came to


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchStarted:
    """A search begins, with a seed of its own; ``speed_limit`` is the highest target speed in its world [m/s]."""

    node_id: str
    seed: int
    speed_limit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A run of the search, with what the test function made of it."""

    run: Run
    verdict: Verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class FindTold:
    """A new find, or more of one that was told before: the last telling of a find is the one that counts."""

    finding: Finding
    find: Find
    origin: str  # how it was found, in one line
    exception: BaseException
    run: Run | None = None  # of the scenario in the file; None where nobody saw how it ended
    file: Path | None = None
    content: str = ""  # of the file that could not be written, or empty
    number: int = 0  # of its run in the search, from 1; 0 where it was none of its runs
    is_new: bool = True  # whether it is told for the first time

    @property
    def is_firm(self) -> bool:
        """Whether its runs are expected to repeat, so that it can be shrunk."""
        return not (self.find.is_flaky or self.find.is_timed or self.finding.expect.is_crash)


SearchEvent = SearchStarted | Judged | FindTold | Progress | SearchSummary | Event

Listener = Callable[[SearchEvent], None]
"""Is told what happens in a search, in the order in which it happens."""
