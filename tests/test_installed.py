"""The installed package: its content, and what works in a folder that is no clone."""

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
    # Panda3D, which MetaDrive needs, adds a command to setuptools that imports this module.
    strict = ["-W", "error", "-W", "ignore:the imp module is deprecated:DeprecationWarning"]
    subprocess.run([sys.executable, *strict, "-c", BUILD, scratch, lib], cwd=ROOT, check=True)
    package = lib / "pytest_pafot"
    for source, copy in (
        (ROOT / "pytest_pafot", package),
        (ROOT / "example_ads", package / "example_ads"),
    ):
        # the same files have the same code, and compiling takes seconds
        for compiled in source.rglob("*.pyc"):
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
    source = {
        path.relative_to(ROOT / "example_ads") for path in (ROOT / "example_ads").rglob("*.py")
    }
    there = {path.relative_to(examples) for path in examples.rglob("*.py")}
    assert source - there == {Path("conftest.py"), Path("test_safety.py")}
    assert not there - source


def test_documented_policies_are_installed_and_importable_anywhere(installed, tmp_path):
    documents = [path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md")]
    shown = "\n".join(
        each for text in documents for each in re.findall(r"```.*?```|`[^`]+`", text, re.DOTALL)
    )
    named = {
        *re.findall(r"--ads\s+([a-z][\w.:-]+)", shown),
        *re.findall(r"`(example_ads\.\w+:[\w:-]+)`", shown),
    }
    of_documents = ("policy", "planner", "test_policy", "test_safety")  # their files
    names = sorted(name for name in named if name.split(":")[0] not in of_documents)
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
