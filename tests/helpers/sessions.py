"""Sessions of pytest inside a test, deep in the calls of the outer session."""

import faulthandler
import functools
import gc
import importlib
import inspect
import json
import multiprocessing
import os
import pkgutil
import re
import runpy
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
from pytest_pafot.commands import search_command
from pytest_pafot.execution.pool import START_METHOD
from pytest_pafot.report.session_record import FINDING, VERSION
from tests.helpers.walks import ROOMS as CORE

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
    """A part of a record, whose keys are attributes, too."""

    __getattr__ = dict.__getitem__


def read_record(text):
    """Return a session's record for programs; each entry of a finding must have all keys."""
    record = Entry(json.loads(text))
    assert record.pafot_json == VERSION
    for name in ("searches", "findings", "orphans"):
        record[name] = [Entry(each) for each in record[name]]
    assert all(each.keys() == FINDING.keys() for each in record.findings)
    return record


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
    begun = time.monotonic()
    base = tempfile.mkdtemp(prefix="runpytest-", dir=pytester.path)
    done = command_in_a_copy("pytest", f"--basetemp={base}", *args, folder=pytester.path)
    return pytest.RunResult(
        done.code, done.out.splitlines(), done.err.splitlines(), time.monotonic() - begun
    )


@functools.cache
def imported(*rooms):
    """Import all modules of some rooms."""
    for room in rooms:
        path = importlib.import_module(f"pytest_pafot.{room}").__path__
        for module in pkgutil.walk_packages(path, f"pytest_pafot.{room}."):
            importlib.import_module(module.name)
    # pytest asks for the module of each line of a traceback, which looks at all modules once: copies need not do so.
    inspect.getmodule(imported.__wrapped__.__code__)


class Ended(NamedTuple):
    """A command that has ended."""

    code: int
    out: str
    err: str


def command_in_a_copy(module, *arguments, folder="."):
    """Run ``python -m pytest_pafot ...`` or ``python -m pytest ...`` as a :class:`Copy`."""
    imported(*CORE)
    if module == "pytest_pafot" and arguments[0] in __main__.COMMANDS:
        importlib.import_module(__main__.COMMANDS[arguments[0]].module)
    command = [sys.executable, "-m", module, *map(str, arguments)]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with Copy(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=err) as process:
            code = process.wait()
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
    monkeypatch.setattr(subprocess, "Popen", Copy)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # rewritten code is already in KNOWN_CODE
    # without the folders of other tests
    monkeypatch.setattr(sys, "path_importer_cache", dict(sys.path_importer_cache))


def set_keys(monkeypatch, **values):
    """Give options a value in the configuration of all sessions, which marks and the command line replace; or None."""
    given = os.environ.get("PYTEST_ADDOPTS", "").split()
    kept = [each for each in given if each.split("=")[1].removeprefix("pafot_") not in values]
    kept += [
        f"--override-ini=pafot_{name}={value}"
        for name, value in values.items()
        if value is not None
    ]
    monkeypatch.setenv("PYTEST_ADDOPTS", " ".join(kept))


def copied_workers(monkeypatch):
    """Let the workers of a command, which are new processes, be copies: importing takes longer than their part."""
    if START_METHOD == "fork":
        copies = multiprocessing.get_context("fork")
        monkeypatch.setattr(multiprocessing, "get_context", lambda method: copies)


class Installed(metadata.PathDistribution):
    """An installed package whose files are read once."""

    entry_points = functools.cached_property(metadata.PathDistribution.entry_points.fget)
    files = functools.cached_property(metadata.PathDistribution.files.fget)
    metadata = functools.cached_property(metadata.PathDistribution.metadata.fget)


ALL_INSTALLED = metadata.distributions


@functools.cache
def _installed():
    """Return the packages in which pytest may find plugins; it would read all packages again in each session."""
    return [
        Installed(each._path)
        for each in ALL_INSTALLED()
        if each.entry_points.select(group="pytest11")
    ]


def _names_of_fixtures(plugin):
    source = plugin if isinstance(plugin, types.ModuleType) else type(plugin)
    return _fixtures_in(source) if _is_shared(source) else dir(plugin)


@functools.cache
def _fixtures_in(source):
    return [
        name for name in dir(source) if isinstance(inspect.getattr_static(source, name), FIXTURE)
    ]


def _names_of_hooks(plugin):
    source = plugin if isinstance(plugin, types.ModuleType) else type(plugin)
    return _hooks_in(source) if _is_shared(source) else dir(plugin)


@functools.cache
def _hooks_in(source):
    return [name for name in dir(source) if name.startswith("pytest_")]


HOOK = getattr(pluggy._manager, "_static_hook_attr", None)


def _hook(plugin, name):
    return (
        _hook_in(plugin, name)
        if isinstance(plugin, types.ModuleType) and _is_shared(plugin)
        else HOOK(plugin, name)
    )


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
    constants = tuple(
        _in_file(each, name) if isinstance(each, types.CodeType) else each
        for each in code.co_consts
    )
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


