"""Requirements that marks name: who inherits what, and where a session says it."""

import json
import os
import sys
from xml.etree import ElementTree

import pytest

from pytest_pafot.commands.inventory import Inventory
from pytest_pafot.report.page import requirement_section
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.traced import Traced

INHERITED = '''
"""The planner.

More."""

pytestmark = pytest.mark.pafot(owner="planning")

@pafot.search(SHORT, requirement="REQ-1")
def test_own(run):
    """It causes no collision."""

@pafot.search(SHORT, requirement=["REQ-2", "REQ-3"], title="It brakes softly", owner="control")
class TestBraking:
    """Not the title."""

    def test_inherits(self, run):
        """Not the title either."""

    @pytest.mark.pafot(requirement="REQ-4")
    def test_overrides(self, run):
        """It stops."""

@pytest.mark.pafot(requirement="REQ-5")
def test_plain():
    pass

@pytest.mark.pafot(title="Without a requirement")
def test_without():
    pass
'''

SESSION = """
@pafot.search(SHORT, stop_after=1, requirement=["REQ-1", "REQ-2"], title="It keeps away", owner="planning")
def test_fails(run):
    assert run.duration < 1

@pytest.mark.pafot(requirement="REQ-3")
def test_plain():
    assert False
"""


def inventory(project):
    plugins = ["pytest_pafot.plugin.inventory_session"]
    project.run("--collect-only", "--inventory-to=inventory.json", plugins=plugins)
    return json.loads((project.path / "inventory.json").read_text())


def test_closest_mark_counts_for_each_argument(project):
    project.write(INHERITED)
    tests = inventory(project)["tests"]
    names = ("requirements", "title", "owner")
    told = {test.rpartition("::")[2]: tuple(each[name] for name in names) for test, each in tests.items()}
    assert told == {
        "test_own": (["REQ-1"], "It causes no collision", "planning"),
        "test_inherits": (["REQ-2", "REQ-3"], "It brakes softly", "control"),
        "test_overrides": (["REQ-4"], "It stops", "control"),
        "test_plain": (["REQ-5"], "", "planning"),
        "test_without": ([], "", "planning"),
    }


def test_inventory_names_files_by_their_tests_and_orphans(project):
    project.write(SESSION)
    project.run_once()
    (file,) = project.files
    assert inventory(project)["files"] == {file: "test_it.py::test_fails"}
    project.write("def test_other():\n    pass\n")
    found = inventory(project)
    assert found["files"] == {}
    assert list(found["orphans"]) == [file]


@pytest.mark.parametrize("options", [(), ("-n2",)], ids=["one process", "two workers"])
def test_session_names_the_requirement_in_every_report(project, monkeypatch, options):
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(project.path / "summary.md"))
    project.write(SESSION)
    files = ("--pafot-json=a.json", "--pafot-table=a.csv", "--pafot-report=a.html", "--junitxml=a.xml")
    result = project.run(*files, *options)
    result.stdout.fnmatch_lines(["  REQ-1, REQ-2: It keeps away (owner planning)"])
    result.stdout.fnmatch_lines(["FAILED test_it.py::test_fails?saved-*? - REQ-1, REQ-2: *"])
    result.stdout.fnmatch_lines(["FAILED test_it.py::test_plain - REQ-3: *"])
    data = json.loads((project.path / "a.json").read_text())
    named = {"requirements": ["REQ-1", "REQ-2"], "title": "It keeps away", "owner": "planning"}
    for entry in (*data["searches"], *data["findings"]):
        assert {name: entry[name] for name in named} == named
    assert [(each["node_id"], each["result"], each["requirements"]) for each in data["tests"]] == [
        ("test_it.py::test_plain", "failed", ["REQ-3"])
    ]
    assert (project.path / "a.csv").read_text().count('"REQ-1, REQ-2"') == data["searches"][0]["runs"]
    properties = [
        {(each.get("name"), each.get("value")) for each in case.iter("property")}
        for case in ElementTree.parse(project.path / "a.xml").getroot().iter("testcase")
    ]
    ours = {("requirement", "REQ-1"), ("requirement", "REQ-2"), ("requirements", "REQ-1,REQ-2"), ("owner", "planning")}
    assert sum(ours <= each for each in properties) == 2
    summary = (project.path / "summary.md").read_text()
    assert "- `REQ-1` It keeps away (planning): 1 failure\n" in summary
    page = (project.path / "a.html").read_text()
    assert "<td>It keeps away</td><td>planning</td><td>1 failure</td>" in page
    assert "REQ-1, REQ-2: It keeps away (owner planning): test_fails <span" in page


