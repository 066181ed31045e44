"""Modules that were does not match the sources next to them are never used, and one line says so."""

import os
import runpy
import warnings
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest
from setuptools import Distribution, Extension
from setuptools.command.build_ext import build_ext

from pytest_pafot.support import compiled

ROOT = Path(__file__).parents[2]
SUFFIX = EXTENSION_SUFFIXES[0]
RECORD = f"_cython{SUFFIX}.txt"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a package with one room of two modules, which are complete and compiled, though to files without code."""
    room = tmp_path / "pytest_pafot" / "room"
    room.mkdir(parents=True)
    monkeypatch.setattr(compiled, "PACKAGE", room.parent)
    monkeypatch.setattr(compiled, "FOLDERS", ("room",))
    monkeypatch.delenv("PAFOT_KERNEL", raising=False)
    (room / "__init__.py").touch()
    for name in ("one", "two"):
        (room / f"{name}.py").write_text("VALUE = 1\n")
        (room / f"{name}.pxd").write_text("cdef int VALUE\n")
        (room / f"{name}{SUFFIX}").touch()
    (room.parent / f"_cython{SUFFIX}").touch()
    (room.parent / RECORD).write_text(compiled.record())
    return room.parent


def rewrite(name, old, new):
    def change(package):
        path = package / name
        path.write_bytes(path.read_bytes().replace(old, new))

    return change


def remove(*names):
    return lambda package: [(package / name).unlink() for name in names]


def add_two(package):
    for suffix in (".py", ".pxd"):
        (package / "room" / f"new{suffix}").touch()


def of_another_python(package):
    for path in package.rglob(f"*{SUFFIX}*"):
        path.rename(path.with_name(path.name.replace(SUFFIX, ".cpython-399.so")))


CHANGES = [
    (lambda package: None, ""),
    (rewrite("room/one.py", b"\n", b"\r\n"), ""),
    (lambda package: (package / "room" / "one.py").touch(), ""),
    (lambda package: (package / "room" / ".#one.pxd").symlink_to("nothing"), ""),
    (rewrite("room/one.py", b"1", b"2"), " room/one.py."),
    (rewrite("room/two.pxd", b"int", b"double"), " room/two.pxd."),
    (add_two, " new."),
    (remove("room/two.py", "room/two.pxd"), " room/two.pxd."),
    (remove(f"room/two{SUFFIX}"), " two."),
    (remove(RECORD), " room/one.pxd."),
    (rewrite(RECORD, b"one.py\n", b"on"), " room/"),
    (of_another_python, compiled.ABSENT),
]  # fmt: skip


@pytest.mark.parametrize(("change", "differs"), CHANGES)
def test_what_differs_from_what_was_compiled_is_named(package, change, differs):
    change(package)
    told = compiled.why_interpreted()
    assert differs in told
    assert bool(told) == bool(differs)


def test_stale_modules_are_not_imported_and_one_line_says_so(package, monkeypatch):
    monkeypatch.syspath_prepend(package)
    import room

    (package / "room" / "one.py").write_text("VALUE = 2\n")
    compiled._warn.cache_clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("error")
        compiled.load("room")
        compiled.load("room")
    assert (room.one.VALUE, room.two.VALUE) == (2, 1)
    (text,) = (str(each.message) for each in told)
    assert "room/one.py" in text
    assert "\n" not in text


def test_modules_made_from_their_sources_are_imported(package, monkeypatch):
    monkeypatch.syspath_prepend(package)
    import room  # noqa: F401

    # a file without code; its source would be imported
    with pytest.raises(ImportError, match=f"one{SUFFIX}"):
        compiled.load("room")


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(ROOT / "setup.py"))


@pytest.fixture
def build(script, package, monkeypatch):
    """Return a function that builds one of the modules as ``setup.py`` does; its compiler only writes a text."""
    monkeypatch.chdir(package.parent)

    def run(problem=None):
        def compile_one(command, extension):
            path = Path(command.get_ext_fullpath(extension.name))
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"forced: {command.force}")
            if problem:
                raise problem

        monkeypatch.setattr(build_ext, "build_extension", compile_one)
        modules = [
            Extension(name, []) for name in ("pytest_pafot._cython", "pytest_pafot.room.one")
        ]
        command = script["AllOrNothing"](Distribution({"ext_modules": modules}))
        command.ensure_finalized()
        command.run()

    return run


def built(package):
    return {
        path.relative_to(package).as_posix().replace(SUFFIX, "")
        for path in package.rglob(f"*{SUFFIX}*")
    }


def test_build_leaves_its_record_and_no_module_of_an_earlier_build(build, script, package):
    build()
    assert built(package) == {"_cython", "_cython.txt", "room/one"}
    assert (package / RECORD).read_text() == script["SOURCES"]
    assert (package / f"room/one{SUFFIX}").read_text() == "forced: True"
    build()
    assert (package / f"room/one{SUFFIX}").read_text() == "forced: False"


def test_failed_build_leaves_nothing(build, package):
    build()
    with pytest.warns(UserWarning, match="no compiler"):
        build(OSError("no compiler"))
    assert built(package) == set()


def test_interrupted_build_leaves_no_record_and_is_repeated_as_a_whole(build, package):
    build()
    with pytest.raises(KeyboardInterrupt):
        build(KeyboardInterrupt())
    assert built(package) == {"_cython", "room/one"}
    build()
    assert (package / f"room/one{SUFFIX}").read_text() == "forced: True"


@pytest.mark.parametrize(("before", "age", "is_missed"), [
    (None, 0, True), ("a one.py\n", 9, False), ("b one.py\n", 9, True), ("b one.py\n", -9, False),
])  # fmt: skip
def test_change_of_an_old_file_is_not_missed(script, package, monkeypatch, before, age, is_missed):
    monkeypatch.setitem(script["has_to_translate_all"].__globals__, "PACKAGE", package / "room")
    made = package / "translated.txt"
    if before:
        made.write_text(before)
        seconds = made.stat().st_mtime - age
        os.utime(package / "room" / "one.py", (seconds, seconds))
    assert script["has_to_translate_all"](made, "a one.py\n") is is_missed
