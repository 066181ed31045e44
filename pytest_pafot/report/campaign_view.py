"""The data that the report page shows of a search, counted from the search's events."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from pytest_pafot.model.crossings import SLOTS
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import PAPER_SPEED_LIMIT
from pytest_pafot.report.page_data import CampaignView, CoverageRow, GenerationView
from pytest_pafot.searching.events import (
    CampaignFinished,
    CampaignStarted,
    Evaluated,
    Event,
    GenerationFinished,
    LocalSearchFinished,
    Restarted,
)
from pytest_pafot.searching.health import CELLS, LANES, SPEED_BIN, STEPS, Coverage, Health, Key, speed_bins


@dataclass(slots=True)
class CampaignCounts:
    """Everything that the report page shows of a search, counted from its events as they happen.

    It grows by one small value for each generation, because a search may have hundreds of thousands of events.
    """

    started: CampaignStarted | None = None
    finished: CampaignFinished | None = None
    health: Health = field(default_factory=Health)
    outcomes: Counter[str] = field(default_factory=Counter)  # of the simulated runs
    generations: dict[int, GenerationView] = field(default_factory=dict)  # of the main search
    _restarts: set[int] = field(default_factory=set)

    def see(self, event: Event) -> None:
        """Count an event."""
        match event:
            case Evaluated():
                self.health = self.health.counted(event.evaluation, reused=event.reused)
                if not event.reused:
                    self.outcomes[str(event.evaluation.outcome)] += 1
            case CampaignStarted():
                self.started = event
            case CampaignFinished():
                self.finished = event
            case GenerationFinished(local_generation=0):
                self.generations[event.generation] = _generation(event, event.generation in self._restarts)
            case Restarted():
                self._restarts.add(event.generation)
            case LocalSearchFinished() if event.generation in self.generations:
                best = round(event.best.fitness, 4) if math.isfinite(event.best.fitness) else None
                view = self.generations[event.generation]
                self.generations[event.generation] = replace(view, local_best=best, local_replaced=event.replaced)

    def view(
        self,
        node_id: str,
        *,
        speed_limit: float = PAPER_SPEED_LIMIT,
        responsibilities: Mapping[str, int] | None = None,
        cut_by: str = "",
    ) -> CampaignView:
        """Return the view of the search so far. A search that was cut short has a view, too.

        Args:
            node_id: node id of the search's item.
            speed_limit: the highest target speed [m/s], which determines the number of speed bins.
            responsibilities: the number of simulated runs by who was responsible.
            cut_by: ``error`` or ``interrupted`` if that ended the search, because no event reports it; otherwise empty.
        """
        coverage = self.health.coverage
        return CampaignView(
            node_id=node_id,
            algorithm="" if self.started is None else self.started.algorithm,
            seed=0 if self.started is None else self.started.seed,
            generations=tuple(self.generations[generation] for generation in sorted(self.generations)),
            asked=None if self.started is None else self.started.generations,
            reason=cut_by or ("" if self.finished is None else self.finished.reason),
            simulated=self.health.simulated,
            reused=self.health.reused,
            outcomes=_by_count(self.outcomes),
            responsibilities=_by_count(responsibilities or {}),
            cells=_rows(coverage, ((f"{int(cell)} {cell.label}", key) for cell, key in zip(Cell, CELLS, strict=True))),
            steps=_rows(coverage, ((" to ".join(map(str, key[1:])), key) for key in STEPS)),
            speeds=_rows(coverage, _speed_labels(speed_limit)),
            zones=_rows(coverage, _zone_labels(coverage)),
            lanes=_rows(coverage, ((str(key[1]), key) for key in LANES if any(map(coverage.requested.get, LANES)))),
            warnings=tuple(self.health.warnings()),
        )


def campaign_view(
    node_id: str,
    events: Iterable[Event],
    *,
    speed_limit: float = PAPER_SPEED_LIMIT,
    responsibilities: Mapping[str, int] | None = None,
) -> CampaignView:
    """Build the view of a search from all of its events, see :meth:`CampaignCounts.view`."""
    counts = CampaignCounts()
    for event in events:
        counts.see(event)
    return counts.view(node_id, speed_limit=speed_limit, responsibilities=responsibilities)


def _generation(event: GenerationFinished, is_restarted: bool) -> GenerationView:
    fitness = [each.fitness for each in event.population if each.eligible and math.isfinite(each.fitness)]
    return GenerationView(
        generation=event.generation,
        best=round(max(fitness), 4) if fitness else None,
        mean=round(sum(fitness) / len(fitness), 4) if fitness else None,
        failing=sum(evaluation.failing for evaluation in event.population),
        population=len(event.population),
        restarted=is_restarted,
    )


def _rows(coverage: Coverage, labels: Iterable[tuple[str, Key]]) -> tuple[CoverageRow, ...]:
    counts = coverage.requested, coverage.driven, coverage.reached
    return tuple(CoverageRow(label, *(count[key] for count in counts)) for label, key in labels)


def _speed_labels(speed_limit: float) -> Iterable[tuple[str, Key]]:
    keys = speed_bins(speed_limit)
    for number, key in enumerate(keys):
        top = speed_limit if key == keys[-1] else (number + 1) * SPEED_BIN
        yield f"{number * SPEED_BIN:g} to {top:g} m/s", key


def _zone_labels(coverage: Coverage) -> Iterable[tuple[str, Key]]:
    """Yield a label and a key for each of the five slots of every zone that an NPC was sent to."""
    for zone in sorted({str(key[1]) for key in coverage.requested if key[0] == "zone"}):
        yield from ((f"{zone} {slot}", ("zone", zone, slot)) for slot in SLOTS)


def _by_count(counts: Mapping[str, int]) -> tuple[tuple[str, int], ...]:
    """Return each name with its number of occurrences, the most frequent first; equally frequent ones by name."""
    return tuple(sorted(counts.items(), key=lambda each: (-each[1], each[0])))
