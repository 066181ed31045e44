"""A comparison that takes a second: short scenarios of the constant-speed policy."""

import io

import pytest

from pytest_pafot.comparison.plan import Plan
from pytest_pafot.world import Highway


@pytest.fixture(scope="session")
def quick():
    """Return a function that makes a short plan with changed fields."""

    def plan(**changes):
        fields = {
            "ads": "constant_speed",
            "algorithms": ("pafot", "av-fuzzer", "random"),
            "runs": 2,
            "generations": 3,
            "world": Highway(duration=20.0).to_dict(),
            "space": {"npcs": 2, "genes": 2, "gene_seconds": 10.0},
        }
        return Plan(**(fields | changes))

    return plan


@pytest.fixture
def quiet():
    """Return a stream for progress."""
    return io.StringIO()
