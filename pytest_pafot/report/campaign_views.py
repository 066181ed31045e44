"""The view of a search, built from its events."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

from pytest_pafot.grid import Cell
from pytest_pafot.report.views import CampaignView, CoverageRow, GenerationView
from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import (
    CampaignFinished,
    CampaignStarted,
    Evaluated,
    Event,
    GenerationFinished,
    LocalSearchFinished,
    Restarted,
)
from pytest_pafot.searching.health import SPEED_BIN, Health

Arrivals = Sequence[Sequence[object]]
"""Per NPC and started gene, the tick at which the cell was reached, or None; as in a trace."""

Step = tuple[int, int]


def campaign_view(
    node_id: str,
    events: Iterable[Event],
    *,
    speed_limit: float = 26.8,
    arrivals: Mapping[Scenario, Arrivals] | None = None,
    responsibilities: Mapping[str, int] | None = None,
) -> CampaignView:
    """The view of a search from everything that it told; also of one that was cut short.

    Args:
        node_id: of the search.
        events: of the campaign.
        speed_limit: highest target speed [m/s], which says how many bins there are.
        arrivals: of the runs by scenario as driven; without them nothing is said of cells that were reached.
        responsibilities: simulated runs by who was responsible.
    """
    events = list(events)
    simulated = [event.evaluation for event in events if isinstance(event, Evaluated) and not event.reused]
    started = next((event for event in events if isinstance(event, CampaignStarted)), None)
    finished = next((event for event in events if isinstance(event, CampaignFinished)), None)
    health = Health.of(events)
    coverage = _coverage(simulated, arrivals)
    return CampaignView(
        node_id=node_id,
        algorithm="" if started is None else started.algorithm,
        seed=0 if started is None else started.seed,
        generations=_generations(events),
        asked=0 if started is None else started.generations,
        reason="" if finished is None else finished.reason,
        simulated=health.simulated,
        reused=health.reused,
        outcomes=_ordered(Counter(str(evaluation.outcome) for evaluation in simulated)),
        responsibilities=_ordered(responsibilities or {}),
        cells=tuple(coverage.row(f"{int(cell)} {cell.label}", int(cell)) for cell in Cell),
        steps=tuple(coverage.row(f"{a} to {b}", (a, b)) for a, b in _all_steps()),
        speeds=_speed_rows(coverage, speed_limit),
        warnings=tuple(health.warnings()),
    )


def _generations(events: Iterable[Event]) -> tuple[GenerationView, ...]:
    views: dict[int, GenerationView] = {}
    restarts: set[int] = set()
    for event in events:
        if isinstance(event, GenerationFinished) and event.local_generation == 0:
            views[event.generation] = _generation(event, restarted=event.generation in restarts)
        elif isinstance(event, Restarted):
            restarts.add(event.generation)
        elif isinstance(event, LocalSearchFinished) and event.generation in views:
            views[event.generation] = replace(
                views[event.generation], local_best=_finite(event.best.fitness), local_replaced=event.replaced
            )
    return tuple(views[generation] for generation in sorted(views))


def _generation(event: GenerationFinished, *, restarted: bool) -> GenerationView:
    fitness = [
        evaluation.fitness
        for evaluation in event.population
        if evaluation.eligible and math.isfinite(evaluation.fitness)
    ]
    return GenerationView(
        generation=event.generation,
        best=_finite(max(fitness)) if fitness else None,
        mean=_finite(sum(fitness) / len(fitness)) if fitness else None,
        failing=sum(evaluation.failing for evaluation in event.population),
        population=len(event.population),
        restarted=restarted,
    )


@dataclass(frozen=True, slots=True)
class _Coverage:
    """Counts of cells (int), steps (pairs) and bins (text) that scenarios asked for, drove and reached."""

    requested: Counter[object] = field(default_factory=Counter)
    driven: Counter[object] = field(default_factory=Counter)
    reached: Counter[object] | None = None

    def row(self, label: str, key: object) -> CoverageRow:
        return CoverageRow(
            label=label,
            requested=self.requested[key],
            driven=self.driven[key],
            reached=None if self.reached is None else self.reached[key],
        )


def _coverage(simulated: Iterable[Evaluation], arrivals: Mapping[Scenario, Arrivals] | None) -> _Coverage:
    requested: Counter[object] = Counter()
    driven: Counter[object] = Counter()
    reached: Counter[object] = Counter()
    for evaluation in simulated:
        depth = evaluation.depth if evaluation.genes_started else 0
        came = arrivals.get(evaluation.executed, ()) if arrivals is not None else ()
        for chain in evaluation.scenario.npcs:
            requested.update(_keys([(int(gene.cell), gene.speed) for gene in chain]))
        for npc, chain in enumerate(evaluation.executed.npcs):
            genes = [(int(gene.cell), gene.speed) for gene in chain[:depth]]
            ticks = came[npc] if npc < len(came) else ()
            driven.update(_keys(genes))
            reached.update(_keys(genes, [tick is not None for tick in ticks]))
    return _Coverage(requested=requested, driven=driven, reached=None if arrivals is None else reached)


def _keys(genes: Sequence[tuple[int, float]], counts: Sequence[bool] | None = None) -> Iterable[object]:
    """Cells, steps and bins of a chain; with ``counts``, only of the genes that are marked there."""
    marked = [True] * len(genes) if counts is None else [*counts, *([False] * (len(genes) - len(counts)))]
    for (cell, speed), is_marked in zip(genes, marked, strict=False):
        if is_marked:
            yield cell
            yield _bin(speed)
    for (before, after), is_marked in zip(pairwise(genes), marked[1:], strict=False):
        if is_marked:
            yield before[0], after[0]


def _all_steps() -> Iterable[Step]:
    """From each cell: holding it, one step clockwise, one step anticlockwise."""
    for cell in Cell:
        anticlockwise, clockwise = cell.neighbours
        for target in (cell, clockwise, anticlockwise):
            yield int(cell), int(target)


def _speed_rows(coverage: _Coverage, speed_limit: float) -> tuple[CoverageRow, ...]:
    bins = int(speed_limit // SPEED_BIN) + 1
    keys = [_bin(index * SPEED_BIN) for index in range(bins)]
    tops = [*((index + 1) * SPEED_BIN for index in range(bins - 1)), speed_limit]
    return tuple(
        coverage.row(f"{index * SPEED_BIN:g} to {top:g} m/s", key)
        for index, (key, top) in enumerate(zip(keys, tops, strict=True))
    )


def _bin(speed: float) -> str:
    return f"bin {int(speed // SPEED_BIN)}"


def _ordered(counts: Mapping[str, int]) -> tuple[tuple[str, int], ...]:
    """The most frequent first, then by name."""
    return tuple(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
