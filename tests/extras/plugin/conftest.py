"""The fixtures of the tests that run pytest in pytest."""

from tests.plugin.conftest import *  # noqa: F403
from tests.plugin.conftest import imported

imported("extras.revisions", "extras.sweeps")
