"""The fixtures of the tests that run pytest in pytest."""

from tests.plugin.conftest import *  # noqa: F403
