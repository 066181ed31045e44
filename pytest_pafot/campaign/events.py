"""What a search tells as it goes on, besides the events of its algorithm (:mod:`pytest_pafot.searching.events`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pytest_pafot.campaign.summary import Find, Progress, SearchSummary
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.findings.finding import Finding
from pytest_pafot.run import Run
from pytest_pafot.searching.events import Event


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
class Kept:
    """A finding with where it lies, or why it lies nowhere, and how it is told."""

    finding: Finding
    find: Find
    origin: str  # how it was found, in one line
    file: Path | None = None
    content: str = ""  # of the file that could not be written, or empty
    number: int = 0  # of its run in the search, from 1; 0 where it was none of its runs

    @property
    def is_firm(self) -> bool:
        """Whether its runs are expected to repeat, so that it can be shrunk."""
        return not (self.find.is_flaky or self.find.is_timed or self.finding.expect.is_crash)


@dataclass(frozen=True, slots=True, kw_only=True)
class FindTold:
    """A new find, or more of one that was told before: the last telling of a find is the one that counts."""

    kept: Kept
    exception: BaseException
    run: Run | None = None  # of the scenario in the file; None where nobody saw how it ended
    is_new: bool = False  # whether it is told for the first time


SearchEvent = SearchStarted | Judged | FindTold | Progress | SearchSummary | Event

Listener = Callable[[SearchEvent], None]
"""Is told what happens in a search, in the order in which it happens."""
