"""What vehicles are: ready ones with fixed numbers, own ones within bounds, and the vehicles of a scenario's NPCs."""

import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import NpcLimits, PositionInstruction, Scenario, ScenarioError, VehicleType
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.model.vehicle_type import CAR, MOTORCYCLE, PAPERS, STYLES, TRUCK, VAN
from pytest_pafot.support.errors import FieldError
from tests.helpers.refusals import refused
from tests.helpers.tables import table

BUS = VehicleType(name="bus", length=12.0, width=2.5, acceleration=1.2)


def of(*vehicles, npcs=3):
    chains = [[PositionInstruction(cell, 20.0)] for cell in range(1, npcs + 1)]
    return Scenario(npcs=chains, vehicles=vehicles)


def test_numbers_of_ready_vehicles_stay():
    """Files contain only their names, so that with other numbers saved scenarios would change."""
    names = "length", "width", "acceleration", "braking", "lateral_acceleration", "top_speed"
    numbers = [[getattr(each, name) for name in names] for each in (CAR, VAN, TRUCK, MOTORCYCLE)]
    assert numbers == [
        [5.0, 2.0, math.inf, math.inf, math.inf, math.inf],
        [6.5, 2.16, math.inf, math.inf, math.inf, math.inf],
        [12.0, 2.55, 1.3, 7.0, 3.4, 25.0],
        [2.2, 0.9, 6.0, 10.0, math.inf, math.inf],
    ]


OUT_OF_BOUNDS = {
    "long": ({"length": 20.1}, "length"),
    "wide": ({"width": 3.1}, "width"),
    "wider than long": ({"length": 2.0, "width": 2.1}, "length"),
    "weak brakes": ({"braking": 4.9}, "braking"),
    "slow": ({"top_speed": -math.inf}, "top_speed"),
    "no acceleration": ({"acceleration": math.nan}, "acceleration"),
    "no name": ({"name": ""}, "name"),
    "two lines": ({"name": "a\nb"}, "name"),
    "another's name": ({"name": "truck"}, "name"),
}


def own(fields):
    return VehicleType(**{"name": "mine", "length": 6.0, "width": 2.0, **fields})


@table(("fields", "field"), OUT_OF_BOUNDS.values())
def test_own_vehicle_out_of_bounds_is_refused(fields, field):
    with refused(field, FieldError):
        own(fields)


def test_limits_are_the_lower_ones_of_world_and_vehicle():
    world = NpcLimits()
    assert world.for_vehicle(CAR) is world.for_vehicle(VAN) is world
    lower = {"acceleration": 1.3, "braking": 7.0, "lateral_acceleration": 3.4}
    assert world.for_vehicle(TRUCK) == replace(world, **lower)
    assert world.for_vehicle(MOTORCYCLE) == world
    assert NpcLimits(braking=12.0).for_vehicle(MOTORCYCLE).braking == 10.0


def test_texts_without_other_vehicles_are_those_of_before():
    assert of("car", CAR).canonical() == "[[[[1,20.0]],[[2,20.0]],[[3,20.0]]],0,1,22.0,10.0]"
    assert of("car", CAR) == of()
    assert of(CAR, "truck", "car").vehicles == (CAR, TRUCK)


@pytest.mark.parametrize("traffic", ["paper", "everyday"])
def test_plain_form_text_pickle_and_repr_are_read_back(traffic):
    scenario = replace(of("car", BUS, TRUCK), traffic=traffic)
    names = {each.__name__: each for each in (Scenario, PositionInstruction, VehicleType)}
    cell = type(scenario.npcs[0][0].cell)
    assert Scenario.from_canonical(json.loads(scenario.canonical())) == scenario
    assert Scenario.from_canonical(scenario.plain()) == scenario
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    assert eval(repr(scenario), {**names, "Cell": cell}) == scenario
    assert scenario.id != of("car", TRUCK, BUS).id != of().id


WRONG = {
    "a name": ("truck", "vehicles"),
    "an unknown name": (["car", "lorry"], "vehicles[1]"),
    "too long": ([{"name": "bus", "length": 40.0, "width": 2.5}], "vehicles[0].length"),
    "too many": (["car"] * 4, "vehicles"),
}


@table(("vehicles", "field"), WRONG.values())
def test_vehicles_of_a_scenario_are_checked(vehicles, field):
    with refused(field, ScenarioError):
        replace(of(), vehicles=vehicles)


def test_an_npc_keeps_its_vehicle_when_others_are_left_out():
    scenario = of("van", "truck", "motorcycle")
    assert scenario.of_npcs([1]).vehicles == (TRUCK,)
    assert scenario.of_npcs([2, 0]).vehicles == (MOTORCYCLE, VAN)
    assert scenario.with_vehicle(2, CAR).vehicles == (VAN, TRUCK)
    assert scenario.rechained(scenario.npcs[::-1]).vehicles == scenario.vehicles


# Styles of traffic.


def test_only_paper_traffic_is_not_attentive():
    assert [style for style in STYLES if not STYLES[style].is_attentive] == [PAPERS]


NO_STYLES = [
    None,
    3,
    True,
    [],
    ["hostile"],
    "fast",
    "",
    {"style": "paper"},
    np.array(["paper", "x"]),
]


@table("given", NO_STYLES)
def test_what_is_no_style_is_refused(given):
    with refused("traffic", ScenarioError):
        Scenario(npcs=[[PositionInstruction(2, 20.0)]], traffic=given)
    with pytest.raises(ValueError, match=r"^traffic:"):
        SearchSpace(traffic=given)
