"""Do sessions write and print the same with this tree as with another commit, byte for byte?

    python -m tests.benchmarks.same_bytes --against REVISION [--sessions NAME ...] [--workers 2]

Run it before and after a change that must not change what users see. The commit is checked out in a temporary folder.
Each session runs with it and then with this tree, at the same path. Compared are the files of the corpus,
``--pafot-json``, and what pytest prints and returns. Left out are :data:`MASKS`, and the JSON of a
call that is killed: until its end, a session writes it when there is time. Prints a line for each session: ``same``, or
the first lines that differ. Ends with 1 if any does.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from tests.benchmarks.command import options

ROOT = Path(__file__).parents[2]

MASKS: Mapping[str, tuple[str, str]] = {
    "seconds of a session, in its last line": (r"^=+ (.* in )[\d.]+s(?: \(\d+:\d\d:\d\d\))? =+$", r"\1..."),
    "seconds of a search, after its runs": (r"^(  \d+ runs?\b.* in )\d+\.\d( s, \d+ failing)", r"\1...\2"),
    "decisions of a search of more than a minute; the JSON always has them": (r"^  [\d,]+ decisions\b.*\n", ""),
    "progress, each ten seconds": (r"^pafot: test_it\.py::\w+\[search\] .*\n", ""),
    "line break before the results, which progress adds": (r"^(test_it\.py )(?=[.Fs]+$)", "\\1\n"),
    "line of the package that Ctrl-C meets": (r"^TREE/\S+\.py:\d+(: KeyboardInterrupt)$", r"TREE/...\1"),
    "id of a process that died": (r"(a process \(pid )\d+(\) died)", r"\1...\2"),
}
"""What may differ in the output, by its place. In addition, the path of each tree is replaced by ``TREE``."""

TESTS = '''
import os
import signal
import time

import numpy as np
from gymnasium.wrappers import FlattenObservation
from highway_env.vehicle.behavior import IDMVehicle

import pytest_pafot as pafot

SESSION, SLOW = os.getpid(), float(os.environ.get("SLOW", "0"))
END, AT = int(os.environ.get("END", "0")), int(os.environ.get("AT", "0"))


def begin():
    """Count a run of any process, and end the session at its first decision if it is the one that ends the session."""
    time.sleep(SLOW)  # from 10 ms on, other processes are used
    if END:
        with open("runs", "ab") as runs:
            runs.write(b".")
        if os.path.getsize("runs") == AT:
            os.kill(SESSION, END)
            time.sleep(5)


class Keeping:
    """Keeps its speed."""

    is_new = True

    def __call__(self, observation):
        if self.is_new:
            self.is_new = False
            begin()
        return self.action

    action = 0.0, 0.0


class Idle(Keeping):
    action = 1


@pafot.search(ads=Keeping)
def test_highway(run):
    assert not run.collision, run.explain()


@pafot.search(ads=Keeping, algorithm="pafot")
def test_paper(run):
    assert not run.collision, run.explain()


@pafot.search(ads=Keeping, world=pafot.World("intersection-v0", planner_hz=5))
def test_intersection(run):
    assert not run.collision, run.explain()


@pafot.search(ads=Idle, world=pafot.World("highway-v0", duration=8.0, wrappers=[FlattenObservation]))
def test_environment(run):
    assert not run.collision, run.explain()


@pafot.search(ads=IDMVehicle)
def test_vehicle(run):
    assert not run.collision, run.explain()
    assert run.min_distance > 0.5
'''


class Session(NamedTuple):
    """Some calls of pytest one after another in one folder: the name of the test, and the options of each call."""

    test: str
    calls: tuple[str, ...] = ("",)
    always: str = ""
    end: int = 0
    """The signal that ends the first call at its run number ``at``; 0 for none."""
    at: int = 0
    slow: float = 0.0
    """How long each run takes at least [s]."""


TWO, XDIST, STOPS = "--pafot-workers=2", "-p xdist -n 2", "--pafot-stop-after=2"
DEAR = 0.02
SHRINKING = 29
"""The number of the first run that shrinks a finding."""
REPLAY = "--pafot-generations=0 -v"
SESSIONS: Mapping[str, Session] = {
    "highway": Session("highway", ("", REPLAY)),
    "highway-workers": Session("highway", always=TWO, slow=DEAR),
    "highway-isolated": Session("highway", always="--pafot-isolate"),
    "highway-interrupted": Session("highway", ("", ""), "", signal.SIGINT, SHRINKING),
    "highway-killed": Session("highway", ("", ""), "", signal.SIGKILL, SHRINKING),
    "highway-killed-isolated": Session("highway", ("", ""), "--pafot-isolate", signal.SIGKILL, SHRINKING),
    "paper": Session("paper"),
    "paper-workers": Session("paper", always=TWO, slow=DEAR),
    "intersection": Session("intersection", ("", REPLAY), STOPS),
    "intersection-workers": Session("intersection", always=f"{STOPS} {TWO}", slow=DEAR),
    "environment": Session("environment", ("", REPLAY), STOPS),
    "environment-workers": Session("environment", always=f"{STOPS} {TWO}", slow=DEAR),
    "vehicle": Session("vehicle", ("", REPLAY)),
    "vehicle-isolated-workers": Session("vehicle", always=f"--pafot-isolate {TWO}"),
}
ALWAYS = (
    "-p pytest_pafot.plugin --pafot-seed=3 --pafot-runs=24 --pafot-shrink-rollouts=16 "
    "--pafot-pairs=50 --pafot-today=2026-01-01 -o console_output_style=classic"
)
SETTINGS = ("CI", "GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY", "BUILD_NUMBER", "COLUMNS", "PYTEST_ADDOPTS", "PYTHONPATH")


def built() -> list[Path]:
    """Return the extensions that are built in this tree, and the records of what they were made from."""
    return [*ROOT.glob("pytest_pafot/**/*.so"), *ROOT.glob("pytest_pafot/*.so.txt")]


def build(tree: Path) -> None:
    """Build the extensions of a tree in place."""
    command = [sys.executable, "setup.py", "-q", "build_ext", "--inplace"]
    subprocess.run(command, cwd=tree, stdout=subprocess.DEVNULL, check=True)


@contextmanager
def checked_out(revision: str) -> Iterator[Path]:
    """Provide a temporary folder with a commit, and the extensions of both trees."""
    with tempfile.TemporaryDirectory(prefix="same-bytes-") as scratch:
        tree = Path(scratch, "tree")
        subprocess.run(["git", "worktree", "add", "-q", "--detach", tree, revision], cwd=ROOT, check=True)
        try:
            typed = [file for each in ROOT.glob("pytest_pafot/**/*.pxd") for file in (each, each.with_suffix(".py"))]
            compared = ["git", "diff", "--quiet", revision, "--", "setup.py", "*.pxd", *typed]
            is_same = subprocess.run(compared, cwd=ROOT, check=False).returncode == 0
            if not (is_same and built()):
                build(ROOT)
            if is_same:
                for each in built():
                    shutil.copy2(each, tree / each.relative_to(ROOT))
            else:
                build(tree)
            yield tree
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)


def written(session: Session, tree: Path, folder: Path) -> dict[str, str]:
    """Run a session in a new folder, and return what it printed and wrote, by the name of the file."""
    folder.mkdir(parents=True)
    (folder / "test_it.py").write_text(TESTS)
    (folder / "pytest.ini").write_text("[pytest]\n")
    kept = {name: value for name, value in os.environ.items() if name not in SETTINGS and not name.startswith("PAFOT_")}
    always = {"PYTHONPATH": str(tree), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "COLUMNS": "1000"}
    found = {}
    for number, call in enumerate(session.calls, start=1):
        more = {"SLOW": str(session.slow)}
        if session.end and number == 1:
            more |= {"END": str(int(session.end)), "AT": str(session.at)}
        outputs = f"--pafot-json={number}.json"
        command = f"{ALWAYS} {session.always} {outputs} {call} test_it.py::test_{session.test}"
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *command.split()],
            cwd=folder,
            env=kept | always | more,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode == -signal.SIGKILL:
            (folder / f"{number}.json").unlink()
        found[f"terminal {number}"] = f"{masked(done.stdout, tree)}\nexit code {done.returncode}\n"
    compared = [*folder.glob("*.json"), *folder.glob("pafot_corpus/**/*")]
    found |= {str(each.relative_to(folder)): each.read_text() for each in compared if each.is_file()}
    shutil.rmtree(folder)
    return found


def masked(text: str, tree: Path) -> str:
    """Return the output of a session without what may differ."""
    text = text.replace(f"{tree}/", "TREE/")
    for pattern, left in MASKS.values():
        text = re.sub(pattern, left, text, flags=re.MULTILINE)
    return text


def difference(before: Mapping[str, str], after: Mapping[str, str]) -> str:
    """Return where the files of two sessions differ first, with that part of both lines; empty if they are the same."""
    for name in sorted({*before, *after}):
        texts = (side.get(name, "(no such file)") for side in (before, after))
        lines = zip_longest(*(text.splitlines(True) for text in texts), fillvalue="")
        for number, (old, new) in enumerate(lines, start=1):
            if old != new:
                # A line may have thousands of characters.
                same = next(place for place, (a, b) in enumerate(zip_longest(old, new)) if a != b)
                at = max(same - 60, 0)
                return f"{name}, line {number}\n    - {old[at : at + 160]!r}\n    + {new[at : at + 160]!r}"
    return ""


def compared(other: Path, scratch: Path, name: str) -> str:
    """Run a session with both trees, and return where it differs; empty if nowhere."""
    before, after = (written(SESSIONS[name], tree, scratch / name) for tree in (other, ROOT))
    return difference(before, after)


def main() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background, sessions would ignore it as well
    given = options(__doc__, against="HEAD", sessions=SESSIONS, workers=2)
    differing = 0
    with (
        checked_out(given.against) as other,
        tempfile.TemporaryDirectory(prefix="same-bytes-") as scratch,
        ThreadPoolExecutor(given.workers) as pool,
    ):
        answers = pool.map(partial(compared, other, Path(scratch)), given.sessions)
        for name, found in zip(given.sessions, answers, strict=True):
            print(f"{name:26} {found or 'same'}", flush=True)
            differing += bool(found)
    print(f"{differing} of {len(given.sessions)} sessions differ")
    sys.exit(bool(differing))


if __name__ == "__main__":
    main()
