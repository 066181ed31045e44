"""Neighbours of a scenario, and how many of them fail as it does."""

import random
import subprocess
import sys
from dataclasses import replace
from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.findings.neighbours import ALL_SPEEDS, WIDE, Breadth, Limits, breadth_of, neighbours
from pytest_pafot.findings.neighbours import around as around_at
from pytest_pafot.model.instructions import CrossingInstruction, LaneInstruction, Manoeuvre, PositionInstruction, Step
from pytest_pafot.model.instructions.crossing import SLOT
from pytest_pafot.model.instructions.instruction import LARGEST_SPEED_STEP
from pytest_pafot.model.instructions.manoeuvre import DISTANCE
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.strategies import manoeuvres, scenarios
from tests.helpers.tables import table

TOP = 26.8
ON_GRID = Scenario(npcs=((PositionInstruction(2, 10.0), PositionInstruction(3, 3.0)), (PositionInstruction(6, 20.0),)))
IN_LANES = Scenario(npcs=((LaneInstruction("keep", 10.0), LaneInstruction("left", 3.0)),))
AT_A_ZONE = Scenario(npcs=((CrossingInstruction("o1>o3", 4.9, 0.2, "late"),),), ego_speed=8.0)


def limits(fits=lambda scenario: True, longest_run=1e9):
    return Limits(fits=fits, top_speed=TOP, longest_run=longest_run)


def around(scenario, number=40, share=1.0, **given):
    return tuple(islice(neighbours(scenario, share, limits(**given)), number))


@given(scenarios(max_speed=TOP), st.sampled_from([1.0, WIDE]))
def test_neighbours_are_different_valid_and_the_same_each_time(scenario, share):
    several = around(scenario, 10, share)
    assert several == around(scenario, 10, share)
    assert len(set(several)) == len(several) == 10
    assert scenario not in several
    for each in several:
        assert Scenario.from_canonical(each.plain()) == each  # with all checks
        longest = max(map(len, scenario.npcs))
        longer = [len(chain) + (len(chain) == longest) for chain in scenario.npcs]
        assert [len(chain) for chain in each.npcs] == longer
        assert all(0 <= gene.speed <= TOP for chain in each.npcs for gene in chain)
        assert 0 <= each.ego_speed <= TOP


@given(scenarios(max_speed=TOP), st.sampled_from([1.0, WIDE]))
def test_steps_are_as_large_as_their_share_at_most(scenario, share):
    for each in around(scenario, 10, share):
        for chain, before in zip(each.npcs, scenario.npcs, strict=True):
            for gene, old in zip(chain, before, strict=False):
                largest = share * max(LARGEST_SPEED_STEP, ALL_SPEEDS * old.speed)
                assert abs(gene.speed - old.speed) <= largest + 0.051


@pytest.mark.parametrize("scenario", [ON_GRID, IN_LANES, AT_A_ZONE], ids=["grid", "lanes", "zone"])
def test_neighbours_differ_in_speeds_instructions_and_starts(scenario):
    several = around(scenario)
    assert len(several) == 40
    assert len({each.ego_speed for each in several}) > 5
    assert (len({each.gene_seconds for each in several}) > 2) == (scenario != AT_A_ZONE)  # where it changes nothing
    assert len({tuple(gene.speed for chain in each.npcs for gene in chain) for each in several}) > 5
    targets = {tuple(gene.target for chain in each.npcs for gene in chain) for each in several}
    assert (len(targets) > 3) == (scenario != AT_A_ZONE)


def test_crossing_neighbours_arrive_at_other_times_within_the_largest_slot():
    slots = {each.npcs[0][0].slot for each in around(AT_A_ZONE)}
    assert len(slots) > 2
    assert min(slots) >= 4.9 - SLOT - 0.051
    assert max(slots) <= 5.0
    assert {each.npcs[0][0].act for each in around(AT_A_ZONE)} == {"late"}
    assert min(each.npcs[0][0].speed for each in around(AT_A_ZONE)) == 0.1


@given(manoeuvres(max_speed=TOP), st.sampled_from([1.0, WIDE]))
def test_neighbours_of_a_manoeuvre_differ_in_speeds_and_distances(manoeuvre, share):
    scenario = Scenario(npcs=((manoeuvre,), (PositionInstruction(6, 20.0),)))
    for each in around(scenario, 10, share):
        assert Scenario.from_canonical(each.plain()) == each  # with all checks
        ((moved,), _) = each.npcs
        assert (moved.beside, moved.ahead) == (manoeuvre.beside, manoeuvre.ahead)
        assert (
            abs(moved.speed - manoeuvre.speed) <= share * max(LARGEST_SPEED_STEP, ALL_SPEEDS * manoeuvre.speed) + 0.051
        )
        for step, old in zip(moved.steps, manoeuvre.steps, strict=True):
            for now, before in ((step.gap, old.gap), (step.headway, old.headway)):
                assert (now is None) == (before is None)
                assert now is None or abs(now - before) <= share * DISTANCE * abs(before) + 0.051
            assert step.speed is None or 0 <= step.speed <= TOP
            assert abs(step.after - old.after) <= share * DISTANCE * old.after + 0.051
            assert (step.speed is None) == (old.speed is None)
            assert replace(step, gap=old.gap, headway=old.headway, after=old.after, speed=old.speed) == old


