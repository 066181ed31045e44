"""AV-Fuzzer as its authors released it: operators, selection, restarts and local searches."""

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Highway, World
from pytest_pafot.algorithms import SearchSpace, sample_manoeuvres
from pytest_pafot.algorithms.av_fuzzer import (
    AvFuzzerSearch,
    distance,
    farthest,
    features,
    mutate_manoeuvre,
    roulette,
    swap_npc,
)
from pytest_pafot.algorithms.evaluation import (
    Evaluated,
    GenerationFinished,
    LocalSearchFinished,
    LocalSearchStarted,
    NewBest,
    Restarted,
)
from pytest_pafot.algorithms.fitness import av_fuzzer, braking_distance, resolve
from pytest_pafot.model.instructions import SHIFTS, LaneInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from tests.algorithms.test_crossing_traffic import WITHOUT, drawn_digest
from tests.helpers.searches import run_plan
from tests.helpers.tables import table
from tests.helpers.traces import random_states, straight_lanes, trace_of, vehicle
from tests.searches.test_request import space_of

SPACE = SearchSpace().sliced(5)
DRAWS = 3000


def rng(seed=0):
    return np.random.default_rng(seed)


def scenarios(count, seed=0):
    generator = rng(seed)
    return [sample_manoeuvres(SPACE, generator) for _ in range(count)]


def one(text, **fields):
    """Return a scenario from texts such as "left@22 keep@3"."""
    pairs = [[gene.split("@") for gene in chain.split()] for chain in text.split("; ")]
    return Scenario(
        npcs=[[LaneInstruction(lane, float(speed)) for lane, speed in chain] for chain in pairs],
        **fields,
    )


def all_speeds(scenario):
    return sum(gene.speed for chain in scenario.npcs for gene in chain)


@pytest.fixture
def landscape(make_evaluation):
    """Return a function that turns a fitness function into an evaluation of scenarios."""

    def evaluate(fitness):
        return lambda each: make_evaluation(each, fitness=fitness(each))

    return evaluate


class TestSampling:
    def test_slices_last_as_long_as_all_genes_together(self):
        search = AvFuzzerSearch(SearchSpace(genes=6, gene_seconds=10.0))
        assert (search.sliced.genes, search.sliced.gene_seconds) == (5, 12.0)

    def test_sampled_speeds_are_uniform_and_actions_equally_likely(self, assert_rate):
        genes = [gene for each in scenarios(300) for chain in each.npcs for gene in chain]
        assert len(genes) == DRAWS
        for lane in SHIFTS:
            assert_rate(sum(gene.lane == lane for gene in genes), DRAWS, 1 / 3)
        assert_rate(sum(gene.speed < 13.4 for gene in genes), DRAWS, 134 / 269)
        assert max(gene.speed for gene in genes) <= 26.8


class TestOperators:
    def test_crossover_swaps_npcs_of_the_same_index(self):
        a, b = scenarios(2)
        generator, seen = rng(), set()
        for _ in range(20):
            first, second = swap_npc(a, b, generator)
            npc = next(npc for npc in (0, 1) if first.npcs[npc] == b.npcs[npc])
            assert second.npcs[npc] == a.npcs[npc]
            assert (first.npcs[1 - npc], second.npcs[1 - npc]) == (a.npcs[1 - npc], b.npcs[1 - npc])
            seen.add(npc)
        assert seen == {0, 1}

    def test_mutation_changes_speed_action_or_nothing_equally_often(self, assert_rate):
        (given,), generator = scenarios(1), rng(1)
        kinds, places = Counter(), Counter()
        for _ in range(DRAWS):
            child = mutate_manoeuvre(given, SPACE, generator)
            changed = [
                (npc, gene, before, after)
                for npc, (old, new) in enumerate(zip(given.npcs, child.npcs, strict=True))
                for gene, (before, after) in enumerate(zip(old, new, strict=True))
                if before != after
            ]
            assert len(changed) <= 1
            for npc, gene, before, after in changed:
                assert (before.speed != after.speed) != (before.lane != after.lane)
                kinds["speed" if before.speed != after.speed else "lane"] += 1
                places[npc, gene] += 1
        assert_rate(kinds["speed"], DRAWS, 1 / 3 * 268 / 269)
        # a sampled action equals the old one in a third of the cases
        assert_rate(kinds["lane"], DRAWS, 1 / 3 * 2 / 3)
        assert len(places) == 10


