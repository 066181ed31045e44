"""What vehicles are: ready ones with fixed numbers, own ones within bounds, and the vehicles of a scenario's NPCs."""

from __future__ import annotations

import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import PositionInstruction, Scenario, ScenarioError, VehicleType
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.model.vehicle_type import CAR, MOTORCYCLE, PAPERS, STYLES, TRUCK, VAN
from pytest_pafot.support.errors import FieldError
from pytest_pafot.world import NpcLimits
from tests.helpers.tables import table

BUS = VehicleType(name="bus", length=12.0, width=2.5, acceleration=1.2)


def of(*vehicles, npcs=3):
    return Scenario(
        npcs=[[PositionInstruction(cell, 20.0)] for cell in range(1, npcs + 1)], vehicles=vehicles
    )


def test_numbers_of_ready_vehicles_stay():
    """Files contain only their names, so that with other numbers saved scenarios would change."""
    numbers = [
        (
            each.length,
            each.width,
            each.acceleration,
            each.braking,
            each.lateral_acceleration,
            each.top_speed,
        )
        for each in (CAR, VAN, TRUCK, MOTORCYCLE)
    ]
    assert numbers == [
        (5.0, 2.0, math.inf, math.inf, math.inf, math.inf),
        (6.5, 2.16, math.inf, math.inf, math.inf, math.inf),
        (12.0, 2.55, 1.3, 7.0, 3.4, 25.0),
        (2.2, 0.9, 6.0, 10.0, math.inf, math.inf),
    ]


@pytest.mark.parametrize(("fields", "place"), [
    ({"length": 20.1}, "length"),
    ({"width": 3.1}, "width"),
    ({"length": 2.0, "width": 2.1}, "length"),
    ({"braking": 4.9}, "braking"),
    ({"top_speed": -math.inf}, "top_speed"),
    ({"acceleration": math.nan}, "acceleration"),
    ({"name": ""}, "name"),
    ({"name": "a\nb"}, "name"),
    ({"name": "truck"}, "name"),
])  # fmt: skip
def test_own_vehicle_out_of_bounds_is_refused(fields, place):
    with pytest.raises(FieldError) as caught:
        VehicleType(**{"name": "mine", "length": 6.0, "width": 2.0, **fields})
    assert caught.value.field == place


def test_limits_are_the_lower_ones_of_world_and_vehicle():
    world = NpcLimits()
    assert world.for_vehicle(CAR) is world.for_vehicle(VAN) is world
    assert world.for_vehicle(TRUCK) == replace(
        world, acceleration=1.3, braking=7.0, lateral_acceleration=3.4
    )
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


@pytest.mark.parametrize(("vehicles", "field", "received"), [
    ("truck", "vehicles", "'truck'"),
    (["car", "lorry"], "vehicles[1]", "'lorry'"),
    ([{"name": "bus", "length": 40.0, "width": 2.5}], "vehicles[0].length", "40.0"),
    (["car"] * 4, "vehicles", "4"),
])  # fmt: skip
def test_vehicles_of_a_scenario_are_checked(vehicles, field, received):
    with pytest.raises(ScenarioError) as caught:
        replace(of(), vehicles=vehicles)
    assert (caught.value.field, caught.value.received) == (field, received)


def test_an_npc_keeps_its_vehicle_when_others_are_left_out():
    scenario = of("van", "truck", "motorcycle")
    assert scenario.of_npcs([1]).vehicles == (TRUCK,)
    assert scenario.of_npcs([2, 0]).vehicles == (MOTORCYCLE, VAN)
    assert scenario.with_vehicle(2, CAR).vehicles == (VAN, TRUCK)
    assert scenario.rechained(scenario.npcs[::-1]).vehicles == scenario.vehicles


# Styles of traffic.


def test_only_paper_traffic_is_not_attentive():
    assert [style for style in STYLES if not STYLES[style].is_attentive] == [PAPERS]


@table(
    "given",
    [None, 3, True, [], ["hostile"], "fast", "", {"style": "paper"}, np.array(["paper", "x"])],
)
def test_what_is_no_style_is_refused(given):
    with pytest.raises(
        ScenarioError,
        match="traffic: expected one of paper, hostile, assertive, everyday, received",
    ):
        Scenario(npcs=[[PositionInstruction(2, 20.0)]], traffic=given)
    with pytest.raises(
        ValueError,
        match="traffic: expected one of paper, hostile, assertive, everyday, but received",
    ):
        SearchSpace(traffic=given)
