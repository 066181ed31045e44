"""Near-misses of the ego: the dangers of a run, judged as the collisions that they almost were."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from example_ads.defects import make
from pytest_pafot import Highway
from pytest_pafot.attribution.mistakes import mistake
from pytest_pafot.attribution.near_misses import ALL, near_misses
from pytest_pafot.attribution.needless_braking import Stop, hard_braking
from pytest_pafot.attribution.responsibility import Attribution, Conflict, is_ego_responsible, rss_rule
from pytest_pafot.criticality import gap, ttc
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching import SearchSpace, sample
from tests.helpers.drives import HZ, crash, driven
from tests.helpers.stages import oracle
from tests.helpers.tables import table
from tests.helpers.traces import random_states, trace_of

LEFT, OWN, RIGHT = 0.0, 4.0, 8.0
DEFECTS = ("looks-only-ahead", "stops-in-its-lane", "brakes-for-ghosts", "sees-cut-ins-late")

COLLISIONS = {
    "leader-unanswered": lambda: crash(driven(0.0), driven(100.0, speed=10.0)),
    "cut-in-unanswered": lambda: crash(
        driven(0.0), driven(25.0, LEFT, brakes=[(9.0, 8.0, 0.0)], shifts=[(2.0, OWN, 2.0)])
    ),
    "entered-lane": lambda: crash(
        driven(0.0, LEFT, shifts=[(2.0, OWN, 2.0)]), driven(-35.0, speed=28.0), side="rear", cell=Cell.REAR
    ),
    "npc": lambda: crash(driven(0.0), driven(-60.0, speed=26.0), side="rear", cell=Cell.REAR),
}


def before(trace, ticks=1):
    """The run as it was so many ticks before the impact, without it."""
    states = trace.states[: len(trace.states) - ticks]
    return replace(trace, states=states, outcome=Outcome.SAFE, collision=None, actions=trace.actions[: len(states) - 1])


def mistakes(trace):
    return [near_miss.mistake for near_miss in near_misses(trace)]


@table("fault", ["leader-unanswered", "cut-in-unanswered", "entered-lane"])
def test_what_almost_was_a_collision_of_the_ego_is_a_near_miss_of_the_same_mistake(fault):
    trace = COLLISIONS[fault]()
    assert rss_rule(trace).fault == fault
    assert mistakes(before(trace)) == [mistake(trace, rss_rule(trace))]


def test_what_almost_was_a_collision_of_an_npc_is_none():
    assert mistakes(before(COLLISIONS["npc"]())) == []


@table("name", COLLISIONS)
def test_the_danger_that_ended_in_the_impact_is_none(name):
    assert near_misses(COLLISIONS[name]()) == ()


def test_a_danger_before_the_impact_with_another_is_one():
    ego = driven(0.0)
    slow = driven(60.0, RIGHT, speed=12.0, shifts=[(1.0, OWN, 2.0), (5.0, RIGHT, 1.0)])
    trace = crash(ego, driven(-60.0, speed=26.0), slow, side="rear", cell=Cell.REAR)
    assert [(near_miss.mistake, near_miss.npc) for near_miss in near_misses(trace)] == [("kept-no-distance", 1)]


def test_keeping_the_distance_is_none():
    assert near_misses(trace_of(driven(0.0), driven(60.0))) == ()


def test_it_is_taken_where_time_and_gap_are_worst():
    trace = trace_of(driven(0.0, brakes=[(7.5, 9.0, 8.0)]), driven(100.0, speed=10.0))
    (found,) = near_misses(trace)
    worst = (1 / (1 + ttc(trace)[:, 0] / 1.5) + 1 / (1 + gap(trace)[:, 0])) / 2
    assert found.tick == np.argmax(worst)
    assert found.severity == pytest.approx(max(worst))


@given(ticks=st.lists(st.integers(1, 50), min_size=2, max_size=2, unique=True))
def test_the_later_the_ego_is_saved_the_more_severe(ticks):
    trace = COLLISIONS["leader-unanswered"]()
    nearer, farther = (near_misses(before(trace, each)) for each in sorted(ticks))
    assert nearer[0].severity > max((near_miss.severity for near_miss in farther), default=0.0)


@given(seed=st.integers(0, 10_000), ticks=st.integers(1, 60), vehicles=st.integers(2, 4))
def test_any_run_has_at_most_one_of_each_mistake_within_its_time(seed, ticks, vehicles):
    states = random_states(np.random.default_rng(seed), ticks + 1, vehicles)
    found = near_misses(trace_of(*states.swapaxes(0, 1)))
    assert [each.mistake for each in found] == sorted({each.mistake for each in found})
    for each in found:
        assert 0 <= each.tick <= ticks
        assert 0 <= each.npc < vehicles - 1
        assert 0 < each.severity <= 1


@table("to", [1.0, 1.5, OWN])
def test_a_cut_in_that_nobody_could_answer_is_none_whether_or_not_the_tracks_came_to_overlap(to):
    npc = driven(28.0, LEFT, speed=10.0, shifts=[(2.0, to, 0.6)])
    whole = crash(driven(0.0), driven(28.0, LEFT, speed=10.0, shifts=[(2.0, OWN, 0.6)]))
    assert rss_rule(whole).reason.endswith("too late to avoid it")
    ego = driven(0.0)
    ticks = whole.ticks
    assert mistakes(trace_of(ego[:ticks], npc[:ticks])) == []


def test_braking_is_hard_from_when_it_has_lasted_and_not_by_what_follows():
    trace = trace_of(driven(0.0, brakes=[(2.0, 9.0, 0.0)]), driven(100.0))
    begin, enough = 2 * HZ, 2 * HZ + 6  # 0.4 s
    assert hard_braking(trace, 0, 0, enough - 1) is None
    assert hard_braking(trace, 0, 0, enough) == Stop(begin=begin, end=enough)


@given(ticks=st.integers(1, 6))
def test_just_before_a_collision_by_a_cut_in_that_came_too_late_there_is_none(ticks):
    trace = crash(driven(0.0), driven(28.0, LEFT, speed=10.0, shifts=[(2.0, OWN, 0.6)]))
    assert rss_rule(trace).reason.endswith("too late to avoid it")
    assert mistakes(before(trace, ticks)) == []


@pytest.fixture(scope="module", params=[(57, 1), oracle((1, 12))], ids=["some", "more"])
def searched(request):
    """Runs of policies with a defect each, among four NPCs."""
    seed, count = request.param
    rng, space = np.random.default_rng(seed), SearchSpace(npcs=4, genes=3)
    return [Highway().rollout(sample(space, rng), make(name)) for name in DEFECTS for _ in range(count)]


def test_floors_spare_verdicts_and_change_no_near_miss_above_them(searched):
    every = [(trace, each) for trace in searched for each in near_misses(trace)]
    assert {each.mistake for _, each in every} >= set(ALL) - {"stopped-for-nothing"}
    for trace, each in every:
        asked = {"braked-for-nothing": 1.0, each.mistake: each.severity - 1e-9}
        assert each in near_misses(trace, asked)
        assert each not in near_misses(trace, {each.mistake: each.severity})


def test_what_is_known_sooner_than_a_verdict_rules_out_no_mistake(searched, monkeypatch):
    found = [near_misses(trace, {mistake: 0.0}) for trace in searched for mistake in ALL]
    monkeypatch.setattr(Conflict, "may_be", lambda conflict, fault: True)
    assert found == [near_misses(trace, {mistake: 0.0}) for trace in searched for mistake in ALL]


def test_the_collision_of_a_run_is_judged_once(monkeypatch):
    trace, judged = COLLISIONS["npc"](), []
    monkeypatch.setattr(
        Conflict,
        "_in_one_lane",
        lambda conflict: judged.append(conflict) or Attribution(responsibility="npc", tick=0, time=0.0),
    )
    assert rss_rule(trace) == rss_rule(trace)
    assert not is_ego_responsible(trace)
    assert len(judged) == 1
