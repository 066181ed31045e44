"""Is any damaged corpus file loaded differently from its text?

    python -m tests.benchmarks.mutants [--mutants 2000] [--seed 0] [--seconds 20]

Damages files from searches of several policies, including gym worlds, with the mutations of
``tests/helpers/mutations.py``. Compares every damaged file that loads with an independent reading of its text. If its
world or scenario has changed, it is built and run once; this must end in time and raise only errors that name the file.
Prints for each mutation how many files were refused, how many were loaded as their text says, and every file that was
not.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from pytest_pafot import Highway, World
from pytest_pafot.campaign.replays import Replays
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.findings.finding import Finding
from pytest_pafot.support.errors import CorpusError, RequestError
from tests.benchmarks.command import options
from tests.helpers.mutations import MUTATIONS, misread

GOLDEN = Path(__file__).parents[1] / "corpus" / "saved"
REPOSITORY = Path(__file__).parents[2]

SEARCHES = """
import pytest
import pytest_pafot as pafot
from example_ads import blind_lane_change, constant_speed, idm_mobil

@pytest.mark.parametrize("ads", [blind_lane_change, constant_speed, idm_mobil], ids=lambda module: module.__name__)
@pafot.search(ads=lambda: None, stop_after=2)
def test_policies(run, ads):
    assert not run.collision

@pytest.mark.parametrize("blame", ["any"])
@pafot.search(ads=constant_speed.make, stop_after=3)
def test_constant_speed(run, blame):
    assert not run.collision, run.explain()

@pafot.search(ads=blind_lane_change.make, algorithm="av-fuzzer", stop_after=2)
def test_blind_lane_change(run):
    assert not run.collision, run.explain()

@pafot.search(ads=idm_mobil.make, stop_after=2)
def test_distance(run):
    assert run.min_ttc > 5.0

@pafot.search(ads=lambda: lambda observation: 1, world=pafot.World("highway-fast-v0"), stop_after=2)
def test_gym(run):
    assert not run.collision

@pafot.search(ads=lambda: lambda observation: 1, world=pafot.World("merge-v1"), stop_after=1)
def test_merge(run):
    assert not run.collision
"""


def sources(folder: Path) -> dict[str, str]:
    """Return texts to damage, by name: saved files, and files of new searches."""
    texts: dict[str, str] = {}
    for path in sorted(GOLDEN.glob("*.pafot.yaml")):
        texts[path.name] = path.read_text(encoding="utf-8")
    (folder / "test_searches.py").write_text(SEARCHES)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--pafot-runs=20",
        "--pafot-seed=1",
    ]
    # Seeds depend on node ids, which are relative to the rootdir.
    command += ["--rootdir", str(folder), str(folder)]
    subprocess.run(
        command, cwd=folder, env=os.environ | {"PYTHONPATH": str(REPOSITORY)}, capture_output=True, check=False
    )
    for path in sorted(folder.rglob("*.pafot.yaml")):
        texts[f"search {path.parent.name} {path.name}"] = path.read_text(encoding="utf-8")
    return texts


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise TimeoutError if the block takes longer."""

    def stop(number: int, frame: object) -> None:
        raise TimeoutError(f"still running after {seconds} s")

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


def run_of(finding: Finding, path: Path) -> None:
    """Build the world of a file and run its scenario once; ignore refusals that name the file."""
    harness: Any = SimpleNamespace(world=Highway())
    try:
        world = Replays(harness=harness).world_of(Saved(path=path, finding=finding))
    except RequestError as error:
        if not str(error).startswith(f"{path}:"):
            raise
        return
    is_gym = isinstance(world, World)
    world.rollout(finding.scenario, lambda: lambda observation: 1 if is_gym else (0.0, 0.0))


def judged(text: str, path: Path, original: Finding, seconds: int) -> tuple[str, list[str]]:
    """Return the category of a damaged file, and its errors."""
    try:
        finding = parsed(path, text.encode("utf-8", "surrogatepass"))
    except CorpusError:
        return "refused", []
    wrong = misread(text, finding)
    if (finding.world, finding.scenario) != (original.world, original.scenario):
        path.write_text(text, encoding="utf-8")
        try:
            with limited(seconds):
                run_of(finding, path)
        except Exception as error:  # noqa: BLE001  (whatever it is, it is no clear error)
            wrong.append(f"running it raised {type(error).__name__}: {error!s:.150}")
    is_same = finding == original
    return ("read, wrong" if wrong else "read, unchanged" if is_same else "read, as it says"), wrong


OUTCOMES = ("refused", "read, unchanged", "read, as it says", "read, wrong")


def main() -> int:
    """Damage, evaluate, and print."""
    given = options(__doc__, mutants=2000, seed=0, seconds=20)
    warnings.simplefilter("ignore")
    rng, counts = random.Random(given.seed), {kind: Counter[str]() for kind in MUTATIONS}
    with tempfile.TemporaryDirectory() as name:
        texts = sources(Path(name))
        print(f"{len(texts)} files, seed {given.seed}")
        path = Path(name) / "mutant.pafot.yaml"
        originals = {source: parsed(path, text.encode()) for source, text in texts.items()}
        for number in range(given.mutants):
            kind, source = rng.choice(list(MUTATIONS)), rng.choice(list(texts))
            text = MUTATIONS[kind](rng, texts[source])
            outcome, wrong = judged(text, path, originals[source], given.seconds)
            counts[kind][outcome] += 1
            for line in wrong:
                print(f"wrong: {number}, {kind}, {source}: {line}", flush=True)
    print(f"{'':24}" + "".join(f"{outcome:>18}" for outcome in OUTCOMES))
    for kind, row in counts.items():
        print(f"{kind:24}" + "".join(f"{row[outcome]:18}" for outcome in OUTCOMES))
    total = sum(counts.values(), Counter[str]())
    print(f"{'all':24}" + "".join(f"{total[outcome]:18}" for outcome in OUTCOMES))
    return 1 if total["read, wrong"] else 0


if __name__ == "__main__":
    sys.exit(main())