ASKED = list(inspect.signature(subprocess.Popen._execute_child).parameters)[2:]
"""What is asked of a process apart from its command, as `subprocess` names it."""
PIPES = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")
"""The ends of the pipes of a process among these."""
OF_ALL = (sys.prefix, sys.base_prefix, str(Path(__file__).parents[2] / "pytest_pafot"))
"""The folders of the modules that a copy keeps. Those of the project in which it runs may have changed."""
SESSION = search_command.PYTEST
WORKER = "import sys;exec(eval(sys.stdin.readline()))"
"""The program of a worker of pytest-xdist, which receives the rest."""


class Copy(subprocess.Popen):
    """What `subprocess.Popen` starts, but scripts, pytest, this package and workers of pytest-xdist as copies.

    A copy of this process has already imported everything, and importing takes longer than most sessions. It cannot
    test what an interpreter settles when it starts, such as finders and hash seeds, and does not come to the end of an
    interpreter, where `atexit` is.
    """

    def _execute_child(self, args, *given):
        found = _call_of(args) if hasattr(os, "fork") else None
        if found is None:
            return super()._execute_child(args, *given)
        asked = dict(zip(ASKED, given, strict=True))
        asked["without"] = _modules_of_the_project()
        with warnings.catch_warnings():
            # a thread of a worker of pytest-xdist only waits
            warnings.simplefilter("ignore", DeprecationWarning)
            self.pid = os.fork()
        if not self.pid:
            sys.orig_argv, (sys.argv, call) = args, found
            _end_with(call, asked)
        self._child_created = True
        return self._close_pipe_fds(*map(asked.get, PIPES))


def _call_of(command):
    """Return what a copy of this process calls instead of a command, with its `sys.argv`, or None."""
    match command:
        case [sys.executable, "-m", "pytest", *arguments]:
            return command[2:], lambda: _with_room(pytest.main, arguments)
        case [sys.executable, "-m", "pytest_pafot", *arguments]:
            return command[2:], lambda: _with_room(__main__.main_in_child, arguments)
        case [sys.executable, "-c", str() as program, *arguments] if program == SESSION:
            return ["-c", *arguments], lambda: _with_room(exec, program, {"__name__": "__main__"})
        case [sys.executable, "-u", "-c", str() as program] if program == WORKER:
            return ["-c"], lambda: _with_room(exec, program, {"__name__": "__main__"})
        case [sys.executable, str() as script, *arguments] if (
            script.endswith(".py") and script == Path(script).name
        ):
            return [
                script,
                *arguments,
            ], lambda: _with_room(runpy.run_path, script, run_name="__main__") and 0
    return None


INSTALLED = set()
"""The names of modules that were found to be installed."""


def _modules_of_the_project():
    """Return the names of the modules that a copy must import itself.

    The copy cannot look for them: it gets its own page of memory for each object that it touches, even to read, and all
    modules together take longer than the fork.
    """
    names = []
    for name in {*sys.modules} - INSTALLED:
        file = getattr(sys.modules[name], "__file__", None)
        if file and file.startswith(OF_ALL):
            INSTALLED.add(name)
        elif file:
            names.append(name)
    return names


def _end_with(call, asked):
    """End this process with the exit code that a call returns, in the surroundings that `subprocess` is asked for."""
    status = 1
    try:
        _settle(**asked)
        status = int(call() or 0)
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:  # noqa: BLE001
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(status)


def _settle(*, p2cread, c2pwrite, errwrite, pass_fds, cwd, env, start_new_session, without, **_):
    """Give a copy of this process what a new interpreter has: its own streams, signals, variables, folder, modules."""
    if start_new_session:
        os.setsid()
    for number, stream in enumerate((p2cread, c2pwrite, errwrite)):
        if stream >= 0:
            os.dup2(stream, number)
    nothing = os.open(os.devnull, os.O_RDWR)
    for number in [int(each.name) for each in Path("/dev/fd").iterdir()]:
        # closed, it might be a new file's when its object ends
        if number > 2 and number not in (nothing, *pass_fds):
            os.dup2(nothing, number, inheritable=False)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stdout, sys.stderr = (
        open(number, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        for number in (1, 2)
    )
    sys.__stdin__, sys.__stdout__, sys.__stderr__ = sys.stdin, sys.stdout, sys.stderr
    warnings.resetwarnings()
    faulthandler.disable()
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        # pygame's handlers, which abort, are not even known here
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(
                number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
            )
    if env is not None:
        os.environ.clear()
        os.environ.update(env)
    # finding it out writes a file, which a killed process leaves
    tempfile.tempdir = os.environ.get("TMPDIR")
    sys.dont_write_bytecode |= bool(os.environ.get("PYTHONDONTWRITEBYTECODE"))
    os.chdir(cwd or ".")
    sys.path[:0] = [
        str(Path.cwd()),
        *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)),
    ]
    for name in without:
        del sys.modules[name]
    importlib.invalidate_caches()
    subprocess.Popen = Copy
    gc.freeze()  # or the end of a session would search all that it shares with this process


def _with_room(call, *args, **kwargs):
    """Call a function in a frame that reserves memory for all frames of the calls in it.

    CPython stores frames in pieces of 16 KiB. It requests a new piece from the system at each call that does not fit,
    and returns the piece at its end. In a loop at such a depth, that takes longer than the calls themselves. A frame
    that needs more gets its own piece of up to twice the size, and later frames use the rest of that.
    """
    return call(*args, **kwargs)


_with_room.__code__ = _with_room.__code__.replace(co_stacksize=70_000)
