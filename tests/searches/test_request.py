"""The search space that follows from the world, the algorithm and the user's arguments."""

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, Simulator, World
from pytest_pafot.algorithms.catalogue import ALGORITHMS
from pytest_pafot.algorithms.operators import breed, mutate
from pytest_pafot.algorithms.space import SearchSpace, sample
from pytest_pafot.model.trace import Outcome
from pytest_pafot.model.vehicle_type import CAR, MOTORCYCLE, TRUCK, VAN
from pytest_pafot.searches.explore import request_of
from pytest_pafot.searches.request import build_space, drawn_space, named_world
from pytest_pafot.support.errors import RequestError
from tests.helpers.searches import Fresh
from tests.helpers.tables import table

ANY_LANE, ANY_SPEED = (0, 1, 2, 3), (12.0, 26.8)


def space_of(world, **given):
    """Return the space of a search with these arguments."""
    return build_space(request_of({"ads": IDMVehicle, **given}), world)


@table(
    ("world", "given", "drawn"),
    [
        (Highway(), {}, (4, ANY_LANE, ANY_SPEED, True)),
        (Highway(), {"algorithm": "random"}, (4, ANY_LANE, ANY_SPEED, True)),
        (Highway(), {"npcs": 2}, (2, ANY_LANE, ANY_SPEED, True)),
        (Highway(), {"npcs": 5}, (5, (1, 2), ANY_SPEED, True)),
        (Highway(), {"npcs": 8}, (8, 1, ANY_SPEED, True)),
        (Highway(), {"ego_lane": 0}, (4, 0, ANY_SPEED, True)),
        (Highway(), {"ego_speed": 25.0}, (4, ANY_LANE, 25.0, True)),
        (Highway(lanes=3, speed_limit=10.0), {}, (4, (0, 1, 2), (5.0, 10.0), True)),
        *(
            (Highway(), {"algorithm": each}, (2, 1, 22.0, False))
            for each in ("pafot", "random-manoeuvre")
        ),
        (World("highway-v0"), {}, (4, 1, 22.0, True)),
        (World("highway-v0", config={"lanes_count": 2}), {}, (4, 1, 22.0, True)),
        (
            World("highway-v0", config={"lanes_count": 1}),
            {"npcs": 1, "ego_lane": 0},
            (1, 0, 22.0, True),
        ),
        (World("roundabout-v0"), {}, (2, 1, 8.0, False)),
    ],
)
def test_drawn_space_depends_on_world_algorithm_and_arguments(world, given, drawn):
    space = space_of(world, **given)
    assert (
        space.npcs,
        space.ego_lanes or space.ego_lane,
        space.ego_speeds or space.ego_speed,
        space.patterns,
    ) == drawn


@pytest.mark.parametrize(
    "world", [Highway(), Highway(lanes=3, speed_limit=15.0)], ids=["default", "slow"]
)
def test_scenarios_fit_their_world_and_are_mostly_valid(world):
    space, rng = space_of(world), np.random.default_rng(0)
    outcomes = [world.rollout(sample(space, rng), IDMVehicle).outcome for _ in range(50)]
    assert outcomes.count(Outcome.INVALID) < 5


def test_plain_start_respects_the_speed_limit():
    assert space_of(Highway(speed_limit=10.0)).ego_speed == 10.0


@table(("world", "given", "most"), [
    (Highway(), {}, (4, 6, 6, 4)),
    (Highway(), {"ego_lane": 0}, (4,)),
    (World("highway-v0"), {}, (6,)),
    (Highway(), {"npcs": 3}, ()),
    (World("highway-v0", config={"lanes_count": 1}), {"ego_lane": 0}, ()),
])  # fmt: skip
def test_npc_count_is_below_cells_of_its_lane(world, given, most):
    assert space_of(world, **given).most_npcs == most


def test_av_fuzzer_uses_its_own_fitness_by_default():
    given = (
        {"algorithm": "av-fuzzer"},
        {"algorithm": "av-fuzzer", "fitness": "default"},
        {"algorithm": "random"},
        {},
    )
    found = [request_of({"ads": IDMVehicle, **each}).fitness for each in given]
    assert found == ["av-fuzzer", "default", "default", "default"]


def test_lane_that_is_a_float_is_refused():
    with pytest.raises(
        RequestError, match=r"ego_lane=1\.0\): ego_lane: expected a whole number from 0 to 1000"
    ):
        space_of(Highway(), ego_lane=1.0)


