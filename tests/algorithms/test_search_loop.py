"""A search from its first event to its last."""

import random
from itertools import count

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_pafot.algorithms import PafotSearch
from pytest_pafot.algorithms.evaluation import (
    Evaluated,
    GenerationFinished,
    LocalSearchStarted,
    PlanStarted,
    Restarted,
)
from pytest_pafot.algorithms.plan import Plan
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.model.scenario import rng_of
from pytest_pafot.model.trace import Outcome
from tests.helpers.searches import Fresh, run_plan
from tests.helpers.tables import table

ALGORITHMS = [PafotSearch(), Fresh(), PafotSearch(SearchSpace(npcs=3, genes=2), population=7)]


def of(kind, events):
    return [event for event in events if isinstance(event, kind)]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_search_runs_the_given_generations_and_sums_up(cheap_world, algorithm):
    world = cheap_world()
    events = list(run_plan(algorithm, world, generations=12, seed=1))
    evaluated = of(Evaluated, events)
    assert events[0] == PlanStarted(algorithm=algorithm.name, generations=12, seed=1)
    main = [
        event.generation for event in of(GenerationFinished, events) if not event.local_generation
    ]
    assert main == list(range(12))
    last = events[-1]
    assert (last.reason, last.generations) == ("generations", 12)
    assert (last.evaluated, last.simulated) == (len(evaluated), len(world.simulated))
    assert last.best.rank == max(event.evaluation.rank for event in evaluated)