class TestRoulette:
    def test_members_are_drawn_in_proportion_to_their_fitness(self, make_evaluation, assert_rate):
        weights = zip(scenarios(3), (1.0, 3.0, 6.0), strict=True)
        population = [make_evaluation(each, fitness=weight) for each, weight in weights]
        drawn = Counter(
            member.fitness for seed in range(1000) for member in roulette(population, rng(seed))
        )
        for weight in (1.0, 3.0, 6.0):
            assert_rate(drawn[weight], DRAWS, weight / 10)

    def test_roulette_shifts_worst_negative_fitness_to_zero_weight(
        self, make_evaluation, assert_rate
    ):
        population = [
            make_evaluation(each, fitness=f)
            for each, f in zip(scenarios(3), (-4.0, -1.0, 5.0), strict=True)
        ]
        drawn = Counter(
            member.fitness for seed in range(1000) for member in roulette(population, rng(seed))
        )
        assert drawn[-4.0] == 0
        assert_rate(drawn[-1.0], DRAWS, 3 / 12)

    def test_roulette_never_draws_ineligible_runs_among_eligible(self, make_evaluation):
        good, crash = scenarios(2)
        population = [
            make_evaluation(good, fitness=1.0),
            make_evaluation(crash, fitness=9.0, outcome=Outcome.INVALID),
        ]
        assert {member.scenario for member in roulette(population, rng())} == {good}

    def test_where_none_is_eligible_all_are_equal(self, make_evaluation):
        population = [make_evaluation(each, fitness=math.nan) for each in scenarios(4)]
        drawn = Counter(
            member.scenario for seed in range(200) for member in roulette(population, rng(seed))
        )
        assert len(drawn) == 4


class TestDistance:
    def test_features_add_up_speeds_and_lane_changes(self):
        given = one("left@10 keep@5 right@1; right@2 right@3 keep@4")
        assert features(given).tolist() == [
            [[10, -34], [15, -34], [16, 0]],
            [[2, 34], [5, 68], [9, 68]],
        ]

    def test_distance_is_euclidean_per_slice_averaged_over_npcs(self):
        a, b = one("left@10 keep@5; keep@1 keep@1"), one("keep@10 keep@5; keep@4 keep@5")
        by_hand = ((34 + 34) + (3 + 7)) / 2
        assert distance(features(a), features(b)) == pytest.approx(by_hand)

    @given(st.integers(0, 10**6))
    def test_it_is_symmetric_and_zero_for_equals(self, seed):
        a, b = scenarios(2, seed)
        assert distance(features(a), features(a)) == 0
        assert distance(features(a), features(b)) == distance(features(b), features(a)) > 0

    def test_farthest_candidates_have_greatest_mean_distance_to_checkpoints(self):
        before, candidates = scenarios(6, seed=1), scenarios(50, seed=2)
        checkpoints = np.stack([features(each) for each in before])
        means = {
            each: np.mean([distance(features(each), features(old)) for old in before])
            for each in candidates
        }
        assert (
            list(farthest(candidates, checkpoints, 4))
            == sorted(candidates, key=lambda each: -means[each])[:4]
        )


