"""What does the job of a pull request say of ten branches that each change one of a policy's five modules?

    python -m tests.benchmarks.revisions [--runs 200] [--seed 5]

Makes a repository with a planner in a package of five modules. Seven branches have a defect each; three are harmless:
they rename, describe and move something. Runs the job for each branch twice: by ``rev:main``, and by name, against a
copy of the planner's own file in main, next to the present file. Prints the exit code, what the job says and its
seconds.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.benchmarks.command import options, print_head

SCRIPT = Path(__file__).parents[2] / "ci" / "pafot.sh"
FILES = {
    "policy/__init__.py": "",
    "policy/limits.py": "CRUISE = 22.0  # [m/s]\nBRAKING = 6.0  # [m/s^2]\nPULL = 1.0  # [m/s^2]\n",
    "policy/spacing.py": """\
HEADWAY = 2.0  # [s]
LEAST = 2.0  # [m]


def needed(speed):
    return LEAST + HEADWAY * speed
""",
    "policy/sight.py": """\
REACH = 120.0  # [m]


def ahead(observation):
    ego = observation.ego
    gaps = [other.x - ego.x - other.length for other in observation.others if abs(other.y - ego.y) < 3.0]
    return [gap for gap in gaps if 0.0 < gap < REACH]
""",
    "policy/speed.py": """\
from policy.limits import BRAKING, CRUISE, PULL


def acceleration(speed, is_blocked):
    if is_blocked:
        return -BRAKING
    return min(CRUISE - speed, PULL)
""",
    "policy/planner.py": """\
from policy.sight import ahead
from policy.spacing import needed
from policy.speed import acceleration


class Planner:
    def __call__(self, observation):
        speed = observation.ego.speed
        is_blocked = any(gap < needed(speed) for gap in ahead(observation))
        return acceleration(speed, is_blocked), 0.0
""",
    "test_safety.py": """\
import pytest_pafot as pafot
from policy.planner import Planner


@pafot.search(ads=Planner, blame="ego")
def test_never_at_fault(run):
    assert not run.collision, run.explain()
""",
    ".gitignore": "__pycache__/\n.pytest_cache/\npafot*\n",
}
BRANCHES = (
    ("headway of 0.6 s", True, "policy/spacing.py", "HEADWAY = 2.0", "HEADWAY = 0.6"),
    ("half of the speed", True, "policy/spacing.py", "HEADWAY * speed", "HEADWAY * speed / 4"),
    ("braking at 2 m/s^2", True, "policy/limits.py", "BRAKING = 6.0", "BRAKING = 2.0"),
    ("brakes only above 5 m/s", True, "policy/speed.py", "if is_blocked:", "if is_blocked and speed > 5.0:"),
    ("sees 15 m", True, "policy/sight.py", "REACH = 120.0", "REACH = 15.0"),
    ("sees its own centre line", True, "policy/sight.py", "< 3.0", "< 0.5"),
    ("the farthest gap counts", True, "policy/planner.py", "any(gap", "bool(ahead(observation)) and all(gap"),
    ("a name", False, "policy/limits.py", "PULL = 1.0", "PULL = GAIN = 1.0"),
    ("a comment", False, "policy/spacing.py", "HEADWAY = 2.0  # [s]", "HEADWAY = 2.0  # [s], as people drive"),
    ("another expression", False, "policy/planner.py", "= observation.ego.speed", "= float(observation.ego.speed)"),
)  # fmt: skip


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder and return its output."""
    named = ("-c", "user.name=Ann", "-c", "user.email=ann@example.org")
    return subprocess.run(["git", *named, *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout


def job(folder: Path, runs: int, seed: int, against: str) -> str:
    """Run the job in a folder; return its exit code, what it says and its seconds as cells of a table."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", os.defpath)])
    environ = {**os.environ, "PATH": path, "AGAINST": against, "RUNS": str(runs), "SEED": str(seed), "COLUMNS": "300"}
    started = time.perf_counter()
    command = ["sh", str(SCRIPT), "pull-request", "-q", "--tb=line", "--pafot-save=none", "--pafot-shrink-rollouts=0"]
    done = subprocess.run(command, cwd=folder, env=environ, capture_output=True, text=True, check=False)
    said = re.search(
        r": (introduces \d+ failures?)|: (nothing to compare)|(would be compared with itself)", done.stdout
    )
    words = next(filter(None, said.groups())) if said else (done.stdout + done.stderr).strip().splitlines()[-1]
    return f"{words} | {done.returncode} | {time.perf_counter() - started:.1f}"


def main() -> None:
    """Make the branches, run the jobs and print the table."""
    given = options(__doc__, runs=200, seed=5)
    print_head("branch", "module", "is", "by rev:main", "exit", "[s]", "by name", "exit", "[s]")
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, text in FILES.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text, encoding="utf-8")
        git(folder, "init", "-q", "-b", "main")
        git(folder, "add", "-A")
        git(folder, "commit", "-qm", "A planner")
        for number, (branch, is_bad, name, before, after) in enumerate(BRANCHES):
            git(folder, "checkout", "-q", "-b", f"branch-{number}", "main")
            text = (folder / name).read_text(encoding="utf-8")
            if before not in text:
                raise ValueError(f"expected {before!r} in {name}")
            (folder / name).write_text(text.replace(before, after), encoding="utf-8")
            git(folder, "commit", "-qam", branch)
            by_revision = job(folder, given.runs, given.seed, "rev:main")
            copy = folder / "policy" / "planner_before.py"
            copy.write_text(git(folder, "show", "main:policy/planner.py"), encoding="utf-8")
            by_name = job(folder, given.runs, given.seed, "policy.planner_before:Planner")
            copy.unlink()
            kind = "a defect" if is_bad else "harmless"
            print(f"| {branch} | {name} | {kind} | {by_revision} | {by_name} |", flush=True)


if __name__ == "__main__":
    main()
