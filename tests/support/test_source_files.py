"""The user's source files behind an object: by imports in the text of files, without running them."""

import functools
import importlib
import sys
from pathlib import Path

import pytest

from pytest_pafot.support.references import source_files


def source_digests(value, *, here):
    """Return the hashes of the source files of an object by their paths in a folder."""
    files = source_files(value).items()
    return dict(
        sorted(
            (f.relative_to(here).as_posix(), digest)
            for f, (_, digest) in files
            if f.is_relative_to(here)
        )
    )


POLICY = """
import numpy, json
from core import steering
from package.deep import brake

class Policy:
    def __call__(self, observation):
        import lazy
        return brake(), steering(observation)
"""

FILES = {
    "policy.py": POLICY,
    "core.py": "def steering(observation): return 0.0",
    "lazy.py": "raise SystemExit('imported')",
    "package/__init__.py": "",
    "package/deep.py": "from . import gains\nif 0: from ..no_parent import x\ndef brake(): return gains.GAIN",
    "package/gains.py": "GAIN = 1.0",
    "package/unused.py": "",
    "unused.py": "",
}


@pytest.fixture
def policy(tmp_path, monkeypatch):
    """Return the module of a policy that imports other files."""
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("policy")
    for name in list(sys.modules):
        if name.partition(".")[0] in ("policy", "core", "package"):
            del sys.modules[name]


OF_POLICY = [
    "core.py", "lazy.py", "package/__init__.py", "package/deep.py", "package/gains.py", "policy.py",
]  # fmt: skip


def test_all_imported_files_are_found_unrun(policy, tmp_path):
    assert list(source_digests(policy, here=tmp_path)) == OF_POLICY
    assert "lazy" not in sys.modules


@pytest.mark.parametrize("name", OF_POLICY)
def test_a_change_of_any_file_changes_its_hash(policy, tmp_path, name):
    before = source_digests(policy.Policy, here=tmp_path)
    with (tmp_path / name).open("a") as file:
        file.write("\n# changed\n")
    after = source_digests(policy.Policy, here=tmp_path)
    assert [each for each in after if after[each] != before[each]] == [name]


def wrapped(factory):
    @functools.wraps(factory)
    def call(*args):
        return factory(*args)

    return call


class Holder:
    def __init__(self, factory):
        self.factory = factory

    def __call__(self):
        return self.factory()

    def method(self):
        return self.factory()


@pytest.mark.parametrize("held", [
    lambda made: lambda: made() or None,
    lambda made: lambda given=made: given(),
    functools.partial,
    lambda made: functools.partial(Holder, made),
    Holder,
    lambda made: Holder(made).method,
    lambda made: Holder([made]),
    wrapped,
    lambda made: made(),
    lambda made: made().__call__,
    lambda made: type("Derived", (made,), {}),
])  # fmt: skip
def test_a_policy_behind_wrappers_is_found(policy, tmp_path, held):
    found = source_digests(held(policy.Policy), here=tmp_path)
    assert set(OF_POLICY) <= set(found)


def test_files_have_names_of_modules(policy):
    names = [name for name, _ in source_files(policy).values()]
    assert sorted(names) == ["core", "lazy", "package", "package.deep", "package.gains", "policy"]


def test_links_are_hashed_by_what_they_point_to(policy, tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "core.py").rename(tmp_path / "real" / "core.py")
    (tmp_path / "core.py").symlink_to(tmp_path / "real" / "core.py")
    before = source_digests(policy, here=tmp_path)
    (tmp_path / "real" / "core.py").write_text("def steering(observation): return 1.0")
    after = source_digests(policy, here=tmp_path)
    assert [each for each in after if after[each] != before[each]] == ["real/core.py"]


def test_missing_and_broken_files_are_no_errors(policy, tmp_path):
    (tmp_path / "core.py").unlink()
    (tmp_path / "lazy.py").write_bytes(b"import \xff\x00")
    found = source_digests(policy, here=tmp_path)
    assert found["core.py"].startswith("unreadable: ")
    assert found["lazy.py"].startswith("sha256:")


def test_installed_and_own_packages_are_left_out():
    import numpy

    from pytest_pafot.algorithms.catalogue import RandomSearch

    assert source_files(numpy, RandomSearch, json_of, None, 1.0, "text").keys() == {Path(__file__)}
    exec_made = {}
    exec("def factory(): pass", exec_made)
    assert source_files(exec_made["factory"]) == {}


def json_of(value):
    import json

    return json.dumps(value)


def test_function_in_closure_without_value_yet_is_skipped():
    def factory():
        return later

    assert source_files(factory).keys() == {Path(__file__)}
    later = 1
