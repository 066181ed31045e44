"""NPCs that drive as recorded: where they are, who hands them over, and what they do then."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import (
    TRUCK,
    CrossingInstruction,
    Drive,
    Free,
    Highway,
    LaneInstruction,
    Manoeuvre,
    Recorded,
    Run,
    Scenario,
    ScenarioError,
    Step,
    Track,
    World,
)
from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.model.trace import ACCELERATION, ACROSS, ALONG, HEADING, SPEED, Outcome, X, Y
from tests.helpers.pencil_and_paper import judge
from tests.helpers.reasons import numbers
from tests.helpers.run_cases import differences
from tests.report.builders import view_of

WORLD = Highway(lanes=3, speed_limit=36.3, duration=12.0)


def track(x, lane, *speeds, seconds=12.0, aside=()):
    """Return a track with speeds, and lanes to the right of the ego's, at some times."""
    times = np.arange(round(seconds * 10) + 1) / 10
    speed = np.interp(times, *zip(*speeds, strict=True)) if isinstance(speeds[0], tuple) else speeds[0] + 0 * times
    across = 4.0 * np.interp(times, *zip(*aside, strict=True)) if aside else 4.0 * lane + 0 * times
    along = x + np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 20)])
    return Track.of(np.stack([along, across, 0 * times, speed], axis=-1))


EGO = track(0.0, 0, 25.0)
LEADER = track(60.0, 0, (0, 25.0), (4, 25.0), (7, 20.0), (9, 25.0))
BEHIND = track(-20.0, 0, 25.0)
CUTS_IN = track(20.0, 1, (0, 25.0), (12, 27.0), aside=[(0, 1), (3, 1), (6, 0)])


def scenario(*npcs, ego=EGO, **fields):
    chains = [[Recorded(track=npc) if isinstance(npc, Track) else npc] for npc in npcs]
    return Scenario(npcs=chains, ego_speed=25.0, ego_track=ego, **fields)


def drive(told, accelerations=((0.0, 0.0),), world=WORLD):
    """Return the run of an ego that keeps its lane, with accelerations from some times on."""

    def ads(seen):
        return max((each for each in accelerations if each[0] <= seen.time + 1e-6), default=(0.0, 0.0))[1], 0.0

    return world.rollout(told, lambda: ads)


def away(trace, npc):
    """Return how far an NPC is from its track at each tick [m]."""
    wanted = trace.scenario.npcs[npc][0].at(trace.times)
    places = trace.states[:, npc + 1, [X, Y]] - [trace.ego[0, X], 4.0 * trace.scenario.ego_lane]
    return np.hypot(*(places - wanted[:, :2]).T)


def test_npcs_are_on_their_tracks_while_the_ego_drives_as_recorded():
    trace = drive(scenario(LEADER, BEHIND, CUTS_IN))
    assert (trace.outcome, trace.handed_over) == (Outcome.SAFE, (None, None, None))
    assert max(away(trace, npc).max() for npc in range(3)) < 1e-9
    assert trace.states[:, 1, SPEED] == pytest.approx(trace.scenario.npcs[0][0].at(trace.times)[:, 3])
    assert trace.states[75, 1, ACCELERATION] == pytest.approx(-5 / 3, abs=0.1)


def test_run_and_replay_are_equal_to_the_last_bit():
    told = scenario(LEADER, BEHIND, CUTS_IN, LaneInstruction("keep", 25.0))
    first, again = (drive(each, [(2.0, -3.0)]) for each in (told, drive(told, [(2.0, -3.0)]).executed))
    assert first.handed_over != (None,) * 4
    assert differences(first, again) == []


@pytest.mark.parametrize("wavering", [0.0, 0.8])
def test_ego_that_drives_as_recorded_hands_nobody_over(wavering):
    """However close the others were: within 1 m of the recorded ego, nobody would have driven otherwise."""
    close = track(-6.5, 0, 25.0)  # a gap of 1.5 m
    beside = track(0.0, 1, 25.0, aside=[(0, 1), (3, 0.62), (12, 0.62)])
    told = scenario(close, beside, ego=track(wavering, 0, 25.0))
    assert drive(told).handed_over == (None, None)


