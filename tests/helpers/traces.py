"""Traces made by hand from positions."""

from __future__ import annotations

import numpy as np

from pytest_pafot.attribution.responsibility import Attribution
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Collision, Lane, Outcome, Trace
from pytest_pafot.oracle.run import Run

LENGTH, WIDTH, LANE_WIDTH = 5.0, 2.0, 4.0


def ring_distance(a, b):
    """Return the number of steps along the ring from one cell to another, 0 to 4."""
    clockwise = (b - a) % 8
    return min(clockwise, 8 - clockwise)


def scenario_of(npcs=1, *, genes=6, gene_seconds=10.0):
    """Return a scenario whose NPCs stay in one cell each for the whole time."""
    chains = [[PositionInstruction(Cell(npc + 1), 20.0)] * genes for npc in range(npcs)]
    return Scenario(npcs=chains, gene_seconds=gene_seconds)


def straight_lanes(count=4, *, heading=0.0, width=LANE_WIDTH, speed_limit=26.8):
    """Return parallel lanes, from the left, whose centre lines are at y = 0, 4, 8 ... for heading 0."""
    common = {"heading": heading, "length": 10_000.0, "width": width, "speed_limit": speed_limit}
    across = [width * index for index in range(count)]
    return tuple(
        Lane(x=-np.sin(heading) * each, y=np.cos(heading) * each, **common) for each in across
    )


def vehicle(x, y=0.0, *, heading=0.0, speed=0.0, acceleration=0.0, lane=None, ticks=None):
    """Return the states of a vehicle, shape [ticks + 1, 7]; scalars stay constant.

    With ``ticks`` and scalar positions, the vehicle drives on at constant velocity at 15 Hz. By default, the lane is
    the one that contains y; lanes are 4 m wide, and the first is centred on y = 0.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if ticks is not None:
        times = np.arange(ticks + 1) / 15
        x, y = x + times * speed * np.cos(heading), y + times * speed * np.sin(heading)
    lanes = np.round(y / LANE_WIDTH) if lane is None else lane
    return np.stack(
        np.broadcast_arrays(*np.atleast_1d(x, y, heading, speed, acceleration, 0.0, lanes)), axis=-1
    )


def trace_of(
    ego,
    *npcs,
    sizes=None,
    scenario=None,
    outcome=Outcome.COMPLETED,
    physics_hz=15,
    lanes=None,
    **fields,
):
    """Return a trace of vehicles from :func:`vehicle`; with the outcome ``collision``, NPC 0 is hit by default."""
    rows = max(len(states) for states in (ego, *npcs))
    states = np.stack([np.broadcast_to(states, (rows, 7)) for states in (ego, *npcs)], axis=1)
    scenario = scenario or scenario_of(max(len(npcs), 1))
    if outcome == Outcome.COLLISION:
        fields.setdefault("collision", collision_at(rows - 1, physics_hz=physics_hz))
    return Trace(
        scenario=scenario,
        executed=scenario,
        outcome=outcome,
        states=states,
        sizes=np.full((states.shape[1], 2), (LENGTH, WIDTH))
        if sizes is None
        else np.asarray(sizes, dtype=float),
        lanes=straight_lanes() if lanes is None else lanes,
        physics_hz=physics_hz,
        ads_hz=fields.pop("ads_hz", 5),
        **fields,
    )


def collision_at(
    tick, *, npc=0, cell=Cell.FRONT, side="front", physics_hz=15, ego_speed=20.0, npc_speed=10.0
):
    """Return a collision, by default with the ego's front."""
    return Collision(
        tick=tick, time=tick / physics_hz, npc=npc, side=side, cell=cell,
        ego_speed=ego_speed, npc_speed=npc_speed, closing_speed=abs(ego_speed - npc_speed),
    )  # fmt: skip


def random_states(rng, rows, vehicles, *, spread=25.0):
    """Return random states of vehicles in a square, with any heading and lane."""
    states = np.zeros((rows, vehicles, 7))
    states[..., 0:2] = rng.uniform(-spread, spread, (rows, vehicles, 2))
    states[..., 2] = rng.uniform(-np.pi, np.pi, (rows, vehicles))
    states[..., 3] = rng.uniform(0, 30, (rows, vehicles))
    states[..., 4] = rng.uniform(-8, 5, (rows, vehicles))
    states[..., 6] = rng.integers(-1, 4, (rows, vehicles))
    return states


def blamed_on(responsible, trace):
    """Return a run for whose collision some vehicles are responsible, whatever the rules say."""
    run = Run(trace)
    # as if it had been read
    vars(run)["attribution"] = Attribution(responsibility=responsible, tick=None, time=None)
    return run
