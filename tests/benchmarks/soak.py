"""Does a long search stay within its bounds? Memory, descriptors, threads and temporary files at ten points.

    python -m tests.benchmarks.soak [--runs 100000] [--plain] [--driver IDMVehicle] [--options "..."]

One search of ``--runs`` runs in a session of its own, with a table, a page and a JSON file, or with ``--plain`` without
any of them. The ego is a vehicle class of highway-env, which the compiled kernel drives. The test function counts its
calls, and at each tenth of the runs it reads the figures of its process from /proc. The last line is from the end of
the session, when the findings are shrunk and the files are written. Only on Linux.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.command import options, print_head

TEST = """
import os
from pathlib import Path

import pytest
from highway_env.vehicle import behavior

import pytest_pafot as pafot

POINTS, EVERY = Path(os.environ["SOAK_POINTS"]), int(os.environ["SOAK_EVERY"])
calls = 0


def note(label):
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    made = sum(len(files) for _, _, files in os.walk(os.environ["TMPDIR"]))
    figures = status["VmRSS"].split()[0], len(os.listdir("/proc/self/fd")), status["Threads"].strip(), made
    with POINTS.open("a") as file:
        print(label, *figures, file=file)


@pytest.fixture(scope="session", autouse=True)
def last_point():
    yield
    note("end")


@pytest.fixture
def ads():
    return getattr(behavior, os.environ["SOAK_DRIVER"])


@pafot.search
def test_soak(run):
    global calls
    calls += 1
    if calls % EVERY == 0 and calls <= 10 * EVERY:
        note(calls)
    assert run.collision is None
"""


def main() -> None:
    """Run the session, and print its figures as a table."""
    given = options(__doc__, runs=100_000, plain=False, driver="IDMVehicle", options="")
    with tempfile.TemporaryDirectory(prefix="soak-") as name:
        folder = Path(name)
        (folder / "test_soak.py").write_text(TEST)
        (folder / "tmp").mkdir()
        points = folder / "points"
        files = ["--pafot-table=runs.csv", "--pafot-report=page.html", "--pafot-json=session.json"]
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:randomly", "--pafot-seed=0"]
        command += [f"--pafot-runs={given.runs}", *([] if given.plain else files), *shlex.split(given.options)]
        environ = os.environ | {
            "TMPDIR": str(folder / "tmp"),
            "SOAK_POINTS": str(points),
            "SOAK_EVERY": str(max(1, given.runs // 10)),
            "SOAK_DRIVER": given.driver,
        }
        began = time.monotonic()
        ended = subprocess.run(command, cwd=folder, env=environ, capture_output=True, text=True, check=False)
        seconds = time.monotonic() - began
        print_head("runs", "memory [MB]", "descriptors", "threads", "temporary files")
        for line in points.read_text().splitlines():
            label, kilobytes, *counts = line.split()
            print(f"| {label} | {int(kilobytes) / 1024:.0f} | {' | '.join(counts)} |")
        print(f"\n{seconds:.0f} s, exit code {ended.returncode}")
        for each in sorted(folder.glob("*.*")):
            print(f"{each.name}: {each.stat().st_size / 1e6:.1f} MB")
        print(f"temporary files afterwards: {sum(len(each) for _, _, each in os.walk(folder / 'tmp'))}")
        if ended.returncode not in (0, 1):  # 1 if it found anything
            sys.exit(ended.stdout[-3000:] + ended.stderr[-3000:])


if __name__ == "__main__":
    main()
