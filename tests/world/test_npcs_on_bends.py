"""Free, recorded and instructed NPCs of any size on a road that bends, in scenarios that hypothesis draws."""

from types import SimpleNamespace

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot import Free, Manoeuvre, Recorded, Scenario, ScenarioError, Step, Track, World
from pytest_pafot.model.trace import ACCELERATION, ALONG, HEADING, SPEED, Outcome
from pytest_pafot.model.vehicle_type import READY
from tests.helpers.interpreted import InterpretedWorld
from tests.helpers.road_cases import ON_LANE_MARGIN, off_lanes, wrapped
from tests.helpers.run_cases import digest

WORLD = World("racetrack-v0", duration=5.0, planner_hz=5)
LIMITS = WORLD.limits
STARTS = (-60, -30, 25, 55, 85)
"""Where NPCs start, in metres ahead of the ego; a truck and the track of a faster NPC fit between two of them."""


def hurrying(seen):
    """Follow the lane as fast as possible, by a pair, which is of the same class for both kernels."""
    return 5.0 if seen.ego.speed < 9.0 else -6.0, -0.1 * (seen.ego.y - 5.0 * seen.ego.lane) - 0.3 * seen.ego.heading


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


OURS = WORLD.with_drivers({"own": lambda: hurrying})


@pytest.fixture(scope="module")
def interpreted():
    """Return a second copy of the room, and the world in it, both made once."""
    room = InterpretedWorld()
    OURS.rollout(Scenario(npcs=[[npc("own", 25, 7.0, 0, 0.0, False)]], ego_lane=1, ego_speed=7.0), IDMVehicle)
    with room.in_place():
        return room, room.room.from_dict(WORLD.to_dict()).with_drivers({"own": lambda: hurrying})


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