class TestCourse:
    def test_only_what_was_touched_is_asked_for_again(self, landscape, assert_rate):
        search = AvFuzzerSearch(local_generations=0, restart_after=10**6)
        events = list(run_plan(search, landscape(lambda each: 1.0), generations=150, seed=1))
        asked = Counter(event.generation for event in events if isinstance(event, Evaluated))
        assert asked[0] == 4
        touched = sum(asked[generation] for generation in range(1, 150))
        # A scenario changes by its own mutation, or by one of two crossovers of two out of four.
        assert_rate(touched, 149 * 4, 1 - 0.6 * (1 - 0.4 / 2) ** 2)

    def test_generation_without_any_change_still_counts(self, landscape):
        search = AvFuzzerSearch(crossover_rate=0.0, mutation_rate=0.0)
        events = list(run_plan(search, landscape(lambda each: 1.0), generations=4, seed=1))
        assert [event.generation for event in events if isinstance(event, GenerationFinished)] == [
            0,
            1,
            2,
            3,
        ]
        assert sum(isinstance(event, Evaluated) for event in events) == 4

    def test_best_of_all_generations_may_die_out(self, landscape):
        search, known = AvFuzzerSearch(local_generations=0), {}

        def fitness(each):
            return known.setdefault(each, 100.0 if not known else 1.0)

        events = list(run_plan(search, landscape(fitness), generations=10, seed=3))
        bests = [event.evaluation.fitness for event in events if isinstance(event, NewBest)]
        assert bests == [100.0]
        last = [event for event in events if isinstance(event, GenerationFinished)][-1]
        assert {member.fitness for member in last.population} == {1.0}

    def test_restart_without_progress_draws_far_from_earlier_scenarios(self, landscape):
        search = AvFuzzerSearch()
        events = list(run_plan(search, landscape(lambda each: 1.0), generations=14, seed=1))
        restarts = [event.generation for event in events if isinstance(event, Restarted)]
        assert restarts == [6, 12]
        asked = [event.evaluation.scenario for event in events if isinstance(event, Evaluated)]
        fresh = [
            e.evaluation.scenario for e in events if isinstance(e, Evaluated) and e.generation == 6
        ]
        assert len(fresh) == 4
        before = np.stack([features(each) for each in asked[: asked.index(fresh[0])]])
        spread = [np.mean(distance(features(each), before)) for each in fresh]
        usual = [np.mean(distance(features(each), before)) for each in scenarios(200, seed=9)]
        assert min(spread) > np.quantile(usual, 0.9)

    def test_restart_needs_best_no_better_than_recent_mean(self, landscape):
        def slowly_rising():
            seen = Counter()

            def fitness(each):
                seen["runs"] += 1
                return float(seen["runs"])

            return fitness

        search = AvFuzzerSearch(local_generations=0, mutation_rate=1.0)
        events = list(run_plan(search, landscape(slowly_rising()), generations=30, seed=1))
        assert not any(isinstance(event, Restarted) for event in events)

    def test_local_search_mutates_copies_of_the_best(self, landscape):
        events = list(run_plan(AvFuzzerSearch(), landscape(all_speeds), generations=12, seed=2))
        start = next(event for event in events if isinstance(event, LocalSearchStarted))
        assert start.generation > 2
        generations = [event for event in events if isinstance(event, GenerationFinished)]
        finished = [
            each
            for each in generations
            if each.generation == start.generation and each.local_generation
        ]
        assert [event.local_generation for event in finished] == [1, 2, 3, 4, 5, 6]
        for member in finished[0].population:
            pairs = zip(start.incumbent.scenario.npcs, member.scenario.npcs, strict=True)
            differ = sum(a != b for old, new in pairs for a, b in zip(old, new, strict=True))
            assert differ <= 1
        end = next(event for event in events if isinstance(event, LocalSearchFinished))
        assert end.best.fitness >= end.incumbent.fitness
        assert end.replaced == (end.best.fitness > end.incumbent.fitness)

    def test_better_local_search_result_replaces_generation_best(self, landscape):
        search, evaluate = AvFuzzerSearch(restart_after=100), landscape(all_speeds)
        for seed in range(20):
            state, generator = search.start(rng(seed)), rng(seed)
            for _ in range(60):
                before = state.population
                state, asked = search.ask(state, generator)
                state, events = search.tell(state, list(map(evaluate, asked)), generator)
                ends = [
                    event
                    for event in events
                    if isinstance(event, LocalSearchFinished) and event.replaced
                ]
                for end in ends:
                    place = max(range(4), key=lambda index: before[index].fitness)
                    assert state.population == (*before[:place], end.best, *before[place + 1 :])
                    assert state.global_best == end.best
                    return
        pytest.fail("no local search found anything better")

    def test_local_search_needs_two_generations_after_restart(self, landscape):
        begun = []

        def fitness(each):
            """Return the same for all until a restart, then more with each run."""
            begun.append(len(begun) if restarts else 0)
            return float(begun[-1])

        restarts, started = [], []
        for event in run_plan(AvFuzzerSearch(), landscape(fitness), generations=10, seed=0):
            if isinstance(event, Restarted):
                restarts.append(event.generation)
            if isinstance(event, LocalSearchStarted):
                started.append(event.generation)
        assert (restarts, started) == ([6], [9])


WRONG = [("population", 1), ("mutation_rate", 1.5), ("local_mutation_factor", math.nan)]


@table(("name", "value"), WRONG)
def test_wrong_parameters_are_refused(name, value):
    with pytest.raises(ValueError, match=f"^{name}: "):
        AvFuzzerSearch(**{name: value})


def test_av_fuzzer_draws_without_zones_as_it_did_before(make_evaluation):
    drawn = {space: drawn_digest("av-fuzzer", WITHOUT[space], make_evaluation) for space in WITHOUT}
    assert drawn == {"papers": "b07ec34b17d5", "wide": "374eb7f4ea29", "bend": "ef9f486e8604"}


