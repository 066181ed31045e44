"""Calls of git with texts that it cannot have."""

from pathlib import Path

import pytest

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import git
from tests.helpers.tables import table

IMPOSSIBLE = [(".", "a\0b"), ("c\0d", "a"), (".", "e\ud800")]


@table("folder, argument", IMPOSSIBLE)
def test_a_text_that_no_command_line_can_have_is_refused(folder, argument):
    with pytest.raises(RequestError):
        git(Path(folder), "rev-parse", argument)
