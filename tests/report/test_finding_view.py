"""A finding's view of its run."""

from dataclasses import replace

import numpy as np
import pytest
from highway_env.vehicle.controller import ControlledVehicle

import pytest_pafot as pafot
from pytest_pafot.attribution import takeovers
from pytest_pafot.criticality import gap, ttc
from pytest_pafot.findings.sighting import Finished
from pytest_pafot.findings.verdict import Verdict
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import ACCELERATION, Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.report.session import Session
from pytest_pafot.report.terminal import command_for
from pytest_pafot.report.views import finding_view, frame_ticks
from pytest_pafot.world.base_world import TakingOver
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, straight_lanes, trace_of, vehicle
from tests.report.builders import (
    CUT_IN,
    TEST,
    Viewed,
    cut_in_trace,
    finding_of,
    is_close,
    rear_trace,
    scenario,
    seen_of,
    view_of,
)


def leader_stops_dead():
    """Return a run with an ego that the rules excuse for want of time."""
    return next(
        each.trace()
        for group in SITUATIONS.values()
        for each in group
        if each.name == "leader-stops-dead"
    )


def braking_ahead(**more):
    """Return a run with an NPC 40 m ahead at 10 m/s; the ego comes at 20 m/s and hits it after 3.5 s."""
    ticks = 52
    npc = vehicle(40.0, 4.0, speed=10.0, ticks=ticks)
    return trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=ticks), npc, outcome=Outcome.COLLISION, **more
    )


@table("physics_hz", [5, 10, 15, 20, 50, 100])
def test_frame_rate_is_similar_at_any_physics_rate(physics_hz):
    ticks = 20 * physics_hz
    trace = trace_of(
        vehicle(0.0, speed=20.0, ticks=ticks),
        vehicle(50.0, speed=20.0, ticks=ticks),
        physics_hz=physics_hz,
    )
    rate = (len(frame_ticks(trace)) - 1) / trace.duration
    assert 5 <= rate <= 10


def test_first_last_and_collision_frames_are_always_included():
    trace = trace_of(
        vehicle(0.0, speed=20.0, ticks=60), vehicle(20.0, speed=20.0, ticks=60),
        outcome=Outcome.COLLISION, collision=collision_at(57),
    )  # fmt: skip
    ticks = frame_ticks(trace)
    assert {0, 57, 60} <= set(ticks)
    assert ticks == sorted(set(ticks))


def test_frame_positions_and_measures_match_the_trace():
    trace = cut_in_trace()
    view, gaps, times = view_of(trace), gap(trace), ttc(trace)
    for frame, time in enumerate(view.times):
        tick = round(time * trace.physics_hz)
        for index, shown in enumerate(view.vehicles):
            x, y, _, speed, *_ = trace.states[tick, index]
            assert is_close(shown.along[frame], x)
            assert is_close(shown.across[frame], y)
            assert is_close(shown.speed[frame], speed)
            assert shown.acceleration[frame] == pytest.approx(
                trace.states[tick, index, ACCELERATION], abs=0.06
            )
        for npc, shown in enumerate(view.vehicles[1:]):
            assert is_close(shown.gap[frame], gaps[tick, npc])
            seconds = times[tick, npc]
            assert is_close(shown.ttc[frame], seconds if np.isfinite(seconds) else None)


@table("heading", [0.5, -2.0, np.pi / 2])
def test_turned_road_gives_the_same_picture_as_straight(heading):
    def driving(offset, lane, speed):
        x = offset * np.cos(heading) - lane * 4.0 * np.sin(heading)
        y = offset * np.sin(heading) + lane * 4.0 * np.cos(heading)
        return vehicle(x, y, heading=heading, speed=speed, lane=lane, ticks=30)

    turned = trace_of(
        driving(0, 1, 20.0), driving(30, 2, 18.0), lanes=straight_lanes(heading=heading)
    )
    straight = trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(30.0, 8.0, speed=18.0, ticks=30)
    )
    one, other = view_of(turned), view_of(straight)
    assert one.road == other.road
    for a, b in zip(one.vehicles, other.vehicles, strict=True):
        assert a.cells == b.cells
        for name in ("along", "across", "heading", "speed"):
            assert all(
                is_close(x, y, 0.011)
                for x, y in zip(getattr(a, name), getattr(b, name), strict=True)
            )


def test_npc_cell_is_given_at_every_frame():
    assert set(view_of(braking_ahead()).vehicles[1].cells) == {int(Cell.FRONT)}
    beside = trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=9), vehicle(1.0, 4.5, speed=20.0, ticks=9)
    )
    assert set(view_of(beside).vehicles[1].cells) == {0}


def test_instructions_include_requested_and_driven_cells():
    asked, driven = scenario([(1, 20.0), (2, 8.0)]), scenario([(1, 20.0), (1, 8.0)])
    trace = replace(braking_ahead(), scenario=asked, executed=driven, arrivals=((30, None),))
    first, second = view_of(trace).instructions
    expected = 1, 1, 20.0, 0.0, 10.0
    assert (first.requested, first.cell, first.speed, first.start, first.end) == expected
    assert first.arrived == 2.0
    assert (second.requested, second.cell, second.started, second.arrived) == (2, 1, True, None)


def test_genes_that_the_run_never_reached_are_marked():
    vehicles = [
        vehicle(x, y, speed=20.0, ticks=52) for x, y in ((0.0, 4.0), (40.0, 4.0), (0.0, 8.0))
    ]
    trace = trace_of(*vehicles, scenario=CUT_IN, arrivals=((15,), (3,)))
    assert [row.started for row in view_of(trace).instructions] == [True, False, True, False]


