"""What is said of names that cannot be imported, of git, of the compiled kernel and of shares."""

import re
from pathlib import Path

import pytest

from pytest_pafot.support import compiled
from pytest_pafot.support.files import git, open_regular
from pytest_pafot.support.proportions import none_text
from pytest_pafot.support.references import factory_named, imported
from tests.helpers.refusals import error_of
from tests.support.test_compiled import CHANGES, package  # noqa: F401
from tests.support.test_git import IMPOSSIBLE
from tests.support.test_references import WRONG, modules  # noqa: F401


@pytest.mark.usefixtures("modules")
def test_name_that_cannot_be_imported_is_told_with_its_cause(snapshot):
    told = {reference: error_of(factory_named, reference) for reference in WRONG}
    assert told | {"no module": error_of(imported, ":x")} == snapshot


def test_what_differs_from_what_was_compiled_is_told(snapshot, package):  # noqa: F811
    change, _ = CHANGES[4]
    change(package)
    assert compiled.why_interpreted() == snapshot


def test_files_and_arguments_that_are_refused_are_told(snapshot, tmp_path):
    told = {
        f"{given}": error_of(git, Path(given[0]), "rev-parse", given[1]) for given in IMPOSSIBLE
    }
    (tmp_path / "link").symlink_to("loop")
    told |= {name: error_of(open_regular, tmp_path / name, "rb") for name in ("link", ".")}
    # Python's versions differ in the words on null bytes
    told = {
        name: re.sub("embedded null .*[)]", "NULL)", f"{error}") for name, error in told.items()
    }
    assert told | {"share": none_text(150)} == snapshot
