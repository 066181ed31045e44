"""What the commands ``search``, ``corpus`` and ``replay`` say."""

import errno
import os
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from datetime import date

import pytest

from pytest_pafot.__main__ import main
from pytest_pafot.commands.tasks import run_tasks
from pytest_pafot.corpus.writer import write
from pytest_pafot.findings.finding import Bounded
from pytest_pafot.model.trace import Outcome
from tests.commands.test_receipt import EXPLORED, IMPORTS, MARKED, SEARCH, ended, session
from tests.commands.test_replay_command import ACCEPTED
from tests.commands.test_replay_command import here as saved  # noqa: F401
from tests.commands.test_tasks import work
from tests.findings.builders import plain_finding
from tests.helpers.hostile import unlisted
from tests.helpers.sessions import Copy, command_in_a_copy, set_keys
from tests.plugin.test_search_command import POLICY


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Return an empty current folder, in which lines are long."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("COLUMNS", "999")
    return tmp_path


@pytest.fixture
def says(capsys):
    """Return a function that runs a command, and returns its exit code and what it says."""

    def run(command):
        try:
            code = main(shlex.split(command))
        except SystemExit as ended:
            code = ended.code
        told = capsys.readouterr()
        # argparse words and wraps the list of all options in each version of Python differently
        error = re.sub(r"(?s)^(usage: [^[]*).*?(?=\n\S)", r"\1...", told.err)
        return f"exit code {code}\n{told.out}{error}"

    return run


def full(descriptor):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


SEARCHES = [
    "search a_planner:Nobody", "search a_planner.py:Planner", "search broken:Planner", "search test_safety:Planner",
    "search a_planner:make:", "search a_planner:Planner --check foo",
    "search a_planner:Planner --check a_planner:nothing", "search a_planner:Planner --check my-planner:make",
    "search a_planner:Planner --against nobody", "search a_planner:Planner --runs -1",
    "search a_planner:Planner --report x.png", "search a_planner:Planner --runz 3",
    "search a_planner:Planner --write-test",
]  # fmt: skip


def test_searches_that_cannot_start_read_so(here, says, monkeypatch, snapshot):
    for name in ("a_planner", "my-planner"):
        (here / f"{name}.py").write_text(POLICY)
    (here / "broken.py").write_text("raise ValueError('no gpu')\n")
    (here / "test_safety.py").symlink_to(here / "elsewhere.py")
    texts = {command: says(command) for command in SEARCHES}
    (here / "test_safety.py").unlink()
    monkeypatch.setattr(os, "fsync", full)
    texts["disk is full"] = says("search a_planner:Planner --write-test")
    (here / "pafot_found").symlink_to(here / "elsewhere")
    texts["link"] = says("search a_planner:Planner")
    assert texts == snapshot


@pytest.mark.processes
def test_searches_read_so(here, monkeypatch, snapshot):
    monkeypatch.setattr(subprocess, "Popen", Copy)
    set_keys(monkeypatch, shrink_runs=0)
    (here / "a_planner.py").write_text(f"{POLICY}\n\ndef wrong(run):\n    return True\n")
    (here / "ending.py").write_text("import os\n\ndef make():\n    os._exit(0)\n")
    texts = {}
    for command in (
        "a_planner:Planner --runs 4 --seed 2 -- -q",
        "a_planner:Planner --check a_planner:wrong --runs 4 --seed 2 -- -q",
        "a_planner:Planner --pafot-runs=0",
        "ending:make --runs 1 --seed 2 -- -q",
    ):
        done = command_in_a_copy("pytest_pafot", "search", *command.split())
        texts[command] = f"exit code {done.code}\n{done.out}{done.err}"
    assert texts == snapshot


REPLAYS = [
    f"replay {ACCEPTED}", f"replay {ACCEPTED} --ads policies:Idel",
    f"replay {ACCEPTED} --ads policies:Idle --world nothing-v0", f"replay {ACCEPTED} --adz policies:Idle",
    "replay crossing --ads policies:Idle --world highway-v0", "replay flaky --ads policies:Idle",
    "replay own --ads policies:Idle", "replay newer --ads policies:Idle", "replay large --ads policies:Idle",
    "replay 'a [1].pafot.yaml' --ads policies:Idle", "replay folder.pafot.yaml --ads policies:Idle",
    "replay nobody --ads policies:Idle",
]  # fmt: skip


def test_replays_that_cannot_start_read_so(saved, says, monkeypatch, snapshot):  # noqa: F811
    monkeypatch.setenv("COLUMNS", "999")
    text = (saved / ACCEPTED).read_text()
    own = "world: {kind: own, class: mine.Road}\n"
    for name, content in {
        "own": re.sub(r"(?s)world: \{kind: highway.*?\}\n", own, text),
        "newer": re.sub(r"(?m)^pafot: \d+", "pafot: 999", text),
        "large": f"{text}{'#' * 256 * 1024}",
        "a [1]": text,
    }.items():
        (saved / f"{name}.pafot.yaml").write_text(content)
    (saved / "folder.pafot.yaml").mkdir()
    assert {command: says(command) for command in REPLAYS} == snapshot


