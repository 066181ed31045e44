"""Edge cases 12, 16, 18, 19 and 20: foreign randomness, empty searches, import cost, short texts, private names."""

import ast
import json
import re
from pathlib import Path

import pytest

import pytest_pafot
import pytest_pafot.plugin

SOURCES = sorted(Path(pytest_pafot.plugin.__file__).parent.glob("*.py"))


def test_a_search_in_which_no_scenario_gave_a_valid_run_fails(project):
    project.write("@pafot.search(SHORT)\ndef test_rejects_all(run):\n    pafot.reject()\n")
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["the search tested nothing:", "*none of * simulated scenarios gave a valid run*"])


def test_health_warnings_are_shown_and_fail_only_when_asked(project):
    project.write(
        """
def parked():
    return lambda observation: (-8.0, 0.0)

@pafot.search(genes=4, gene_seconds=10, ads=parked)
def test_parked(run):
    pass
"""
    )
    result = project.run(generations=2)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["  warning: *"])
    result = project.run("--pafot-strict-health", generations=2)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["health warnings (--pafot-strict-health):*"])


def test_an_ego_that_collides_before_anybody_can_have_caused_it_is_a_health_warning(project):
    project.write(
        """
def swerving():
    return lambda observation: (0.0, 1.0)

@pafot.search(npcs=8, genes=2, gene_seconds=5, ego_lane=1, ads=swerving)
def test_swerves(run):
    pass
"""
    )
    result = project.run(generations=2)
    result.stdout.fnmatch_lines(["  warning: * valid runs collided within the first*"])


def test_other_plugins_randomness_changes_nothing(project):
    pytest.importorskip("pytest_randomly")
    project.write(
        "@pafot.search(SHORT)\ndef test_a(run):\n    assert run.scenario.id == ''\n\ndef test_b():\n    pass\n"
    )
    project.run(generations=2)
    plain = project.contents
    for name in plain:
        (project.path / name).unlink()
    project.run(generations=2, plugins=("randomly",))
    assert project.contents == plain


MODULES = """
import json, sys

def test_modules():
    with open({name!r}, "w") as file:
        json.dump(sorted(sys.modules), file)
"""


def test_a_session_without_marked_tests_imports_nothing_but_the_plugin(project):
    project.pytester.makeconftest("")
    found = []
    # With another plugin in both: for the first that is installed as a package, pytest reads that package's metadata.
    for name, options in (("with.json", ["-p", "xdist", "-p", "pafot"]), ("without.json", ["-p", "xdist"])):
        project.pytester.makepyfile(test_it=MODULES.format(name=name))
        project.pytester.runpytest_subprocess(*options).assert_outcomes(passed=1)
        found.append(set(json.loads((project.path / name).read_text())))
    gained = found[0] - found[1]
    light = {"pytest_pafot", "pytest_pafot.campaign", "pytest_pafot.campaign.options"}
    light |= {"pytest_pafot.corpus", "pytest_pafot.corpus.layout", "pytest_pafot.corpus.saved"}
    assert {name for name in gained if not name.startswith("pytest_pafot.plugin")} <= light


def test_a_session_that_only_lists_marked_tests_does_not_wait_for_the_simulation(project):
    project.pytester.makeconftest(
        """
import sys

def pytest_unconfigure():
    print("heavy:", *sorted({"numpy", "highway_env", "gymnasium", "yaml"} & set(sys.modules)))
"""
    )
    project.write("@pafot.search\ndef test_a(run):\n    pass\n")
    result = project.run("--collect-only", subprocess=True)
    result.stdout.fnmatch_lines(["pafot: 1 search, 0 saved scenarios*", "*test_a[[]search[]]*", "heavy:"])


def test_the_plugin_does_not_import_hypothesis(project):
    project.pytester.makeconftest("")
    project.write(
        """
import sys

@pafot.search(SHORT, ads=lambda: lambda observation: (0.0, 0.0))
def test_a(run):
    assert "hypothesis" not in sys.modules
"""
    )
    project.run(subprocess=True).assert_outcomes(passed=1)


def test_a_run_is_short_in_the_header_of_a_traceback(failing):
    (header,) = re.findall(r"^run = .*$", failing.run("-v").stdout.str(), re.MULTILINE)
    assert len(header) < 80


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_the_plugin_uses_no_private_names_of_pytest(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    imported = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    assert not [name for name in imported if name.split(".")[0] == "_pytest"]
    attributes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr.startswith("_")]
    foreign = [
        node.attr for node in attributes if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    ]
    of_python = ("_exit", "_current_frames")  # documented, of os and sys
    assert [name for name in foreign if not name.startswith("__") and name not in of_python] == []
    assert not [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr == "callspec"]


def test_the_output_is_ascii_and_its_own_lines_fit_in_80_columns(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    project.write("@pafot.search(SHORT)\ndef test_a(run):\n    pass\n")
    lines = project.run("-v", generations=2).outlines
    section = lines[next(index for index, line in enumerate(lines) if " pafot " in line) :]
    assert all(line.isascii() for line in section)
    assert max(map(len, section)) <= 80
