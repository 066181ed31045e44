"""What messages name as a way out: each command, option and package exists, and commands do what is said."""

import argparse
import ast
import html
import json
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from pytest_pafot.__main__ import COMMANDS, main
from pytest_pafot.commands.search_command import add_arguments
from pytest_pafot.export import exporter
from pytest_pafot.searches.options import BY_NAME, OPTIONS
from pytest_pafot.support.errors import OF_REPLAY, OF_SEARCH, command, flag, install, rerun
from tests.helpers.sessions import command_in_a_copy

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "pytest_pafot"
SAID = re.compile(r"--pafot-[a-z-]+|python -m pytest|pip install .pytest-pafot|\bdocs/[\w/-]+\.md")


class Facts(NamedTuple):
    """What the modules of the package say and call.

    Attributes:
        texts: All strings, each after its module and whether it is a docstring.
        calls: All calls of functions by name: the module, the name and the first argument, None if it is no constant.
    """

    texts: list[tuple[str, bool, str]]
    calls: list[tuple[str, str, object]]


@cache
def facts():
    found = Facts([], [])
    for path in sorted(PACKAGE.rglob("*.py")):
        place, tree = (
            path.relative_to(PACKAGE).as_posix(),
            ast.parse(path.read_text(encoding="utf-8")),
        )
        documents = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Expr):
                documents.add(id(node.value))  # the walk comes to it later
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.texts.append((place, id(node) in documents, node.value))
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                first = node.args[0] if node.args else None
                found.calls.append(
                    (place, node.func.id, first.value if isinstance(first, ast.Constant) else None)
                )
    return found


def calls(name):
    """Return where the package calls a function of a name, with the first argument; None if that is no constant."""
    return [(place, first) for place, called, first in facts().calls if called == name]


def test_messages_name_ways_out_only_by_the_functions():
    texts = [(place, text) for place, is_document, text in facts().texts if not is_document]
    found = [(place, said) for place, text in texts for said in SAID.findall(text)]
    assert {place for place, _ in found} == {
        "__main__.py",
        "searches/options.py",
        "support/errors.py",
    }
    # the name of the program
    assert [said for place, said in found if place == "__main__.py"] == ["python -m pytest"]
    flags = {option.flag for option in OPTIONS}
    # texts of help
    assert {said for place, said in found if place == "searches/options.py"} <= flags


def test_every_option_that_messages_name_exists_also_in_search():
    named = [(place, name) for place, name in calls("flag") if name is not None]
    assert len(named) > 30
    assert [each for each in named if each[1] not in BY_NAME] == []
    values = {"runs": 5, "seed": 7, "report": "a b.html", "max_time": 2.5, "workers": 1}
    for name in {name for _, name in named} - {"allow_orphans"}:
        parser = argparse.ArgumentParser()
        add_arguments(parser)
        is_switch = BY_NAME[name].kind == "switch"
        given = flag(name) if is_switch else flag(name, values.get(name, "a b"))
        told = parser.parse_args(["planner:Planner", *shlex.split(given)])
        own = getattr(told, name, None)
        assert shlex.split(given) == told.options or str(own) == str(values.get(name, "a b")), name


OF_COMMANDS = {
    "search": ["commands/search_command.py"],
    "replay": ["commands/replay_command.py"],
    "rate": ["commands/rate_command.py"],
    "compare": ["comparison/command.py", "comparison/plan.py"],
    "export": ["export/exporter.py", "export/exporter.py"],
    "corpus": ["commands/corpus_command.py"],
}
SHOWN_BY = {"corpus": [["corpus", each] for each in ("list", "accept")]}
"""The helps with the options of a command."""
# of the sessions that commands start
OF_PYTEST = {"--rootdir", "--collect-only", "--no-header", "--runxfail", "--tb"}


def test_every_command_explains_itself(capsys):
    for name, command_ in COMMANDS.items():
        with pytest.raises(SystemExit, match="0"):
            main([name, "--help"])
        assert command_.about[:20] in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", OF_COMMANDS)
def test_every_option_that_a_command_names_is_its_own(name, capsys):
    for words in SHOWN_BY.get(name, [[name]]):
        with pytest.raises(SystemExit):
            main([*words, "--help"])
    told = capsys.readouterr().out
    named = {
        said
        for place, _, text in facts().texts
        if place in OF_COMMANDS[name]
        for said in re.findall(r"(?<![\w-])--[a-z][a-z-]*[a-z]", text)
    }
    assert named
    assert named - set(re.findall(r"--[a-z-]*[a-z]", told)) <= OF_PYTEST


def test_every_package_that_messages_name_exists():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    named = [name for _, name in calls("install") if name is not None] + list(
        exporter.EXTRAS.values()
    )
    assert named
    assert set(named) <= extras.keys()
    assert install("dask") == "pip install 'pytest-pafot[dask]'"


def test_rerun_repeats_what_has_started_the_session():
    words, search = ["pytest", "a b.py"], "python -m pytest_pafot search p:P --runs 4 -- -q"
    assert rerun(words, {}, "--pafot-seed=3", saved="front-1") == "pytest 'a b.py' --pafot-seed=3"
    told = rerun(words, {OF_SEARCH: search}, "--pafot-seed=3", saved="front-1")
    assert told == "python -m pytest_pafot search p:P --runs 4 --pafot-seed=3 -- -q"
    told = rerun(words, {OF_SEARCH: search, OF_REPLAY: "--ads 'p:P:a b'"}, saved="front-1")
    assert told == "python -m pytest_pafot replay front-1 --ads 'p:P:a b'"
    assert (
        rerun(words, {OF_SEARCH: "python -m pytest_pafot search p:P"})
        == "python -m pytest_pafot search p:P"
    )


