"""Workers of pytest-xdist, hash seeds and kills do not change what is found, saved and reported."""

import json
import os
import subprocess
import sys

import pytest

from pytest_pafot.corpus.reader import load
from tests.helpers.processes import begun
from tests.helpers.sessions import set_keys
from tests.plugin.test_report_page import read_page
from tests.plugin.test_search_command import wait_for_a_finding
from tests.plugin.test_session_records import TWO

pytestmark = pytest.mark.processes

pytest.importorskip("xdist")


@pytest.fixture(autouse=True)
def short_shrinking(project, monkeypatch):
    set_keys(monkeypatch, shrink_runs=60)  # none of these tests needs the default of 300


def test_xdist_workers_give_same_results_as_one_process(project):
    project.write(TWO)
    page = project.path / "report.html"
    written = ("--pafot-report=report.html", "--pafot-json=out/pafot.json")
    project.run(*written, runs=8)
    serial, shown, record = (
        project.contents,
        read_page(page)[1:],
        (project.path / "out/pafot.json").read_text(),
    )
    project.run("--pafot-json=again.json", runs=0)
    again = (project.path / "again.json").read_text()
    assert len(json.loads(again)["findings"]) == len(json.loads(record)["findings"]) > 1
    assert any("shrunk: {" in text for text in serial.values())
    project.forget()
    result = project.run("-n2", "-v", "--junitxml=junit.xml", *written, runs=8)
    assert project.contents == serial
    assert (project.path / "out/pafot.json").read_text() == record
    project.run("-n2", "--pafot-json=again.json", runs=0)
    assert (project.path / "again.json").read_text() == again
    result.assert_outcomes(failed=2 + len(serial))
    assert read_page(page)[1:] == shown
    assert [len(part) for part in shown] == [len(serial), 2]
    text = (project.path / "junit.xml").read_text()
    assert text.count('name="pafot_base_seed" value="1"') >= 2
    for name in serial:
        assert f'name="pafot_file" value="{name}"' in text
        test, file = name.split("/")[2:]
        assert text.count(f'name="{test}[saved-{file.removesuffix(".pafot.yaml")}]"') == 1


def test_a_worker_can_send_what_no_text_encoding_has(project):
    project.write(
        "@pafot.search(SHORT)\ndef test_it(run):\n    assert run.duration < 1, '\\ud800'\n"
    )
    for label, passed in (("new", 0), ("still failing", 1)):
        result = project.run("-n1", "--pafot-report=report.html", runs=4)
        result.assert_outcomes(failed=2 - passed, passed=passed)
        assert [finding.label for finding in read_page(project.path / "report.html")[1]] == [label]


def test_workers_name_the_base_seed_once(project):
    project.write(TWO.replace('run.scenario.id == ""', "run"))
    assert project.run("-n2", seed=None).stdout.str().count(" base seed 0 ") == 1


def test_worker_death_loses_no_finding_or_collected_test(project):
    project.write("""
import os
seen = set()

@pafot.search(SHORT)
def test_dies(run):
    seen.add(run.scenario.id)
    if len(seen) > 1 and os.environ.get("PYTEST_XDIST_WORKER"):
        os._exit(9)
    assert run.scenario.id == ""

@pytest.mark.parametrize("number", range(6))
def test_ordinary(number): pass
""")
    result = project.run("-n1", "-v")
    assert result.parseoutcomes()["passed"] == 6
    found = next(name for name in project.files if "crash" not in name)
    id_ = found.rpartition("/")[2].removesuffix(".pafot.yaml")
    result.stdout.fnmatch_lines([f"FAILED test_it.py::test_dies[[]saved-{id_}[]]*"])
    result.stdout.fnmatch_lines(["*problem: *(pid *) * test_it.py::*"])


def test_the_hash_seed_changes_nothing(project, monkeypatch):
    project.write(TWO)
    contents = []
    for hash_seed in ("0", "1"):
        monkeypatch.setenv("PYTHONHASHSEED", hash_seed)
        project.run("--pafot-shrink-runs=30", fresh=True)
        contents.append(project.contents)
        project.forget()
    assert contents[0] == contents[1]
    assert contents[0]


