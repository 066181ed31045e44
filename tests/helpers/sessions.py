"""Sessions of pytest inside a test, deep in the calls of the outer session."""

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

from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.report.session_record import VERSION, FindingRecord, ItemRecord, SessionRecord

INTERRUPTIBLE = (
    sys.executable,
    "-c",
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from pytest_pafot.__main__ import main\n"
    "sys.exit(main())",
)
"""The start of a ``python -m pytest_pafot`` command that SIGINT interrupts even in a shell's background job."""


def read_record(text):
    """Return a session's record for programs, and check that it has no unknown keys; `finds` of a search are ids."""
    plain = json.loads(text)
    assert plain.pop("pafot_json") == VERSION
    searches = [SearchSummary(**each) for each in plain.pop("searches")]
    findings = [FindingRecord(**each) for each in plain.pop("findings")]
    tests = [ItemRecord(**each) for each in plain.pop("tests")]
    return SessionRecord(searches=searches, findings=findings, tests=tests, **plain)


def section(result, name):
    """Return the output of a session about the failure of a test function."""
    lines = result.outlines
    title = re.compile(rf"_{{3,}} (.*[ .])?{re.escape(name)}(\[.*\])? _{{3,}}")
    start = next(number for number, line in enumerate(lines) if title.fullmatch(line))
    rest = range(start + 1, len(lines))
    end = next(number for number in rest if re.fullmatch(r"([_=])\1{2,} .* \1{3,}", lines[number]))
    return "\n".join(lines[start:end])


def in_process(pytester, *args, **kwargs):
    """Run ``pytester.runpytest_inprocess`` with room for its frames."""
    return _with_room(pytester.runpytest_inprocess, *args, **kwargs)


def in_a_copy(pytester, *args):
    """Run ``pytester.runpytest_subprocess`` in a copy of this process, which has already imported everything.

    A new interpreter takes longer than most sessions. A copy may end in any way. It cannot test what a session imports,
    hash seeds, or other things that are settled when an interpreter starts.
    """
    if not hasattr(os, "fork"):
        return pytester.runpytest_subprocess(*args)
    begun = time.monotonic()
    base = tempfile.mkdtemp(prefix="runpytest-", dir=pytester.path)
    streams = [pytester.path / name for name in ("stdout", "stderr")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a thread of a worker of pytest-xdist only waits
        pid = os.fork()
    if not pid:
        _be_a_session(streams, [f"--basetemp={base}", *map(str, args)])
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    out, err = (stream.read_text(encoding="utf-8") for stream in streams)
    print(out, err, sep="\n")
    return pytest.RunResult(status, out.splitlines(), err.splitlines(), time.monotonic() - begun)


FIXTURE = type(pytest.fixture(lambda: None))


def quick_sessions(monkeypatch):
    """Cache what is the same in all sessions of this process: looking it up takes a third of a short session."""
    monkeypatch.setattr(metadata, "distributions", lambda **which: iter(_installed()))
    monkeypatch.setattr(_pytest.fixtures, "dir", _names_of_fixtures, raising=False)
    monkeypatch.setattr(_pytest.assertion.rewrite, "_rewrite_test", _rewritten)
    monkeypatch.setattr(_pytest._code.code, "getstatementrange_ast", _statement_range)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # rewritten code is already in KNOWN_CODE
    monkeypatch.setattr(sys, "path_importer_cache", dict(sys.path_importer_cache))  # without the folders of other tests


class Installed(metadata.PathDistribution):
    """An installed package whose files are read once."""

    entry_points = functools.cached_property(metadata.PathDistribution.entry_points.fget)
    files = functools.cached_property(metadata.PathDistribution.files.fget)
    metadata = functools.cached_property(metadata.PathDistribution.metadata.fget)


ALL_INSTALLED = metadata.distributions


@functools.cache
def _installed():
    """Return the packages in which pytest may find plugins; it would read all packages again in each session."""
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
    """Return the result of assertion rewriting, cached: the same text in a different folder has the same result."""
    key = path.name, path.read_bytes()
    if key not in KNOWN_CODE:
        KNOWN_CODE[key] = REWRITE(path, config)
    source_hash, code = KNOWN_CODE[key]
    return source_hash, _in_file(code, str(path))


def _in_file(code, name):
    """Return the code, and all code in it, as if it came from a file of this name."""
    constants = tuple(_in_file(each, name) if isinstance(each, types.CodeType) else each for each in code.co_consts)
    return code.replace(co_filename=name, co_consts=constants)


KNOWN_RANGES = {}
STATEMENT_RANGE = _pytest._code.code.getstatementrange_ast


def _statement_range(line, source, astnode=None):
    """Return pytest's range of a failed statement, cached because pytest parses the whole file for it."""
    key = str(source), line
    if key in KNOWN_RANGES:
        return None, *KNOWN_RANGES[key]  # no syntax tree: pytest would cache it per file
    tree, start, end = STATEMENT_RANGE(line, source, astnode=astnode)
    KNOWN_RANGES[key] = start, end
    return tree, start, end


def _is_shared(source):
    """Return whether a source is a part of pytest or of this plugin, which all sessions of this process share."""
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
    """Call a function in a frame that reserves memory for all frames of the calls in it.

    CPython stores frames in pieces of 16 KiB. It requests a new piece from the system at each call that does not fit,
    and returns the piece at its end. In a loop at such a depth, that takes longer than the calls themselves. A frame
    that needs more gets its own piece of up to twice the size, and later frames use the rest of that.
    """
    return call(*args, **kwargs)


_with_room.__code__ = _with_room.__code__.replace(co_stacksize=70_000)
