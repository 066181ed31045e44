"""Plugins of the kind of allure-pytest's and of VS Code's, which learn of tests from the hooks of items."""

import json

import pytest

LISTENER = """
import json
import pytest


class Listener:
    def __init__(self):
        self.seen = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item):
        self.seen[item.nodeid] = {"run": item.callspec.params["run"]}
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item, call):
        report = yield
        message = call.excinfo.exconly() if call.excinfo else ""
        self.seen[item.nodeid].setdefault(call.when, []).append([report.outcome, message])
        return report

    def pytest_runtest_logfinish(self, nodeid):
        with open("results.json", "a") as file:
            file.write(json.dumps([(told := self.seen.pop(nodeid))["run"], told]) + "\\n")


def pytest_configure(config):
    config.pluginmanager.register(Listener(), "allure_listener")
"""

TEST = """
import pytest_pafot as pafot


{mark}
@pafot.search(ads=lambda: lambda seen: (0.0, 0.0), blame="ego", stop_after=1, shrink_rollouts=30)
def test_a(run):
    assert not run.collision, run.explain()
"""


@pytest.mark.parametrize(("mark", "outcome"), [("", "failed"), ("@__import__('pytest').mark.xfail", "skipped")])
def test_finding_has_a_result_of_its_own_with_the_name_of_its_replay(project, mark, outcome):
    project.write(TEST.format(mark=mark))
    (project.path / "conftest.py").write_text(LISTENER)
    results = []
    for _ in range(2):
        project.run("--pafot-runs=12", "--pafot-seed=2", generations=None)
        file = project.path / "results.json"
        results.append(dict(json.loads(line) for line in file.read_text().splitlines()))
        file.unlink()
    new, replay = results
    search, found = "search", next(each for each in new if each.startswith("saved-"))
    assert set(new) == set(replay) == {search, found}
    ((told, message),) = new[found]["call"]
    assert told == outcome
    assert message == replay[found]["call"][0][1]  # that of the shrunk run
    ((told, message),) = new[search]["call"]
    assert (told, message.startswith("Failed: 1 new finding")) == (outcome, True)


EDITOR = """
import json
import pytest


class Editor:
    def __init__(self):
        self.files = {}

    @pytest.hookimpl(hookwrapper=True, trylast=True)
    def pytest_runtest_protocol(self, item, nextitem):
        self.files[item.nodeid] = item.path.name
        yield

    def pytest_report_teststatus(self, report):
        if report.when == "call":
            with open("shown.json", "a") as file:
                file.write(json.dumps([report.nodeid, self.files.get(report.nodeid)]) + "\\n")


def pytest_configure(config):
    config.pluginmanager.register(Editor(), "vscode_pytest")
"""


def test_finding_is_shown_in_its_file_by_an_editor_that_knows_the_files_of_items(project):
    project.write(TEST.format(mark=""))
    (project.path / "conftest.py").write_text(EDITOR)
    project.run("--pafot-runs=12", "--pafot-seed=2", generations=None)
    shown = dict(json.loads(line) for line in (project.path / "shown.json").read_text().splitlines())
    found = f"test_it.py::test_a[saved-{project.only_id}]"
    assert shown == {"test_it.py::test_a[search]": "test_it.py", found: "test_it.py"}
