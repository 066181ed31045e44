"""The project itself: what counts as an error in its tests, and for which Pythons it is made."""

import re
import shutil
import tomllib
import warnings
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_every_warning_is_an_error():
    with pytest.raises(UserWarning, match="any"):
        warnings.warn("any", stacklevel=1)


def test_a_plugin_that_warns_while_it_is_configured_does_not_end_the_session(pytester, monkeypatch):
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    for name in ("conftest.py", "pyproject.toml"):
        shutil.copy(ROOT / name, pytester.path)
    pytester.makepyfile(
        noisy="import warnings\n\ndef pytest_configure():\n    warnings.warn('configured')\n",
        test_it="import warnings\n\ndef test_quiet(): pass\n\ndef test_noisy(): warnings.warn('ran')\n",
    )
    result = pytester.runpytest_subprocess("-p", "noisy", "-p", "xdist", "-n", "1", "test_it.py")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*UserWarning: ran"])


def test_wheels_are_built_for_every_python_that_is_supported():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    supported = re.findall(r"Python :: 3\.(\d+)", " ".join(project["project"]["classifiers"]))
    assert project["project"]["requires-python"] == f">=3.{supported[0]}"
    assert project["tool"]["cibuildwheel"]["build"] == [f"cp3{minor}-*" for minor in supported]
