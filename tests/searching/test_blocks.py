"""Searches that begin anew after some generations: their scenarios, whoever drives a block, and what it is told."""

import pickle
from dataclasses import replace
from itertools import islice

import pytest

from pytest_pafot.searching import DistinctSearch, PafotSearch, RandomManoeuvreSearch, RandomSearch, SearchSpace
from pytest_pafot.searching.ask_tell import block_runs
from pytest_pafot.searching.events import GenerationFinished, NewBest
from pytest_pafot.searching.plan import LEAST_GENERATIONS, Learnt, plan_of
from tests.helpers.campaigns import run_campaign

SPACE = SearchSpace(genes=3)
DISTINCT = DistinctSearch(SPACE, population=5, random_runs=7)


class Named(DistinctSearch):
    name = "named"


class WithChildren(DistinctSearch):
    def child(self, parents, rng):
        return super().child(parents, rng)


class WithProposals(DistinctSearch):
    def propose(self, state, rng):
        return super().propose(state, rng)


class Learning(RandomSearch):
    def learn(self, state, evaluations, rng):
        return super().learn(state, evaluations, rng)


class LearningInBlocks(Learning):
    block_runs = 100


SEARCHES = [DistinctSearch(), RandomSearch(), RandomManoeuvreSearch(), Named(), WithChildren()]


@pytest.mark.parametrize("algorithm", SEARCHES, ids=lambda each: type(each).__name__)
def test_a_search_has_blocks_if_its_class_says_so(algorithm):
    assert block_runs(algorithm) == 64
    assert block_runs(LearningInBlocks()) == 100


@pytest.mark.parametrize("algorithm", [PafotSearch(), WithProposals(), Learning()], ids=repr)
def test_a_search_that_changes_how_another_one_draws_or_learns_has_one_population(algorithm):
    assert block_runs(algorithm) is None


@pytest.mark.parametrize(("population", "generations"), [(4, 16), (16, 4), (5, 13), (64, 4), (1000, 4)])
def test_a_block_has_some_whole_generations(population, generations):
    plan = plan_of(replace(DISTINCT, population=population), generations=100, seed=1)
    assert plan.length == generations >= LEAST_GENERATIONS


def scenarios_of(block, generations, world):
    """Follow a block by itself; return the scenarios of each generation."""
    told = []
    for _ in range(generations):
        told.append(block.drawn)
        while not block.is_whole:
            block.take(world(block.scenario()))
        block.learn()
    return told


@pytest.mark.parametrize("algorithm", [DISTINCT, RandomSearch(SPACE)], ids=lambda each: each.name)
def test_a_block_by_itself_has_the_scenarios_of_the_search(cheap_world, algorithm):
    world = cheap_world()
    plan = plan_of(algorithm, generations=3 * 64, seed=3)
    events = run_campaign(algorithm, world, generations=3 * plan.length, seed=3)
    finished = [each for each in events if isinstance(each, GenerationFinished)]
    whole = [tuple(each.scenario for each in generation.population) for generation in finished]
    for number in range(3):
        first = number * plan.length
        assert scenarios_of(plan.beginning(number), plan.length, world) == whole[first : first + plan.length]


def test_a_block_begins_at_random_and_its_children_are_bred_from_its_own_runs(cheap_world):
    plan = plan_of(DISTINCT, generations=100, seed=3)
    block, other = plan.beginning(2), plan.beginning(2)
    first, *_ = scenarios_of(block, 2, cheap_world())
    assert first == other.drawn
    elites = dict(block.state.elites).values()
    assert {each.scenario for each in elites} <= {*first, *scenarios_of(plan.beginning(2), 2, cheap_world())[1]}
    assert block.state.proposed == 2 * plan.length * DISTINCT.population + 2 * DISTINCT.population


def test_generations_that_another_process_has_driven_are_unpacked_when_they_are_needed(cheap_world):
    world = cheap_world()
    here, there = (plan_of(DISTINCT, generations=100, seed=3) for _ in range(2))
    block, events = there.beginning(0), []
    for _ in range(3):
        evaluations = [world(scenario) for scenario in block.drawn]
        for each in evaluations:
            block.take(each)
            here.take(each)
        events += block.learn()
        there.skip(len(evaluations), pickle.dumps(evaluations))
        there.block.learnt = Learnt.packed(block.state, events[-1:])
        assert there.is_whole
        assert [each for each in there.learn() if isinstance(each, NewBest)] == [
            each for each in here.learn() if isinstance(each, NewBest)
        ][-1:]
    assert there.scenario() == here.scenario()
    assert there.block.state == here.block.state


@pytest.mark.parametrize(("limits", "blocks"), [({"runs": 64}, 0), ({"runs": 65}, 1), ({"generations": 25}, 1)])
def test_blocks_within_the_limits_of_a_search(limits, blocks):
    plan = plan_of(DISTINCT, **({"generations": None} | limits), seed=3)  # a block has 13 generations of 5
    assert plan.whole_blocks == blocks


def test_later_blocks_have_only_scenarios_within_the_limits():
    plan = plan_of(DISTINCT, generations=None, runs=67, seed=3)
    assert len(list(plan.within(plan.beginning(0)))) == 5
    assert len(list(plan.within(plan.beginning(1)))) == 2
    assert not list(islice(plan.within(plan.beginning(2)), 1))
