"""The project itself: which warnings are errors in its tests, its Python versions, and the shape of its code."""

import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import warnings
from collections import Counter
from pathlib import Path

import pytest

from tests.helpers.sessions import Copy, in_a_copy
from tests.test_layers import MODULES, ROOMS

ROOT = Path(__file__).parents[1]
OF_ONE_NAME = {
    "plan": "the scenarios of one search in their order, and the searches of a comparison",
    "session": "what a session of pytest holds for its items, and the record of what they say",
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
    result = in_a_copy(pytester, "-p", "noisy", "-p", "xdist", "-n", "1", "test_it.py")
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["*UserWarning: ran"])


FACTS = """
import os, signal, sys, tempfile
import planner

def test_it():
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGSEGV)]
    places = [os.getcwd(), sys.path[:2], planner.__file__, tempfile.gettempdir()]
    given = [sys.argv[1:], sys.orig_argv[1:], os.environ["NAME"], os.read(0, 9), os.read(int(os.environ["PIPE"]), 9)]
    print([places, given, handlers, os.getsid(0) == os.getpid(), sys.dont_write_bytecode])
"""
"""A test that tells what its process was given when it started."""


@pytest.mark.processes
@pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no copies without forking")
def test_copy_of_this_process_has_what_a_new_one_has(tmp_path, monkeypatch):
    present, other = tmp_path / "present", tmp_path / "other"
    for folder in (present, other):
        folder.mkdir()
        (folder / "planner.py").write_text("")
    (tmp_path / "test_it.py").write_text(FACTS)
    monkeypatch.syspath_prepend(present)
    assert importlib.import_module("planner").__file__ == str(present / "planner.py")
    monkeypatch.setattr(tempfile, "tempdir", str(present))
    command = [sys.executable, "-m", "pytest", "-qs", "-p", "no:cacheprovider", "test_it.py"]
    own = {
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "NAME": "a",
        "TMPDIR": str(other),
        "PYTHONPATH": str(other),
    }
    own["PYTHONDONTWRITEBYTECODE"] = "1"
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    told = []
    for kind in (subprocess.Popen, Copy):
        reader, writer = os.pipe()
        os.write(writer, b"passed")
        os.close(writer)
        given = {
            "cwd": tmp_path,
            "env": {**os.environ, **own, "PIPE": str(reader)},
            "pass_fds": [reader],
        }
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with kind(command, start_new_session=True, text=True, **given, **pipes) as process:
            out, err = process.communicate("typed")
        os.close(reader)
        told.append((process.returncode, err, out.partition("\n")[0]))
    assert told[0] == told[1]
    assert told[0][:2] == (0, "")


def test_wheels_are_built_for_every_supported_python_and_one_more():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    supported = re.findall(r"Python :: 3\.(\d+)", " ".join(project["project"]["classifiers"]))
    assert project["project"]["requires-python"] == f">=3.{supported[0]}"
    # One more, on which no test has run; docs/explanation/search.md says so, and the classifiers do not name it.
    assert project["tool"]["cibuildwheel"]["build"] == [
        f"cp3{minor}-*" for minor in [*supported, "14"]
    ]


def test_modules_with_equal_names_are_listed_exceptions():
    counted = Counter(path.stem for path in MODULES if path.name != "__init__.py")
    assert {name for name, count in counted.items() if count > 1} == set(OF_ONE_NAME)


def test_listed_long_tests_exist():
    for name in (ROOT / "tests" / "long.txt").read_text(encoding="utf-8").split():
        path, _, test = name.partition("::")
        assert f"def {test.split('::')[-1]}(" in (ROOT / path).read_text(encoding="utf-8"), name


def test_folders_of_tests_are_named_after_rooms():
    folders = {path.name for path in (ROOT / "tests").iterdir() if any(path.glob("test_*.py"))}
    assert folders <= {*ROOMS, "optional", "example_ads", "upgrade", "words"}
