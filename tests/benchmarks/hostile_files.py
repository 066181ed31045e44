"""What does a session do with malicious corpus files? Each must be refused or run as data, and nothing else.

    python -m tests.benchmarks.hostile_files [--kinds NAME ...] [--modes serial workers xdist isolate] [--seconds 60]

Each file is replayed in its own session, next to a test that must pass, and in each mode. The test fails for every run,
so a session without failures has lost the file. A secret is outside the project. No session may copy anything from
there into its output (log, JUnit, JSON, page, summary of the job), write there or delete anything there. Prints a
Markdown table: the exit status (124: killed after ``--seconds``), time and memory, what went wrong, and the session's
message.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest_pafot as pafot
from tests.benchmarks.broken_ads import MODES
from tests.benchmarks.command import options, print_head

SECRET = "KEY-5f0c9a7e"
ESCAPES = r"\e[2J\e]0;owned\a\r::error::owned\n::add-mask::owned\n##[error]owned" + "\\u202e\\u2028\\x9b31m"
"""Text of a double-quoted YAML string: control characters, and commands of GitHub or Azure."""

TEST = """
import pytest_pafot as pafot

def drive(observation):  # in an environment by its own actions
    return (0.0, 0.0) if hasattr(observation, "ego") else 1

@pafot.search(ads=lambda: drive, world=pafot.Highway(duration=10.0))
def test_it(run):
    assert run.duration < 0

def test_other():
    pass
"""
GOOD = """pafot: 2
test: test_it.py::test_it
world: WORLD
scenario:
  seed: 7
  ego: {lane: 1, speed: 22.0}
  npcs:
    - - {cell: 1, speed: 25.0}
      - {cell: 2, speed: 8.0}
expect: {failure: AssertionError, assertion: run.duration < N, outcome: safe, time: 10.0, responsibility: none}
found: {seed: 1234, generation: 17, algorithm: pafot, versions: {pytest-pafot: 0.1.0, numpy: 2.4.6}}
"""


class Place:
    """A project with one corpus file, and the folder outside it."""

    def __init__(self, folder: Path) -> None:
        self.project, self.outside, self.told = folder / "project", folder / "outside", folder / "told"
        self.corpus = self.project / "pafot_corpus"
        self.folder = self.corpus / "test_it" / "test_it"
        self.file = self.folder / "hostile.pafot.yaml"
        for made in (self.folder, self.outside / "files", self.told, folder / "tmp"):
            made.mkdir(parents=True)
        (self.project / "test_it.py").write_text(TEST)
        self.secret = self.outside / "secret.yaml"
        self.secret.write_text(f"key: {SECRET}\n")
        (self.outside / "files" / "good.pafot.yaml").write_text(f"test: {SECRET}\n" + good())

    def outside_now(self) -> dict[str, object]:
        """Return all files outside the project, with their content and mode."""
        paths = sorted(self.outside.rglob("*"))
        return {str(path): (path.stat().st_mode, path.read_bytes() if path.is_file() else b"") for path in paths}

    def write(self, text: str | bytes) -> None:
        """Write the corpus file."""
        self.file.write_bytes(text.encode() if isinstance(text, str) else text)


Recipe = Callable[[Place], object]


def good(world: Mapping[str, Any] | None = None, **replaced: str) -> str:
    """Return a file that can be replayed, with a different world, or with changed values of keys."""
    text = GOOD.replace("WORLD", json.dumps(world or highway()))
    for key, value in replaced.items():
        text, count = re.subn(rf"(?<![a-z]){key}: [^,}}\n]+", lambda _, new=f"{key}: {value}": new, text)  # type: ignore[misc]
        if not count:
            raise KeyError(key)
    return text


def highway(**changes: object) -> dict[str, Any]:
    """Return a world of the plugin's own as plain data."""
    return {**pafot.Highway(duration=10.0).to_dict(), **changes}


def gym(config: Mapping[str, object] = MappingProxyType({}), **changes: object) -> dict[str, Any]:
    """Return an environment as plain data."""
    data = {**pafot.World("highway-fast-v0", duration=5.0).to_dict(), **changes}
    return data | {"config": {**data["config"], **config}}


def file(text: Callable[[], str | bytes]) -> Recipe:
    """Return a recipe that writes a text as the corpus file."""
    return lambda place: place.write(text())


def beside(what: Recipe) -> Recipe:
    """Return a recipe that writes a good file and does something in addition."""

    def recipe(place: Place) -> None:
        place.write(good())
        what(place)

    return recipe


def _file_linked_from_outside(place: Place) -> None:
    place.file.symlink_to(place.secret)