def test_headline_and_prose_are_from_run_by_default():
    view, hit = view_of(rear_trace()), rear_trace().collision
    assert (view.event.kind, view.event.npc, view.event.side) == ("collision", hit.npc, hit.side)
    assert view.event.time == pytest.approx(hit.time, abs=0.001)
    assert (
        view.headline
        == f"{Run(rear_trace()).impact} (ego {hit.ego_speed:.1f} m/s, NPC {hit.npc_speed:.1f} m/s)"
    )
    assert view_of(rear_trace(), headline="H").headline == "H"


def test_takeover_is_above_the_picture():
    trace = rear_trace()
    safe = replace(trace, outcome=Outcome.COMPLETED, collision=None)
    finding = finding_of(trace)
    first, *others = Run(trace).sentences
    assert view_of(trace).sentences == (first, *others)
    expect = replace(finding.expect, takeover=1.25)
    avoided, other = (
        replace(finding, expect=each) for each in (expect, replace(expect, time=expect.time + 0.1))
    )
    # this finding is from a different run
    assert view_of(trace, other).sentences == (first, *others)
    assert view_of(safe, avoided).sentences == ()
    view = view_of(trace, avoided)
    assert view.sentences[:-1] == (first, *others[:-1])
    assert view.sentences[-1].endswith(takeovers.sentence(1.25))
    assert view.deed == ""  # NPC 0 is responsible
    ((_, prose, _),) = view.happened
    assert not any(each in prose for each in view.sentences[:-1])


def test_deed_is_that_of_a_responsible_ego():
    # 20 m/s behind 10 m/s, 35 m apart: the ego may respond late, but not never
    stopped = braking_ahead()
    run = Run(stopped)
    assert run.responsibility == "ego"
    assert view_of(stopped).deed == run.sentences[1]
    assert Run(rear_trace()).responsibility == "npc"
    assert view_of(rear_trace()).deed == ""


@pytest.mark.parametrize(("seconds", "responsible"), [(1.25, "both"), (0.0, "npc")])
def test_page_shows_the_verdict_that_a_careful_driver_has_decided(
    seconds, responsible, monkeypatch
):
    """The rules alone excuse this ego; the page and the deed in its headline follow the run that the search judged."""
    monkeypatch.setattr(takeovers, "latest", lambda trace, take_over: seconds)
    run = Run(leader_stops_dead(), take_over=TakingOver(pafot.Highway()))
    seen = seen_of(run.trace)
    ended = Finished(run=run, verdict=Verdict(kind="failed"))
    view = Viewed(seen=seen, view=finding_view(seen.with_observed(ended=ended)))
    assert run.responsibility == responsible
    assert view.sentences == run.sentences
    assert view.sentences[-1].endswith(takeovers.sentence(seconds))
    assert view.deed == (run.attribution.sentences[-1] if responsible == "both" else "")


class MovingLeft(ControlledVehicle):
    def act(self, action=None):
        super().act("LANE_LEFT")


def test_page_says_when_a_lane_change_started_as_the_terminal_does():
    world = pafot.World("highway-v0", duration=15.0)
    npcs = scenario([(8, 20.0)], gene_seconds=15.0, ego_speed=20.0)
    trace = world.rollout(npcs, lambda: MovingLeft)
    assert (Run(trace).attribution.fault, trace.actions) == ("entered-lane", ())
    view = view_of(trace, finding_of(trace, world=world.to_dict()))
    moved, *others = Run(trace).sentences
    assert " 0.1 s, " in moved
    assert " 0.0 s and " in view.deed  # it moves from the first tick
    assert view.deed.endswith(moved.removeprefix("The ego "))
    assert view.sentences == (view.deed, *others)
    assert not any(moved in words for _, words, _ in view.happened)  # each fact once


def test_the_command_survives_a_shell():
    seen = view_of(cut_in_trace(), node_id=f"{TEST}[a b'c]", path="a").seen
    again = command_for(Session(), seen, "pytest", name=seen.node_id)
    assert again == f"""pytest '{TEST}[a b'"'"'c]'"""


def test_unseen_finding_has_instructions_but_no_frames():
    finding = finding_of(cut_in_trace())
    view = view_of(None, finding)
    assert view.times == view.vehicles == ()
    assert view.headline
    assert len(view.instructions) == 4
    assert not any(row.started for row in view.instructions)


DISCRETE = {"kind": "gym", "config": {"action": {"type": "DiscreteMetaAction"}}}


@table(("world", "actions", "shown"), [
    (DISCRETE, (1, np.int64(1), 4, 1), [(0.0, 0.4, "IDLE"), (0.4, 0.6, "SLOWER"), (0.6, 9.9, "IDLE")]),
    (DISCRETE | {"planner_hz": 5}, (1, 0), [(0.0, 0.2, "1"), (0.2, 9.9, "0")]),
    ({"config": {"action": {"type": "DiscreteMetaAction", "lateral": False}}}, (2,), [(0.0, 9.9, "FASTER")]),
    ({"config": {"action": {"type": "ContinuousAction"}}}, (0.5,), [(0.0, 9.9, "0.5")]),
    ({}, ((-3.0, 0.0),) * 2 + ((1.04, -0.021),), [(0.0, 0.4, "-3.0 m/s^2"), (0.4, 9.9, "1.0 m/s^2, -0.02 rad")]),
    ({}, (), []),
])  # fmt: skip
def test_equal_decisions_in_succession_are_one_stretch_with_the_name_of_the_action(
    world, actions, shown
):
    trace = replace(braking_ahead(), actions=actions)
    view = view_of(trace, finding_of(trace, world=world))
    assert list(view.decisions) == [
        (start, min(end, view.times[-1]), words) for start, end, words in shown
    ]
