"""Runs made by hand: without a collision, and with one that the ego or the NPC is responsible for."""

from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import Outcome
from tests.helpers.traces import collision_at, scenario_of, trace_of, vehicle


def closing(ticks=30, **fields):
    """Return a run with the ego at 20 m/s behind an NPC at 10 m/s in its lane, and an NPC far behind on the left."""
    return trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=ticks),
        vehicle(26.0, 4.0, speed=10.0, ticks=ticks),
        vehicle(-80.0, 0.0, speed=20.0, ticks=ticks),
        scenario=scenario_of(2),
        **fields,
    )


def running_into():
    """Return a run in which the ego runs into the NPC ahead and is responsible."""
    return closing(outcome=Outcome.COLLISION)


def rammed():
    """Return a run in which an NPC at 30 m/s hits the rear of the ego at 20 m/s and is responsible."""
    hit = collision_at(30, cell=Cell.REAR, side="rear", npc_speed=30.0)
    ego, npc = vehicle(0.0, 4.0, speed=20.0, ticks=30), vehicle(-25.0, 4.0, speed=30.0, ticks=30)
    return trace_of(ego, npc, outcome=Outcome.COLLISION, collision=hit)
