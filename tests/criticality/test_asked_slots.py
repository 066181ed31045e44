"""Whether NPCs that cross kept the slot that was asked for, against the times of the vehicles in the zone."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pytest_pafot.criticality.signals import slot_requests
from pytest_pafot.model.trace import SPEED, Outcome
from pytest_pafot.oracle.run import Run
from tests.helpers.tables import table
from tests.world.kernel.test_road_directors import (
    AHEAD,
    FREEZE,
    INTO,
    LEFT,
    RIGHT,
    Steady,
    braking_at,
    rollout,
    slot_of,
)


class Hurrying(Steady):
    def act(self, action=None):
        super().act()
        self.action["acceleration"] = 5.0


@table("zone", [LEFT, AHEAD, RIGHT, INTO])
def test_slot_with_a_steady_ego_is_that_of_the_times_in_the_zone(zone):
    for slot, speed in ((-1.5, 8.6), (-0.5, 7.0), (0.5, 8.6), (1.2, 5.0), (3.0, 9.0)):
        trace = rollout((zone, slot, speed))
        (found,) = slot_requests(trace)
        assert (found.what, found.asked, found.npc) == ("slot", slot, 0)
        assert found.was == pytest.approx(slot_of(trace), abs=0.1)
        assert all(each.is_met for each in Run(trace).asked)


@table("zone", [LEFT, AHEAD, RIGHT])
def test_collision_in_the_zone_is_judged_by_the_speeds_at_the_impact(zone):
    trace = rollout((zone, 0.0, 7.0))
    assert trace.outcome is Outcome.COLLISION
    assert slot_requests(trace)[0].description in (
        "slot requested: 0 s, actual: 0.0 s",
        "slot requested: 0 s, actual: 0.1 s",
    )


def test_ego_that_brakes_once_the_npc_keeps_to_its_plan_changes_nothing():
    kept = rollout((LEFT, -1.0, 7.0))
    late = rollout((LEFT, -1.0, 7.0), ego=braking_at(kept.arrivals[0][0] / 15 - FREEZE + 0.2, 4.0))
    assert slot_of(late) < -1.4
    assert slot_requests(late)[0].was == pytest.approx(slot_requests(kept)[0].was, abs=0.05)


def test_slot_is_not_judged_if_the_npc_waits_for_an_ego_in_its_zone():
    kept = rollout((LEFT, 1.0, 7.0))
    late = rollout((LEFT, 1.0, 7.0), ego=braking_at(kept.arrivals[0][0] / 15 - FREEZE + 0.2, 1.0))
    assert late.arrivals[0][0] > kept.arrivals[0][0] + 5
    assert slot_requests(late) == ()


def test_ego_that_slows_down_early_is_adapted_to():
    trace = rollout((LEFT, 1.0, 7.0), ego=braking_at(0.0, 7.0))
    assert slot_requests(trace)[0].was == pytest.approx(1.0, abs=0.2)


def test_slot_is_not_judged_with_an_ego_that_waits():
    trace = rollout((RIGHT, -0.5, 8.0), ego=braking_at(0.5, 0.0))
    assert trace.ego[-1, SPEED] < 0.1
    assert trace.arrivals[0][0] is not None
    assert slot_requests(trace) == ()


def test_npc_that_does_not_come_because_the_ego_waits_is_not_as_asked():
    trace = rollout((LEFT, 1.0, 8.0), ego=braking_at(1.0, 0.0))
    assert trace.ego[-1, SPEED] < 0.1
    assert [each.description for each in slot_requests(trace)] == ["the NPC did not reach its zone"]


def test_crash_does_not_hide_that_the_ego_came_too_early():
    trace = rollout((RIGHT, -1.0, 8.0), ego=Hurrying)
    assert trace.outcome is Outcome.COLLISION
    assert [each.description for each in slot_requests(trace)] == ["slot requested: -1 s, actual: -0.4 s"]
    assert not all(each.is_met for each in Run(trace).asked)


def test_npc_that_comes_too_late_for_the_run_is_not_as_asked():
    trace = rollout((LEFT, 1.0, 7.0))
    entered = trace.arrivals[0][0]
    fields = {name: getattr(trace, name)[: entered - 1] for name in ("states", "track", "on_way")}
    early = replace(trace, outcome=Outcome.END_OF_ROAD, **fields)
    assert [each.description for each in slot_requests(early)] == ["the NPC did not reach its zone"]
    assert slot_requests(replace(early, outcome=Outcome.OFF_ROAD, off_road_tick=early.ticks)) == ()


@table("act", ["hold", "stop", "late"])
def test_slot_of_an_npc_that_stops_is_not_judged(act):
    assert slot_requests(rollout((LEFT, 1.0, 6.0, act))) == ()
