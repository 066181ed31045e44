"""A campaign's history can be rebuilt from its events only."""

from dataclasses import dataclass, field

import pytest

from pytest_pafot.searching import PafotSearch
from pytest_pafot.searching.events import (
    Evaluated,
    GenerationFinished,
    LocalSearchFinished,
    LocalSearchStarted,
    NewBest,
    Restarted,
)
from tests.helpers.campaigns import run_campaign
from tests.helpers.stages import mostly_oracle


@dataclass
class History:
    """Populations rebuilt from single evaluations and from the reports of the search's parts."""

    population: list = field(default_factory=list)
    local_population: list = field(default_factory=list)
    evaluated: list = field(default_factory=list)
    incumbent: object = None
    best: object = None
    random_at: list = field(default_factory=lambda: [0])
    local_searches: list = field(default_factory=list)
    sizes: dict = field(default_factory=dict)

    def read(self, event):
        getattr(self, f"read_{type(event).__name__}", lambda _: None)(event)

    def read_Evaluated(self, event):  # noqa: N802
        assert event.index == len(self.evaluated)
        self.evaluated.append(event.evaluation)

    def read_GenerationFinished(self, event):  # noqa: N802
        rebuilt = [*self.elites(event.local_generation), *self.evaluated]
        assert list(map(id, event.population)) == list(map(id, rebuilt))
        self.sizes[event.generation, event.local_generation] = len(self.evaluated)
        self.evaluated = []
        if event.local_generation:
            self.local_population = rebuilt
        else:
            self.population = rebuilt

    def elites(self, local_generation):
        if local_generation == 1:
            return [self.incumbent]
        population = self.local_population if local_generation else self.population
        ranked = sorted(population, key=lambda member: member.rank, reverse=True)
        return [member for member in ranked[:1] if member.eligible]

    def read_NewBest(self, event):  # noqa: N802
        assert self.best is None or event.evaluation.rank > self.best.rank
        self.best = event.evaluation

    def read_LocalSearchStarted(self, event):  # noqa: N802
        assert event.incumbent is self.best
        self.incumbent = event.incumbent

    def read_LocalSearchFinished(self, event):  # noqa: N802
        assert event.best is self.best
        assert event.replaced == (event.best is not event.incumbent)
        self.population = [event.best if member is self.incumbent else member for member in self.population]
        self.local_searches.append(event.generation)

    def read_Restarted(self, event):  # noqa: N802
        self.population, self.best = [], None
        self.random_at.append(event.generation)


@pytest.mark.parametrize("seed", mostly_oracle(range(4), 1))
def test_populations_restarts_and_local_searches_can_be_rebuilt(cheap_world, seed):
    history = History()
    events = list(run_campaign(PafotSearch(), cheap_world(crash_speed=15.0), generations=60, seed=seed))
    for event in events:
        history.read(event)
    started = [event.generation for event in events if isinstance(event, LocalSearchStarted)]
    assert history.local_searches == started
    assert len(history.random_at) > 1
    assert all(
        history.sizes[generation, 0] == (4 if generation in history.random_at else 3) for generation in range(60)
    )
    assert all(history.sizes[generation, local] == 3 for generation in started for local in (1, 2))
    for generation in started:
        age = generation - max(start for start in history.random_at if start <= generation)
        assert age > 2


def test_events_of_a_generation_have_fixed_order(cheap_world):
    order = {
        Evaluated: 0,
        GenerationFinished: 1,
        NewBest: 2,
        LocalSearchFinished: 3,
        LocalSearchStarted: 3,
        Restarted: 3,
    }
    events = list(run_campaign(PafotSearch(), cheap_world(), generations=30, seed=5))[1:-1]
    rounds = [[]]
    for event in events:
        if isinstance(event, Evaluated) and event.index == 0:
            rounds.append([])
        rounds[-1].append(order[type(event)])
    assert all(numbers == sorted(numbers) for numbers in rounds)