def test_vehicle_behind_an_ego_that_brakes_otherwise_is_handed_over_and_brakes():
    trace = drive(scenario(BEHIND, track(60.0, 1, 25.0)), [(2.0, -4.0), (4.5, 0.0)])
    left, other = trace.handed_over
    assert other is None, "nobody is near it"
    assert 30 < left < 60
    assert away(trace, 0)[: left + 1].max() < 1e-9
    assert (trace.outcome, trace.states[-1, 1, SPEED]) == (Outcome.SAFE, pytest.approx(15.0, abs=0.5))
    assert trace.states[:, 1, ACCELERATION].min() > -6.5


def test_nobody_is_blamed_if_the_recording_itself_comes_so_close():
    """The gap is 1.0 m, and 0.6 m after 4 s; the ego loses 0.5 m/s, so it is 0.75 m behind the recorded one then."""
    close = track(-6.0, 0, 25.1)
    run = Run(drive(scenario(close), [(2.0, -0.5), (3.0, 0.0)]))
    assert (run.collision.npc, run.trace.handed_over, run.responsibility) == (0, (None,), None)
    assert run.collision.time == pytest.approx(3.8, abs=0.1)
    sentence = "NPC 0 drove as recorded, the ego within 0.6 m of the recorded ego: the recording comes so close."
    assert run.attribution.sentences[-1] == sentence
    assert "Neither the ego nor NPC 0 is responsible." in run.explain()
    assert numbers(run.trace, run.attribution)[0] == numbers(run.trace, run.attribution)[1]
    farther = replace(run.trace, scenario=scenario(close, ego=track(0.5, 0, 25.0)))
    for trace, responsibility in (
        (run.trace, "none"),
        (replace(run.trace, handed_over=(40,)), "npc"),
        (replace(run.trace, scenario=scenario(Recorded(track=close, later=0.1))), "npc"),
        (replace(run.trace, scenario=scenario(close, ego=None)), "npc"),
        (farther, "npc"),
    ):
        assert rss_rule(trace).responsibility == judge(trace).responsibility == responsibility


def test_ego_that_runs_into_a_recorded_leader_is_blamed_however_near_it_is_to_the_recorded_one():
    ahead = track(6.0, 0, 24.9)
    run = Run(drive(scenario(ahead), [(2.0, 0.5), (3.0, 0.0)]))
    assert (run.collision.npc, run.trace.handed_over, run.responsibility) == (0, (None,), "ego")


def test_without_the_recorded_ego_each_ego_counts_as_another_one():
    assert drive(scenario(track(-6.5, 0, 25.0), ego=None)).handed_over == (0,)
    assert drive(scenario(BEHIND, ego=None)).handed_over == (None,)


def test_vehicle_that_would_cut_into_a_faster_ego_stays_in_its_lane():
    recorded = drive(scenario(CUTS_IN))
    trace = drive(scenario(CUTS_IN), [(0.0, 3.0), (3.0, 0.0)])
    assert recorded.states[-1, 1, Y] == pytest.approx(4.0, abs=0.01)
    assert trace.handed_over[0] < 45
    assert (trace.outcome, trace.states[-1, 1, Y]) == (Outcome.SAFE, pytest.approx(8.0, abs=0.2))


def test_vehicle_directly_ahead_is_not_handed_over():
    trace = drive(scenario(LEADER), [(0.0, 3.0), (3.0, 0.0)])
    assert (trace.outcome, trace.handed_over) == (Outcome.COLLISION, (None,))


def test_vehicle_behind_one_that_was_handed_over_is_handed_over_too():
    trace = drive(scenario(track(-25.0, 0, 25.0), track(-45.0, 0, 25.0)), [(2.0, -4.0), (4.5, 0.0)])
    first, second = trace.handed_over
    assert first < second
    assert trace.outcome is Outcome.SAFE


