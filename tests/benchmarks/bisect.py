"""Does ``python -m pytest_pafot bisect`` find the one bad commit of twenty?

    python -m tests.benchmarks.bisect [--seeds 5] [--first-seed 0] [--commits 20] [--runs 200] [--tune]

Makes a repository for each seed: a planner in a package. Its commits rename, describe and move something, and one of
them has a defect. In two of five histories, some commits in a row cannot be imported. They are in the middle, where the
first trial is, and do not end right before the bad commit, because then the answer would be ambiguous. With ``--tune``,
other commits change the planner's speed by 0.05 m/s, so that a scenario may begin to fail at a commit without the
defect. Then it searches with the last commit against the first, as a user does, and passes each finding to the command,
the worst first, until one is accepted; if none is, because the situation does not occur with the first commit, it adds
``--any-pass``. Prints the command's answer, its sessions and seconds, and to stderr all its output.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from random import Random

from tests.benchmarks.command import options, print_head, seeds_of

SETTINGS = "HEADWAY = {headway}  # [s]\nBRAKING = 6.0  # [m/s^2]\nCRUISE = {cruise:.2f}  # [m/s]\n"
PLANNER = '''\
"""{about}"""

from policy.{settings} import BRAKING, CRUISE, HEADWAY


class Planner:
    def __call__(self, observation):
        ego = observation.ego
        {gaps} = [other.x - ego.x - other.length for other in observation.others if {counts}]
        if any(0 < gap < {least} + HEADWAY * ego.speed for gap in {gaps}):
            return -{braking}, 0.0
        return min(CRUISE - ego.speed, {pull}), 0.0
'''
TEST = """\
import pytest_pafot as pafot
from policy.planner import Planner


@pafot.search(ads=Planner, blame="ego")
def test_never_at_fault(run):
    assert not run.collision, run.explain()
