"""The project's page on a package index, and the checks before a release: each refuses what it should."""

import os
import re
import runpy
import tomllib
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TARGET = re.compile(r'\]\(([^)\s]+)\)|(?:src|srcset)="([^"]+)"')


@pytest.fixture(scope="module")
def setup():
    """Return the names of the script, which imports setuptools and Cython."""
    return runpy.run_path(str(ROOT / "setup.py"))


@pytest.fixture
def long_description(setup):
    return setup["long_description"]


@pytest.fixture
def check():
    """Return the names of the script, whose globals a test can change."""
    return runpy.run_path(str(ROOT / ".ci" / "release_check.py"))


def targets(text):
    return [found[1] or found[2] for found in TARGET.finditer(text)]


def fences(text):
    return re.findall(r"^```.*?^```$", text, re.DOTALL | re.MULTILINE)


def test_readme_links_lead_into_the_versioned_repository(long_description):
    shown = long_description(README, "https://host.test/owner/name", "1.2.3")
    assert len(targets(shown)) == len(targets(README))
    for before, after in zip(targets(README), targets(shown), strict=True):
        kind = "raw" if before.endswith((".png", ".svg")) else "blob"
        assert after == f"https://host.test/owner/name/{kind}/v1.2.3/{before}"
        assert (ROOT / before.partition("#")[0]).exists()


def test_readme_without_address_loses_links_but_no_text(long_description):
    shown = long_description(README, None, "1.2.3")
    assert targets(shown) == []
    assert "<picture>" not in shown
    assert fences(shown) == fences(README)
    assert (
        "test policies for highway-env, networks and\nprograms, and policies in your own simulator"
        in shown
    )


def test_absolute_and_internal_links_stay_unchanged(long_description):
    kept = "[a](https://host.test/b) [c](#d) [e](mailto:f@host.test)"
    assert long_description(kept, None, "1") == kept
    assert long_description(kept, "https://host.test/owner/name", "1") == kept


JUDGED = {
    "Intended Audience :: Developers",
    "Intended Audience :: Science/Research",
    "Topic :: Software Development :: Testing",
}
"""Classifiers that no machine can check."""


def test_every_classifier_has_something_that_makes_it_true(check):
    entries = PROJECT["entry-points"]
    wheels = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "cibuildwheel"
    ]["build"]
    true = {
        "Development Status :: 4 - Beta": PROJECT["version"].startswith("0."),
        "Framework :: Pytest": "pytest11" in entries,
        "Framework :: Hypothesis": "hypothesis" in entries,
        "Operating System :: POSIX :: Linux": "auditwheel"
        in check["TOOLS"],  # builds wheels for this Python and runs tests with them
        "Typing :: Typed": (ROOT / "pytest_pafot" / "py.typed").is_file(),
        # A classifier says that tests ran with a Python. A wheel is built for one more, see docs/explanation/search.md.
        **{
            f"Programming Language :: Python :: 3.{name[3:-2]}": True
            for name in wheels
            if name != "cp314-*"
        },
    }
    assert {*PROJECT["classifiers"]} - JUDGED == {name for name, holds in true.items() if holds}
    assert not [each for each in PROJECT["classifiers"] if each.startswith("License ::")], (
        "the expression says it"
    )


def test_the_version_is_one_wherever_it_stands(check):
    assert check["one_version"]() == PROJECT["version"]


@pytest.mark.parametrize(("heading", "is_dated"), [
    ("0.1.0 - unreleased", False), ("0.0.9 - 2031-02-03", False), ("0.1.0 - 2031-02-03", True),
])  # fmt: skip
def test_a_release_has_its_day_in_the_changelog(check, tmp_path, monkeypatch, heading, is_dated):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "changelog.md").write_text(f"# Changelog\n\n## {heading}\n")
    names = check["dated_changelog"].__globals__
    monkeypatch.setitem(names, "ROOT", tmp_path)
    monkeypatch.setitem(names, "VERSION", "0.1.0")
    if is_dated:
        assert check["dated_changelog"]() == f"## {heading}"
    else:
        with pytest.raises(
            check["NotYetError"],
            match=f"expected `## 0.1.0 - ` and the release date, received `## {heading}`",
        ):
            check["dated_changelog"]()


@pytest.mark.parametrize(
    "address", ["", "https://example.org/owner/name", "http://host.test/owner/name"]
)
def test_release_requires_a_real_public_repository_address(check, monkeypatch, address):
    monkeypatch.setitem(
        check["public_address"].__globals__, "PROJECT", {"urls": {"Source": address}}
    )
    with pytest.raises(
        check["NotYetError"], match=r"expected the repository's public address as Source"
    ):
        check["public_address"]()


METADATA = "pytest_pafot-0.1.0.dist-info/METADATA"
RECORD = "pytest_pafot/_cython.abi.so.txt"
LICENCE = "pytest_pafot-0.1.0.dist-info/licenses/LICENSE"


