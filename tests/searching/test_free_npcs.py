"""Searches with free NPCs: starts at which no two vehicles touch, and only the drivers of the mark."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot import Drive, Free, Highway, Manoeuvre, Scenario, World
from pytest_pafot.campaign.explore import request_of
from pytest_pafot.campaign.request import build_space
from pytest_pafot.searching.operators import crossover, mutate
from pytest_pafot.searching.space import sample
from pytest_pafot.support.errors import RequestError
from pytest_pafot.world.guard.own_worlds import base_world
from pytest_pafot.world.limits import CONNECTED
from tests.helpers.road_cases import ROADS
from tests.helpers.shrinking import shrink
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.toy_world import Toy


def steady(observation):
    return 0.0, 0.0


def following(observation):
    ego = observation.ego
    gaps = [each.x - ego.x for each in observation.others if abs(each.y - ego.y) < 2 and each.x > ego.x]
    return (-6.0 if min(gaps, default=100.0) < 5 + 0.8 * ego.speed else 0.5 * (ego.speed < 24)), 0.0


DRIVERS = {"idm": "idm", "last": lambda: steady}
WORLD = base_world(Highway().with_drivers({"last": DRIVERS["last"]}))


def space_of(world=WORLD, drivers=DRIVERS, **more):
    return build_space(request_of({"ads": lambda: steady, "drivers": drivers, **more}), world)


SPACES = [
    space_of(),
    space_of(npcs=5, ego_speed=12.0),
    space_of(npcs=3, instructions="cells", drivers="idm"),
]


def free_of(scenario):
    return [chain[0] for chain in scenario.npcs if isinstance(chain[0], Free)]


@given(st.sampled_from(SPACES), st.integers(0, 2**32), st.integers(0, 25))
def test_what_is_sampled_and_varied_can_start(space, seed, mutations):
    """That is checked by the rules of the world: no two vehicles touch there."""
    rng = np.random.default_rng(seed)
    scenario, other = sample(space, rng), sample(space, rng)
    for _ in range(mutations):
        scenario = mutate(scenario, space, rng)
    for each in (scenario, other, *crossover(scenario, other, rng)):
        WORLD.check_fits(each)
        assert {free.driver for free in free_of(each)} <= set(space.drivers)


@pytest.mark.parametrize("seed", range(6))
def test_long_lines_of_mutations_can_start(seed):
    rng, space = np.random.default_rng(seed), space_of(npcs=5, ego_speed=22.0, ego_lane=1)
    scenario = sample(space, rng)
    for _ in range(300):
        scenario = mutate(scenario, space, rng)
        WORLD.check_fits(scenario)


def test_long_vehicles_have_room():
    bus = pafot.VehicleType(name="bus", length=18.0, width=2.55)
    rng, space = np.random.default_rng(0), space_of(npcs=6, ego_speed=22.0, ego_lane=1, vehicles=bus)
    for _ in range(300):
        WORLD.check_fits(sample(space, rng))


def test_free_npcs_and_the_others_are_different_vehicles():
    rng, space = np.random.default_rng(0), space_of(npcs=4)
    scenarios = [sample(space, rng) for _ in range(200)]
    found = [
        (type(chain[0]) is Free, each.vehicle_of(npc)) for each in scenarios for npc, chain in enumerate(each.npcs)
    ]
    assert set(found) == {(is_free, vehicle) for is_free in (True, False) for vehicle in space.vehicles}
    assert set(space.vehicles) == {pafot.CAR, pafot.VAN, pafot.TRUCK, pafot.MOTORCYCLE}


def test_about_half_of_the_npcs_are_free():
    rng, space = np.random.default_rng(0), space_of(npcs=4)
    free = [len(free_of(sample(space, rng))) for _ in range(200)]
    assert {0, 4} < set(free)
    assert 1.8 < np.mean(free) < 2.2
    assert (
        "4 NPCs with Position- or Lane-Instructions, half of them free (idm, last) in hostile traffic "
        "(NPCs may stop, brake hard and cut in close)" in space.described
    )


def test_mutations_change_driver_lane_distance_and_speed_of_free_npcs_and_the_others():
    rng, space = np.random.default_rng(0), space_of(npcs=4)
    scenario = next(each for each in iter(lambda: sample(space, rng), None) if len(free_of(each)) == 2)
    changed = set()
    for _ in range(300):
        child = mutate(scenario, space, rng)
        for before, after in zip(scenario.npcs, child.npcs, strict=False):
            if isinstance(before[0], Free) and isinstance(after[0], Free):
                names = ("driver", "beside", "ahead", "speed")
                changed |= {name for name in names if getattr(before[0], name) != getattr(after[0], name)}
            elif before != after:
                changed.add("directed")
    assert changed == {"driver", "beside", "ahead", "speed", "directed"}


def test_without_drivers_the_space_is_as_before():
    usual = build_space(request_of({"ads": lambda: steady}), WORLD)
    assert "drivers" not in usual.plain
    assert not any(free_of(sample(usual, np.random.default_rng(seed))) for seed in range(20))


@table(
    ("is_needed", "simplest"),
    [
        (lambda each: True, Manoeuvre(beside=1, ahead=30.0, speed=21.3)),
        (lambda each: isinstance(each, Free), Free(beside=1, ahead=30.0, speed=20.0, driver="idm")),
        (
            lambda each: each.name == "free" and each.driver != "idm",
            Free(beside=1, ahead=30.0, speed=20.0, driver="mobil"),
        ),
    ],
)
def test_shrinking_prefers_what_a_reader_knows(is_needed, simplest):
    """A manoeuvre that keeps lane and speed, then the simplest driver that fails."""

    def fails(scenario):
        each = scenario.npcs[0][0]
        is_there = each.keeps_start and (each.beside, each.ahead > 0) == (1, True)
        return scenario if is_there and is_needed(each) else None

    given = Scenario(npcs=((Free(beside=1, ahead=31.4, speed=21.3, driver="last"),),))
    found, _ = shrink(given, fails, rollouts=1000, top_speed=26.8)
    assert type(found.npcs[0][0]) is type(simplest)
    assert getattr(found.npcs[0][0], "driver", "") == getattr(simplest, "driver", "")
    assert found.npcs[0][0].ahead == simplest.ahead


# On other roads.


@pytest.mark.parametrize("env_id", mostly_oracle(ROADS, "merge-v1", "roundabout-generic-v1", "u-turn-v1"))
def test_all_scenarios_fit_a_road_of_any_shape(env_id):
    """Their free NPCs start in the ego's lane, as far from it as the road goes."""
    world = base_world(World(env_id, planner_hz=5))
    space, rng = space_of(world, {"idm": "idm", "mobil": "mobil"}), np.random.default_rng(0)
    found = [sample(space, rng) for _ in range(16)]
    found += [mutate(each, space, rng) for each in found]
    for each in found:
        world.check_fits(each)
    assert {free.beside for scenario in found for free in free_of(scenario)} == {0}
    assert 0.2 < sum(len(free_of(each)) for each in found) / sum(len(each.npcs) for each in found) < 0.7


