"""The commands for contributors exist, and are the same everywhere."""

import ast
import re
import shlex
import tomllib
from pathlib import Path

import pytest
import yaml

import pytest_pafot
from tests.helpers.sessions import command_in_a_copy
from tests.helpers.tables import table

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
CI = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
NOX = (ROOT / "noxfile.py").read_text(encoding="utf-8")
HOOKS = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT, PYTEST = CONFIG["project"], CONFIG["tool"]["pytest"]["ini_options"]


def commands():
    """Yield every command of every block, as words, without environment variables."""
    blocks = "".join(re.findall(r"^```sh\n(.*?)^```$", TEXT, re.MULTILINE | re.DOTALL))
    for line in re.split(r"\n| && ", blocks.strip()):
        words = shlex.split(line)
        while "=" in words[0]:
            del words[0]
        yield words


def calls_of_pytest():
    """Return the arguments of each call of pytest."""
    return [words[3:] for words in commands() if words[:3] == ["python", "-m", "pytest"]]


def said():
    """Return the commands of the blocks, and those inside sentences."""
    return [
        *commands(),
        *(shlex.split(text) for text in re.findall(r"`((?:python -m|nox) [^`]*)`", TEXT)),
    ]


def nox_sessions():
    functions = [
        node
        for node in ast.parse(NOX).body
        if isinstance(node, ast.FunctionDef) and node.decorator_list
    ]
    return {node.name: ast.unparse(node) for node in functions}


@pytest.mark.processes
def test_pytest_knows_every_option_of_a_command():
    known = set(
        re.findall(
            r"(?<![\w-])--?[a-z][\w-]*", command_in_a_copy("pytest", "--help", folder=ROOT).out
        )
    )
    used = {
        word.partition("=")[0]
        for words in calls_of_pytest()
        for word in words
        if word.startswith("-")
    }
    assert used - known == set()


def test_every_file_in_a_pytest_command_or_the_quick_part_exists():
    files = [
        word.removeprefix("@")
        for words in calls_of_pytest()
        for word in words
        if word.endswith((".py", ".txt"))
    ]
    quick = (ROOT / "tests" / "quick.txt").read_text(encoding="utf-8").splitlines()
    assert files
    assert quick
    assert [name for name in (*files, *quick) if not (ROOT / name).is_file()] == []
    assert "@tests/quick.txt" in CI
    assert "@tests/quick.txt" in NOX


def test_every_program_and_session_that_is_named_exists():
    for words in said():
        if words[:2] == ["python", "-m"] and words[2].startswith("tests."):
            assert (ROOT / words[2].replace(".", "/")).with_suffix(".py").is_file()
        if words[0] == "python" and words[1].endswith(".py"):
            assert (ROOT / words[1]).is_file()
        if words[:2] == ["nox", "-s"]:
            assert words[2] in nox_sessions()


def test_ci_and_nox_run_every_omitted_stage():
    (*_, chosen) = PYTEST["addopts"]
    left_out = set(re.findall(r"not (\w+)", chosen))
    every = {line.partition(":")[0] for line in PYTEST["markers"]}
    # which conftest.py leaves out, so that they are not imported
    assert left_out == every - {"optional"}
    (stages,) = re.findall(r'^part python -m pytest .*-m "(.*)"$', CI, re.MULTILINE)
    assert set(stages.split(" or ")) == every
    assert f'STAGES = "{stages}"' in NOX


@table("command", ["ruff check", "ruff format", "mypy"])
def test_same_linters_run_locally_and_in_ci(command):
    words = command.split()
    assert any(each[: len(words)] == words for each in commands())
    assert any(
        hook["entry"].startswith(command)
        for repository in HOOKS["repos"]
        for hook in repository["hooks"]
    )
    assert repr(words)[1:-1] in nox_sessions()["types" if command == "mypy" else "lint"]
    assert re.search(rf"^part {command}\b", CI, re.MULTILINE)


def test_site_is_built_strictly_by_one_command():
    conf = (ROOT / "docs/conf.py").read_text(encoding="utf-8")
    assert "docs" in PROJECT["optional-dependencies"]
    for text in (conf, TEXT, CI, NOX):
        assert re.search(r"python -m sphinx (-q )?-W --keep-going -n -b html docs build/site", text)


def test_citation_matches_version_and_paper():
    assert CITATION["version"] == PROJECT["version"] == pytest_pafot.__version__
    assert (CITATION["title"], CITATION["license"]) == (PROJECT["name"], PROJECT["license"])
    (paper,) = CITATION["references"]
    address = f"https://doi.org/{paper['doi']}"
    assert PROJECT["urls"]["Paper"] == address
    assert address in (ROOT / "docs" / "explanation" / "paper.md").read_text(encoding="utf-8")
