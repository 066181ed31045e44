"""The project itself: what counts as an error in its tests, for which Pythons it is made, and the shape of its code."""

import ast
import re
import shutil
import statistics
import tomllib
import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from tests.test_layers import MODULES, ROOMS

ROOT = Path(__file__).parents[1]
OF_ONE_NAME = {
    "events": "what a campaign of generations yields, and what a whole search tells",
    "loop": "of a search over its scenarios, and of a run over its ticks",
}
"""Why modules of different rooms are called alike."""
BLOCKS = (ast.If, ast.For, ast.While, ast.With, ast.Try, ast.Match)


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


@cache
def trees():
    """Every module of the package with what it says."""
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in MODULES}


def functions():
    """Every function and method of the package with the file that it is in."""
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                yield path, node


def repeated(names):
    return {name for name, count in Counter(names).items() if count > 1}


def nesting(node, depth=0):
    """How many blocks stand inside of each other at most; ``elif`` is no block inside of ``if``."""
    deepest = depth
    for child in ast.iter_child_nodes(node):
        is_elif = isinstance(node, ast.If) and isinstance(child, ast.If) and node.orelse == [child]
        deepest = max(deepest, nesting(child, depth + (isinstance(child, BLOCKS) and not is_elif)))
    return deepest


def test_functions_are_short_and_nest_little():
    assert statistics.median(node.end_lineno - node.lineno + 1 for _, node in functions()) <= 7
    assert [f"{path.name}: {node.name}" for path, node in functions() if nesting(node) > 4] == []


def test_few_private_functions_are_used_only_once():
    read = Counter()
    for path, tree in trees().items():
        nodes = list(ast.walk(tree))
        read.update((path, node.id) for node in nodes if isinstance(node, ast.Name))
        read.update((path, node.attr) for node in nodes if isinstance(node, ast.Attribute))
    named = [(path, node.name) for path, node in functions()]
    used_once = [each for each in named if re.match(r"_[^_]", each[1]) and read[each] == 1]
    assert len(used_once) <= len(named) / 5, "a helper that is read in one place is better written there"


def test_no_two_classes_have_one_name():
    assert (
        repeated(node.name for tree in trees().values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
        == set()
    )


def test_modules_of_one_name_are_few_and_have_a_reason():
    assert repeated(path.stem for path in MODULES if path.name != "__init__.py") == set(OF_ONE_NAME)


def test_the_folders_of_tests_are_named_after_what_they_test():
    folders = {path.name for path in (ROOT / "tests").iterdir() if any(path.glob("test_*.py"))}
    assert folders <= {*ROOMS, "example_ads"}
