"""What happens in a session when an ADS is broken? Is each kind of failure contained and named?

    python -m tests.benchmarks.broken_ads [--kinds NAME ...] [--modes serial workers xdist isolate] [--seconds 90]

Each kind is searched in its own session, next to a test that must pass in the same session, and in each mode. Prints a
Markdown table: the exit status of the session (124: it was killed after ``--seconds``), whether the other test passed,
how long it took, and what the session named. If an ADS ends the session, a second session follows and its answer
appears instead, because it must name the scenario that was in flight.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from tests.benchmarks.command import options, print_head

RAISES = {
    "raises ValueError": "raise ValueError('lane')",
    "raises BaseException": "raise type('Panic', (BaseException,), {})('native')",
    "raises SystemExit": "sys.exit(3)",
    "raises SystemExit(0)": "sys.exit(0)",
    "raises KeyboardInterrupt": "raise KeyboardInterrupt",
    "pytest.exit": "pytest.exit('done', returncode=0)",
    "raises GeneratorExit": "raise GeneratorExit",
    "raises CancelledError": "import asyncio; raise asyncio.CancelledError",
    "raises a group": "raise BaseExceptionGroup('many', [SystemExit(1)])",
    "raises AssertionError": "assert not observation",
    "pytest.skip": "pytest.skip('no GPU')",
    "pytest.importorskip": "pytest.importorskip('no_such_module')",
    "pytest.xfail": "pytest.xfail('never')",
    "pytest.fail": "pytest.fail('never')",
    "unittest.SkipTest": "import unittest; raise unittest.SkipTest('no')",
    "message that raises": "raise type('Mute', (Exception,), {'__str__': lambda self: 1 / 0})",
    "message that exits": "raise type('Mute', (Exception,), {'__str__': lambda self: sys.exit(3)})",
    "huge message": "raise ValueError('x' * 5_000_000)",
    "message of many lines": "raise ValueError('a\\n' * 1000)",
    "surrogates and escapes": "raise ValueError('\\ud800 \\x00 \\x1b[31m')",
    "class with an odd name": "raise type('Bad\\nName ' * 50, (Exception,), {})('x')",
    "cause of itself": "error = ValueError('a'); error.__cause__ = error; raise error",
    "recursion without end": "f = lambda: f(); f()",
    "MemoryError": "raise MemoryError",
    "raises in __del__": "type('Late', (), {'__del__': lambda self: 1 / 0})()",
}
RETURNS = {
    "None": "return None",
    "NaN": "return float('nan'), 0.0",
    "infinity": "return 0.0, float('inf')",
    "text": "return 'FASTER'",
    "text in a pair": "return '1', '2'",
    "three numbers": "return 0.0, 0.0, 0.0",
    "one number": "return 1",
    "dict": "return {'acceleration': 0.0, 'steering': 0.0}",
    "huge whole number": "return 10**400, 0",
    "booleans": "return True, False",
    "array of shape (1, 2)": "return np.zeros((1, 2))",
    "array of objects": "return np.array([None, object()])",
    "number that raises": "return type('N', (), {'__float__': lambda self: 1 / 0})(), 0.0",
    "number that exits": "return type('N', (), {'__float__': lambda self: sys.exit(3)})(), 0.0",
    "repr that raises": "return type('R', (), {'__repr__': lambda self: 1 / 0})()",
    "a coroutine": "import asyncio; return asyncio.sleep(1)",
    "a generator": "return (value for value in (0.0, 0.0, 0.0))",
    "(action, state)": "return np.int64(1), None",
}
HANGS = {
    "sleeps": "time.sleep(1000)",
    "loops": "while True: pass",
    "loops and swallows": "while True:\n    try:\n        time.sleep(0.01)\n    except BaseException:\n        pass",
    "waits for a lock": "import threading; lock = threading.Lock(); lock.acquire(); lock.acquire()",
    "loops in C": "sum(range(10**12))",
    "SIGSTOP": "import signal; os.kill(os.getpid(), signal.SIGSTOP)",
}
DIES = {
    "os._exit": "os._exit(7)",
    "os._exit(0)": "os._exit(0)",
    "another program": "os.execv('/bin/true', ['true'])",
    "alarm": "import signal; signal.alarm(1)",
    "SIGSEGV": "import ctypes; ctypes.string_at(0)",
    "SIGKILL": "import signal; os.kill(os.getpid(), signal.SIGKILL)",
    "SIGTERM": "import signal; os.kill(os.getpid(), signal.SIGTERM)",
    "abort": "os.abort()",
    "stack of C": "sys.setrecursionlimit(10**7); f = lambda: f(); f()",
}
MEDDLES = {
    "os.chdir": "os.chdir('/')",
    "random.seed": "import random; random.seed(0); np.random.seed(0)",
    "np.seterr": "np.seterr(all='raise')",
    "closes stdout": "sys.stdout.close()",
    "no stdout": "sys.stdout = None",
    "closes descriptor 1": "os.close(1)",
    "takes all descriptors": (
        "global kept; kept = []\ntry:\n    while True: kept.append(open(os.devnull))\nexcept OSError: pass"
    ),
    "leaves threads": "import threading; threading.Thread(target=time.sleep, args=(1,), daemon=True).start()",
    "writes on its observation": "observation.array[:] = 0",
    "replaces the clock": "time.perf_counter = time.monotonic = lambda: 0.0",
    "warnings as errors": "import warnings; warnings.simplefilter('error'); warnings.warn('old')",
    "prints megabytes": "print('x' * 3_000_000)",
    "logs": "import logging; logging.error('x' * 100_000)",
    "takes the signals": "import signal; signal.signal(signal.SIGUSR1, signal.SIG_IGN)",
    "gc.disable": "import gc; gc.disable()",
    "little recursion": "sys.setrecursionlimit(60)",
    "empties the folder": "import shutil; shutil.rmtree('pafot_corpus', ignore_errors=True)",
    "empties sys.modules": "sys.modules.pop('pytest_pafot.oracle.run', None)",
    "forks": "os.fork() or os._exit(0)",
    "forks and runs on": "if not hasattr(os, 'forked'): os.forked = True; os.fork()",
    "closes all descriptors": "os.closerange(3, 256)",
    "leaves a thread that is no daemon": (
        "if not hasattr(os, 'left'):\n"
        "    import threading; os.left = threading.Thread(target=time.sleep, args=(1000,)); os.left.start()"
    ),
    "replaces json": "import json; json.dumps = json.loads = json.dump = json.load = None",
    "replaces pathlib": "import pathlib; pathlib.Path.open = pathlib.Path.iterdir = pathlib.Path.mkdir = None",
    "replaces open": "import builtins; builtins.open = os.open = None",
    "replaces time": "time.time = time.sleep = time.monotonic = None",
    "replaces writing of files": "import pytest_pafot.support.files; pytest_pafot.support.files.write_whole = None",
    "replaces random numbers": "import random; random.random = lambda: 0.5; np.random.default_rng = None",
    "takes all memory": ("import resource; resource.setrlimit(resource.RLIMIT_AS, (2**31, -1)); kept = np.ones(2**40)"),
    "keeps all that it saw": "os.kept = [*getattr(os, 'kept', ()), observation, np.ones(100_000)]",
    "little memory is left": "import resource; resource.setrlimit(resource.RLIMIT_AS, (2**28, -1))",
    "empties the cache": "import shutil; shutil.rmtree('.pytest_cache', ignore_errors=True)",
    "a file in the place of the corpus": "os.path.exists('pafot_corpus') or open('pafot_corpus', 'w').close()",
    "locks the corpus": "os.makedirs('pafot_corpus', exist_ok=True); os.chmod('pafot_corpus', 0)",
    "empties the folder of temporary files": (
        "import shutil, tempfile; shutil.rmtree(tempfile.gettempdir(), ignore_errors=True)"
    ),
    "os.umask": "os.umask(0o777)",
    "os.environ": "os.environ.clear()",
    "locale": "import locale; locale.setlocale(locale.LC_ALL, 'C')",
    "ignores interrupts": "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)",
    "sys.settrace": "sys.settrace(lambda frame, event, arg: None); sys.setprofile(lambda *args: None)",
    "a trace that raises": "sys.settrace(lambda frame, event, arg: 1 / 0)",
    "another stdout": "import io; sys.stdout = sys.stderr = io.StringIO()",
    "writes to all descriptors": (
        "for number in range(3, 30):\n    try: os.write(number, b'x' * 100)\n    except OSError: pass"
    ),
    "writes to descriptor 1": "os.write(1, b'x' * 100_000)",
    "an exit handler that exits": "import atexit; atexit.register(os._exit, 0)",
}
FACTORY = {
    "factory raises": "raise ValueError('weights')",
    "factory skips": "pytest.skip('no GPU')",
    "factory exits": "sys.exit(3)",
}
ELSEWHERE = {
    f"{name}, in another process": f"if os.getpid() == SESSION: return 0.0, 0.0\n{body}"
    for name, body in (HANGS | DIES | MEDDLES).items()
    if name in HANGS | DIES or "descriptors" in name or "forks" in name or "memory" in name or "stdout" in name
}
"""Kinds that end processes, or that interfere with the session's own processes."""
STARTS = {f"{name}, at first": body for name, body in list(RAISES.items())[:2] + list(RETURNS.items())[:1]}