"""
FIRST = {
    "about": "Keeps its distance.",
    "settings": "settings",
    "gaps": "gaps",
    "counts": "other.lane == ego.lane",
    "least": "2.0",
    "braking": "BRAKING",
    "pull": "1.0",
    "headway": "1.5",
    "cruise": 22.0,
}
DEFECTS = (
    ("keeps too little distance", {"headway": "0.5"}),
    ("does not see who stands still", {"counts": "other.lane == ego.lane and other.speed > 1.0"}),
    ("brakes too little", {"braking": "BRAKING / 3"}),
    ("takes a far leader for none", {"counts": "other.lane == ego.lane and other.x - ego.x < 15.0"}),
    ("speeds up as hard as it can, and looks too near", {"pull": "6.0", "headway": "0.6"}),
)
BROKEN = ("from policy.nets import Net\n", "import no_such_module\n", "def half(:\n")


def history(seed: int, commits: int, *edits: str) -> Iterator[tuple[str, bool, dict[str, str]]]:
    """Yield the commits: subject, whether it is the bad one, and the files of the package."""
    rng = Random(seed)
    told, defect = dict(FIRST), DEFECTS[seed % len(DEFECTS)]
    broken = range(commits // 2 - rng.randrange(1, 4), commits // 2 + rng.randrange(1, 3)) if seed % 5 in (1, 3) else ()
    bad = rng.choice([number for number in range(2, commits - 1) if number not in broken and number - 1 not in broken])
    for number in range(commits):
        edit = rng.choice(("tell", "rename", "move", *edits)) if number else "begin"
        if number == bad:
            edit, told = "improve", {**told, **defect[1]}
        elif edit == "tell":
            told["about"] = f"Keeps its distance, as of version {number}."
        elif edit == "rename":
            told["gaps"] = f"gaps_{number}"
        elif edit == "tune":
            told["cruise"] += rng.choice((-0.05, 0.05))
        elif edit == "move":
            told["settings"] = f"settings_{number}"
        text = PLANNER.format(**told) + f"# {number}\n"
        files = {"__init__.py": "", "planner.py": text, f"{told['settings']}.py": SETTINGS.format(**told)}
        if number in broken:
            edit, files["planner.py"] = f"{edit}, half done", rng.choice(BROKEN) + text
        yield f"{number}: {edit}", number == bad, files


def made(root: Path, seed: int, commits: int, *edits: str) -> tuple[str, str]:
    """Make the repository of a seed; return the hashes of its first commit and of the bad one."""
    guilty = ""
    _run(root, "git", "init", "--quiet")
    (root / "test_safety.py").write_text(TEST)
    for subject, is_bad, files in history(seed, commits, *edits):
        for path in (root / "policy").glob("*.py"):
            path.unlink()
        (root / "policy").mkdir(exist_ok=True)
        for name, text in files.items():
            (root / "policy" / name).write_text(text)
        _run(root, "git", "add", ".")
        _run(root, "git", "-c", "user.name=A", "-c", "user.email=a@example.org", "commit", "--quiet", "-m", subject)
        guilty = _run(root, "git", "rev-parse", "HEAD").strip() if is_bad else guilty
    return _run(root, "git", "rev-list", "--max-parents=0", "HEAD").strip(), guilty


def findings(root: Path, seed: int, runs: int) -> list[str]:
    """Search with the last commit against the first; return the files of the findings, the worst first."""
    planner = PLANNER.format(**FIRST).partition("\n\n\n")[2]
    (root / "before.py").write_text(SETTINGS.format(**FIRST) + planner)
    search = [
        "--pafot-against=before:Planner",
        f"--pafot-runs={runs}",
        f"--pafot-seed={seed}",
        "--pafot-json=told.json",
    ]
    _run(root, sys.executable, "-m", "pytest", "-q", "--tb=no", *search)
    found = [each for each in json.loads((root / "told.json").read_text())["findings"] if each["status"] == "new"]
    return [each["file"] for each in sorted(found, key=lambda each: -each["severity"]["value"])]


def bisected(root: Path, file: str, good: str, *more: str) -> tuple[int, str, int]:
    """Run the command; return its exit code, the commits in its answer, and its number of sessions."""
    command = [sys.executable, "-m", "pytest_pafot", "bisect", file, "--good", good, "--policy", "policy", *more]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    print(f"{done.stdout}{done.stderr}", file=sys.stderr)
    told = re.findall(r"^(?:  )?([0-9a-f]{40}) ", done.stdout, re.MULTILINE)
    return done.returncode, " ".join(told), len(re.findall(r"^  [0-9a-f]{10} ", done.stdout, re.MULTILINE))


def row(seed: int, runs: int, commits: int, *edits: str) -> list[object]:
    """Make a history, search, find the bad commit, and return a row of the table."""
    with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
        root = Path(folder) / "project"
        root.mkdir()
        first, guilty = made(root, seed, commits, *edits)
        files, refused = findings(root, seed, runs), 0
        broken = sum("half done" in subject for subject, _, _ in history(seed, commits, *edits))
        known = [seed, DEFECTS[seed % len(DEFECTS)][0], broken, f"{guilty:.10}"]
        for more in ([], ["--any-pass"]):
            for file in files:
                began = time.monotonic()
                code, told, sessions = bisected(root, file, first, *more)
                if code != 2:
                    verdict = "found" if told == guilty else f"not found: {told}"
                    return [*known, verdict, refused, " ".join(more), sessions, round(time.monotonic() - began)]
                refused += 1
        return [*known, "nothing that is accepted", refused, "", 0, 0]


def _run(root: Path, *command: str) -> str:
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{command} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


def main() -> None:
    given = options(__doc__, seeds=5, first_seed=0, commits=20, runs=200, tune=False)
    edits = ["tune"] if given.tune else []
    print_head("seed", "defect", "not importing", "bad commit", "told", "refused", "option", "sessions", "seconds")
    for seed in seeds_of(given):
        print(f"| {' | '.join(map(str, row(seed, given.runs, given.commits, *edits)))} |", flush=True)


if __name__ == "__main__":
    main()
