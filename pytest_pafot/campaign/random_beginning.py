"""How often random scenarios fail by the ego's fault, counted in those that a search begins with."""

from __future__ import annotations

from dataclasses import dataclass, field

from pytest_pafot.campaign.events import Judged, Listener, SearchEvent
from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.events import Evaluated

AT_FAULT = ("failed", "unpreventable", "common")
"""Kinds of verdicts on runs that failed, whatever else excuses them."""


@dataclass(slots=True, kw_only=True)
class RandomBeginning:
    """Passes the events of a search on, and counts its first runs as long as their scenarios are random.

    Attributes:
        listener: to whom the events go.
        most: scenarios at the beginning that are random; infinite where all are.
        runs: of them, but for those that say nothing of the ego.
        failing: of these, those that failed without an NPC alone being responsible.
    """

    listener: Listener
    most: float = 0.0
    runs: int = 0
    failing: int = 0
    _evaluated: int = 0
    _judged: dict[Scenario, Judged] = field(default_factory=dict)

    @property
    def is_whole(self) -> bool:
        """Whether all of them were run."""
        return self._evaluated >= self.most

    @property
    def counts(self) -> tuple[int, int, int]:
        """Scenarios that were evaluated, as far as it counts, ``runs`` and ``failing``."""
        return self._evaluated, self.runs, self.failing

    def restore(self, evaluated: int, runs: int, failing: int) -> None:
        """Go on from the counts of an earlier session."""
        self._evaluated, self.runs, self.failing = evaluated, runs, failing

    def __call__(self, event: SearchEvent) -> None:
        """Told what happens; a run is judged, and perhaps judged again, before its scenario is evaluated."""
        self.listener(event)
        if self.is_whole:
            return
        if isinstance(event, Judged):
            self._judged[event.run.trace.scenario] = event
        elif isinstance(event, Evaluated):
            self._evaluated += 1
            judged = self._judged.pop(event.evaluation.scenario, None)
            if judged is not None and not (judged.verdict.discarded or judged.verdict.kind == "invalid"):
                self.runs += 1
                self.failing += judged.verdict.kind in AT_FAULT and judged.run.responsibility != "npc"
