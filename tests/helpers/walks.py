"""Which file of the package calls which, in whole sessions.

    python -m tests.helpers.walks FOLDER

A program, since the kernel must be interpreted for its calls to be seen, and one process imports one kernel. Each route
of :data:`ROUTES` is a session in a fork, so what one caches hides no call of the next. A call through other code, such
as pytest's, counts as one of the file of the package that called that code. Calls while a module is imported are left
out. Writes the calls to ``ROUTE.json`` in the folder, each once: the file that calls, the file that is called, and the
function. The first is empty if no file of the package has called pytest.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import pkgutil
import sys
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

TESTS = """
import time

import pytest_pafot as pafot

SHORT = {"genes": 2, "gene_seconds": 3, "npcs": 2, "ego_lane": 1, "ego_speed": 22}


def keeping():
    return lambda observation: (0.0, 0.0)


def slow():
    time.sleep(0.03)  # from 10 ms on, other processes are used
    return keeping()


@pafot.search(**SHORT, ads=keeping, blame="ego")
def test_collision(run):
    assert not run.collision, run.explain()


@pafot.search(**SHORT, ads=keeping)
def test_check(run):
    assert run.collision or run.min_distance > 15


@pafot.search(genes=1, npcs=1, ads=lambda: lambda observation: 1, world=pafot.World("highway-v0", duration=2.0))
def test_environment(run):
    assert run.duration < 1


@pafot.search(**SHORT, ads=slow)
def test_workers(run):
    assert run.min_distance > 3
"""
ROUTES: Mapping[str, str] = {
    "collision": "test_it.py::test_collision",
    "check": "test_it.py::test_check",
    "environment": "test_it.py::test_environment",
    "workers": "test_it.py::test_workers --pafot-workers=2",
    "replay": "test_it.py::test_collision --pafot-generations=0",
}
"""The options of each route's session; the last one replays what the first one saves."""
ALWAYS = (
    "-p", "pytest_pafot.plugin", "-p", "no:cacheprovider", "--pafot-seed=2",
    "--pafot-runs=8", "--pafot-shrink-runs=6",
)  # fmt: skip
ROOMS = (
    "attribution", "searches", "corpus", "execution", "findings", "oracle", "plugin", "report", "algorithms", "world",
)  # fmt: skip
"""The rooms whose modules a session imports."""


class Watch:
    """A profiler that notes each call from one file of a folder into another."""

    def __init__(self, folder: str) -> None:
        self.calls: dict[tuple[str, str, str], None] = {}
        self._folder = folder
        self._files: dict[str, str] = {}
        self._stack: list[tuple[str, bool]] = [("", False)]

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            name = frame.f_code.co_filename
            if name not in self._files:
                self._files[name] = (
                    name.removeprefix(self._folder) if name.startswith(self._folder) else ""
                )
            here, (caller, is_loading) = self._files[name], self._stack[-1]
            is_loading = is_loading or (bool(here) and frame.f_code.co_name == "<module>")
            if here and here != caller and not is_loading:
                self.calls[caller, here, frame.f_code.co_name] = None
            self._stack.append((here or caller, is_loading))
        elif event == "return" and len(self._stack) > 1:
            self._stack.pop()


def main(folder: Path) -> None:
    os.environ |= {"PAFOT_KERNEL": "interpreted", "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    import pytest

    import pytest_pafot

    for room in ROOMS:  # once, and not in each fork, under the profiler
        rooms = importlib.import_module(f"pytest_pafot.{room}").__path__
        for module in pkgutil.walk_packages(rooms, f"pytest_pafot.{room}."):
            importlib.import_module(module.name)
    # a slow session would report its progress
    importlib.import_module("pytest_pafot.plugin.session").LOG_SECONDS = 1e9
    # the end of a generator that is garbage is a call, from wherever the collection happens to be
    gc.disable()
    os.register_at_fork(after_in_child=lambda: sys.setprofile(None))
    os.chdir(folder)
    Path("test_it.py").write_text(TESTS)
    Path("pytest.ini").write_text("[pytest]\n")
    for route, options in ROUTES.items():
        if not (child := os.fork()):
            watch = Watch(f"{Path(pytest_pafot.__file__).parent}{os.sep}")
            sys.setprofile(watch)
            status = pytest.main([*ALWAYS, *options.split()])
            sys.setprofile(None)
            Path(f"{route}.json").write_text(json.dumps(list(watch.calls)))
            sys.stdout.flush()
            os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        assert status == pytest.ExitCode.TESTS_FAILED, (
            f"{route}: expected a failure to follow, received {status}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
