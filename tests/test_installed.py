"""The installed package: its content, what works in a folder that is no clone, and what works without extras."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.stories

ROOT = Path(__file__).parents[1]
BUILD = (
    "import runpy, sys\n"
    "sys.modules['Cython'] = None  # which modules are compiled changes nothing here\n"
    "sys.argv = ['setup.py', '-q', 'egg_info', '--egg-base', sys.argv[1], 'build_py', '--build-lib', sys.argv[2]]\n"
    "runpy.run_path('setup.py', run_name='__main__')\n"
)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Return the folder of modules that an installation puts next to other packages."""
    lib = tmp_path_factory.mktemp("installed")
    scratch = tmp_path_factory.mktemp("egg-info")
    subprocess.run([sys.executable, "-W", "error", "-c", BUILD, scratch, lib], cwd=ROOT, check=True)
    return lib


def run(installed, folder, *arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(installed)},
        capture_output=True,
        text=True,
        check=False,
    )


def test_package_contains_every_example_policy_and_no_tests(installed):
    assert [path.name for path in installed.iterdir()] == ["pytest_pafot"]
    examples = installed / "pytest_pafot" / "example_ads"
    source = {path.relative_to(ROOT / "example_ads") for path in (ROOT / "example_ads").rglob("*.py")}
    there = {path.relative_to(examples) for path in examples.rglob("*.py")}
    assert source - there == {Path("conftest.py"), Path("test_safety.py")}
    assert not there - source


def test_documented_policies_are_installed_and_importable_anywhere(installed, tmp_path):
    documents = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
    named = {*re.findall(r"--ads ([a-z][\w.:-]+)", documents), *re.findall(r"`(example_ads\.\w+:[\w:-]+)`", documents)}
    names = sorted(
        name for name in named if name.split(":")[0] not in ("policy", "planner", "test_policy")
    )  # files of documents
    assert "example_ads.defects:make:two-defects" in names
    names.append("idm_mobil")  # one that needs no module of a path, which no page names by itself
    code = (
        "import sys, pytest_pafot\n"
        "from pytest_pafot.commands.policy_reference import ads_factory\n"
        "made = [ads_factory(name)() for name in sys.argv[1:]]\n"
        "print(len(made), pytest_pafot.__file__)"
    )
    done = run(installed, tmp_path, "-c", code, *names)
    assert done.stderr == ""
    assert done.stdout.split() == [str(len(names)), str(installed / "pytest_pafot" / "__init__.py")]


WITHOUT_FINDERS = (
    "import sys\nsys.meta_path = [each for each in sys.meta_path if 'editable' not in str(each).lower()]\n"
)
"""An editable installation finds what a copy of the package lacks."""
POLICY = """\
def make():
    return lambda seen: (0.0, 0.0)
"""
MARKED = """\
import pytest_pafot as pafot
from policy import make

@pafot.search(ads=make, runs=8, seed=1, shrink_rollouts=20)
def test_safe(run):
    assert not run.collision
"""
MISSING = "expected a whole installation of pytest-pafot, received one without pytest_pafot.extras; install it again"


EACH = """\
import os, runpy, sys, tempfile
import gymnasium, highway_env, hypothesis, numpy, pytest, yaml  # once for all commands

for line in sys.argv[1:]:
    with tempfile.TemporaryFile("w+") as out:
        if not os.fork():
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
            code, sys.argv = 1, line.split()
            sys.orig_argv = [sys.executable, "-m", *sys.argv]
            try:
                runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
            except SystemExit as ended:
                code = int(ended.code or 0)
            finally:
                sys.stdout.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.wait()[1])
        out.seek(0)
        print([code, out.read()], flush=True)
"""
"""Runs each line as `python -m` would, in a copy of one interpreter that has imported all except this package."""


@pytest.fixture
def core(tmp_path, monkeypatch):
    """Return a folder with a policy, and a function that runs commands there with a copy of the package without extras.

    It returns the exit code and the output of each.
    """
    copy, here = tmp_path / "core", tmp_path / "here"
    # With what Python has compiled, which takes seconds, but not with a file that it is just writing.
    shutil.copytree(ROOT / "pytest_pafot", copy / "pytest_pafot", ignore=shutil.ignore_patterns("extras", "*.pyc.*"))
    (copy / "sitecustomize.py").write_text(WITHOUT_FINDERS)
    here.mkdir()
    (here / "policy.py").write_text(POLICY)
    for name, value in (("DISABLE_PLUGIN_AUTOLOAD", "1"), ("PLUGINS", "pytest_pafot.plugin"), ("ADDOPTS", "")):
        monkeypatch.setenv(f"PYTEST_{name}", value)
    monkeypatch.delenv("CI", raising=False)

    def do(*lines):
        done = run(copy, here, "-c", EACH, *lines)
        assert (done.returncode, done.stderr) == (0, "")
        return [ast.literal_eval(each) for each in done.stdout.splitlines()]

    return here, do


def test_core_without_extras_searches_and_replays(core):
    here, do = core
    (here / "test_it.py").write_text(MARKED)
    found, replayed, searched, listed = do(
        "pytest -p no:cacheprovider test_it.py",
        "pytest -p no:cacheprovider test_it.py --pafot-generations=0",
        "pytest_pafot search policy:make --runs 8 --seed 1 -- --pafot-shrink-rollouts=20",
        "pytest_pafot corpus list",
    )
    count = len([*here.glob("pafot_corpus/test_it/**/*.pafot.yaml")])
    assert found[0] == 1, found[1]
    assert count > 0
    assert f"{count} still failing" in replayed[1]
    assert (searched[0], "new finding" in searched[1]) == (1, True), searched[1]
    assert listed[0] == 0


def test_core_without_extras_says_what_is_missing(core):
    here, do = core
    (here / "test_swept.py").write_text(
        f"{MARKED}\ndef test_swept():\n    pafot.sweep('r157/cut-in', make, over={{'gap': '10:60:3'}})\n\n"
        "def test_other():\n    pass\n"
    )
    (here / "test_listed.py").write_text(
        "import pytest_pafot as pafot\nfrom policy import make\n"
        "@pafot.catalogue('r157/cut-in', ads=make)\ndef test_it(run):\n    pass\n"
    )
    done = do(
        "pytest_pafot map r157/cut-in --ads policy:make --over gap=10:60:2",
        "pytest_pafot search policy:make -- --pafot-algorithm=av-fuzzer",  # an error of its item
        "pytest --pafot-generations=0 -p no:randomly test_swept.py",
        "pytest test_listed.py",
    )
    told = [" ".join(text.split()) for _, text in done]
    assert ([code for code, _ in done], [MISSING in each for each in told]) == ([2, 1, 1, 1], [True] * 4), done
    assert "1 failed, 1 passed" in told[2]