@settings(max_examples=settings.default.max_examples // 2)
@given(st.sampled_from(ALGORITHMS), st.integers(0, 2**64))
def test_events_do_not_depend_on_simulation_order(cheap_world, algorithm, seed):
    draw, ahead = random.Random(seed), {}

    def simulate(scenarios):
        to_come = list(scenarios)
        draw.shuffle(to_come)
        ahead.update({each: cheap_world()(each) for each in to_come})

    one_by_one = list(run_plan(algorithm, cheap_world(), generations=5, seed=seed))
    assert one_by_one == list(
        run_plan(algorithm, ahead.pop, generations=5, seed=seed, foresee=simulate)
    )


@pytest.mark.parametrize("algorithm", ALGORITHMS, ids=lambda algorithm: algorithm.name)
def test_scenarios_are_announced_in_the_order_of_their_evaluation(cheap_world, algorithm):
    world, foreseen, evaluated = cheap_world(), [], []

    def foresee(scenarios):
        more = list(scenarios)
        assert all(each not in evaluated for each in more)
        foreseen.extend(more)

    def evaluate(scenario):
        evaluated.append(scenario)
        # Not evaluated, since an earlier run determined its result.
        while foreseen.pop(0) != scenario:
            pass
        return world(scenario)

    events = list(run_plan(algorithm, evaluate, generations=8, seed=1, foresee=foresee))
    assert evaluated == world.simulated
    assert events == list(run_plan(algorithm, cheap_world(), generations=8, seed=1))


def test_another_seed_is_another_search(cheap_world):
    first, second = (
        list(run_plan(PafotSearch(), cheap_world(), generations=2, seed=s)) for s in (1, 2)
    )
    assert of(Evaluated, first) != of(Evaluated, second)


def test_every_generation_has_its_own_draws():
    draws = {
        rng_of(*key).integers(2**62) for key in ((1,), (1, 0, 0), (1, 0, 1), (1, 1, 0), (2, 0, 0))
    }
    assert len(draws) == 5
    assert rng_of(1, 2, 3).integers(2**62) == rng_of(1, 2, 3).integers(2**62)


def test_a_reused_evaluation_is_marked(cheap_world):
    search = PafotSearch(crossover_rate=0.0, mutation_rate=0.0, local_generations=0)
    events = of(Evaluated, run_plan(search, cheap_world(), generations=3, seed=1))
    assert [event.reused for event in events] == [False] * 4 + [True] * 6


@pytest.fixture(scope="module")
def longer(cheap_world):
    """Return the events of a search that is longer than the interrupted ones."""
    return list(run_plan(PafotSearch(), cheap_world(), generations=12, seed=1))


@pytest.mark.parametrize("runs", [1, 4, 6, 8, 21])
def test_search_ends_after_run_limit_within_a_generation(cheap_world, longer, runs):
    world, foreseen = cheap_world(), []
    plan = run_plan(
        PafotSearch(), world, generations=None, runs=runs, seed=1, foresee=foreseen.extend
    )
    events = list(plan)
    assert len(world.simulated) == len(set(foreseen)) == events[-1].simulated == runs
    assert of(Evaluated, events) == of(Evaluated, longer)[: len(of(Evaluated, events))]
    told = [
        each
        for event in of(GenerationFinished, events)
        for each in event.population[event.elites :]
    ]
    assert told == [event.evaluation for event in of(Evaluated, events)]
    assert events[-1].reason == "runs"


def test_first_reached_limit_of_runs_or_generations_ends(cheap_world):
    ends = [
        list(run_plan(Fresh(), cheap_world(), generations=2, runs=runs, seed=1))[-1]
        for runs in (7, 8, 9)
    ]
    expected = [("runs", 7), ("generations", 8), ("generations", 8)]
    assert [(end.reason, end.simulated) for end in ends] == expected


@table("events_before", [0, 1, 2, 7, 30])
def test_closing_it_ends_it_without_another_evaluation(cheap_world, events_before):
    world = cheap_world()
    plan = run_plan(PafotSearch(), world, generations=50, seed=1)
    for _ in range(events_before):
        next(plan)
    simulated = len(world.simulated)
    plan.close()
    assert list(plan) == []
    assert len(world.simulated) == simulated


def test_what_the_evaluation_raises_reaches_the_consumer(cheap_world):
    world = cheap_world()

    def breaking(scenario):
        if len(world.simulated) == 2:
            raise OSError("disk full")
        return world(scenario)

    plan = run_plan(PafotSearch(), breaking, generations=5, seed=1)
    seen = []
    with pytest.raises(OSError, match="disk full"):
        seen.extend(plan)
    assert list(plan) == []


def test_an_evaluation_of_another_scenario_is_refused(make_evaluation):
    plan = run_plan(Fresh(), lambda scenario: make_evaluation(), generations=1, seed=1)
    with pytest.raises(ValueError, match="an evaluation of"):
        list(plan)


def constant(make_evaluation, **fields):
    return lambda scenario: make_evaluation(scenario, **fields)


def test_invalid_runs_are_told_and_never_best(make_evaluation):
    evaluate = constant(make_evaluation, outcome=Outcome.INVALID, fitness=9.0, failing=True)
    events = list(run_plan(PafotSearch(), evaluate, generations=3, seed=1))
    assert events[-1].best is None
    assert events[-1].generations == 3


def test_restart_without_following_generation_does_not_happen(make_evaluation):
    evaluate = constant(make_evaluation)
    restarts = [
        len(of(Restarted, run_plan(PafotSearch(), evaluate, generations=n, seed=1)))
        for n in (6, 7, 13)
    ]
    assert restarts == [0, 1, 2]


def test_local_generations_are_added_after_the_last_generation(make_evaluation):
    fitness = count()

    def evaluate(scenario):
        return make_evaluation(scenario, fitness=float(next(fitness)))

    events = list(run_plan(PafotSearch(), evaluate, generations=4, seed=1))
    finished = [(e.generation, e.local_generation) for e in of(GenerationFinished, events)]
    assert finished == [(0, 0), (1, 0), (2, 0), (3, 0), (3, 1), (3, 2)]
    assert len(of(LocalSearchStarted, events)) == 1
    assert events[-1].generations == 4


@table(("name", "value"), [("generations", 0), ("seed", -1)])
def test_arguments_out_of_range_are_refused_early(name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        Plan(PafotSearch(), **({"generations": 1, "seed": 1} | {name: value}))


def best_after(algorithm, evaluate, *, simulations, seed):
    *_, last = run_plan(algorithm, evaluate, generations=None, runs=simulations, seed=seed)
    return last.best.fitness


def test_genetic_algorithm_beats_random_search_on_smooth_landscape(make_evaluation):
    """The landscape is smooth: the goal is the front cell at 10 m/s, and every gene counts separately."""

    def evaluate(scenario):
        genes = [gene for chain in scenario.npcs for gene in chain]
        far = sum(min((g.cell - 2) % 8, (2 - g.cell) % 8) + abs(g.speed - 10.0) / 5 for g in genes)
        return make_evaluation(scenario, fitness=-far)

    def bests(algorithm):
        return [best_after(algorithm, evaluate, simulations=120, seed=seed) for seed in range(3)]

    by_chance = bests(Fresh())
    for algorithm in (PafotSearch(), PafotSearch(restart_after=50)):
        scores = list(zip(bests(algorithm), by_chance, strict=True))
        assert all(ours > theirs for ours, theirs in scores), scores