@pytest.mark.processes
def test_search_among_crossing_and_free_npcs_is_the_same_with_other_processes():
    world = World("roundabout-v1", {CONNECTED: True}, planner_hz=5, duration=10.0)
    one, two = (
        pafot.explore(
            lambda: keeping, holds=no_collision, world=world, drivers={"policy": "policy", "mobil": "mobil"},
            workers=workers, runs=20, seed=5, shrink_rollouts=0,
        )
        for workers in (1, 2)
    )  # fmt: skip
    assert one.summary.outcomes == two.summary.outcomes
    assert [each.scenario for each in one.findings] == [each.scenario for each in two.findings]
    assert not any(CONNECTED in note for note in one.summary.notes)


def keeping(observation):
    return Drive(lane=observation.ego.lane, speed=8.0)


# The argument of the mark.


@table(
    ("drivers", "message"),
    [
        (3, "expected some of 'idm'"),
        ({"a b": lambda: steady}, "a name has up to 40 letters"),
        ({"idm": lambda: steady}, "expected 'idm' to have no factory"),
        ({"last": 3}, "expected the name of a fixture or a factory"),
        ({"last": "nowhere:Planner"}, "nowhere"),
    ],
)
def test_wrong_drivers_are_refused(drivers, message):
    with pytest.raises(RequestError, match=message):
        request_of({"ads": lambda: steady, "drivers": drivers})


@table(
    ("world", "more", "message"),
    [
        (Toy(), {}, "expected a world whose NPCs can have drivers"),
        (WORLD, {"algorithm": "pafot"}, "expected an algorithm that draws .*, received algorithm='pafot'; leave"),
        (WORLD, {"instructions": "manoeuvres"}, "expected NPCs with .*, received instructions='manoeuvres'; leave"),
        (World("highway-v0"), {"drivers": "policy"}, "expected no 'policy' in a world whose policy has the"),
        (WORLD, {"drivers": ["fast"]}, r"expected some of 'idm', 'mobil', 'policy', or a mapping .* received 'fast'"),
        (WORLD, {"around": 3}, "arguments of scenarios beside it, received drivers"),
    ],
)
def test_search_that_can_have_no_free_npcs_is_refused(world, more, message):
    with pytest.raises(RequestError, match=message):
        space_of(base_world(world), **more)


SHORT = Highway(duration=12.0)
explored = partial(pafot.explore, lambda: following, world=SHORT, runs=100, seed=5, blame="ego", shrink_rollouts=40)


def no_collision(run):
    assert not run.collision


def anything(run):
    assert run.duration >= 0


@pytest.mark.processes
def test_search_is_the_same_with_other_processes_and_its_findings_run_again():
    drivers = {"policy": "policy", "mobil": "mobil", "drawing": Drawing}
    one, two = (
        explored(holds=no_collision, drivers=drivers, workers=workers, runs=60, shrink_rollouts=0) for workers in (1, 2)
    )
    assert one.summary.outcomes == two.summary.outcomes
    assert [each.scenario for each in one.findings] == [each.scenario for each in two.findings]


class Drawing:
    """A driver that draws from a global generator."""

    def __call__(self, observation):
        return np.random.normal(), 0.0


def test_driver_that_fails_is_reported_and_is_no_failure():
    def raising(observation):
        raise ValueError("no way")

    found = explored(holds=anything, drivers={"own": lambda: raising}, npcs=1)
    assert found.findings == ()
    (warning, *_) = found.summary.warnings
    assert "tested nothing; most often the driver own failed: ValueError: no way; correct that driver" in warning