def _folder_linked_outside(place: Place) -> None:
    place.folder.rmdir()
    place.folder.symlink_to(place.outside / "files")


def _corpus_linked_outside(place: Place) -> None:
    (place.outside / "files" / "test_it" / "test_it").mkdir(parents=True)
    (place.outside / "files" / "test_it" / "test_it" / "x.pafot.yaml").write_text(f"test: {SECRET}\n{good()}")
    place.folder.rmdir()
    place.folder.parent.rmdir()
    place.corpus.rmdir()
    place.corpus.symlink_to(place.outside / "files")


def _socket(place: Place) -> None:
    here = os.open(place.folder, os.O_RDONLY)  # a socket's path must be short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(f"/proc/self/fd/{here}/hostile.pafot.yaml")
    os.close(here)


def _temporary_linked_outside(place: Place) -> None:
    (place.folder / ".pafot-1-0123456789abcdef.tmp").symlink_to(place.secret)


def _many_files(place: Place) -> None:
    for number in range(500):
        (place.folder / f"many-{number}.pafot.yaml").write_text("pafot: 2\n")


def _deep_folders(place: Place) -> None:
    place.folder.joinpath(*["d" * 60] * 40).mkdir(parents=True)


def _named(name: bytes) -> Recipe:
    return lambda place: Path(os.fsdecode(os.fsencode(place.folder) + b"/" + name)).write_text(good())


RECIPES: Mapping[str, Recipe] = MappingProxyType(
    {
        "link to a file outside": _file_linked_from_outside,
        "link to a folder outside": _folder_linked_outside,
        "corpus that is a link": _corpus_linked_outside,
        "link to a file of /proc": lambda place: place.file.symlink_to("/proc/self/environ"),
        "link to a device": lambda place: place.file.symlink_to("/dev/zero"),
        "link to itself": lambda place: place.file.symlink_to(place.file),
        "hard link to a file outside": lambda place: place.file.hardlink_to(place.secret),
        "FIFO": lambda place: os.mkfifo(place.file),
        "socket": _socket,
        "folder": lambda place: place.file.mkdir(),
        "half-written file that is a link": beside(_temporary_linked_outside),
        "deep folders": beside(_deep_folders),
        "500 files": beside(_many_files),
        "escapes in the message": file(lambda: good(assertion=f'"{ESCAPES}"', failure="ValueError")),
        "escapes in the test": file(lambda: good(test=f'"{ESCAPES}"')),
        "escapes in a version": file(lambda: good(algorithm=f'"{ESCAPES}"')),
        "escapes in a note of flakiness": file(lambda: good() + f'flaky: "{ESCAPES}"\n'),
        "escapes in a key": file(lambda: good() + f'"{ESCAPES}": 1\n'),
        "escapes in a reason": file(lambda: good() + f'xfail: {{reason: "{ESCAPES}", until: 2001-01-01}}\n'),
        "escapes in the name": _named(b"a\x1b[2J\r\n::error::owned.pafot.yaml"),
        "name that is no text": _named(b"\xff\xfe.pafot.yaml"),
        "name of brackets": _named(b"a]::test_other[x.pafot.yaml"),
        "bomb of aliases": file(lambda: "a: &a [x, x]\nb: &b [*a, *a]\nc: [" + "*b, " * 9999 + "]\n" + good()),
        "tag of Python": file(lambda: good(algorithm="!!python/object/apply:os.system ['id']")),
        "deep nesting": file(lambda: good(algorithm="[" * 100_000)),
        "deep mappings": file(lambda: good(algorithm="{a: " * 60_000)),
        "256 KiB of commas": file(lambda: good(algorithm="[" + "1," * 130_000 + "]")),
        "larger than 256 KiB": file(lambda: good() + "#" * 300_000),
        "number of 100,000 digits": file(lambda: good(seed="9" * 100_000)),
        "numbers that are none": file(lambda: good(speed=".inf", generation="-1.7e+308")),
        "speed far below zero": file(lambda: good(speed="-1.7e+308")),
        "long chain": file(
            lambda: good().replace("      - {cell: 2", "      - {cell: 1, speed: 1.0}\n" * 7000 + "      - {cell: 2")
        ),
        "a drive of a year": file(lambda: good(highway(duration=3e7))),
        "a drive of a year in an environment": file(lambda: good(gym(duration=3e7))),
        "a hang limit of a year": file(lambda: good(highway(hang_limit=3e7))),
        "many steps a second": file(lambda: good(highway(physics_hz=10**6, ads_hz=10**6))),
        "a million lanes": file(lambda: good(gym({"lanes_count": 10**6}))),
        "a million vehicles": file(lambda: good(gym({"vehicles_count": 10**6}))),
        "a picture of a million pixels a side": file(
            lambda: good(gym({"screen_width": 10**6, "screen_height": 10**6, "offscreen_rendering": True}))
        ),
        "a grid of a million cells a side": file(
            lambda: good(gym({"observation": {"type": "OccupancyGrid", "grid_size": [[-1e6, 1e6], [-1e6, 1e6]]}}))
        ),
        "class of vehicles of another module": file(lambda: good(gym({"other_vehicles_type": "os.system"}))),
        "class of vehicles that is none": file(
            lambda: good(gym({"other_vehicles_type": "highway_env.vehicle.behavior.np.save"}))
        ),
        "environment with a module": file(lambda: good(gym(env_id="antigravity:highway-v0"))),
        "environment of another package": file(lambda: good(gym(env_id="CartPole-v1"))),
        "world that names a class": file(lambda: good({"kind": "own", "class": "os:system", "data": "id"})),
        "world of a package that is not there": file(lambda: good({"kind": "no_such:kind", "data": {}})),
    }
)