def test_vehicle_whose_track_soon_ends_is_handed_over_in_time_to_brake():
    """What it will do after the end of its track is to keep its speed, and not to stand there."""
    told = scenario(track(-45.0, 0, 25.0, seconds=4.5))
    trace = drive(told, [(1.0, -5.0), (4.0, 0.0)])
    assert trace.handed_over[0] < 60
    assert (trace.outcome, trace.states[-1, 1, SPEED]) == (Outcome.SAFE, pytest.approx(10.0, abs=0.5))


def test_vehicle_whose_track_ends_keeps_its_lane_and_speed():
    trace = drive(scenario(track(40.0, 1, 22.0, seconds=3.0)))
    assert trace.handed_over == (45,)
    assert trace.states[-1, 1, [Y, SPEED]] == pytest.approx([8.0, 22.0], abs=0.05)


def test_run_ends_with_the_track_of_the_recorded_ego():
    told = scenario(LEADER, ego=track(0.0, 0, 25.0, seconds=5.0))
    assert (told.seconds, drive(told).duration) == (5.0, 5.0)
    assert drive(scenario(LEADER, ego=None)).duration == 12.0


def test_step_takes_a_vehicle_from_its_track():
    told = Recorded(track=track(40.0, 1, 25.0), steps=(Step(after=2.0, lane="left"), Step(after=1.0, speed=20.0)))
    trace = drive(scenario(told))
    assert (trace.handed_over, trace.begun[0][0]) == ((30,), 30)
    assert len(trace.begun[0]) == 2
    assert trace.states[-1, 1, [Y, SPEED]] == pytest.approx([4.0, 20.0], abs=0.3)


def test_changed_track_is_driven_and_others_react_to_it():
    later = Recorded(track=track(-20.0, 1, 25.0), later=1.0)
    trace = drive(scenario(later, track(-60.0, 1, 25.0), track(-32.0, 1, 25.0)))
    assert trace.states[0, 1, X] - trace.ego[0, X] == pytest.approx(-20.0 - 25.0)
    assert trace.handed_over[1] is None or trace.handed_over[2] is None


def test_vehicle_starts_where_its_track_begins():
    trace = drive(scenario(track(30.0, 0, (0, 18.0), (12, 20.0), aside=[(0, 0.4), (2, 0)])))
    assert trace.states[0, 1, [X, Y, SPEED]] - [trace.ego[0, X], 4.0, 0.0] == pytest.approx([30.0, 1.6, 18.0])


def test_recorded_vehicle_has_its_size():
    told = scenario(LEADER, BEHIND, vehicles=("truck",))
    trace = drive(told)
    assert trace.sizes.tolist() == [[5.0, 2.0], [12.0, 2.55], [5.0, 2.0]]
    assert (trace.outcome, trace.handed_over) == (Outcome.SAFE, (None, None))
    assert max(away(trace, npc).max() for npc in range(2)) < 1e-9
    with pytest.raises(ScenarioError, match=r"received -0\.5 m in the same lane"):
        WORLD.check_fits(scenario(track(8.0, 0, 25.0), vehicles=("truck",)))


def test_truck_that_left_its_recording_has_its_limits():
    trace = drive(scenario(track(40.0, 1, 20.0), vehicles=("truck",), ego=None), [(0.0, 3.0), (3.0, 0.0)])
    later = Recorded(track=track(40.0, 1, 20.0), steps=(Step(after=1.0, speed=26.0),))
    faster = drive(scenario(later, vehicles=("truck",)))
    assert trace.outcome is Outcome.SAFE
    assert faster.handed_over == (15,)
    assert faster.states[16:, 1, ACCELERATION].max() <= TRUCK.acceleration + 1e-9
    assert 23.0 < faster.states[-1, 1, SPEED] <= TRUCK.top_speed