def members():
    """Return the members of a correct wheel."""
    assets = ("css", "html", "js")
    compiled = [
        each.relative_to(ROOT).with_suffix(".abi.so") for each in ROOT.glob("pytest_pafot/**/*.pxd")
    ]
    data = [
        each.relative_to(ROOT)
        for kind in assets
        for each in ROOT.glob(f"pytest_pafot/report/assets/*.{kind}")
    ]
    examples = ["pytest_pafot/example_ads/idm_mobil.py", "pytest_pafot/example_ads/ppo/actor.npz"]
    names = [each.as_posix() for each in [*compiled, *data]]
    return {**dict.fromkeys([*names, *examples, "pytest_pafot/py.typed", RECORD, LICENCE], "")} | {
        METADATA: f"Name: pytest-pafot\nLicense-Expression: {PROJECT['license']}\n"
    }


@pytest.mark.parametrize(("change", "told"), [
    ({}, None),
    ({"pytest_pafot/world/kernel/loop.abi.so": None},
     "expected compiled modules, received none for pytest_pafot/world/kernel/loop."),
    ({RECORD: None}, "expected one record of the compiled sources, received none"),
    ({"pytest_pafot/py.typed": None}, "the wheel does not contain pytest_pafot/py.typed"),
    ({"pytest_pafot/report/assets/main.js": None}, "the wheel does not contain pytest_pafot/report/assets/main.js"),
    ({"pytest_pafot/example_ads/ppo/actor.npz": None},
     "the wheel does not contain pytest_pafot/example_ads/ppo/actor.npz"),
    ({"tests/oracle/test_run.py": ""}, "the wheel must not contain tests/oracle/test_run.py"),
    ({"pytest_pafot/example_ads/conftest.py": ""}, "the wheel must not contain pytest_pafot/example_ads/conftest.py"),
    ({METADATA: "Name: pytest-pafot\nLicense-Expression: ISC\n"}, "expected the licence MIT, received ISC"),
    ({LICENCE: None}, "the wheel does not contain the licence text"),
])  # fmt: skip
def test_wheel_with_missing_or_extra_contents_is_refused(check, tmp_path, change, told):
    path = tmp_path / "any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in (members() | change).items():
            if content is not None:
                archive.writestr(name, content)
    if told is None:
        assert "compiled modules" in check["contents"](path)
    else:
        with pytest.raises(check["NotYetError"], match=re.escape(told)):
            check["contents"](path)


def test_release_check_extracts_the_files_from_readme(check):
    files = check["readme_files"]()
    assert list(files) == ["test_cruise.py"]
    assert "@pafot.search" in files["test_cruise.py"]
    assert (
        (ROOT / "docs/start/test_cruise.py").read_text().endswith(files["test_cruise.py"].lstrip())
    )


@pytest.mark.skipif(os.name != "posix", reason="needs locks of POSIX")
def test_two_builds_in_one_folder_are_serialized(setup, tmp_path, monkeypatch):
    import fcntl

    def is_free():
        with (tmp_path / "build" / "lock").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            return True

    monkeypatch.chdir(tmp_path)
    for failure in (None, RuntimeError):
        with suppress(RuntimeError), setup["one_build_at_a_time"]():
            assert not is_free()
            if failure:
                raise failure
        assert is_free()


def test_release_workflow_publishes_on_a_tag_what_was_tried_by_files_that_exist():
    workflow = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))
    assert workflow[True]["push"] == {"tags": ["v*"]}  # YAML reads the key `on` as true
    jobs = workflow["jobs"]
    publish = jobs.pop("publish")
    assert publish["if"] == "github.event_name == 'push'"
    assert {*publish["needs"]} == {*jobs}
    assert publish["permissions"] == {"id-token": "write"}
    assert not [name for name, job in jobs.items() if "permissions" in job]
    steps = [step for job in jobs.values() for step in job["steps"]]
    uploads = [
        step["with"]["name"]
        for step in steps
        if step.get("uses", "").startswith("actions/upload-artifact")
    ]
    assert all(name.startswith("packages-") for name in uploads)
    assert publish["steps"][0]["with"]["pattern"] == "packages-*"
    wheels = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "cibuildwheel"
    ]
    commands = [step.get("run", "") for step in workflow["jobs"]["try"]["steps"]]
    assert "rm -r pytest_pafot setup.py" in commands
    assert "pytest_pafot" not in wheels["test-sources"]
    quick = wheels["test-command"][-1]
    assert commands[-1] == quick == "python -m pytest -n 2 @tests/quick.txt"
    named = (ROOT / "tests" / "quick.txt").read_text(encoding="utf-8").split()
    for path in ["pytest_pafot", "setup.py", "tests/quick.txt", *wheels["test-sources"], *named]:
        assert (ROOT / path).exists()
    assert 'os.environ.get("PAFOT_PURE"' in (ROOT / "setup.py").read_text(encoding="utf-8")
    assert {"PAFOT_PURE": "1"} in [
        step.get("env") for step in workflow["jobs"]["any-system"]["steps"]
    ]
