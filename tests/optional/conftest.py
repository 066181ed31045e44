"""The tests that need optional libraries are a stage of their own."""

import pytest

from tests.helpers.sessions import copied_workers


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Add the mark of the stage to each test in this folder."""
    for item in items:
        if item.path.is_relative_to(__file__.rpartition("/")[0]):
            item.add_marker("optional")


@pytest.fixture
def copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the workers of a command be copies of this process. At least one test of each room starts new ones."""
    copied_workers(monkeypatch)
