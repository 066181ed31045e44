import pytest

from pytest_pafot.findings.responsibility import position_reason, position_rule
from pytest_pafot.grid import Cell
from pytest_pafot.trace import Outcome
from tests.support.traces import collision_at, trace_of, vehicle


def crash(cell, ego_speed=20.0):
    hit = collision_at(30, cell=cell, ego_speed=ego_speed)
    return trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=30),
        vehicle(20.0, 4.0, speed=10.0, ticks=30),
        outcome=Outcome.COLLISION,
        collision=hit,
    )


@pytest.mark.parametrize("cell", [Cell.FRONT_LEFT, Cell.FRONT, Cell.FRONT_RIGHT])
def test_the_ego_is_responsible_for_hitting_what_is_ahead(cell):
    assert position_rule(crash(cell)) == "ego"
    assert position_reason(crash(cell)) == f"NPC 0 was ahead of the ego (cell {int(cell)}) at the impact"


@pytest.mark.parametrize("cell", [Cell.RIGHT, Cell.REAR_RIGHT, Cell.REAR, Cell.REAR_LEFT, Cell.LEFT])
def test_an_npc_beside_or_behind_is_responsible_itself(cell):
    assert position_rule(crash(cell)) == "npc"


@pytest.mark.parametrize("cell", list(Cell))
@pytest.mark.parametrize("speed", [0.0, 0.1])
def test_a_standing_ego_is_never_responsible(cell, speed):
    assert position_rule(crash(cell, ego_speed=speed)) == "npc"
    assert "standing" in position_reason(crash(cell, ego_speed=speed))


def test_a_creeping_ego_counts_as_driving():
    assert position_rule(crash(Cell.FRONT, ego_speed=0.11)) == "ego"


def test_without_a_collision_nobody_is_responsible():
    trace = trace_of(vehicle(0.0, ticks=10), vehicle(50.0, ticks=10))
    assert position_rule(trace) == "none"
    assert position_reason(trace) == "there was no collision"