def test_two_simultaneous_sessions_write_one_file_per_finding(project):
    project.write(TWO)
    result = project.run("--dist=each", "--tx=2*popen", "--pafot-shrink-runs=0")
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    names = [name.rpartition("/")[2] for name in project.files]
    project.forget()
    project.run("--pafot-shrink-runs=0")
    assert names == [name.rpartition("/")[2] for name in project.files]


def test_load_groups_do_not_change_finding_ids(project):
    project.write('@pytest.mark.xdist_group("research")\n' + TWO.strip() + "\n")
    result = project.run("-n1", "--dist=loadgroup")
    first = next(name for name in project.files if "test_first" in name)
    id_ = first.rpartition("/")[2].removesuffix(".pafot.yaml")
    result.stdout.fnmatch_lines([f"FAILED test_it.py::test_first[[]saved-{id_}[]]*"])


def test_kill_loses_no_announced_finding_or_file(project):
    project.write(TWO.replace("assert run", "__import__('time').sleep(0.05)\n    assert run"))
    options = ["-p", "pafot", "--pafot-generations=5", "--pafot-seed=1"]
    command = [sys.executable, "-m", "pytest", *options]
    with begun(command, cwd=project.path, stdout=subprocess.PIPE, text=True) as process:
        announced = []
        for line in process.stdout:
            if line.startswith("pafot: found "):
                announced.append(line.rpartition("[saved-")[2].strip().removesuffix("]"))
            if len(announced) == 2:
                break
        process.kill()
    assert set(announced) <= {
        name.rpartition("/")[2].removesuffix(".pafot.yaml") for name in project.files
    }
    assert [load(project.path / name).test for name in project.files]
    result = project.run(runs=0)
    assert result.parseoutcomes()["failed"] >= 2


IDLES = """
import time

def idles():
    def drive(observation):
        time.sleep(0.003)
        return 0.0, 0.0
    return drive
"""


@pytest.mark.skipif(os.name == "nt", reason="processes have no signals there")
def test_a_signal_to_the_controller_loses_nothing_that_workers_have_saved(project):
    # The workers search on for some seconds before pytest-xdist interrupts them.
    project.write(IDLES + TWO.replace("SHORT", "SHORT, runs=100000, ads=idles"))
    command = [sys.executable, "-m", "pytest", "-n2", "-p", "xdist", "-p", "pafot"]
    command += ["--pafot-json=pafot.json", "--pafot-report=x.html"]
    with begun(command, stdout=subprocess.PIPE, text=True) as session:
        wait_for_a_finding(session)
        session.terminate()
        rest, _ = session.communicate(timeout=100)
    record, page = project.record, (project.path / "x.html").read_text()
    assert (session.returncode, record.exit) == (2, 2)
    assert {each.reason for each in record.searches} == {"interrupted"}
    assert {each.file for each in record.findings} == set(project.files)
    assert all(each.id in page for each in record.findings)
    assert "received SIGTERM" in rest


IN_BETWEEN = """
import os, signal

def pytest_sessionstart(session):
    dsession = session.config.pluginmanager.get_plugin("dsession")
    if dsession is None:
        return
    handle = dsession.worker_testreport

    def interrupted(node, rep):
        if getattr(rep, "pafot", ("",))[0] == "Seen":
            dsession.worker_testreport = handle
            os.kill(os.getpid(), signal.SIGTERM)
            for _ in range(1000):  # Python runs the handler before these are over.
                pass
        handle(node, rep)

    dsession.worker_testreport = interrupted
"""


@pytest.mark.skipif(os.name == "nt", reason="processes have no signals there")
def test_a_finding_that_the_controller_has_read_and_not_yet_taken_is_not_lost(project):
    project.write(TWO)
    with (project.path / "conftest.py").open("a") as conftest:
        conftest.write(IN_BETWEEN)
    options = ("-n1", "--pafot-json=pafot.json", "--pafot-stop-after=1")
    result = project.run(*options, runs=None, apart=True)
    assert (result.ret, project.record.exit) == (2, 2)
    files = [each.file for each in project.record.findings]
    assert files
    assert sorted(files) == project.files
    assert result.stdout.str().count("pafot: found") == len(files)
