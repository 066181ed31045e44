"""The fixtures of the tests that run pytest in pytest."""

from tests.helpers.sessions import imported
from tests.plugin.conftest import *  # noqa: F403

imported("extras.sweeps")
