"""A situation, and runs in which it occurs again or does not; the positions are made by hand."""

from dataclasses import replace

import pytest

from pytest_pafot.findings.finding import Expect, Finding, Found, handles, unhandled
from pytest_pafot.findings.situation import Situation, missed, seconds_after
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import AdsError, Outcome, X
from pytest_pafot.oracle.run import Check, Run
from tests.helpers.drives import HZ, crash, driven
from tests.helpers.situations import FAR, LEFT, OWN, RIGHT
from tests.helpers.traces import LENGTH, trace_of

FAILS = Failure(kind="AssertionError", assertion="assert not run.collision")
BRAKES = {"brakes": [(3.0, 6.0, 8.0)]}
"""Braking from 20 to 8 m/s, between 3 and 5 s."""
AT_20 = {"npc": 0, "ego_speed": 20.0, "npc_speed": 20.0}
MOVES = {"shifts": [(4.0, RIGHT, 3.0)]}
"""A move into the lane to the right, between 4 and 7 s."""


def finding_of(run):
    found = Found(seed=1, generation=0, algorithm="distinct")
    return Finding.from_run(run, FAILS, test="t.py::t", world={}, found=found)


def situation(run, failure=FAILS):
    return Expect.from_run(run, failure).situation


def rear_end():
    """Return a run with a leader, 35 m ahead, that slows from 20 to 8 m/s; the ego does not answer."""
    return Run(crash(driven(0.0), driven(35.0, **BRAKES)))


def into_the_side():
    """Return a run in which the ego changes lanes into a vehicle that drives alongside, 2 m behind, at its speed."""
    return Run(crash(driven(0.0, **MOVES), driven(-2.0, RIGHT), side="right"))


def comes_up(failed, ego, npc):
    """Return whether the situation of a failed run occurs if the two drive like this."""
    return not missed(situation(failed), Run(trace_of(ego, npc)))


def test_leader_situation_starts_when_it_came_too_close():
    then = situation(rear_end())
    assert (then.npc, then.lanes_to_right, then.ego_speed, then.npc_speed) == (0, 0, 20.0, 8.0)
    assert 3.0 <= then.time <= 5.0
    assert then.gap == pytest.approx(35.0 - LENGTH - 3.0 * (then.time - 3.0) ** 2, abs=0.5)
    assert not missed(then, rear_end())


def test_lane_change_situation_is_before_it_began():
    then = situation(into_the_side())
    assert then == Situation(**AT_20, time=4.0, gap=2.0 - LENGTH, place="behind", lanes_to_right=1)
    assert not missed(then, into_the_side())


def test_cut_in_situation_starts_with_npc_in_lane():
    cutting = driven(15.0, RIGHT, speed=14.0, shifts=[(0.0, OWN, 4.0)])
    then = situation(Run(crash(driven(0.0), cutting)))
    assert (then.lanes_to_right, then.npc_speed) == (0, pytest.approx(14.0))
    assert then.time == pytest.approx(2.0, abs=0.2)  # halfway


def test_needless_braking_is_told_from_before_it_began():
    run = Run(
        crash(driven(0.0, brakes=[(3.0, 7.0, 4.0)]), driven(-30.0), side="rear", cell=Cell.REAR)
    )
    assert run.attribution.fault == "braked-for-nothing"
    assert situation(run) == Situation(
        **AT_20, time=3.0, gap=30.0 - LENGTH, place="behind", lanes_to_right=0
    )


def check(time, npc):
    made = Check(name="headway", value=0.3, margin=-0.7, at_least=1.0, time=time, npc=npc)
    return Failure(kind="CheckFailed", message=str(made), assertion="headway", check=made)


def test_check_situation_is_two_seconds_before_its_time():
    run = Run(trace_of(driven(0.0), driven(30.0, LEFT, speed=18.0), driven(60.0, speed=18.0)))
    assert situation(run, check(8.0, npc=1)) == Situation(
        npc=1,
        time=6.0,
        gap=48.0 - LENGTH,
        place="ahead",
        lanes_to_right=0,
        ego_speed=20.0,
        npc_speed=18.0,
    )


def test_failures_without_an_npc_have_no_situation():
    safe = trace_of(driven(0.0), driven(30.0, speed=18.0))
    error = AdsError(kind="ValueError", message="", traceback="", tick=6)
    assert situation(Run(safe), check(8.0, npc=None)) is None
    assert situation(Run(replace(safe, outcome=Outcome.ADS_ERROR, error=error))) is None
    assert situation(Run(replace(safe, outcome=Outcome.OFF_ROAD, off_road_tick=30))) is None


EARLIER = driven(0.0, brakes=[(1.0, 2.0, 8.0)])
AWAY = driven(0.0, shifts=[(4.5, LEFT, 3.0)])