TEST = """
import os, sys, time
import numpy as np
import pytest
import pytest_pafot as pafot

SESSION = os.getpid()

def drive(observation):
    time.sleep(0.001)
    if observation.time > WHEN:
BODY
    return 0.0, 0.0

def make():
FACTORY
    return drive

WORLD = pafot.Highway(duration=4.0, hang_limit=1.0)

@pafot.search(ads=make, world=WORLD, genes=1, shrink_rollouts=5)
def test_broken(run):
    assert run.duration > 0

def test_other():
    pass
"""

MODES: Mapping[str, Sequence[str]] = MappingProxyType(
    {
        "serial": (),
        "workers": ("--pafot-workers=2",),
        "xdist": ("-p", "xdist", "-n", "2"),
        "isolate": ("--pafot-isolate",),
    }
)
TELLING = (
    re.compile(r"^(?:FAILED|ERROR) \S*test_broken"),
    re.compile(r"^pafot: (?:found|died|hang)|code of the ADS, or of its environment, exceeds"),
    re.compile(r"Fatal Python error|^!+ .* !+$"),
    re.compile(r"^ +(?:warning|note): (?!--pafot-workers)"),
)
"""Patterns of what a session names, the clearest first."""


@dataclass(frozen=True, kw_only=True)
class Session:
    """The end of a session: its exit status, whether the other test passed, what it named, and how long it took [s]."""

    status: int
    is_other_passed: bool
    named: str
    seconds: float