def test_av_fuzzer_has_the_space_of_the_paper():
    space = space_of(Highway(), algorithm="av-fuzzer")
    assert (space.npcs, space.ego_lane, space.ego_speed, space.patterns) == (2, 1, 22.0, False)
    assert space_of(World("intersection-v0"), algorithm="av-fuzzer").crossings is None


# Its fitness against a second implementation, written from the description in plain loops.


def brake(speed):
    return max(0.0, 0.0467 * speed**2 + 0.4116 * speed - 1.4913)


def released(trace):
    """Return the released formula, sample by sample and vehicle by vehicle; the road runs along x."""
    samples = {round(k * trace.physics_hz / 4) for k in range(int(trace.duration * 4 + 1e-9) + 1)}
    if trace.collision is not None:
        samples.add(trace.collision.tick)
    distances, rooms = [130.0], [130.0]
    for tick in samples:
        ex, ey, heading, ev = trace.ego[min(tick, trace.ticks), :4]
        for npc in trace.npcs[min(tick, trace.ticks)]:
            nx, ny, _, nv = npc[:4]
            d = math.dist((ex, ey), (nx, ny))
            distances.append(d)
            if abs(ny - ey) < 2 and ex + 4.6 < nx < ex + 20:
                rooms.append(d - 4.6 - brake(ev))
            yaw = abs(math.degrees(math.asin(math.sin(heading))))
            if abs(ny - ey) < 2 and ex - 20 < nx < ex - 4.6 and yaw > 1:
                rooms.append(d - 4.6 - brake(nv))
    return (130 - 0.5 * min(distances) - 0.5 * min(rooms)) / max(trace.npcs.shape[1] - 1, 1)


@table("seed", range(60))
def test_fitness_is_the_released_formula_on_any_trace(seed):
    rng = np.random.default_rng(seed)
    states = random_states(
        rng, rows=int(rng.integers(1, 40)), vehicles=int(rng.integers(2, 5)), spread=18.0
    )
    states[..., 2] = rng.uniform(-0.05, 0.05, states.shape[:2])
    states[..., 1] /= 4
    trace = trace_of(
        *np.moveaxis(states, 1, 0), outcome=Outcome.COLLISION if seed % 2 else Outcome.COMPLETED
    )
    assert av_fuzzer(trace) == pytest.approx(released(trace), abs=1e-9)


@table("speed", [0.0, 3.0, 22.0, 30.0])
def test_braking_distance_is_polynomial_and_never_negative(speed):
    assert braking_distance(np.array([speed]))[0] == pytest.approx(brake(speed))
    assert braking_distance(np.zeros(1))[0] == 0.0


def test_a_turned_road_makes_no_difference_to_the_fitness():
    heading = 0.7
    cos, sin = math.cos(heading), math.sin(heading)

    def turned(x, y, **fields):
        return vehicle(x * cos - y * sin, x * sin + y * cos, heading=heading, lane=0, **fields)

    cars = [(0.0, 0.0, 20.0), (12.0, 1.0, 9.0), (-9.0, 0.5, 20.0)]
    straight = trace_of(*(vehicle(x, y, speed=speed) for x, y, speed in cars))
    other = trace_of(
        *(turned(x, y, speed=speed) for x, y, speed in cars), lanes=straight_lanes(heading=heading)
    )
    assert av_fuzzer(other) == pytest.approx(av_fuzzer(straight))


def test_only_a_collision_counts_between_two_samples():
    passing = np.array([40.0, 40.0, 6.0, 40.0, 40.0])
    unseen = trace_of(vehicle(0.0, ticks=4), vehicle(passing), vehicle(500.0, 8.0))
    seen = trace_of(
        vehicle(0.0, ticks=2), vehicle(passing[:3]), vehicle(500.0, 8.0), outcome=Outcome.COLLISION
    )
    assert av_fuzzer(unseen) == pytest.approx(130 - 20 - 65)
    assert av_fuzzer(seen) > av_fuzzer(unseen)


def test_av_fuzzer_fitness_is_available_by_its_name():
    trace = trace_of(vehicle(0.0), vehicle(15.0), vehicle(500.0, 8.0))
    assert resolve("av-fuzzer")(trace) == av_fuzzer(trace)
    invalid = trace_of(vehicle(0.0), vehicle(15.0), vehicle(500.0, 8.0), outcome=Outcome.INVALID)
    assert resolve("av-fuzzer")(invalid) == -math.inf