def test_session_without_requirements_says_nothing_of_them(failing):
    result = failing.run("--pafot-json=a.json", "--pafot-report=a.html", "--junitxml=a.xml")
    assert "REQ" not in result.stdout.str()
    assert "owner" not in result.stdout.str()
    assert json.loads((failing.path / "a.json").read_text())["tests"] == []
    assert 'name="requirement' not in (failing.path / "a.xml").read_text()
    assert 'id="requirements"' not in (failing.path / "a.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("requirement=1", "requirement: expected an id such as *, received 1"),
        ("requirement='a,b'", "requirement: expected an id such as *, received 'a,b'"),
        ("requirement=['']", "requirement: expected an id such as *, received ''"),
        ("title='a\\nb'", "title: expected a text of at most 300 printable characters, received 'a\\nb'"),
        ("owner=5", "owner: expected a text of at most 300 printable characters, received 5"),
    ],
)
def test_wrong_argument_fails_only_its_item(project, arguments, message):
    project.write(f"@pafot.search(SHORT, {arguments})\ndef test_it(run):\n    pass\n\ndef test_other():\n    pass\n")
    result = project.run()
    result.assert_outcomes(errors=1, passed=1)
    result.stdout.fnmatch_lines([f"*{message.replace('[', '?')}*"])


def test_page_escapes_texts_of_requirements():
    told = Traced(requirements=("<b>",), title="<script>", owner='"><img src=x>')
    section = requirement_section([(told, 1)])
    assert "<script>" not in section
    assert "<img" not in section
    assert "<b>" not in section


def test_wrong_argument_of_the_mark_itself_fails_its_item(project):
    project.write("@pytest.mark.pafot(requirment='R')\ndef test_it():\n    pass\n")
    result = project.run()
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*pytest.mark.pafot: expected requirement, title, owner by name, *requirment=*"])


def test_mark_of_a_hook_is_seen_and_docstring_of_a_base_class_is_no_title(project):
    project.write(
        "class Base:\n    'Of the base.'\n\n@pytest.mark.pafot(requirement='R1')\nclass TestIt(Base):\n"
        "    def test_it(self):\n        assert False\n\ndef test_other():\n    assert False\n"
    )
    (project.path / "conftest.py").write_text(
        "import pytest\n\ndef pytest_collection_modifyitems(items):\n"
        "    items[-1].add_marker(pytest.mark.pafot(requirement='R2'))\n"
    )
    project.run("--pafot-json=a.json")
    tests = json.loads((project.path / "a.json").read_text())["tests"]
    assert [(each["requirements"], each["title"]) for each in tests] == [(["R1"], ""), (["R2"], "")]


@pytest.mark.processes
@pytest.mark.parametrize(
    ("source", "option"),
    [("raise KeyboardInterrupt", None), ("raise SystemExit(0)", None), ("def test_it(): pass", "nowhere")],
)
def test_inventory_of_a_session_that_was_broken_off_is_refused(project, monkeypatch, source, option):
    project.write(source)
    monkeypatch.chdir(project.path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    with pytest.raises(RequestError, match="expected pytest to collect the tests here"):
        Inventory.collected([] if option is None else [option])


@pytest.mark.processes
def test_inventory_has_what_a_selection_leaves_out(project, monkeypatch):
    project.write(SESSION)
    (project.path / "pytest.ini").write_text("[pytest]\naddopts = -k nothing\n")
    monkeypatch.chdir(project.path)
    assert set(Inventory.collected().tests) == {"test_it.py::test_fails", "test_it.py::test_plain"}
