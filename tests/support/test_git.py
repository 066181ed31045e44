"""Calls of git with texts that it cannot have."""

from pathlib import Path

import pytest

from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import git
from tests.helpers.tables import table


@table("folder, argument, message", [
    (".", "a\0b", r"received 'a\\x00b' \(embedded null .*\)\. Use another name"),
    ("c\0d", "a", r"received 'c\\x00d' \(embedded null .*\)\. Use another name"),
    (".", "e\ud800", r"received 'e\\ud800' \(.*surrogates not allowed\)\. Use another name"),
])  # fmt: skip
def test_a_text_that_no_command_line_can_have_is_named(folder, argument, message):
    with pytest.raises(RequestError, match=message):
        git(Path(folder), "rev-parse", argument)
