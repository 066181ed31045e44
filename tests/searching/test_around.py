"""Scenarios around a recording: which changes a search makes of it, and how shrinking undoes them."""

from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import Highway, Recorded, Scenario, Step, Track
from pytest_pafot.findings.neighbours import Limits, neighbours
from pytest_pafot.model.instructions import Manoeuvre
from pytest_pafot.searching.operators import crossover, mutate
from pytest_pafot.searching.space import SearchSpace, sample
from tests.helpers.shrinking import shrink


def track(x, lane, speed):
    return Track.of([[x + speed * row / 10, 4.0 * lane, 0.0, speed] for row in range(101)])


NPCS = [[Recorded(track=each)] for each in (track(20, 0, 25), track(-20, 0, 25), track(30, 1, 24), track(3, -1, 26))]
RECORDING = Scenario(npcs=NPCS, ego_track=track(0, 0, 25), ego_lane=1, ego_speed=25.0)
SPACE = SearchSpace(
    npcs=4, least_npcs=4, most_npcs=(5,), genes=1, speed_limit=30.0, ego_lane=1, ego_speed=25.0, lanes=4,
    room=(150.0, 480.0), first=(RECORDING,), around=RECORDING,
)  # fmt: skip
WORLD = Highway(lanes=4, speed_limit=30.0)


def changes(scenario):
    """Return the kinds of changes that a scenario has of the recording."""
    found = {type(chain[0]).__name__ for chain in scenario.npcs} - {"Recorded"}
    for (npc,), (was,) in zip(scenario.npcs, RECORDING.npcs, strict=False):
        if isinstance(npc, Recorded):
            assert npc.track == was.track
            found |= {name for name in ("later", "pace", "shift", "steps") if getattr(npc, name) != getattr(was, name)}
    return found


def test_sampled_scenarios_have_each_change_and_fit_the_world():
    rng, found = np.random.default_rng(0), set()
    for _ in range(200):
        scenario = sample(SPACE, rng)
        WORLD.check_fits(scenario)
        assert 4 <= len(scenario.npcs) <= 5
        assert (scenario.ego_track, scenario.ego_lane, scenario.ego_speed) == (RECORDING.ego_track, 1, 25.0)
        found |= changes(scenario)
    assert found == {"later", "pace", "shift", "steps", "Manoeuvre"}


def test_mutation_keeps_the_recording_and_crossover_the_starts():
    rng, scenario, other = np.random.default_rng(0), RECORDING, sample(SPACE, np.random.default_rng(1))
    for _ in range(200):
        scenario = mutate(scenario, SPACE, rng)
        WORLD.check_fits(scenario)
        assert sum(isinstance(chain[0], Recorded) for chain in scenario.npcs) == 4
        first, second = crossover(scenario, other, rng)
        assert (first.ego_track, second.ego_track) == (RECORDING.ego_track, RECORDING.ego_track)
        WORLD.check_fits(first)


def test_vehicles_of_a_recording_stay_and_have_room():
    rng = np.random.default_rng(0)
    recording = replace(RECORDING, vehicles=("car", "truck", "truck"))
    space = replace(SPACE, around=recording, first=(recording,))
    scenario = sample(space, rng)
    for _ in range(300):
        scenario = mutate(scenario, space, rng)
        WORLD.check_fits(scenario)
        assert scenario.vehicles == recording.vehicles


def test_starts_leave_room_for_the_egos_own_vehicle():
    rng, world = np.random.default_rng(0), replace(WORLD, ego="truck")
    for _ in range(300):
        world.check_fits(sample(replace(SPACE, ego_length=12.0), rng))


def test_vehicle_that_comes_later_may_start_before_the_road():
    rng = np.random.default_rng(0)
    recording = replace(RECORDING, npcs=(*RECORDING.npcs, [Recorded(track=track(-600, 2, 30))]))
    space = replace(SPACE, npcs=5, least_npcs=5, most_npcs=(6,), around=recording, first=(recording,))
    drawn = [sample(space, rng) for _ in range(50)]
    for each in drawn:
        WORLD.check_fits(each)
    assert len({each.id for each in drawn}) > 40
    assert any(each.npcs[4] != recording.npcs[4] for each in drawn)