def session(place: Place, mode: str, seconds: float) -> tuple[int, float, float, str]:
    """Run pytest in the project; return its exit status, duration [s], memory [MB] and output."""
    told = place.told
    written = [f"--junitxml={told}/junit.xml", f"--pafot-json={told}/pafot.json", f"--pafot-report={told}/page.html"]
    command = [sys.executable, "-m", "pytest", "-p", "pafot", "-v", "-rA", "--pafot-generations=0", *written]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "GITHUB_STEP_SUMMARY": f"{told}/summary.md"}
    environment |= {"TMPDIR": str(told.parent / "tmp"), "GITHUB_ACTIONS": "true", "COLUMNS": "120", "A_SECRET": SECRET}
    began, usage = time.monotonic(), None
    with (told / "log").open("wb") as log:
        process = subprocess.Popen(
            [*command, *MODES[mode]], cwd=place.project, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        status = 124 << 8
        while usage is None or not usage[0]:
            usage = os.wait4(process.pid, os.WNOHANG)
            if time.monotonic() - began > seconds:
                break
            time.sleep(0.05)
        else:
            status = usage[1]
        took = time.monotonic() - began
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        if not usage[0]:
            usage = os.wait4(process.pid, 0)
    process.returncode = 0  # It has already been waited for.
    text = (told / "log").read_bytes().decode(errors="backslashreplace")
    return os.waitstatus_to_exitcode(status), took, usage[2].ru_maxrss / 1024, text


def wrong(place: Place, before: dict[str, object], status: int, log: str) -> Iterator[str]:
    """Yield what went wrong."""
    if status == 0:
        yield "green"
    if not re.search(r"test_other PASSED|PASSED \S*test_other", log):
        yield "the other test did not pass"
    if "INTERNALERROR" in log:
        yield "internal error"
    for path in sorted(place.told.iterdir()):
        content = path.read_bytes()
        if SECRET.encode() in content:
            yield f"the secret is in {path.name}"
        if path.name in ("log", "summary.md"):
            lines = re.split(r"[\r\n\x85\u2028]", content.decode(errors="replace"))
            if any(line.lstrip().startswith("::") or "##[" in line for line in lines):
                yield f"a command in {path.name}"
            if re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e\u2028]", content.decode(errors="replace")):
                yield f"control characters in {path.name}"
    after = place.outside_now()
    if after != before:
        changed = sorted({path for path in {*before, *after} if before.get(path) != after.get(path)})
        yield f"changed outside: {', '.join(Path(path).name for path in changed)}"


def row(name: str, mode: str, seconds: float) -> str:
    """Return the row of a kind in a mode."""
    with tempfile.TemporaryDirectory() as folder:
        place = Place(Path(folder))
        RECIPES[name](place)
        before = place.outside_now()
        status, took, memory, log = session(place, mode, seconds)
        faults = "; ".join(wrong(place, before, status, log))
        said = next(iter(re.findall(r"^(?:FAILED|ERROR) .*", log, re.MULTILINE)), "")
        cells = (
            name,
            mode,
            str(status),
            f"{took:.0f} s",
            f"{memory:.0f} MB",
            faults or "nothing",
            ascii(said)[1:-1][:160],
        )
        return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def main() -> None:
    """Print the table."""
    given = options(__doc__, kinds=RECIPES, modes=MODES, seconds=60.0)
    print_head("kind", "mode", "exit status", "took", "memory", "wrong", "said")
    for name in given.kinds:
        for mode in given.modes:
            print(row(name, mode, given.seconds), flush=True)


if __name__ == "__main__":
    main()
