"""A recording as a scenario: who is in it, where they start, and how near they come to the tracks."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.extras.recordings.recording import RecordedVehicle, Recording
from pytest_pafot.model.trace import Lane, X, Y
from pytest_pafot.support.errors import RequestError
from tests.benchmarks.recordings import distances_as_recorded, recorded_traffic
from tests.helpers.tables import table

TIMES = np.arange(0.0, 25.01, 0.1)
LANES = tuple(Lane(x=0.0, y=3.75 * n, heading=0.0, length=1e4, width=3.75, speed_limit=math.inf) for n in range(3))


def driven(name, x, speeds, lanes=((0.0, 1.0),), *, length=4.5, width_of_lane=3.75, heading=0.0, first=0.0, last=25.0):
    """Return a vehicle with speeds and lanes at some times, and straight lines between them."""
    speed = np.interp(TIMES, *zip(*speeds, strict=True))
    y = width_of_lane * np.interp(TIMES, *zip(*lanes, strict=True))
    along = x + np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    states = np.stack([along, y, np.full_like(along, heading), speed], axis=-1)
    seen = (first - 1e-6 <= TIMES) & (last + 1e-6 >= TIMES)
    return RecordedVehicle(name=name, kind="car", length=length, width=1.8, times=TIMES[seen], states=states[seen])


EGO = driven("1", 0.0, [(0, 25.0)])


def recording(*others, lanes=LANES, ego=EGO):
    return Recording(vehicles=(ego, *others), rate=10.0, lanes=lanes, source="tracks.csv")


def test_vehicles_that_are_far_or_come_towards_the_ego_are_not_in_the_scenario():
    tracks = recording(
        driven("2", 40.0, [(0, 25.0)]),
        driven("oncoming", 300.0, [(0, 25.0)], heading=math.pi),
        driven("far", 500.0, [(0, 25.0)]),
    )
    assert [chain[0].ahead for chain in tracks.scenario(1).npcs] == [40.0]


def test_ego_that_the_file_names_need_not_drive_along_x():
    def up(vehicle):
        x, y, heading, speed = vehicle.states.T
        return replace(vehicle, states=np.stack([-y, x, heading + math.pi / 2, speed], axis=-1))

    others = [driven("2", 40.0, [(0, 20.0)]), driven("3", -30.0, [(0, 30.0)], [(0, 0.0), (5, 0.0), (8, 1.0)])]
    along_y = replace(recording(*map(up, others), ego=up(EGO), lanes=()), ego="1")
    along_x = recording(*others, lanes=())
    for (one,), (other,) in zip(along_y.scenario().npcs, along_x.scenario(1).npcs, strict=True):
        assert one.track.states == pytest.approx(other.track.states, abs=0.011), "apart from rounding"


def test_track_can_be_followed_up_to_its_last_row():
    thirtieths = np.arange(145) / 30  # the last of them is less than a start plus the time from there
    ends = replace(driven("2", 40.0, [(0, 20.0)]), times=thirtieths, states=driven("2", 0.0, [(0, 20.0)]).states[:145])
    ego = replace(EGO, times=thirtieths, states=EGO.states[:145] - [1.0, 0.0, 0.0, 0.0])
    assert recording(ends, ego=ego).scenario(1, at=thirtieths[132]).npcs


def test_road_gets_lanes_on_the_left_for_who_drives_beside_its_leftmost_one():
    shoulder = driven("2", 40.0, [(0, 25.0)], [(0, -1.0)])
    ego = driven("1", 0.0, [(0, 25.0)], [(0, 0.0)])
    scenario = recording(shoulder, ego=ego).scenario(1)
    assert (scenario.ego_lane, scenario.npcs[0][0].beside) == (1, -1)


@table(
    "arguments, message",
    [
        ({}, r"tracks.csv: expected a vehicle in whose place the policy drives; give it as ego="),
        ({"ego": 1, "at": 30.0}, r"a time at which 1 was seen, from 0 to 25 s, and at most 40 s, received at=30 and"),
        (
            {"ego": 1},
            r"expected vehicles within 200 m of 1 that drive in its direction at 0 s, received none; start at",
        ),
    ],
)
def test_recording_without_a_scenario_is_refused(arguments, message):
    with pytest.raises(RequestError, match=message):
        recording().scenario(**arguments)


def test_ego_in_a_bend_is_refused():
    bent = np.array(EGO.states)
    bent[:, 2] = np.linspace(0.0, 1.0, len(bent))
    ego = RecordedVehicle(name="1", kind="car", length=4.5, width=1.8, times=TIMES, states=bent)
    with pytest.raises(
        RequestError, match=r"a straight road from 0 s on, received 1, which turns by 46 degrees; start"
    ):
        recording(driven("2", 40.0, [(0, 25.0)]), ego=ego).scenario(1)


def test_vehicle_that_turns_off_the_road_drives_on_in_its_lane():
    other = driven("2", 40.0, [(0, 20.0)], [(0, 1.0), (5, 1.0), (7, 40.0)])
    states = np.array(other.states)
    states[50:, 2] = 1.4
    turning = RecordedVehicle(name="2", kind="car", length=4.5, width=1.8, times=TIMES, states=states)
    ((npc,),) = recording(turning).scenario(1).npcs
    assert npc.track.seconds == pytest.approx(4.9), "the last row along the road; then it is attentive"


def test_vehicles_drive_on_their_tracks():
    others = (
        driven("2", 40.0, [(0, 25.0), (5, 20.0), (10, 25.0)]),
        driven("3", -30.0, [(0, 30.0), (9, 22.0)], [(0, 0.0), (6, 0.0), (11, 1.0)]),
        driven("4", 30.0, [(0, 25.0)], [(0, 2.0)], last=8.0),
    )
    scenario = recording(*others).scenario(1, at=1.0)
    trace = pafot.Highway(speed_limit=36.3, duration=20.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    assert (scenario.ego_lane, scenario.ego_speed, scenario.ego_track.seconds) == (1, 25.0, 20.0)
    assert trace.handed_over == (None, 105, None), "the second nearest one is seen for 8 s"
    for npc, other in enumerate((others[1], others[2], others[0])):
        times = trace.times[trace.times <= other.times[-1] - 1.0]
        track = other.at(1.0 + times) - EGO.at(1.0)
        missed = trace.states[: len(times), npc + 1, [X, Y]] - trace.states[0, 0, [X, Y]]
        assert np.abs(missed[:, 0] - track[:, X]).max() < 0.05
        assert np.abs(missed[:, 1] - track[:, Y] * 4.0 / 3.75).max() < 0.05


def test_npcs_have_their_recorded_sizes():
    others = driven("2", 40.0, [(0, 22.0)], length=16.5), driven("3", -30.0, [(0, 30.0)], [(0, 0.0)], length=4.2)
    scenario = recording(*others).scenario(1, seconds=5.0)
    trace = pafot.Highway(speed_limit=36.3, duration=5.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    assert trace.sizes.tolist() == [[5.0, 2.0], [4.2, 1.8], [16.5, 1.8]], "the nearest one first; the ego is a car"
    assert [each.kind for each in scenario.vehicles] == ["car", "truck"]


@given(
    first=st.integers(1, 150), ahead=st.floats(-190.0, 190.0), speed=st.floats(0.0, 33.0), lane=st.sampled_from([0, 2])
)
def test_vehicle_that_comes_later_drives_evenly_to_where_it_is_first_seen(first, ahead, speed, lane):
    """Nothing appears in the world, so a policy that drives otherwise than the recorded ego sees it come."""
    seen = TIMES[first]
    speeds, lanes = [(0, speed), (seen, speed), (25, speed + 2)], [(0, lane)]
    x = ahead + float(EGO.at(seen)[0, X]) - speed * seen
    later = driven("later", x, speeds, lanes, first=seen)
    ((npc,),) = recording(later).scenario(1, seconds=20.0).npcs
    assert npc.track.states[:, X] == pytest.approx(driven("later", x, speeds).states[:201, X], abs=0.01)
    assert npc.track.states[:, Y] == pytest.approx(4.0 * (lane - 1))
    world = pafot.Highway(speed_limit=36.3, duration=20.0)
    assert world.rollout(recording(later).scenario(1), lambda: lambda seen: (0.0, 0.0)).outcome == "safe"


def test_ego_that_stops_is_not_hit_by_who_comes_later():
    later = driven("later", -300.0, [(0, 33.0)], first=16.0)
    scenario = recording(driven("2", 60.0, [(0, 25.0)]), later).scenario(1)
    trace = pafot.Highway(speed_limit=36.3, duration=20.0).rollout(scenario, lambda: lambda seen: (-4.0, 0.0))
    assert trace.outcome == "safe"
    assert trace.handed_over[1] is not None
    assert trace.states[0, 2, X] == pytest.approx(trace.states[0, 0, X] - 300.0)


def test_vehicle_that_cannot_have_come_is_left_out():
    ahead = driven("2", 60.0, [(0, 25.0)])
    through_the_ego = driven("3", -20.0, [(0, 28.0)], first=8.0)  # it passed in the lane of the ego, or in another one
    lost = driven("2/2", 30.0, [(0, 26.0)], [(0, 2.0)], first=15.0)
    found = driven("4", 20.0, [(0, 25.0)], [(0, 2.0)], first=22.0)
    assert len(recording(ahead, through_the_ego, lost, found).scenario(1).npcs) == 1, "the last one comes after the end"
    assert len(recording(ahead, found).scenario(1, seconds=23.0).npcs) == 2


def test_who_comes_first_has_the_places_that_are_left():
    there = [driven(f"there {n}", 40.0 + 30 * n, [(0, 25.0)], [(0, n % 3)]) for n in range(5)]
    come = [driven(f"comes {n}", -20.0 - 30 * n, [(0, 25.0)], first=9.0 - n) for n in range(6)]
    npcs = [chain[0].ahead for chain in recording(*come, *there).scenario(1).npcs]
    assert npcs == [40.0, 70.0, 100.0, 130.0, 160.0, -170.0, -140.0, -110.0]


def test_places_without_lanes_are_those_of_the_data():
    tracks = recording(driven("2", 40.0, [(0, 25.0)], [(0, 1.5)]), lanes=())
    ((npc,),) = tracks.scenario(1).npcs
    assert npc.track.states[0].tolist() == [40.0, 1.88, 0.0, 25.0]


def test_recording_that_is_longer_than_a_track_is_refused():
    with pytest.raises(RequestError, match="at most 40 s, received at=0 and seconds=50"):
        recording(driven("2", 40.0, [(0, 25.0)])).scenario(1, seconds=50.0)


def test_traffic_of_highway_env_is_driven_to_a_tenth_of_a_metre(tmp_path):
    """The benchmark does the same with more recordings."""
    found = distances_as_recorded(recorded_traffic(0, tmp_path / "tracks.csv"))
    assert len(found) == 8
    assert max(found) < 0.1
