"""Sessions of pytest inside a test, deep in the calls of the outer session."""

import faulthandler
import functools
import importlib
import inspect
import json
import math
import os
import pkgutil
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import types
import warnings
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import _pytest._code.code
import _pytest.assertion.rewrite
import _pytest.fixtures
import pluggy._manager
import pytest

from pytest_pafot import __main__
from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.commands import search_command
from pytest_pafot.report.session_record import FINDING, VERSION, ItemRecord, SessionRecord

INTERRUPTIBLE = (
    sys.executable,
    "-c",
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from pytest_pafot.__main__ import main\n"
    "sys.exit(main())",
)
"""The start of a ``python -m pytest_pafot`` command that SIGINT interrupts even in a shell's background job."""


class Entry(dict):
    """The entry of a finding, whose keys are attributes, too."""

    __getattr__ = dict.__getitem__


def read_record(text):
    """Return a session's record for programs, and check that it has no unknown keys; `finds` of a search are ids."""
    plain = json.loads(text)
    assert plain.pop("pafot_json") == VERSION
    searches = [SearchSummary(**each) for each in plain.pop("searches")]
    findings = [Entry(each) for each in plain.pop("findings")]
    assert all(each.keys() == FINDING.keys() for each in findings)
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
    pid = _forked()
    if not pid:
        _be_a_session(streams, [f"--basetemp={base}", *map(str, args)])
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    out, err = (stream.read_text(encoding="utf-8") for stream in streams)
    print(out, err, sep="\n")
    return pytest.RunResult(status, out.splitlines(), err.splitlines(), time.monotonic() - begun)


CORE = (
    "attribution",
    "campaign",
    "corpus",
    "execution",
    "findings",
    "oracle",
    "plugin",
    "report",
    "searching",
    "world",
)
"""The rooms that a session imports."""


@functools.cache
def imported(*rooms):
    """Import all modules of some rooms."""
    for room in rooms:
        path = importlib.import_module(f"pytest_pafot.{room}").__path__
        for module in pkgutil.walk_packages(path, f"pytest_pafot.{room}."):
            importlib.import_module(module.name)


class Ended(NamedTuple):
    """A command that has ended."""

    code: int
    out: str
    err: str


def command_in_a_copy(module, *arguments, folder="."):
    """Run ``python -m pytest_pafot ...`` or ``python -m pytest ...`` in a copy of this process, for the same reason.

    The process that drives is a copy, too. Neither comes to the end of an interpreter, where `atexit` is.
    """
    arguments = list(map(str, arguments))
    assert module in ("pytest", "pytest_pafot"), module
    if not hasattr(os, "fork"):
        command = [sys.executable, "-m", module, *arguments]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=120)
        return Ended(done.returncode, done.stdout, done.stderr)
    imported(
        "attribution", "campaign", "corpus", "execution", "findings", "oracle", "plugin", "report", "searching", "world"
    )
    if module == "pytest_pafot" and arguments[0] in __main__.COMMANDS:
        importlib.import_module(__main__.COMMANDS[arguments[0]].module)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        pid = _forked()
        if not pid:
            _be_a_command(module, arguments, folder, (out.fileno(), err.fileno()))
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        texts = []
        for stream in (out, err):
            stream.seek(0)
            texts.append(stream.read().decode("utf-8"))
    print(*texts, sep="\n")
    return Ended(code, *texts)


FIXTURE = type(pytest.fixture(lambda: None))


def quick_sessions(monkeypatch):
    """Cache what is the same in all sessions of this process: looking it up takes a third of a short session."""
    monkeypatch.setattr(metadata, "distributions", lambda **which: iter(_installed()))
    monkeypatch.setattr(_pytest.fixtures, "dir", _names_of_fixtures, raising=False)
    monkeypatch.setattr(pluggy._manager, "dir", _names_of_hooks, raising=False)
    monkeypatch.setattr(pluggy._manager, "_static_hook_attr", _hook, raising=False)
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


def _names_of_hooks(plugin):
    source = plugin if isinstance(plugin, types.ModuleType) else type(plugin)
    return _hooks_in(source) if _is_shared(source) else dir(plugin)


@functools.cache
def _hooks_in(source):
    return [name for name in dir(source) if name.startswith("pytest_")]


HOOK = getattr(pluggy._manager, "_static_hook_attr", None)


def _hook(plugin, name):
    return _hook_in(plugin, name) if isinstance(plugin, types.ModuleType) and _is_shared(plugin) else HOOK(plugin, name)


@functools.cache
def _hook_in(module, name):
    return HOOK(module, name)


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


def _forked():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # a thread of a worker of pytest-xdist only waits
        return os.fork()


def _be_a_session(streams, args):
    """Run pytest to the end of this process, with standard output and errors in files."""
    _end_with(
        lambda: int(_with_room(pytest.main, args)),
        [os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC) for path in streams],
    )


def _be_a_command(module, arguments, folder, streams):
    """Run a command to the end of this process, as ``python -m`` does."""

    def run():
        os.chdir(folder)
        sys.path.insert(0, str(Path.cwd()))
        sys.argv = [module, *arguments]
        sys.orig_argv = [sys.executable, "-m", module, *arguments]
        for each in (__main__, search_command):
            each.subprocess = types.SimpleNamespace(Popen=_started, TimeoutExpired=subprocess.TimeoutExpired)
        return int(_with_room(pytest.main, arguments)) if module == "pytest" else _drive(arguments)

    _end_with(run, streams)


def _drive(arguments):
    return _with_room(__main__.main_in_child, arguments)


def _started(command, **options):
    """Return what `subprocess.Popen` does: a copy of this process for this package's own processes."""
    place = command.index("-m") if "-m" in command else 1
    is_own = command[place : place + 2] in (["-m", "pytest_pafot"], ["-c", search_command.PYTEST])
    return Copy(command[place:], **options) if is_own else subprocess.Popen(command, **options)


class Copy:
    """What `subprocess.Popen` is for a command that starts itself again, or a session, in a child process."""

    def __init__(self, command, env, stdout=None, stderr=None):
        self.left = None
        self.pid = _forked()
        if not self.pid:
            _end_with(lambda: self._run(command, env), (stdout or 1, stderr or 2))

    def _run(self, command, env):
        os.environ.clear()
        os.environ.update(env)
        if command[0] == "-m":
            return _drive(command[2:])
        sys.argv = ["-c", *command[2:]]
        return _with_room(exec, command[1], {"__name__": "__main__"})

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.wait()

    def send_signal(self, number):
        if self.left is None:
            os.kill(self.pid, number)

    def terminate(self):
        self.send_signal(signal.SIGTERM)

    def kill(self):
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout=None):
        deadline = math.inf if timeout is None else time.monotonic() + timeout
        while self.left is None:
            pid, status = os.waitpid(self.pid, 0 if timeout is None else os.WNOHANG)
            if pid:
                self.left = os.waitstatus_to_exitcode(status)
            elif time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("a copy", timeout)
            else:
                time.sleep(0.01)
        return self.left


def _end_with(call, streams=(1, 2)):
    """End this process with the exit code that a call returns, with standard output and errors in other streams."""
    status = 1
    try:
        for number, stream in enumerate((os.open(os.devnull, os.O_RDWR), *streams)):
            if stream != number:
                os.dup2(stream, number)
        sys.stdout, sys.stderr = (open(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))  # noqa: SIM115
        sys.__stdout__, sys.__stderr__ = sys.stdout, sys.stderr
        warnings.resetwarnings()
        faulthandler.disable()
        signal.signal(signal.SIGSEGV, signal.SIG_DFL)  # pygame has a handler that aborts
        status = call()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
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
