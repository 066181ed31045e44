"""The fixtures of the tests that run pytest in pytest."""

from tests.plugin.conftest import *
from tests.plugin.conftest import imported

imported("extras.revisions", "extras.sweeps")