def test_whoever_is_behind_at_the_start_can_avoid_a_change():
    """Otherwise a search finds collisions that begin with the change, and are nobody's fault."""
    rng, scenario, least = np.random.default_rng(0), RECORDING, 1.0
    for _ in range(500):
        scenario = mutate(scenario, SPACE, rng)
        for (first,) in scenario.npcs:
            if first.beside == 0 and not (first.follows_track and first.is_as_recorded):
                gap = abs(first.ahead) - 5.0 * first.follows_track
                closing = (first.speed - 25.0) * (1 if first.ahead < 0 else -1)
                least = min(least, gap - max(closing, 0.0) * (1.0 + max(closing, 0.0) / 10.0))
    assert 0.5 - 1e-6 <= least < 1.0


def test_vehicle_that_changes_lanes_at_the_start_begins_on_the_road():
    rng = np.random.default_rng(0)
    aside = Track.of([[20 + 2.5 * row, 9.5 - 0.1 * min(row, 15), -0.04, 25.0] for row in range(101)])
    recording = replace(RECORDING, npcs=[[Recorded(track=aside)]])
    space = replace(SPACE, npcs=1, least_npcs=1, most_npcs=(2,), around=recording, first=(recording,))
    for _ in range(100):
        WORLD.check_fits(sample(space, rng))


def test_pace_stays_below_the_speed_limit():
    rng = np.random.default_rng(0)
    varied = [Recorded(track=track(3, -1, 26 + n / 50)).varied(SPACE.choices, rng) for n in range(200)]
    assert max(each.speed for each in varied) <= 30.0
    assert min(each.pace for each in varied) < 0.9


def test_shrinking_goes_back_to_the_recording():
    step = Step(after=3.0, lane="left", lateral_speed=2.5, speed=11.3)
    npcs = [
        [Recorded(track=NPCS[0][0].track, later=0.7, pace=1.07, shift=-3.3)],
        [Recorded(track=NPCS[1][0].track, later=-1.2)],
        [Recorded(track=NPCS[2][0].track, steps=(step,))],
        [Manoeuvre(beside=0, ahead=60.0, speed=20.0)],
    ]
    start = Scenario(npcs=npcs, ego_track=RECORDING.ego_track, ego_lane=1, ego_speed=25.0, seed=7)

    def fails(scenario):
        """Fail if the first vehicle is more than 2 m behind its place, whoever else is there."""
        first = scenario.npcs[0][0]
        return scenario if isinstance(first, Recorded) and first.shift < -1.5 else None

    simplest, how = shrink(start, fails, rollouts=500, top_speed=30.0, plain=(1, 25.0))
    assert [chain[0] for chain in simplest.npcs] == [Recorded(track=NPCS[0][0].track, shift=-1.6)]
    assert (simplest.ego_track, how.is_minimal, how.speeds) == (RECORDING.ego_track, True, ())


def test_shrinking_leaves_recorded_vehicles_their_size():
    added = [Manoeuvre(beside=0, ahead=60.0, speed=20.0)]
    start = Scenario(npcs=[NPCS[0], added], ego_track=RECORDING.ego_track, vehicles=("truck", "truck"))
    fails = lambda scenario: scenario if len(scenario.npcs) == 2 else None  # noqa: E731
    simplest, _ = shrink(start, fails, rollouts=500, top_speed=30.0)
    assert [each.name for each in simplest.all_vehicles] == ["truck", "car"]


def test_shrinking_stays_around_the_recording():
    start = Scenario(npcs=[NPCS[0], [Manoeuvre(beside=0, ahead=60.0, speed=0.0)]], ego_track=RECORDING.ego_track)
    simplest, _ = shrink(start, lambda scenario: scenario, rollouts=500, top_speed=30.0)
    assert [chain[0] for chain in simplest.npcs] == NPCS[0]


def test_neighbours_move_the_tracks():
    limits = Limits(fits=lambda scenario: True, top_speed=30.0, longest_run=60.0)
    drawn = [each for each, _ in zip(neighbours(RECORDING, 1.0, limits), range(20), strict=False)]
    assert {type(chain[0]) for each in drawn for chain in each.npcs} == {Recorded}
    assert all(abs(chain[0].shift) <= 2.0 and abs(chain[0].later) <= 0.3 for each in drawn for chain in each.npcs)
    assert len(drawn) == 20


def test_space_says_what_it_is_around():
    assert SPACE.described.startswith(f"4 to 5 NPCs around the recording {RECORDING.id}; the ego starts at 25 m/s")
    assert SPACE.plain["around"] == RECORDING.id
    assert pytest.approx(SPACE.ego_track.seconds) == 10.0
