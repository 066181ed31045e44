"""Searches that draw generations before all earlier ones are learnt: what they must learn, and when they may draw."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching import DistinctSearch, PafotSearch, RandomManoeuvreSearch, RandomSearch
from pytest_pafot.searching.ask_tell import draws_ahead
from tests.helpers.traces import collision_at

SEARCHES = [DistinctSearch(population=3), RandomSearch(population=3), RandomManoeuvreSearch(population=3)]


@st.composite
def evaluations(draw, make_evaluation):
    """Return three evaluations, with few different values, so that equal and better ones are frequent."""
    several, margin = [], st.tuples(st.sampled_from(["gap", "speed"]), st.sampled_from([-1.0, 0.0, 1.0]))
    for _ in range(3):
        fields = {
            "fitness": draw(st.sampled_from([0.0, 1.0, 2.0, float("nan")])),
            "demand": draw(st.sampled_from([(0, 0, False), (1, 0, False), (1, 0, True)])),
            "margins": draw(st.lists(margin, max_size=2, unique_by=lambda each: each[0]).map(tuple)),
            "discarded": draw(st.booleans()),
        }
        if draw(st.booleans()):
            hit = replace(collision_at(30, cell=Cell(draw(st.sampled_from([2, 4])))), closing_speed=3.0)
            fields |= {"outcome": Outcome.COLLISION, "collision": hit}
        if draw(st.booleans()):
            kind, mistake = draw(st.sampled_from(["a", "b", None])), draw(st.sampled_from(["gap", "moved", None]))
            fields |= {"failing": True, "kind": kind, "mistake": mistake}
        several.append(make_evaluation(**fields))
    return several


def known(state):
    """Return a state without groups of elites that are empty, which change nothing."""
    strained = getattr(state, "strained", {})
    return replace(state, strained={name: each for name, each in strained.items() if each}) if strained else state


@pytest.mark.parametrize("algorithm", SEARCHES, ids=lambda each: each.name)
@given(data=st.data())
def test_learning_what_matters_is_learning_all(make_evaluation, algorithm, data):
    whole = some = algorithm.start(np.random.default_rng(0))
    earlier = [some]
    for _ in range(data.draw(st.integers(1, 5))):
        told = data.draw(evaluations(make_evaluation))
        older = data.draw(st.sampled_from(earlier))
        news = [each for each in told if algorithm.matters(older, each)]
        whole, some = (
            algorithm.tell(
                replace(state, asked=tuple(each.scenario for each in learnt)), learnt, np.random.default_rng(0)
            )[0]
            for state, learnt in ((whole, told), (some, news))
        )
        assert repr(known(some)) == repr(known(whole))  # equal, also where a fitness is not a number
        earlier.append(some)


@pytest.mark.parametrize("algorithm", SEARCHES, ids=lambda each: each.name)
@given(population=st.integers(1, 2000))
def test_each_generation_waits_for_earlier_ones_alone_and_at_least_as_many(algorithm, population):
    waits = [replace(algorithm, population=population).waits_for(generation) for generation in range(2000)]
    assert waits[0] == 0
    assert all(wait <= generation for generation, wait in enumerate(waits))
    assert waits == sorted(waits)
    assert waits[-1] > 0


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


class LearningAhead(Learning):
    def waits_for(self, generation):
        return generation

    def matters(self, state, evaluation):
        return True


@pytest.mark.parametrize("algorithm", [*SEARCHES, Named(), WithChildren(), LearningAhead()], ids=repr)
def test_a_search_draws_ahead_if_it_says_what_it_waits_for(algorithm):
    assert draws_ahead(algorithm)


@pytest.mark.parametrize("algorithm", [PafotSearch(), WithProposals(), Learning()], ids=repr)
def test_a_search_that_changes_how_another_one_draws_or_learns_does_not(algorithm):
    assert not draws_ahead(algorithm)