@pytest.mark.parametrize(("ego", "npc", "is_met"), [
    (EARLIER, driven(35.0, **BRAKES), True),
    (AWAY, driven(35.0, **BRAKES), True),
    (driven(0.0), driven(35.0), False),  # the leader does not slow down
    # the ego is no faster than the leader becomes
    (driven(0.0, speed=9.0), driven(35.0, **BRAKES), False),
    (driven(0.0), driven(35.0, LEFT, **BRAKES), False),  # the other is in the next lane
    (driven(0.0, speed=10.0), driven(80.0, **BRAKES), False),  # the ego never comes close
    (driven(0.0), driven(-35.0, speed=8.0), False),  # the other is behind
])  # fmt: skip
def test_leader_is_met_however_the_ego_answers_it(ego, npc, is_met):
    assert comes_up(rear_end(), ego, npc) is is_met


@pytest.mark.parametrize(("ego", "npc", "is_met"), [
    (driven(0.0), driven(-2.0, RIGHT), True),  # no lane change
    # later
    (driven(0.0, shifts=[(9.0, RIGHT, 3.0)]), driven(-2.0, RIGHT, brakes=[(6.0, 3.0, 14.0)]), True),
    (driven(0.0, shifts=[(4.0, LEFT, 3.0)]), driven(-2.0, RIGHT), True),  # to the other side
    (driven(0.0, speed=12.0), driven(-2.0, RIGHT, speed=12.0), True),  # all drive slower
    (driven(0.0, RIGHT), driven(-4.0, FAR), True),  # one lane further to the right
    (driven(0.0), driven(-2.0, LEFT), False),  # on the other side
    (driven(0.0), driven(-2.0, FAR), False),  # two lanes away
    (driven(0.0), driven(-12.0, RIGHT), False),  # never comes up to the ego
    (driven(0.0, speed=10.0), driven(-20.0, RIGHT, speed=25.0), False),  # passes at once
    # only where they start; then the ego stops
    (driven(0.0, brakes=[(0.0, 6.0, 0.0)]), driven(-2.0, RIGHT), False),
])  # fmt: skip
def test_vehicle_alongside_is_met_whatever_the_ego_does(ego, npc, is_met):
    assert comes_up(into_the_side(), ego, npc) is is_met


def test_miss_says_where_npc_was_and_came_nearest():
    passing = Run(trace_of(driven(0.0), driven(-20.0, LEFT)))
    assert missed(situation(into_the_side()), passing) == (
        "the situation did not occur: before the saved run failed, NPC 0 was side by side with the ego one lane to "
        "the right at 20.0 m/s, with the ego at 20.0 m/s. In this run, the NPC came closest to this after 4.0 s, when "
        "it was 15.0 m behind one lane to the left at 20.0 m/s, with the ego at 20.0 m/s"
    )


def test_pass_is_fixed_only_if_situation_came_up_or_is_unknown():
    saved = finding_of(into_the_side())
    met, missed_it = (Run(trace_of(driven(0.0), driven(x, RIGHT))) for x in (-2.0, -20.0))
    assert [handles(saved, run) for run in (met, missed_it)] == [True, False]
    older = replace(saved, expect=replace(saved.expect, situation=None))
    assert handles(older, missed_it)


def test_blameless_impact_after_failure_time_is_fixed():
    """The ego slows down as its leader does, unlike before; then a vehicle that does not slow hits it from behind."""
    saved = finding_of(rear_end())
    ego, leader = driven(0.0, **BRAKES), driven(35.0, **BRAKES)
    safe = Run(trace_of(ego, leader))
    met = safe.duration - seconds_after(saved.expect.situation, safe)
    failed = met + max(saved.expect.time - saved.expect.situation.time, 2.0)
    for later, is_handled in ((-0.3, False), (0.3, True)):
        impact = round((failed + later) * HZ)
        behind = driven(ego[impact, X] - LENGTH - 20.0 * impact / HZ)
        run = Run(crash(ego, leader, behind, npc=1, side="rear", cell=Cell.REAR))
        assert handles(saved, run) is is_handled


def test_collision_with_the_same_npc_is_no_fix():
    saved = finding_of(rear_end())
    later = Run(crash(driven(0.0), driven(35.0, brakes=[(6.0, 6.0, 8.0)])))
    assert not handles(saved, later)
    assert unhandled(saved, later) == (
        f"the ego and NPC 0 still collide at {later.collision.time:.1f} s, but the test accepts this"
    )


def test_ego_that_leaves_road_has_fixed_nothing():
    saved = finding_of(rear_end())
    met = trace_of(driven(0.0, **BRAKES), driven(35.0, **BRAKES))
    off = replace(met, outcome=Outcome.OFF_ROAD, off_road_tick=met.ticks)
    assert [handles(saved, Run(trace)) for trace in (met, off)] == [True, False]


def test_same_collision_with_other_responsibility_is_no_fix():
    """The ego drives as before, and only the verdict has changed, as if the other had cut in just before."""
    run = rear_end()
    assert run.responsibility == "ego"
    saved = finding_of(run)
    other = replace(saved, expect=replace(saved.expect, responsibility="npc"))
    assert [handles(each, run) for each in (saved, other)] == [True, False]