@pytest.mark.processes
def test_replays_read_so(saved, snapshot):  # noqa: F811
    texts = {}
    for policy in ("Idle", "Stopping"):
        done = command_in_a_copy("pytest_pafot", "replay", ACCEPTED, "--ads", f"policies:{policy}")
        texts[policy] = f"exit code {done.code}\n{done.out}{done.err}"
    assert texts == snapshot


AHEAD = {
    "outcome": Outcome.COMPLETED,
    "time": 5.9,
    "cell": None,
    "side": None,
    "responsibility": "none",
}
FAILURES = {
    "a-111111": {},
    "bound": {"failure": "CheckFailed", "assertion": "gap", "check": Bounded(value=0.64, at_least=10.0, unit="m")}
    | AHEAD,
    "nan": {"failure": "CheckFailed", "assertion": "gap", "check": Bounded(value=None, at_most=2.0)} | AHEAD,
    "measure": {"assertion": "run.min_ttc > N"} | AHEAD,
    "error": {"failure": "KeyError", "assertion": "speeds[0]"} | AHEAD,
    "ads-error": {"failure": "ValueError", "outcome": Outcome.ADS_ERROR, "message": "no\x1b[31m"},
    "off-road": {"outcome": Outcome.OFF_ROAD, "npc": None, "cell": None, "side": None},
}  # fmt: skip
ACCEPT = "corpus accept {} --reason TICKET-7 --until 2999-01-31"


def test_the_corpus_command_reads_so(here, says, monkeypatch, snapshot):
    texts = {"nothing": says("corpus list"), "no folder": says("corpus list none")}
    folder = here / "pafot_corpus" / "test_it" / "test_x"
    plain = plain_finding(test="test_it.py::test_x[planner-b]")
    for id_, changes in FAILURES.items():
        finding = replace(plain, id=id_, expect=replace(plain.expect, **changes))
        write(folder / f"{id_}.pafot.yaml", finding)
    accepted = replace(plain, id="b-222222", xfail="issue 12", xfail_until=date(2027, 1, 31))
    write(folder / "b-222222.pafot.yaml", accepted)
    (folder / "c.pafot.yaml").symlink_to("/dev/zero")
    texts["list"] = says("corpus list")
    for ids in ("a-111111", "111111", "b-222", "other", "bound other nan"):
        texts[f"accept {ids}"] = says(ACCEPT.format(ids))
    for day in ("soon", "2026-01-31"):
        texts[day] = says(f"corpus accept a-111111 --reason x --until {day}")
    write(folder.with_name("test_y") / "a-111111.pafot.yaml", replace(plain, id="a-111111"))
    texts["two files"] = says(ACCEPT.format("a-111111"))
    with (folder / "measure.pafot.yaml").open("a") as file:
        file.write("xfail:\n  {reason: x}\n")
    texts["several lines"] = says(ACCEPT.format("measure"))
    unlisted(monkeypatch, folder)
    texts["unlisted"] = says("corpus list pafot_corpus/test_it")
    monkeypatch.undo()
    monkeypatch.chdir(here)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        texts["disk is full"] = says(ACCEPT.format("error"))
    (here / "gone").mkdir()
    monkeypatch.chdir(here / "gone")
    (here / "gone").rmdir()
    texts["gone"] = says("corpus list")
    assert texts == snapshot


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="only Linux has this device")  # noqa: PTH110
def test_a_full_output_reads_so(here, monkeypatch, capsys, snapshot):
    with open("/dev/full", "w") as output, monkeypatch.context() as patch:  # noqa: PTH123
        patch.setattr(sys, "stdout", output)
        assert main(["corpus", "list"]) == 2
    assert capsys.readouterr().err == snapshot


@pytest.mark.processes
def test_a_task_whose_process_ends_reads_so(snapshot):
    with pytest.raises(ChildProcessError) as raised:
        list(run_tasks(work, ["a", "ends"], 2))
    assert raised.value == snapshot


@pytest.mark.processes
def test_assertions_that_are_off_read_so(tmp_path, monkeypatch, snapshot):
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_PLUGINS", "pytest_pafot.plugin")
    monkeypatch.setenv("COLUMNS", "999")
    imported = f"{IMPORTS}test_it = pafot.search(ads=Old)(holds)\n"
    texts = {
        "session": session(
            tmp_path, "--disable-warnings", test_it=MARKED + EXPLORED, test_imported=imported
        )
    }
    code, texts["search"] = ended(tmp_path, f"{SEARCH} --check planner:check", options=["-O"])
    assert (code, texts) == (2, snapshot)
