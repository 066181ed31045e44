"""Runs of saved scenarios on a straight road and in bends, and the largest difference to a reader's values."""

from pathlib import Path

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.commands.policy_reference import ads_factory

FILES = Path(__file__).parents[1] / "corpus" / "saved"
POLICIES = {"collision-xfail": "constant_speed", "gym-merge": "idm_mobil", "gym-roundabout": "idm_mobil"}
"""The policy that drives in each file; the first and the last one collide."""
JUNCTION = "junction"
"""A stand-in for a file: two NPCs cross the way of an ego with a constant action, and one of them is hit."""


def at_junction():
    world = pafot.World("intersection-v0")
    told = pafot.CrossingInstruction("o1>o3", 0.0, 8.0), pafot.CrossingInstruction("o3>o1", 1.0, 7.0)
    scenario = pafot.Scenario(npcs=[[each] for each in told], ego_lane=0, ego_speed=world.crossings.ego_speed)
    return world.rollout(scenario, lambda: lambda observation: 1)


@pytest.fixture(scope="session", params=[*POLICIES, JUNCTION])
def exported(request):
    """Return a finding and its trace, for a built-in file or one that ``tests.benchmarks.exports`` gives."""
    name = request.param
    if name == JUNCTION:  # an exporter only needs the finding's id
        return pafot.load(FILES / "collision-xfail.pafot.yaml").finding, at_junction()
    file, policy = (FILES / f"{name}.pafot.yaml", POLICIES[name]) if isinstance(name, str) else name
    saved = pafot.load(file)
    return saved.finding, saved.replay(ads_factory(policy)).trace


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
