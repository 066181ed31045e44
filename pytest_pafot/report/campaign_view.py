"""The data that the report page shows of a search, built from the search's events."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace

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
from pytest_pafot.searching.health import CELLS, SPEED_BIN, STEPS, Coverage, Health, Key, speed_bins


def campaign_view(
    node_id: str,
    events: Iterable[Event],
    *,
    speed_limit: float = PAPER_SPEED_LIMIT,
    responsibilities: Mapping[str, int] | None = None,
    cut_by: str = "",
) -> CampaignView:
    """Build the view of a search from the events that it emitted. A search that was cut short has a view, too.

    Args:
        node_id: node id of the search's item.
        events: the events so far.
        speed_limit: the highest target speed [m/s], which determines the number of speed bins.
        responsibilities: the number of simulated runs by who was responsible.
        cut_by: ``error`` or ``interrupted`` if that ended the search, because no event reports it; otherwise empty.
    """
    events = list(events)
    simulated = [event.evaluation for event in events if isinstance(event, Evaluated) and not event.reused]
    started = next((event for event in events if isinstance(event, CampaignStarted)), None)
    finished = next((event for event in events if isinstance(event, CampaignFinished)), None)
    health = Health.of(events)
    coverage = health.coverage
    return CampaignView(
        node_id=node_id,
        algorithm="" if started is None else started.algorithm,
        seed=0 if started is None else started.seed,
        generations=_generations(events),
        asked=None if started is None else started.generations,
        reason=cut_by or ("" if finished is None else finished.reason),
        simulated=health.simulated,
        reused=health.reused,
        outcomes=_by_count(str(evaluation.outcome) for evaluation in simulated),
        responsibilities=_by_count(Counter(responsibilities or {}).elements()),
        cells=_rows(coverage, ((f"{int(cell)} {cell.label}", key) for cell, key in zip(Cell, CELLS, strict=True))),
        steps=_rows(coverage, ((" to ".join(map(str, key[1:])), key) for key in STEPS)),
        speeds=_rows(coverage, _speed_labels(speed_limit)),
        zones=_rows(coverage, _zone_labels(coverage)),
        warnings=tuple(health.warnings()),
    )


def _generations(events: Iterable[Event]) -> tuple[GenerationView, ...]:
    views: dict[int, GenerationView] = {}
    restarts: set[int] = set()
    for event in events:
        if isinstance(event, GenerationFinished) and event.local_generation == 0:
            fitness = [each.fitness for each in event.population if each.eligible and math.isfinite(each.fitness)]
            views[event.generation] = GenerationView(
                generation=event.generation,
                best=round(max(fitness), 4) if fitness else None,
                mean=round(sum(fitness) / len(fitness), 4) if fitness else None,
                failing=sum(evaluation.failing for evaluation in event.population),
                population=len(event.population),
                restarted=event.generation in restarts,
            )
        elif isinstance(event, Restarted):
            restarts.add(event.generation)
        elif isinstance(event, LocalSearchFinished) and event.generation in views:
            best = round(event.best.fitness, 4) if math.isfinite(event.best.fitness) else None
            view = views[event.generation]
            views[event.generation] = replace(view, local_best=best, local_replaced=event.replaced)
    return tuple(views[generation] for generation in sorted(views))


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


def _by_count(names: Iterable[str]) -> tuple[tuple[str, int], ...]:
    """Return each name with its number of occurrences, the most frequent first; equally frequent ones by name."""
    return tuple(Counter(sorted(names)).most_common())
