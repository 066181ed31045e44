"""The project itself: which warnings are errors in its tests, its Python versions, and the shape of its code."""

import re
import shutil
import tomllib
import warnings
from collections import Counter
from pathlib import Path

import pytest

from tests.helpers.tables import table
from tests.test_layers import MODULES, ROOMS

ROOT = Path(__file__).parents[1]
OF_ONE_NAME = {
    "events": "what a campaign of generations yields, and what a whole search tells",
    "plan": "the scenarios of one search in their order, and the searches of a comparison",
    "run": "a finished run as checks read it, and a run of the world that proceeds",
}
"""The reasons why modules of different rooms have the same name."""


def test_every_warning_is_an_error():
    with pytest.raises(UserWarning, match="any"):
        warnings.warn("any", stacklevel=1)


@pytest.mark.processes
def test_warning_of_a_plugin_does_not_end_session(pytester, monkeypatch):
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    for name in ("conftest.py", "pyproject.toml"):
        shutil.copy(ROOT / name, pytester.path)
    pytester.mkdir("tests").joinpath("long.txt").write_text("")
    pytester.makepyfile(
        noisy="import warnings\n\ndef pytest_configure():\n    warnings.warn('configured')\n",
        test_it="import warnings\n\ndef test_quiet(): pass\n\ndef test_noisy(): warnings.warn('ran')\n",
    )
    result = pytester.runpytest_subprocess("-p", "noisy", "-p", "xdist", "-n", "1", "test_it.py")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*UserWarning: ran"])


def test_wheels_are_built_for_every_supported_python_and_one_more():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    supported = re.findall(r"Python :: 3\.(\d+)", " ".join(project["project"]["classifiers"]))
    assert project["project"]["requires-python"] == f">=3.{supported[0]}"
    # One more, on which no test has run; docs/guide/limits.md says so, and the classifiers do not name it.
    assert project["tool"]["cibuildwheel"]["build"] == [f"cp3{minor}-*" for minor in [*supported, "14"]]


def repeated(names):
    return {name for name, count in Counter(names).items() if count > 1}


def test_modules_with_equal_names_are_listed_exceptions():
    assert repeated(path.stem for path in MODULES if path.name != "__init__.py") == set(OF_ONE_NAME)


def test_listed_long_tests_exist():
    for name in (ROOT / "tests" / "long.txt").read_text(encoding="utf-8").split():
        path, _, test = name.partition("::")
        assert f"def {test.split('::')[-1]}(" in (ROOT / path).read_text(encoding="utf-8"), name


def test_folders_of_tests_are_named_after_rooms():
    folders = {path.name for path in (ROOT / "tests").iterdir() if any(path.glob("test_*.py"))}
    assert folders <= {*ROOMS, "extras", "example_ads"}


def test_table_runs_every_row_and_names_failures():
    seen = []

    @table(("one", "other"), [(1, 1), (1, 2), (3, 4)])
    def equal(one, other):
        seen.append(one)
        assert one == other

    with pytest.raises(BaseExceptionGroup, match="2 of 3 rows fail") as caught:
        equal()
    assert seen == [1, 1, 3]
    assert [error.__notes__ for error in caught.value.exceptions] == [["with one=1, other=2"], ["with one=3, other=4"]]
