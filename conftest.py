"""Configuration of the project's own tests."""

import pytest
from hypothesis import HealthCheck, settings

pytest_plugins = ["pytester"]

# The same examples in every session; with --hypothesis-profile=fresh others, which --hypothesis-seed=N repeats.
settings.register_profile(
    "project", derandomize=True, deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("fresh", settings.get_profile("project"), derandomize=False)
settings.load_profile("project")


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """From here on every warning is an error; of what other plugins warn while they are configured is their matter."""
    config.addinivalue_line("filterwarnings", "error")