def test_most_npcs_cross_where_ways_meet():
    world = World("intersection-v0")
    drawn = space_of(world)
    assert (drawn.crossings, drawn.most_npcs, drawn.most_on_grid) == (world.crossings, (3,), 2)
    assert drawn.described.startswith(
        "1 to 3 NPCs with PositionInstructions or LaneInstructions in hostile traffic "
        "(NPCs may stop, brake hard and cut in close), most of them on paths that cross the ego's path in 6 zones"
    )
    assert space_of(world, npcs=3).most_npcs == ()
    assert space_of(world, algorithm="pafot").crossings is None
    assert space_of(Highway()).crossings is space_of(World("highway-v0")).crossings is None


@table(("kinds", "drawn"), [
    (("cells", "lanes", "both"), ("both", (2.0, 3.0, 4.0))),
    (("lanes",), ("lanes", (2.0, 3.0, 4.0))),
    (("cells",), ("cells", (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0))),
])  # fmt: skip
def test_own_algorithm_gets_instructions_that_it_can_sample(kinds, drawn):
    own = type("Own", (Fresh,), {"name": "own", "instructions": kinds})
    space = space_of(Highway(), algorithm=own)
    assert (space.instructions, space.gene_durations) == drawn
    for refused in {"cells", "lanes", "both"}.difference(kinds):
        with pytest.raises(
            RequestError, match=f"instructions=.*: expected .* algorithm own, received '{refused}'"
        ):
            space_of(Highway(), algorithm=own, instructions=refused)


def test_default_search_draws_vehicles_that_fit_the_road():
    assert space_of(Highway()).vehicles == (CAR, VAN, TRUCK, MOTORCYCLE)
    assert space_of(Highway()).described.endswith("; one NPC in six is a van, truck or motorcycle")
    assert space_of(World("racetrack-v1")).vehicles == (CAR, VAN, MOTORCYCLE)
    assert (
        space_of(Highway(), vehicles=["car"]).vehicles
        == space_of(Highway(), vehicles="car").vehicles
        == (CAR,)
    )


@table("algorithm", [name for name in ALGORITHMS if name != "random"])
def test_all_other_algorithms_draw_cars(algorithm):
    assert space_of(Highway(), algorithm=algorithm).vehicles == (CAR,)


def test_drawn_and_varied_vehicles_fit_all_ways():
    world, rng, kinds = World("intersection-v0"), np.random.default_rng(2), set()
    space = space_of(world)
    for _ in range(100):
        pair = sample(space, rng), sample(space, rng)
        for child in (*pair, mutate(pair[0], space, rng), *breed(pair, space, 1.0, 1.0, rng)):
            world.check_fits(child)
            kinds |= set(child.all_vehicles)
    assert kinds == {CAR, VAN, MOTORCYCLE}


@table(("world", "given", "words"), [
    (Highway(), {"vehicles": "lorry"}, "vehicle: expected car, van, truck, motorcycle or"),
    (Highway(), {"vehicles": []}, "vehicles: expected one or more of car, van, truck, motorcycle"),
    (
        World("racetrack-v1"),
        {"vehicles": "truck"},
        r"\(vehicles=...\): expected vehicles that fit the roads of World.*, received truck",
    ),
])  # fmt: skip
def test_vehicles_that_cannot_be_drawn_are_refused(world, given, words):
    with pytest.raises(RequestError, match=words):
        space_of(world, **given)


def test_drawn_genes_fill_a_run_on_a_bent_road():
    world = World("merge-v0")
    drawn = SearchSpace(**drawn_space(world, {}))
    assert (drawn.genes, drawn.gene_seconds) == (5, 3.0)
    assert 4 * 3.0 < world.longest_run <= 5 * 3.0


def a_class():
    return Highway


class Still(Simulator):
    def start(self, vehicles, seed): ...
    def step(self, controls): ...
    def states(self): ...


def a_simulator():
    return Still


@pytest.mark.parametrize("name", ["Still", "a_simulator"])
def test_a_simulator_is_no_world_yet(name):
    with pytest.raises(
        RequestError,
        match=r"to return pafot.*, received .*\. Write pafot\.SimulatorWorld\(Still\)$",
    ):
        named_world(f"{__name__}:{name}", "--world")


def test_factory_of_a_world_that_returns_its_class_is_refused():
    message = r"to return pafot\.Highway\(\.\.\.\), .*, received <class '.*Highway'>\. Call it: Highway\(\.\.\.\)"
    with pytest.raises(RequestError, match=message):
        named_world(f"{__name__}:a_class", "--world")
