"""Sessions of pytest inside of a test, deep in the calls of the session that runs it."""

import faulthandler
import functools
import inspect
import json
import os
import re
import signal
import sys
import tempfile
import time
import traceback
import types
import warnings
from importlib import metadata

import _pytest._code.code
import _pytest.assertion.rewrite
import _pytest.fixtures
import pytest

from pytest_pafot.report.session_record import VERSION, FindingRecord, SearchRecord, SessionRecord


def read_record(text):
    """What a session told to programs, with no other keys than a record has."""
    plain = json.loads(text)
    assert plain.pop("pafot_json") == VERSION
    searches = [SearchRecord(**each) for each in plain.pop("searches")]
    findings = [FindingRecord(**each) for each in plain.pop("findings")]
    return SessionRecord(searches=searches, findings=findings, **plain)


def section(result, name):
    """What a session shows of the failure of the test function of this name."""
    lines = result.outlines
    title = re.compile(rf"_{{3,}} (.*[ .])?{re.escape(name)}(\[.*\])? _{{3,}}")
    start = next(number for number, line in enumerate(lines) if title.fullmatch(line))
    rest = range(start + 1, len(lines))
    end = next(number for number in rest if re.fullmatch(r"([_=])\1{2,} .* \1{3,}", lines[number]))
    return "\n".join(lines[start:end])


def in_process(pytester, *args, **kwargs):
    """``pytester.runpytest_inprocess``, with room for its frames."""
    return _with_room(pytester.runpytest_inprocess, *args, **kwargs)


def in_a_copy(pytester, *args):
    """``pytester.runpytest_subprocess`` in a copy of this process, which has imported all that a session needs.

    For an interpreter of its own that takes longer than most sessions last. A copy may end in any way. It shows nothing
    of what a session imports, of hash seeds, or of other things that are settled when an interpreter starts.
    """
    if not hasattr(os, "fork"):
        return pytester.runpytest_subprocess(*args)
    begun = time.monotonic()
    base = tempfile.mkdtemp(prefix="runpytest-", dir=pytester.path)
    streams = [pytester.path / name for name in ("stdout", "stderr")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads: that of a worker of pytest-xdist only waits
        pid = os.fork()
    if not pid:
        _be_a_session(streams, [f"--basetemp={base}", *map(str, args)])
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    out, err = (stream.read_text(encoding="utf-8") for stream in streams)
    print(out, err, sep="\n")
    return pytest.RunResult(status, out.splitlines(), err.splitlines(), time.monotonic() - begun)


FIXTURE = type(pytest.fixture(lambda: None))


def quick_sessions(monkeypatch):
    """Let sessions of this process look up once what is the same in all: else that is a third of a short one."""
    monkeypatch.setattr(metadata, "distributions", lambda **which: iter(_installed()))
    monkeypatch.setattr(_pytest.fixtures, "dir", _names_of_fixtures, raising=False)
    monkeypatch.setattr(_pytest.assertion.rewrite, "_rewrite_test", _rewritten)
    monkeypatch.setattr(_pytest._code.code, "getstatementrange_ast", _statement_range)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # what is rewritten is known
    monkeypatch.setattr(sys, "path_importer_cache", dict(sys.path_importer_cache))  # without the folders of other tests


class Installed(metadata.PathDistribution):
    """An installed package whose files are read once."""

    entry_points = functools.cached_property(metadata.PathDistribution.entry_points.fget)
    files = functools.cached_property(metadata.PathDistribution.files.fget)
    metadata = functools.cached_property(metadata.PathDistribution.metadata.fget)


ALL_INSTALLED = metadata.distributions


@functools.cache
def _installed():
    """Packages in which pytest may find plugins, of all that it would read again in each session."""
    return [Installed(each._path) for each in ALL_INSTALLED() if each.entry_points.select(group="pytest11")]


def _names_of_fixtures(plugin):
    source = plugin if isinstance(plugin, types.ModuleType) else type(plugin)
    return _fixtures_in(source) if _is_shared(source) else dir(plugin)


@functools.cache
def _fixtures_in(source):
    return [name for name in dir(source) if isinstance(inspect.getattr_static(source, name), FIXTURE)]


KNOWN_CODE = {}
REWRITE = _pytest.assertion.rewrite._rewrite_test


def _rewritten(path, config):
    """What assertion rewriting makes of a file; of the same text in another folder it is the same."""
    key = path.name, path.read_bytes()
    if key not in KNOWN_CODE:
        KNOWN_CODE[key] = REWRITE(path, config)
    source_hash, code = KNOWN_CODE[key]
    return source_hash, _in_file(code, str(path))


def _in_file(code, name):
    """The code, and all code in it, as if it had been read from a file of this name."""
    constants = tuple(_in_file(each, name) if isinstance(each, types.CodeType) else each for each in code.co_consts)
    return code.replace(co_filename=name, co_consts=constants)


KNOWN_RANGES = {}
STATEMENT_RANGE = _pytest._code.code.getstatementrange_ast


def _statement_range(line, source, astnode=None):
    """What pytest finds out of a statement that a failure shows, for which it parses the whole file."""
    key = str(source), line
    if key in KNOWN_RANGES:
        return None, *KNOWN_RANGES[key]  # without the tree of the file: pytest keeps it, to parse no file twice
    tree, start, end = STATEMENT_RANGE(line, source, astnode=astnode)
    KNOWN_RANGES[key] = start, end
    return tree, start, end


def _is_shared(source):
    """Whether it is a part of pytest, or of this plugin, that all sessions of this process share."""
    name = source.__name__ if isinstance(source, types.ModuleType) else source.__module__
    return name.startswith(("_pytest.", "pytest_pafot.plugin")) and "<locals>" not in getattr(
        source, "__qualname__", ""
    )


def _be_a_session(streams, args):
    """Run pytest to the end of this process, with standard output and errors in files."""
    status = 1
    try:
        for number, path in enumerate((os.devnull, *streams)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout, sys.stderr = (open(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))  # noqa: SIM115
        sys.__stdout__, sys.__stderr__ = sys.stdout, sys.stderr
        warnings.resetwarnings()
        faulthandler.disable()
        signal.signal(signal.SIGSEGV, signal.SIG_DFL)  # pygame has a handler that aborts
        status = int(_with_room(pytest.main, args))
    except BaseException:  # noqa: BLE001
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _with_room(call, *args, **kwargs):
    """A call in a frame that brings room for all frames of the calls in it.

    CPython keeps frames in pieces of 16 KiB, and asks the system for a new piece at each call that does not fit, which
    goes back when the call returns: where a loop calls so deep, that takes more time than what it calls. A frame that
    needs more has a piece of its own, of twice the size or a little less, and later frames use the rest of it.
    """
    return call(*args, **kwargs)


_with_room.__code__ = _with_room.__code__.replace(co_stacksize=70_000)