# The commands that messages print are run as they are, in a folder and with names that need quotes.

PLANNER = """\
class Planner:
    def __init__(self, name=""):
        self.name = name

    def __call__(self, observation):
        return 0.0, 0.0


def idle(name):
    return lambda observation: 1
"""
RUN_BY = {
    "corpus/reader.py": "test_unknown_finding_is_among_those_that_the_command_lists",
    "searches/saved_scenario.py": "test_deadly_scenario_is_replayed_by_the_command_that_is_named",
    "plugin/collection.py": "test_a_saved_file_is_replayed_without_its_project",
    "support/errors.py": "test_session_of_search_names_commands_that_work_without_test_files",
    "report/terminal.py": "test_the_list_that_a_ci_job_names_has_the_findings",
}
"""The test that runs the command of each place where a message names one."""


def test_every_command_that_messages_name_is_run_here():
    assert {place for place, _ in calls("command")} == RUN_BY.keys()
    tests = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")
    )
    assert [name for name in RUN_BY.values() if f"def {name}(" not in tests] == []


@pytest.fixture
def here(tmp_path, monkeypatch):
    folder = tmp_path / "a b"
    folder.mkdir()
    (folder / "planner.py").write_text(PLANNER)
    monkeypatch.chdir(folder)
    for name in ("CI", "COLUMNS", "PYTEST_ADDOPTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "500")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    # loading other plugins takes as long as a search
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_PLUGINS", "pytest_pafot.plugin")
    return folder


def ran(text):
    """Run a command as a shell reads it. Return its exit code and its output."""
    words = shlex.split(text)
    if words[:2] == ["python", "-c"]:
        done = subprocess.run(
            [sys.executable, *words[1:]], capture_output=True, text=True, check=False, timeout=120
        )
        return done.returncode, done.stdout + done.stderr
    done = command_in_a_copy(*(words[2:] if words[:2] == ["python", "-m"] else words))
    return done.code, done.out + done.err


def named_in(text, before):
    """Return the command that a text names after some words."""
    (found,) = re.findall(rf"{before}`?((?:python -m )?pytest[^`\n]*)", text)
    return found


@pytest.mark.processes
def test_session_of_search_names_commands_that_work_without_test_files(here, monkeypatch):
    code, told = ran(
        "python -m pytest_pafot search 'planner:Planner:a b' --seed 2 --runs 4 --pafot-json=j.json"
    )
    assert code == 1, told
    (file,) = here.rglob("*.pafot.yaml")
    single = named_in(told, "\nreplay ")
    finding = json.loads((here / "j.json").read_text())["findings"][0]
    report = html.unescape((here / "pafot.html").read_text())
    (again,) = set(re.findall(r"python -m pytest_pafot replay [^<\"]*b'", report))
    assert single == again == finding["replay"]
    assert file.name.partition(".")[0] in single
    keep = named_in(told, "to keep this as a test, run ").partition(", and commit")[0]
    code, told = ran(single)
    assert (code, "replayed 1 saved scenario: 1 still failing" in told) == (1, True)
    (here / "test_it.py").write_text("def test_it():\n    pass\n")
    monkeypatch.setenv("CI", "1")
    assert ran("pytest")[0] == 0
    assert ran(keep)[0] == 0
    code, told = ran(command("pytest", *here.rglob("*.pafot.yaml")))
    assert (code, "replayed 1 saved scenario: 1 still failing" in told) == (1, True), told


@pytest.mark.processes
def test_options_that_a_session_of_search_names_repeat_it(here):
    search = "python -m pytest_pafot search planner:Planner --runs 4 --pafot-shrink-runs=0"
    told = ran(f"{search} --pafot-save=none --pafot-json=j.json -- -v")[1]
    seed, base = re.search(r"seed (\d+) from (--pafot-seed=\d+)", told).groups()
    again = ran(f"{search} {base} -- -v")[1]
    assert f"seed {seed} from {base}" in again
    for finding in json.loads((here / "j.json").read_text())["findings"]:
        assert finding["file"] is None
        assert finding["id"] in ran(finding["replay"])[1]


TEST = """\
import pytest_pafot as pafot

@pafot.search(ads="planner:Planner:a b", runs=4, seed=2, shrink_runs=0)
def test_safe(run):
    assert not run.collision
"""


@pytest.mark.processes
def test_unknown_finding_is_among_those_that_the_command_lists(here):
    (here / "test_it.py").write_text(TEST)
    ran("python -m pytest")
    file = min(here.rglob("*.pafot.yaml"))
    code, told = ran("python -m pytest_pafot export 000000 --to csv --ads planner:Planner")
    assert code == 2
    code, told = ran(named_in(told, ". "))
    assert (code, file.name.partition(".")[0] in told) == (0, True), told


@pytest.mark.processes
def test_deadly_scenario_is_replayed_by_the_command_that_is_named(here):
    marked = TEST.replace('ads="planner:Planner:a b"', "ads=deadly, isolate=True")
    deadly = "import os\n\ndef deadly():\n    return lambda observation: os._exit(3)\n\n"
    (here / "test_it.py").write_text(f"{deadly}{marked}")
    ran("python -m pytest")
    file = min(here.rglob("*.pafot.yaml"))
    code, told = ran(
        shlex.join(
            ["python", "-c", f"import pytest_pafot as p\np.load({str(file)!r}).replay(None)"]
        )
    )
    assert code == 1
    code, told = ran(named_in(told, "Run "))
    assert (code, "1 still failing" in told) == (1, True), told
