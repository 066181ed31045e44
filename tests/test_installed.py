"""The installed package: its content, what works in a folder that is no clone, and what works without extras."""

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
    package = lib / "pytest_pafot"
    for source, copy in ((ROOT / "pytest_pafot", package), (ROOT / "example_ads", package / "example_ads")):
        for compiled in source.rglob("*.pyc"):  # the same files have the same code, and compiling takes seconds
            place = copy / compiled.relative_to(source)
            if place.parents[1].is_dir():
                place.parent.mkdir(exist_ok=True)
                shutil.copy2(compiled, place)
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


@pytest.fixture
def core(tmp_path, monkeypatch):
    """Return a folder with a policy, and a function that runs Python there with a copy without extras."""
    copy, here = tmp_path / "core", tmp_path / "here"
    # With what Python has compiled, which takes seconds, but not with a file that it is just writing.
    shutil.copytree(ROOT / "pytest_pafot", copy / "pytest_pafot", ignore=shutil.ignore_patterns("extras", "*.pyc.*"))
    (copy / "sitecustomize.py").write_text(WITHOUT_FINDERS)
    here.mkdir()
    (here / "policy.py").write_text(POLICY)
    for name, value in (("DISABLE_PLUGIN_AUTOLOAD", "1"), ("PLUGINS", "pytest_pafot.plugin"), ("ADDOPTS", "")):
        monkeypatch.setenv(f"PYTEST_{name}", value)
    monkeypatch.delenv("CI", raising=False)
    return here, lambda *arguments: run(copy, here, "-m", *arguments)


def test_core_without_extras_searches_and_replays(core):
    here, do = core
    (here / "test_it.py").write_text(MARKED)
    done = do("pytest")
    assert (done.returncode, done.stderr) == (1, ""), done.stdout
    count = len([*here.rglob("*.pafot.yaml")])
    assert count > 0
    assert f"{count} still failing" in do("pytest", "--pafot-generations=0").stdout
    quick = ("--", "--pafot-shrink-rollouts=0")
    done = do("pytest_pafot", "search", "policy:make", "--runs", "8", "--seed", "1", *quick)
    assert done.returncode == 1, done.stderr
    assert "new finding" in done.stdout
    assert do("pytest_pafot", "corpus", "list").returncode == 0


def test_core_without_extras_says_what_is_missing(core):
    _, do = core
    for code, command in (
        (2, "rate --ads policy:make"),
        (1, "search policy:make -- --pafot-algorithm=av-fuzzer"),  # an error of its item
    ):
        done = do("pytest_pafot", *command.split())
        assert (done.returncode, MISSING in " ".join((done.stdout + done.stderr).split())) == (code, True), done
