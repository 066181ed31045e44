"""The fixtures of the tests of searches."""

from tests.searching.conftest import *  # noqa: F403
