"""A comparison that takes a second: short scenarios of the constant-speed policy."""

import pytest

from pytest_pafot.comparison.plan import Plan


@pytest.fixture(scope="session")
def quick():
    """Return a function that makes a short plan with changed fields."""

    def plan(**changes):
        fields = {
            "ads": "constant_speed",
            "algorithms": ("pafot", "av-fuzzer", "random"),
            "runs": 2,
            "seconds": 200.0,
            "duration": 20.0,
        }
        return Plan(**(fields | changes))

    return plan
