"""The tests of extras, which are a stage of their own; tests/test_extras.py has in short what each extra promises."""

import pytest

from tests.helpers.sessions import copied_workers


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Add the mark of the stage to each test in this folder."""
    for item in items:
        if item.path.is_relative_to(__file__.rpartition("/")[0]):
            item.add_marker("extras")


@pytest.fixture
def copies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the workers of a command be copies of this process. At least one test of each room starts new ones."""
    copied_workers(monkeypatch)