def kinds() -> dict[str, str]:
    """Return the test file of each kind."""
    late = RAISES | {f"returns {name}": body for name, body in RETURNS.items()} | HANGS | DIES | MEDDLES | ELSEWHERE
    sources = {name: _source(body) for name, body in late.items()}
    sources |= {name: _source(body, when="-1") for name, body in STARTS.items()}
    return sources | {name: _source("pass", factory=body) for name, body in FACTORY.items()}


def _source(body: str, *, when: str = "1", factory: str = "pass") -> str:
    text = TEST.replace("WHEN", when).replace("BODY", textwrap.indent(body, " " * 8))
    return text.replace("FACTORY", textwrap.indent(factory, " " * 4))


def session(folder: Path, options: Sequence[str], seconds: float) -> Session:
    """Run pytest in a folder, with only this plugin and those of the options."""
    command = [sys.executable, "-m", "pytest", "-p", "pafot", "-v", "-rfE", "--pafot-runs=8", "--pafot-seed=1"]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "COLUMNS": "200", "CI": ""}
    environment["TMPDIR"] = str(folder / "tmp")
    (folder / "tmp").mkdir(exist_ok=True)
    began = time.monotonic()
    with (folder / "output").open("wb") as output:
        process = subprocess.Popen(
            [*command, *options], cwd=folder, env=environment, stdout=output, stderr=output, start_new_session=True
        )
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired:
            status = 124
        seconds = time.monotonic() - began
        with suppress(ProcessLookupError):  # the ADS may have left processes
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    text = (folder / "output").read_text(errors="replace")
    told = [line.strip() for each in TELLING for line in text.splitlines() if each.search(line)]
    is_passed = re.search(r"test_other PASSED|PASSED \S*test_other", text) is not None
    return Session(status=status, is_other_passed=is_passed, named=" / ".join(told[:2])[:200], seconds=seconds)


def row(name: str, source: str, mode: str, seconds: float) -> str:
    """Return the row of a kind in a mode."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "test_broken.py").write_text(source)
        first = session(folder, MODES[mode], seconds)
        status, named = str(first.status), first.named
        if first.status not in range(6) or not first.named:
            after = session(folder, MODES[mode], seconds)
            status, named = f"{first.status}, then {after.status}", after.named or "nothing"
    cells = (name, mode, status, "yes" if first.is_other_passed else "no", f"{first.seconds:.0f} s", named)
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def main() -> None:
    """Print the table."""
    sources = kinds()
    given = options(__doc__, kinds=sources, modes=MODES, seconds=90.0)
    print_head("kind", "mode", "exit status", "other test passed", "took", "named")
    for name in given.kinds:
        for mode in given.modes:
            print(row(name, sources[name], mode, given.seconds), flush=True)


if __name__ == "__main__":
    main()
