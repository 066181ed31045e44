"""Free, recorded and instructed NPCs of any size on a road that bends, in scenarios that hypothesis draws."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot import Free, Manoeuvre, Recorded, Scenario, ScenarioError, Step, Track, World
from pytest_pafot.model.trace import ACCELERATION, ALONG, HEADING, LANE, SPEED, Outcome
from pytest_pafot.model.vehicle_type import READY
from tests.helpers.interpreted import InterpretedWorld
from tests.helpers.road_cases import ON_LANE_MARGIN, off_lanes, wrapped
from tests.helpers.run_cases import digest

WORLD = World("racetrack-v0", duration=5.0, planner_hz=5)
LIMITS = WORLD.limits
STARTS = (-60, -30, 25, 55, 85)
"""Where NPCs start, in metres ahead of the ego; a truck and the track of a faster NPC fit between two of them."""


def hurrying():
    """Make a planner that follows the lane as fast as possible, and a little slower at each decision.

    It decides by a pair, which is of the same class for both kernels.
    """
    numbers = itertools.count()

    def decide(seen):
        most = 9.0 - 0.1 * next(numbers)
        return 5.0 if seen.ego.speed < most else -6.0, -0.1 * (
            seen.ego.y - 5.0 * seen.ego.lane
        ) - 0.3 * seen.ego.heading

    return decide


def npc(kind, ahead, speed, beside, gain, changes):
    """Return an NPC that gains speed [m/s] within 4 s, and changes lanes meanwhile, as far as its kind lets it."""
    if kind == "recorded":
        times = np.arange(41) / 10
        across = 4.0 * (beside + (-1 - 2 * beside) * changes * times / 4)  # lanes -1 and 0 from the ego's exist
        along = ahead + speed * times + gain * times**2 / 8
        return Recorded(track=Track.of(np.stack([along, across, 0 * times, speed + gain * times / 4], axis=-1)))
    if kind == "steps":
        lane = ("right" if beside else "left") if changes else "keep"
        step = Step(after=0.5, speed=round(speed + gain, 1), lane=lane)
        return Manoeuvre(beside=beside, ahead=ahead, speed=speed, steps=(step,))
    return Free(beside=beside, ahead=ahead, speed=speed, driver=kind)


tenths = st.integers(30, 80).map(lambda number: number / 10)
drawn = st.tuples(
    st.sampled_from(["recorded", "steps", "idm", "mobil", "own"]),
    tenths,
    st.sampled_from([0, -1]),
    st.integers(-20, 20).map(lambda number: number / 10),
    st.booleans(),
)


@st.composite
def scenarios(draw):
    starts = draw(st.lists(st.sampled_from(STARTS), min_size=1, max_size=3, unique=True))
    chains = [[npc(kind, ahead, *rest)] for ahead in starts for kind, *rest in [draw(drawn)]]
    vehicles = draw(st.tuples(*[st.sampled_from(sorted(READY))] * len(chains)))
    follows = any(chain[0].follows_track for chain in chains)
    ego_track = npc("recorded", 0, 7.0, 0, 0.0, False).track if follows and draw(st.booleans()) else None
    return Scenario(npcs=chains, vehicles=vehicles, ego_lane=1, ego_speed=7.0, ego_track=ego_track)


OURS = WORLD.with_drivers({"own": hurrying})


@pytest.fixture(scope="module")
def interpreted():
    """Return a second copy of the room, and the world in it, both made once."""
    room = InterpretedWorld()
    OURS.rollout(Scenario(npcs=[[npc("own", 25, 7.0, 0, 0.0, False)]], ego_lane=1, ego_speed=7.0), IDMVehicle)
    with room.in_place():
        return room, room.room.from_dict(WORLD.to_dict()).with_drivers({"own": hurrying})


@given(scenario=scenarios())
def test_npcs_keep_the_road_and_the_limits_of_their_size_in_bends(interpreted, scenario):
    room, again = interpreted
    try:
        OURS.check_fits(scenario)
    except ScenarioError:
        assume(False)
    trace = OURS.rollout(scenario, IDMVehicle)
    assert trace.outcome in (Outcome.SAFE, Outcome.COLLISION, Outcome.INVALID)  # two NPCs may touch, without an error
    assert trace.users_error_text == ""
    assert digest(OURS.rollout(scenario, IDMVehicle)) == digest(trace)
    with room.in_place():
        assert digest(again.rollout(scenario, IDMVehicle)) == digest(trace)
    for index, ((instruction,), states) in enumerate(zip(scenario.npcs, trace.npcs.swapaxes(0, 1), strict=True)):
        kind, left = scenario.vehicle_of(index), 0
        assert states[:, SPEED].min() >= -1e-9
        if instruction.follows_track:
            left = trace.ticks if trace.handed_over[index] is None else trace.handed_over[index]
            along = trace.track[: left + 1, index + 1, ALONG] - trace.track[0, 0, ALONG]
            assert along == pytest.approx(instruction.at(trace.times[: left + 1])[:, 0], abs=0.05)
        driven = states[left + 1 :]  # what it did by itself
        assert (driven[:, SPEED] <= max(min(LIMITS.overspeed * WORLD.speed_limit, kind.top_speed), 8.0) + 1e-6).all()
        hardest, strongest = (6.0, 6.0) if instruction.drives_itself else (LIMITS.braking, LIMITS.acceleration)
        assert (driven[:, ACCELERATION] >= -min(hardest, kind.braking) - 1e-6).all()
        assert (driven[:, ACCELERATION] <= min(strongest, kind.acceleration) + 1e-6).all()
        turning = driven[:-1, SPEED] * wrapped(np.diff(driven[:, HEADING])) * trace.physics_hz
        if not instruction.drives_itself:
            assert (np.abs(turning) <= min(LIMITS.lateral_acceleration, kind.lateral_acceleration) + 1e-6).all()
        if getattr(instruction, "driver", "") != "own":  # a planner drives where it likes
            alone = SimpleNamespace(
                npcs=states[:, None], sizes=trace.sizes[[0, index + 1]], physics_hz=trace.physics_hz
            )
            assert off_lanes(WORLD.network, alone) < ON_LANE_MARGIN


def test_both_engines_hand_a_recorded_npc_over_in_bends_at_the_same_tick(interpreted):
    """It drives next to the ego, and is 2.3 m from its line, 0.3 m from its box, 3.7 s after the start."""
    room, again = interpreted
    times = np.arange(51) / 10
    across = -4.0 + np.clip(times - 2.0, 0.0, 3.0)
    track = Track.of(np.stack([7.0 * times - 3.0, across, 0 * times, 0 * times + 7.0], axis=-1))
    scenario = Scenario(npcs=[[Recorded(track=track)]], ego_lane=1, ego_speed=7.0)
    trace = OURS.rollout(scenario, IDMVehicle)
    assert trace.handed_over[0] == pytest.approx((3.7 - 3.0) * trace.physics_hz, abs=1.0)
    with room.in_place():
        assert digest(again.rollout(scenario, IDMVehicle)) == digest(trace)


TURN, RADIUS = World("u-turn-v0", duration=12.0, planner_hz=5), 20.0
"""A road with a half circle that a truck can follow, and the radius of its left lane there [m]."""


def turned(instruction, vehicle):
    """Return the states of an NPC ahead of an ego that stops, and the ticks from 1.5 s after the half circle begins."""
    lane, speed = TURN.start
    scenario = Scenario(npcs=[[instruction]], vehicles=(vehicle,), ego_lane=lane, ego_speed=speed)
    trace = TURN.rollout(scenario, lambda: lambda seen: (-5.0 if seen.ego.speed > 0.5 else 0.0, 0.0))
    states = trace.npcs[:, 0]
    turns = np.abs(np.hypot(states[:, 0] - 128.0, states[:, 1] - 24.0) - RADIUS) < 0.5
    turns &= states[:, 0] > 128.0  # the centre of the circle, at which the straight lanes end
    assert set(states[turns, LANE]) == {0}
    ticks = np.flatnonzero(turns)[round(1.5 * trace.physics_hz) : -1]
    assert len(ticks) >= 5
    return states, ticks


@pytest.mark.parametrize(("vehicle", "most"), [("car", 4.0), ("truck", 3.4)])
def test_instructed_npcs_drive_bends_with_four_fifths_of_their_lateral_acceleration(vehicle, most):
    """The rest is for their control."""
    step = Step(after=0.5, speed=20.0)
    states, ticks = turned(Manoeuvre(beside=0, ahead=30, speed=10.0, steps=(step,)), vehicle)
    assert states[ticks, SPEED] ** 2 / RADIUS == pytest.approx(0.8 * most, abs=0.06)


@pytest.mark.parametrize(("vehicle", "most"), [("car", 3.0), ("truck", 1.3)])
def test_free_npcs_speed_up_in_bends_as_their_size_can(vehicle, most):
    """A car's IDM has less acceleration than the car."""
    states, _ = turned(Free(beside=0, ahead=140, speed=15.0, driver="idm"), vehicle)
    assert 0.9 * most < states[:, ACCELERATION].max() < most + 1e-6


@pytest.mark.parametrize(("vehicle", "length"), [("car", 5.0), ("truck", 12.0)])
def test_recorded_npcs_lean_in_bends_as_vehicles_with_steered_front_wheels(vehicle, length):
    """The middle moves at right angles to the radius, the rear axle, half a length behind, where the body points."""
    times = np.arange(121) / 10
    track = Track.of(np.stack([90.0 + 8.0 * times, 0 * times, 0 * times, 0 * times + 8.0], axis=-1))
    states, ticks = turned(Recorded(track=track), vehicle)
    moved = states[ticks[-9:] + 1, :2] - states[ticks[-9:] - 1, :2]
    lean = wrapped(states[ticks[-9:], HEADING] - np.arctan2(moved[:, 1], moved[:, 0]))
    assert lean == pytest.approx(np.arcsin(length / 2 / RADIUS), abs=0.005)