def test_free_npcs_drive_among_recorded_ones():
    free = Free(beside=0, ahead=-40.0, speed=28.0, driver="mobil")
    told = scenario(LEADER, BEHIND, CUTS_IN, free)
    trace = drive(told)
    assert trace.outcome is Outcome.SAFE
    stayed = [npc for npc in range(3) if trace.handed_over[npc] is None]
    assert {0, 2} <= set(stayed), "it is near the one behind the ego alone"
    assert max(away(trace, npc).max() for npc in stayed) < 1e-9
    assert trace.states[0, 4, SPEED] == 28.0
    again = WORLD.rollout_in_gym(told, lambda: lambda seen: (0.0, 0.0))
    assert again.handed_over == trace.handed_over
    assert again.states[:, :, :4] == pytest.approx(trace.states[:, :, :4], abs=1e-6)


def test_starts_that_touch_and_other_roads_are_refused():
    with pytest.raises(
        ScenarioError, match=r"npcs\[0\]: expected a start at least 0.5 m from the ego, received -1.0 m"
    ):
        WORLD.check_fits(scenario(track(4.0, 0, 25.0)))
    with pytest.raises(ScenarioError, match=r"npcs\[0\]\[0\].beside: expected a lane that exists 20 m"):
        WORLD.check_fits(scenario(track(20.0, 2, 25.0)))


# On roads that bend.


def on_way(world, *npcs, ego, **fields):
    lane, speed = world.start
    chains = [[Recorded(track=npc) if isinstance(npc, Track) else npc] for npc in npcs]
    return Scenario(npcs=chains, ego_lane=lane, ego_speed=speed, ego_track=ego, **fields)


def keeping(speed):
    return lambda: lambda seen: Drive(lane=seen.ego.lane, speed=speed)


def test_tracks_bend_with_the_road():
    """Along the ego's way, vehicles are where they were recorded, also one that changes lanes."""
    world = World("racetrack-v0", duration=9.0, planner_hz=15)
    moving = track(60.0, 0, 6.0, aside=[(0, 0), (2, 0), (5, -1.25)])  # lanes are 5 m wide there, and 4 m in a track
    trace = world.rollout(on_way(world, track(30.0, 0, 8.5), moving, ego=track(0.0, 0, 10.0)), keeping(10.0))
    for npc, (ahead, speed) in enumerate(((30.0, 8.5), (60.0, 6.0))):
        left = trace.handed_over[npc] or trace.ticks
        along = trace.track[:left, npc + 1, ALONG] - trace.track[0, 0, ALONG]
        assert along == pytest.approx(ahead + speed * trace.times[:left], abs=0.02)
    followed = trace.track[:, 1, ACROSS]
    assert np.abs(followed).max() < 0.05
    assert np.ptp(trace.states[:, 1, HEADING]) > 0.5
    assert trace.states[0, 1, SPEED] == pytest.approx(8.5)
    assert trace.track[trace.handed_over[1] or -1, 2, ACROSS] == pytest.approx(-5.0, abs=0.1)
    again = world.rollout_in_gym(trace.scenario, keeping(10.0))
    assert again.states[..., :4] == pytest.approx(trace.states[..., :4], abs=1e-6)


def test_who_leaves_its_track_in_a_bend_drives_on_attentively():
    """A vehicle that follows the ego brakes if the ego does not drive as recorded, and stays in its lane."""
    world = World("racetrack-v0", duration=12.0, planner_hz=5)
    told = on_way(world, track(-20.0, 0, 8.0), ego=track(0.0, 0, 8.0))
    as_recorded, slow = (world.rollout(told, keeping(speed)) for speed in (8.0, 3.0))
    assert slow.outcome is Outcome.SAFE
    assert 0 < slow.handed_over[0] < 60
    assert slow.states[-1, 1, SPEED] < 3.5
    assert np.abs(slow.track[:, 1, 3]).max() < 0.5
    assert as_recorded.outcome is Outcome.SAFE


