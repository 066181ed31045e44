"""How many machine instructions does a scenario cost? A gate against slower code that noise cannot affect.

    python -m tests.benchmarks.instructions [--tolerance 0.05] [--write]

Runs twice under valgrind's callgrind, with few and with more scenarios; the difference is the cost of the runs without
start and imports. Compares it with the counts in ``instructions.json``, which are valid for one Python version and one
kind of processor, and exits with 1 if a count exceeds the tolerance. ``--write`` stores the present counts as the new
ones.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from pytest_pafot.world import kernel
from tests.benchmarks.command import options

BASELINE = Path(__file__).with_name("instructions.json")
FEW, MORE = 5, 55
SETUP = """
import sys
from pytest_pafot import Highway, PositionInstruction, Scenario
def chain(*genes):
    return tuple(PositionInstruction(cell, speed) for cell, speed in genes)
scenario = Scenario(npcs=(chain((8, 22.0), (1, 26.0), (1, 24.0)), chain((4, 22.0), (3, 24.0), (4, 23.0))),
                    gene_seconds=20.0)
"""
CASES = {
    "trivial planner, 15/5 Hz": "world, ads = Highway(speed_limit=30.0), lambda: lambda seen: (0.0, 0.0)",
    "trivial planner, 15/15 Hz": "world, ads = Highway(speed_limit=30.0, ads_hz=15), lambda: lambda seen: (0.0, 0.0)",
    "IDM+MOBIL": "from highway_env.vehicle.behavior import IDMVehicle as ads; world = Highway(speed_limit=30.0)",
}
"""The setups to count: a world and a factory each."""


def counted(setup: str, runs: int) -> int:
    """Count the instructions of a process that runs the scenario a number of times.

    Raises:
        SystemExit: valgrind fails; its output says why.
    """
    code = f"{SETUP}{setup}\nfor _ in range({runs}): world.rollout(scenario, ads)"
    with tempfile.TemporaryDirectory() as folder:
        command = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={folder}/out", sys.executable, "-c", code]
        environment = {**os.environ, "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    found = re.search(r"Collected : (\d+)", done.stderr)
    if found is None:
        raise SystemExit(f"expected callgrind's count, received:\n{done.stderr}")
    return int(found[1])


def main() -> None:
    arguments = options(__doc__, tolerance=0.05, write=False)
    state = "compiled" if kernel.is_compiled() else "interpreted"
    here = f"{platform.machine()}, Python {platform.python_version()}, {state}"
    counts = {name: (counted(setup, MORE) - counted(setup, FEW)) // (MORE - FEW) for name, setup in CASES.items()}
    baseline = json.loads(BASELINE.read_text(encoding="utf-8")) if BASELINE.exists() else {}
    known, grown = baseline.get(here, {}), False
    print(f"instructions per scenario of 60 s and two NPCs; {here}")
    for name, count in counts.items():
        change = f"{count / known[name] - 1:+.1%}" if name in known else "nothing to compare with"
        grown |= name in known and count > known[name] * (1 + arguments.tolerance)
        print(f"  {name:26} {count:12,}   {change}")
    if arguments.write:
        BASELINE.write_text(json.dumps({**baseline, here: counts}, indent=2) + "\n", encoding="utf-8")
    sys.exit(int(grown))


if __name__ == "__main__":
    main()
