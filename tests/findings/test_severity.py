"""The severity of failures: figures by mechanics and by hand, a total order, and what became worse."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.findings.sighting import Alike
from pytest_pafot.findings.verdict import CHECK_FAILED, Failure, Severity, severity_of, worsening
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome, Y
from pytest_pafot.oracle.run import Check, CheckFailed, Run, check
from pytest_pafot.world import Highway
from tests.findings.builders import sighting
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, trace_of, vehicle

CRASHED = Failure(kind="AssertionError", assertion="assert not run.collision")
HIT = Severity(kind="collision", value=9.8, unit="m/s")
JERK = Severity(kind="check", value=15.1, unit="m/s^3", margin=-0.755, name="jerk")


def crash(closing=9.8, **fields):
    ego, npc = vehicle(0.0, speed=20.0, ticks=9), vehicle(30.0, speed=10.0, ticks=9)
    hit = replace(collision_at(9), closing_speed=closing)
    return Run(trace_of(ego, npc, outcome=Outcome.COLLISION, collision=hit, **fields))


def failed(value, **bounds):
    with pytest.raises(CheckFailed) as raised:
        check(value, name="jerk", unit="m/s^3", **bounds)
    made = raised.value.check
    return Failure(kind=CHECK_FAILED, message=str(made), assertion=made.name, check=made)


@pytest.mark.parametrize("steering", [0.05, 0.2])
def test_collision_is_measured_one_tick_after_contact(steering):
    """The ego steers towards the NPC alongside. It moves where its wheels point, not where its body does."""
    scenario = Scenario(npcs=[[PositionInstruction(4, 22.0)]], ego_lane=1, ego_speed=22.0)
    trace = Highway().rollout(
        scenario, lambda: lambda seen: (0.0, steering if seen.time > 8.0 else 0.0)
    )
    before, last = np.diff(trace.states[-3:, :2, : Y + 1], axis=0) * trace.physics_hz
    ego, npc = 2 * last - before  # the next tick, as if there had been no contact
    (speed, other), course = (
        np.hypot(*np.transpose([ego, npc])),
        np.arctan2(ego[1], ego[0]) - np.arctan2(npc[1], npc[0]),
    )
    by_cosines = math.sqrt(speed**2 + other**2 - 2 * speed * other * math.cos(course))
    assert severity_of(Run(trace), CRASHED).value == pytest.approx(by_cosines, rel=0.01)


@table(("value", "bounds", "by", "margin"), [
    (35.1, {"at_most": 20.0}, 15.1, -0.755),
    (0.3, {"at_least": 0.5}, 0.2, -0.4),
    (-1.0, {"at_least": 0.0, "at_most": 9.0}, 1.0, -1.0),
    (12.0, {"at_least": 0.0, "at_most": 9.0}, 3.0, -1 / 3),
    (12.0, {"at_most": 9.0, "scale": 6.0}, 3.0, -0.5),
])  # fmt: skip
def test_failed_check_is_measured_by_its_broken_bound(value, bounds, by, margin):
    severity = severity_of(crash(), failed(value, **bounds))
    assert (severity.kind, severity.name, severity.unit) == ("check", "jerk", "m/s^3")
    assert (severity.value, severity.margin) == (pytest.approx(by), pytest.approx(margin, rel=1e-5))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_check_without_finite_value_ranks_just_below_collision(value):
    worst = severity_of(crash(), failed(value, at_most=1.0))
    assert worst.value is worst.margin is None
    assert str(worst) == "violates the bound of jerk by no finite number m/s^3"
    assert replace(JERK, margin=-1e9, value=1e9) < worst < replace(HIT, value=0.0)


@table(("failure", "run"), [
    (CRASHED, Run(trace_of(vehicle(0.0, ticks=3), vehicle(30.0, ticks=3)))),
    (Failure(kind="AssertionError", assertion="assert run.duration < 1"), crash()),
    (Failure(kind="KeyError", message="'x'"), Run(trace_of(vehicle(0.0, ticks=3), outcome=Outcome.OFF_ROAD))),
])  # fmt: skip
def test_other_failures_have_no_severity(failure, run):
    assert severity_of(run, failure) is None


def severities():
    figures = st.sampled_from([0.0, 0.1, 0.5, 1.0, 20.0])
    collisions = st.builds(Severity, kind=st.just("collision"), value=figures, unit=st.just("m/s"))
    words = {"unit": st.sampled_from(["", "m"]), "name": st.sampled_from(["a", "b"])}
    margins = figures.map(lambda figure: -figure)
    checks = st.builds(Severity, kind=st.just("check"), value=figures, margin=margins, **words)
    return (
        collisions | checks | st.builds(Severity, kind=st.just("check"), value=st.none(), **words)
    )


@given(severities(), severities(), severities())
def test_the_order_is_total(one, two, three):
    for first, second in itertools.product((one, two, three), repeat=2):
        assert (first < second) + (first == second) + (first > second) == 1
    ranked = [sorted(each) for each in itertools.permutations((one, two, three))]
    assert all(each == ranked[0] for each in ranked)


@given(st.permutations(range(7)))
def test_findings_are_ranked_by_responsibility_then_severity(order):
    ranked = [
        ("both", HIT), ("ego", replace(HIT, value=3.0)), ("npc", replace(HIT, value=30.0)),
        ("none", replace(JERK, margin=-0.8)), ("ego", JERK), ("none", replace(JERK, value=900.0, margin=-0.1)),
        ("none", None),
    ]  # fmt: skip
    assert (
        sorted((ranked[index] for index in order), key=lambda each: Severity.worst_first(*each))
        == ranked
    )


@table(("now", "before", "told"), [
    (replace(HIT, value=12.1), replace(HIT, value=8.0), "hits at 12.1 m/s instead of 8.0"),
    (HIT, None, "hits at 9.8 m/s, with no collision before"),
    (HIT, JERK, "hits at 9.8 m/s, with no collision before"),
    (JERK, replace(JERK, value=3.2, margin=-0.16), "violates the bound of jerk by 15.1 m/s^3 instead of 3.2"),
    (HIT, HIT, ""),
    (replace(HIT, value=8.0), HIT, ""),
    (JERK, HIT, ""),
    (JERK, None, ""),
    (None, HIT, ""),
])  # fmt: skip
def test_worsening_needs_comparable_and_visibly_different_severities(now, before, told):
    assert worsening(now, before) == told


def test_check_of_many_values_uses_its_named_value():
    made = Check(name="gap", value=0.4, margin=-0.2, at_least=0.5, unit="m", time=3.0)
    severity = severity_of(crash(), Failure(kind=CHECK_FAILED, assertion="gap", check=made))
    assert str(severity) == "violates the bound of gap by 0.1 m"


def alike(*runs):
    """Return the sum over runs of a search: their numbers, each with its closing speed, or None."""
    hits = [
        (number, None if speed is None else replace(HIT, value=speed)) for number, speed in runs
    ]
    each = [Alike(runs=1, number=number, severity=hit, least=hit) for number, hit in hits]
    return sum(each, start=Alike())


@table(("runs", "number", "worst", "least"), [
    ([(3, 9.8), (4, 12.1), (5, 2.0)], 4, 12.1, 2.0),
    ([(3, 9.8), (4, 9.8)], 3, 9.8, 9.8),  # of two equal ones, the first
    ([(3, None), (4, 2.0), (5, None)], 4, 2.0, 2.0),
    ([(7, 5.0)], 7, 5.0, 5.0),
])  # fmt: skip
def test_runs_that_fail_alike_have_their_worst_and_their_mildest(runs, number, worst, least):
    found = alike(*runs)
    assert (found.runs, found.number, found.severity.value, found.least.value) == (
        len(runs),
        number,
        worst,
        least,
    )
    halves = [alike(*runs[:1]), alike(*runs[1:])]
    assert halves[0] + halves[1] == found


def test_runs_without_a_measure_are_only_counted():
    assert (
        alike((3, None), (4, None)).runs,
        alike((3, None)).severity,
        alike((3, None)).least,
    ) == (2, None, None)


@table(("of", "own", "told"), [
    (alike((3, 9.8), (4, 2.0)), HIT, ", closing at 2.0 to 9.8 m/s"),
    (alike((3, 9.81), (4, 9.79)), HIT, ", closing at 9.8 m/s"),
    (Alike(), HIT, ", closing at 9.8 m/s"),
    (Alike(), None, ""),
    (Alike(runs=2, severity=JERK, least=replace(JERK, value=3.0)), JERK, ", violating the bound by 3 to 15.1 m/s^3"),
    (Alike(), replace(JERK, unit=""), ", violating the bound by 15.1"),
])  # fmt: skip
def test_the_impacts_of_runs_that_fail_alike_are_a_range(of, own, told):
    assert sighting(severity=own, alike=of).impacts == told