def test_distances_of_a_manoeuvre_are_moved():
    steps = Step(gap=20.0, speed=10.0), Step(headway=-2.0)
    several = around(Scenario(npcs=((Manoeuvre(beside=1, ahead=30.0, speed=20.0, steps=steps),),)))
    assert len({each.npcs[0][0].steps[0].gap for each in several}) > 5
    assert len({each.npcs[0][0].steps[1].headway for each in several}) > 3
    assert {each.gene_seconds for each in several} == {10.0}, "it changes nothing"


def test_steps_of_a_standing_manoeuvre_are_faster_and_slower_and_its_stop_stays():
    pulls_away = Manoeuvre(beside=0, ahead=90.0, speed=0.0, steps=(Step(gap=60.0, speed=10.0), Step(speed=0.0)))
    scenario = Scenario(npcs=((pulls_away,),))
    speeds = [step.speed for each in around(scenario) for step in each.npcs[0][0].steps]
    assert 10.0 - LARGEST_SPEED_STEP <= min(speeds[::2]) <= max(speeds[::2]) <= 10.0 + LARGEST_SPEED_STEP
    assert len({*speeds[::2]}) > 5
    assert {*speeds[1::2]} == {0.0}


def test_latest_step_gets_no_later():
    latest = Manoeuvre(beside=0, ahead=90.0, speed=10.0, steps=(Step(after=600.0),))
    times = {each.npcs[0][0].steps[0].after for each in around(Scenario(npcs=((latest,),)))}
    assert 540.0 <= min(times) < max(times) == 600.0


def test_only_the_longest_chains_are_longer():
    one = (PositionInstruction(2, 10.0),)
    scenario = Scenario(npcs=(one, (PositionInstruction(3, 5.0), PositionInstruction(2, 5.0))))
    assert {tuple(map(len, each.npcs)) for each in around(scenario)} == {(1, 3)}


def test_neighbours_that_do_not_fit_the_world_are_left_out():
    several = around(ON_GRID, fits=lambda each: each.ego_speed == ON_GRID.ego_speed)
    assert len(several) == 40
    assert {each.ego_speed for each in several} == {ON_GRID.ego_speed}
    assert around(ON_GRID, fits=lambda each: False) == ()


def test_neighbours_do_not_depend_on_the_hash_seed():
    program = "from tests.findings.test_neighbours import *; print([each.id for each in around(ON_GRID, 5)])"
    told = {
        subprocess.run(
            [sys.executable, "-c", program], env={"PYTHONHASHSEED": seed}, capture_output=True, text=True, check=True
        ).stdout
        for seed in ("1", "2")
    }
    assert told == {f"{[each.id for each in around(ON_GRID, 5)]}\n"}


def breadth_by(fails, scenario, number, **given):
    asking, answer = breadth_of(scenario, number, limits(**given)), None
    try:
        while True:
            answer = fails(asking.send(answer)[0])
    except StopIteration as done:
        return done.value


def breadth(fails, number=40, scenario=ON_GRID):
    ran = []

    def runs(each):
        ran.append(each)
        return fails(each)

    return breadth_by(runs, scenario, number), ran


def test_breadth_counts_the_neighbours_that_fail_until_its_word_is_clear():
    def fails(each):
        return each.npcs[0][0].cell == 2 and each.npcs[0][0].speed >= 9.5

    found, ran = breadth(fails)
    whole = list(map(fails, around(ON_GRID)))
    assert found == Breadth(failing=sum(map(fails, ran)), of=len(ran))
    assert found.word == Breadth(failing=sum(whole), of=40).word == "broad"
    assert list(map(fails, ran)) == whole[: len(ran)]
    assert [ran.count(each) for each in ran] == [1] * len(ran)
    assert (len(ran), found.failing) == (34, 21)  # 21 of 40 are most


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.7, 0.95])
def test_word_is_that_of_all_neighbours(share):
    for seed in range(8):
        rng = random.Random(seed)
        told = {each: rng.random() < share for each in around(ON_GRID)}
        found, ran = breadth(lambda each, told=told: told.get(each, False))
        assert found.word == Breadth(failing=sum(told.values()), of=40).word
        assert sum(told.values()) in (0, 20, 21) or len(ran) < 40


def test_a_failure_without_any_failing_neighbour_has_all_of_them():
    found, ran = breadth(lambda each: False)
    assert found == Breadth(failing=0, of=40)
    assert len(ran) == 40


def test_fewer_neighbours_count_if_there_are_no_more():
    found, ran = breadth(lambda each: each.ego_speed > 8, number=10_000, scenario=AT_A_ZONE)
    assert 100 < found.of == len(ran) < 10_000
    assert 0 < found.failing < found.of
    assert breadth_by(lambda each: True, ON_GRID, 9, fits=lambda each: False) is None