def test_on_a_straight_network_tracks_are_those_of_a_straight_road():
    """merge-v0 has three straight sections."""
    world = World("merge-v0", duration=6.0, planner_hz=5)
    told = on_way(world, track(-20.0, 0, 30.0), track(45.0, -1, 28.0), ego=track(0.0, 0, 30.0))
    straight = Highway(duration=6.0, speed_limit=36.3).rollout(told, keeping(30.0))
    bent = world.rollout(told, keeping(30.0))
    assert bent.handed_over == straight.handed_over == (None, None)
    ours, theirs = (each.states[:, 1:, :4] - [*each.states[0, 0, :2], 0, 0] for each in (bent, straight))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_recorded_npcs_drive_among_those_that_cross():
    world = World("intersection-v1", duration=8.0, planner_hz=5)
    zone = world.crossings.zones[0]
    crossing = CrossingInstruction(zone.way, 3.0, 8.0, "pass")
    told = on_way(world, crossing, track(-25.0, 0, 6.0), ego=track(0.0, 0, 8.0))
    trace = world.rollout(told, keeping(8.0))
    assert trace.outcome is not Outcome.INVALID
    assert trace.handed_over[0] is None
    assert len(trace.handed_over) == 2
    left = trace.handed_over[1] or trace.ticks
    along = trace.track[:left, 2, ALONG]
    assert along == pytest.approx(along[0] + 6.0 * trace.times[:left], abs=0.02)


def test_track_that_no_vehicle_could_follow_in_the_bends_is_refused():
    world = World("racetrack-v0", planner_hz=5)
    with pytest.raises(ScenarioError, match=r"npcs\[0\]\[0\].track: expected a track that the bends of the road allow"):
        world.check_fits(on_way(world, track(20.0, 0, (0, 9.0), (3, 18.0)), ego=track(0.0, 0, 10.0)))


def test_npc_in_lanes_needs_a_cell_that_no_track_begins_in():
    beside = [track(along, lane, 25.0) for along, lane in ((20, 0), (-20, 0), (20, 1), (-20, 1), (0, 1))]
    keep = LaneInstruction("keep", 25.0)
    drive(scenario(*beside[1:], keep, ego_lane=0))
    with pytest.raises(ScenarioError, match="npcs: expected at most 5 NPCs, one per cell that exists around lane 0"):
        WORLD.check_fits(scenario(*beside, keep, ego_lane=0))


def test_highway_env_itself_gives_the_same_run():
    told = scenario(LEADER, BEHIND, CUTS_IN)
    trace = drive(told, [(2.0, -3.0), (4.0, 0.0)])
    again = WORLD.rollout_in_gym(told, lambda: lambda seen: ((-3.0 if 2.0 <= seen.time + 1e-6 < 4.0 else 0.0), 0.0))
    assert again.handed_over == trace.handed_over != (None,) * 3
    assert again.states[:, :, :4] == pytest.approx(trace.states[:, :, :4], abs=1e-6)


def test_terminal_and_page_say_where_the_recording_was_left():
    run = Run(drive(scenario(BEHIND, track(60.0, 1, 25.0)), [(2.0, -4.0), (4.5, 0.0)]))
    place, left = (
        "as recorded, from 20 m behind",
        "leaves the recording after 3.0 s, with a gap of 13 m instead of 15 m",
    )
    assert (
        f"  NPC 0: {place}, 25.0 m/s\n    {left}\n  NPC 1: as recorded, from 60 m ahead, 1 lane right" in run.explain()
    )
    assert [view.words for view in view_of(run.trace).instructions][:1] == [f"{place}; {left}"]
    assert run.as_asked


def test_others_are_attentive_beside_recorded_vehicles():
    """In the paper's traffic alone, this one would run into the rear of an ego that brakes."""
    behind = Manoeuvre(beside=0, ahead=-30.0, speed=25.0)
    braking = [(1.0, -3.0), (5.0, 0.0)]
    assert drive(scenario(behind, track(60.0, 1, 25.0)), braking).outcome is Outcome.SAFE
    assert drive(scenario(behind), braking).outcome is Outcome.COLLISION
