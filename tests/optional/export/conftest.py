"""Runs of saved scenarios on a straight road and in bends, and the largest difference to a reader's values."""

from pathlib import Path

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.commands.policy_reference import ads_factory
from pytest_pafot.model.trace import LANE

FILES = Path(__file__).parents[2] / "corpus" / "saved"
POLICIES = {
    "collision-xfail": "constant_speed",
    "gym-merge": "idm_mobil",
    "gym-roundabout": "idm_mobil",
}
"""The policy that drives in each file; the first and the last one collide."""
JUNCTION, BOTH_KINDS = "junction", "both kinds"
"""Stand-ins for files: two NPCs cross the way of an ego with a constant action, and one of them is hit; an NPC cuts in,
and another one leaves its cell on the grid."""


def at_junction():
    world = pafot.World("intersection-v0")
    told = (
        pafot.CrossingInstruction("o1>o3", 0.0, 8.0),
        pafot.CrossingInstruction("o3>o1", 1.0, 7.0),
    )
    scenario = pafot.Scenario(
        npcs=[[each] for each in told], ego_lane=0, ego_speed=world.crossings.ego_speed
    )
    return world.rollout(scenario, lambda: lambda observation: 1)


def of_both_kinds():
    lanes = pafot.LaneInstruction("right", 20.0), pafot.LaneInstruction("keep", 8.0)
    cells = pafot.PositionInstruction(2, 22.0), pafot.PositionInstruction(3, 22.0)
    trace = pafot.Highway(duration=8.0).rollout(
        pafot.Scenario(npcs=[lanes, cells], gene_seconds=4.0),
        lambda: lambda observation: (0.0, 0.0),
    )
    assert trace.states[0, 1, LANE] != trace.states[-1, 1, LANE]
    return trace


@pytest.fixture(scope="session", params=[*POLICIES, JUNCTION, BOTH_KINDS])
def exported(request):
    """Return a finding and its trace, for a saved file or a stand-in."""
    name = request.param
    if name in (JUNCTION, BOTH_KINDS):  # an exporter only needs the finding's id
        trace = at_junction() if name == JUNCTION else of_both_kinds()
        return pafot.load(FILES / "collision-xfail.pafot.yaml").finding, trace
    saved = pafot.load(FILES / f"{name}.pafot.yaml")
    return saved.finding, saved.replay(ads_factory(POLICIES[name])).trace


def refuses():
    def drive(observation):
        raise RuntimeError("no plan")

    return drive


@pytest.fixture(scope="session")
def ended_at_once():
    """Return a finding and a trace that ends with the first decision of its ADS."""
    saved = pafot.load(FILES / "collision-xfail.pafot.yaml")
    trace = saved.replay(refuses).trace
    assert trace.ticks == 0
    return saved.finding, trace


@pytest.fixture
def largest(record_property):
    """Record, print and return the largest difference of some arrays, by name."""

    def of(name, one, other):
        difference = float(np.abs(np.asarray(one) - np.asarray(other)).max())
        record_property(name, difference)
        print(f"{name}: {difference:.1e}")
        return difference

    return of
