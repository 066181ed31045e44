"""A session's imports for the plugin, and the plugin's use of pytest."""

import ast
import dataclasses
import importlib
import inspect
import json
from pathlib import Path

import pytest_pafot
import pytest_pafot.plugin

SOURCES = sorted(Path(pytest_pafot.plugin.__file__).parent.glob("*.py"))


UNUSED = (
    "searches", "searches.options", "corpus", "corpus.layout", "support", "support.errors",
    "plugin", "plugin.collection", "plugin.session",
    "report", "report.session",
)  # fmt: skip
"""The modules that every pytest session imports where the plugin is installed. Each costs it some time."""

MODULES = """
import inspect, json, sys

def test_modules():
    for name, module in list(sys.modules.items()):
        if name.startswith("pytest_pafot"):
            inspect.getmembers(module)
    with open({name!r}, "w") as file:
        json.dump(sorted(sys.modules), file)
"""


def test_session_without_marked_tests_imports_no_other_module(project):
    project.pytester.makeconftest("")
    found = []
    # Another plugin is in both, because pytest reads a package's metadata for the first installed plugin.
    for name, options in (
        ("with.json", ["-p", "xdist", "-p", "pafot"]),
        ("without.json", ["-p", "xdist"]),
    ):
        project.pytester.makepyfile(test_it=MODULES.format(name=name))
        project.pytester.runpytest_subprocess(*options).assert_outcomes(passed=1)
        found.append(set(json.loads((project.path / name).read_text())))
    gained = found[0] - found[1]
    assert {name for name in gained if name != "pytest_pafot"} == {
        f"pytest_pafot.{name}" for name in UNUSED
    }


def test_session_without_marked_tests_makes_few_data_classes():
    """Each costs more time than the import of its module, and each of its methods as much as the class itself."""
    modules = [importlib.import_module(f"pytest_pafot.{name}") for name in UNUSED]
    own = (each for module in modules for each in vars(module).values() if inspect.isclass(each))
    made = {each for each in own if dataclasses.is_dataclass(each)}
    assert {each.__name__ for each in made} == {"Settings"}
    assert not any("__repr__" in vars(each) or "__eq__" in vars(each) for each in made)


def test_search_imports_neither_hypothesis_nor_page(project):
    project.write("""
import atexit, json, sys

@pafot.search(SHORT, ads=lambda: lambda observation: (0.0, 0.0))  # stop_after=1
def test_fails(run):
    assert run.duration < 1

def dump():
    with open("modules.json", "w") as file:
        json.dump(sorted(sys.modules), file)

atexit.register(dump)
""")
    project.pytester.makeconftest("")
    project.run(fresh=True).assert_outcomes(failed=2)
    names = set(json.loads((project.path / "modules.json").read_text()))
    assert "hypothesis" not in names
    own = {name for name in names if name.startswith("pytest_pafot.report")}
    assert own == {
        f"pytest_pafot.report{each}" for each in ("", ".messages", ".session", ".terminal")
    }
    assert "pytest_pafot.report.views" not in names


def test_the_plugin_uses_no_private_names_of_pytest():
    assert not {path.name: set(names) for path in SOURCES if (names := private_names(path))}


def private_names(path):
    """Return the private modules and attributes of other packages that a module uses."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported += [
        alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    ]
    attributes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    private = [
        node.attr
        for node in attributes
        if node.attr.startswith("_")
        and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    ]
    of_python = ("_exit", "_current_frames")  # documented by Python, in os and sys
    return [
        *(name for name in imported if name.split(".")[0] == "_pytest"),
        *(name for name in private if not name.startswith("__") and name not in of_python),
        *(node.attr for node in attributes if node.attr == "callspec"),
    ]