def test_runs_that_are_the_findings_own_are_no_neighbours():
    found, ran = breadth(lambda each: None if each.gene_seconds != 10 else False, number=10)
    assert found == Breadth(failing=0, of=10)
    assert 10 < len(ran) <= 20
    assert breadth(lambda each: None, number=10)[0] is None


def test_slow_traffic_is_not_among_the_neighbours_of_traffic_without_it():
    traffic = pafot.Traffic(style="everyday")
    least = traffic.least_speed(TOP)
    scenario = Scenario(npcs=((PositionInstruction(2, least), PositionInstruction(2, 25.0)),), traffic=traffic)
    speeds = {gene.speed for each in around(scenario) for chain in each.npcs for gene in chain}
    assert min(speeds) == least
    slower = Scenario(npcs=((PositionInstruction(2, least - 3),),), traffic=traffic)  # from a file of the user's
    assert min(gene.speed for each in around(slower) for chain in each.npcs for gene in chain) == least - 3


def test_no_neighbour_lasts_longer_than_the_world():
    assert {each.genes for each in around(ON_GRID, longest_run=20.0)} == {2}
    assert {each.genes for each in around(ON_GRID, longest_run=40.0)} == {3}


@table(
    ("found", "text", "rank"),
    [
        (Breadth(failing=40, of=40), "broad: most similar scenarios fail the same way", 1.0),
        (Breadth(failing=21, of=40), "broad: most similar scenarios fail the same way", 0.525),
        (Breadth(failing=20, of=40), "narrow: some similar scenarios fail the same way, but not most", 0.5),
        (Breadth(failing=1, of=40), "narrow: some similar scenarios fail the same way, but not most", 0.025),
        (Breadth(failing=0, of=40), "knife edge: no similar scenarios fail the same way", 0.0),
    ],
)
def test_breadth_in_words_and_as_a_rank(found, text, rank):
    assert (str(found), found.rank) == (text, rank)
    assert found.word == text.partition(":")[0]


def test_neighbours_of_a_real_finding_fail_around_it():
    """A policy that never brakes hits whatever brakes ahead of it, in most of the neighbours."""
    scenario = Scenario(npcs=((PositionInstruction(2, 0.0),),))
    world = pafot.Highway()

    def fails(each):
        return world.rollout(each, lambda: lambda observation: (0.0, 0.0)).collision is not None

    assert fails(scenario)
    several = around(scenario, 20)
    for each in several:
        world.check_fits(each)
    found = breadth_by(fails, scenario, 20)
    assert found.failing > 5


@given(scenarios(max_speed=TOP), st.floats(0.4, 2.5))
def test_for_another_pace_the_re_timed_scenarios_are_first(scenario, pace):
    several = tuple(islice(around_at(scenario, pace, limits()), 12))
    assert len(set(several)) == len(several) == 12
    assert scenario not in several
    assert all(0 <= gene.speed <= TOP for each in several for chain in each.npcs for gene in chain)


def test_re_timed_scenarios_have_other_speeds_or_other_times_or_both():
    first, second, third, *_ = islice(around_at(ON_GRID, 0.5, limits()), 4)
    assert [[gene.speed for gene in chain] for chain in first.npcs] == [[5.0, 1.5, 1.5], [10.0]]
    assert (first.gene_seconds, first.ego_speed) == (10.0, ON_GRID.ego_speed / 2)
    assert [[gene.speed for gene in chain] for chain in second.npcs] == [[10.0, 3.0, 3.0], [20.0]]
    assert (second.gene_seconds, second.ego_speed) == (20.0, ON_GRID.ego_speed)
    assert (third.npcs, third.gene_seconds, third.ego_speed) == (first.npcs, 20.0, first.ego_speed)


def test_for_the_same_pace_they_are_the_neighbours():
    assert tuple(islice(around_at(ON_GRID, 1.01, limits()), 9)) == around(ON_GRID, 9, share=WIDE)


def test_a_replay_has_slower_and_faster_egos_and_easier_traffic():
    several = tuple(islice(around_at(IN_LANES, 1.0, limits()), 40))
    starts = {each.ego_speed - IN_LANES.ego_speed for each in several}
    assert min(starts) < -3
    assert max(starts) > 3
    first = {each.npcs[0][0].speed for each in several}
    assert min(first) < 7
    assert max(first) > 13
    assert len({each.gene_seconds for each in several}) > 3


@table(("failing", "needed"), [(40, 10), (20, 10), (15, 15), (3, 27), (0, 30)])
def test_a_replay_runs_the_more_neighbours_the_narrower_its_failure_was(failing, needed):
    assert Breadth(failing=failing, of=40).needed == needed


def test_re_timed_scenarios_that_do_not_fit_are_left_out():
    fits = lambda each: each.gene_seconds == 10.0  # noqa: E731
    assert {each.gene_seconds for each in islice(around_at(ON_GRID, 0.5, limits(fits)), 9)} == {10.0}
