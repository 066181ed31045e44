"""Runs of saved scenarios on a straight road and on bends, and the largest difference to what a reader has of them."""

from pathlib import Path

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.commands.policy_reference import ads_factory

FILES = Path(__file__).parents[1] / "corpus" / "saved"
POLICIES = {"collision-xfail": "constant_speed", "gym-merge": "idm_mobil", "gym-roundabout": "idm_mobil"}
"""Who drives in which file; the first and the last collide."""


@pytest.fixture(scope="session", params=POLICIES)
def exported(request):
    """A finding, and the trace of a run of it; or of a file with a policy, which ``tests.benchmarks.exports`` gives."""
    name = request.param
    file, policy = (FILES / f"{name}.pafot.yaml", POLICIES[name]) if isinstance(name, str) else name
    saved = pafot.load(file)
    return saved.finding, saved.replay(ads_factory(policy)).trace


def refuses():
    def drive(observation):
        raise RuntimeError("no plan")

    return drive


@pytest.fixture(scope="session")
def ended_at_once():
    """The same of a run that ends with the first decision of its ADS."""
    saved = pafot.load(FILES / "collision-xfail.pafot.yaml")
    trace = saved.replay(refuses).trace
    assert trace.ticks == 0
    return saved.finding, trace


@pytest.fixture
def largest(record_property):
    """Records and prints the largest difference of some arrays, by what they are, and gives it."""

    def of(name, one, other):
        difference = float(np.abs(np.asarray(one) - np.asarray(other)).max())
        record_property(name, difference)
        print(f"{name}: {difference:.1e}")
        return difference

    return of
