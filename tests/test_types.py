"""A user's type checker knows every public name, and finds misspelt names and values."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

import pytest_pafot as pafot
from pytest_pafot.algorithms import ALGORITHMS
from pytest_pafot.algorithms.fitness import FITNESSES, FitnessName
from pytest_pafot.algorithms.space import LANE_SHARES, Instructions
from pytest_pafot.model.sight import NOISES, Noise
from pytest_pafot.model.vehicle_type import READY, STYLES, Style, VehicleName
from pytest_pafot.searches.explore import ExploreArguments
from pytest_pafot.searches.options import BY_NAME, AlgorithmName
from pytest_pafot.searches.request import SearchArguments

ROOT = Path(__file__).parents[1]
CONFIG = """
[mypy]
strict = True
[mypy-PIL.*,_pytest.*,distributed.*,gymnasium.*,hypothesis.*,matplotlib.*,pandas.*,scipy.*,yaml.*]
follow_imports = skip
follow_imports_for_stubs = True
ignore_missing_imports = True
"""
"""The skipped libraries take most of the time, and no public type is made of theirs."""

HEAD = """
from collections.abc import Sequence
from typing import Any
import pytest_pafot as pafot
from pytest_pafot.testing import check_world
class Planner:
    def __call__(self, observation: pafot.Observation) -> tuple[float, float]:
        return 0.0, observation.ego.y
class Toy(pafot.Simulator):
    def start(self, vehicles: Sequence[Any], seed: int) -> None: ...
    def step(self, controls: Sequence[Any]) -> None: ...
    def states(self) -> Any: ...
def make(env: Any) -> Planner:
    return Planner()
def holds(run: pafot.Run) -> None: ...
NPCS = [[pafot.PositionInstruction(2, 20)]]
untyped: Any = None
def test(run: pafot.Run, seen: pafot.Observation) -> None:
"""

MISTAKES = """
pafot.search(ads=Planner, blame="egoo")
pafot.search(ads=Planner, traffic="hostil")
pafot.search(ads=Planner, vehicles=["cra"])
pafot.search(ads=Planner, algorithm="gaa")
pafot.search(ads=Planner, instructions="lane")
pafot.search(ads=Planner, fitness="npcs.tcc")
pafot.search(ads=Planner, world=3)
pafot.search(ads=Planner, lane=3)
pafot.search(ads=42, blame="ego")
pafot.search(42)
pafot.search(ads=pafot.policies.sbb3("model.zip"), blame="ego")
pafot.Highwya(lanes=4)
pafot.Highway(ego="trcuk")
pafot.World("highway-v0", ends="enviroment")
pafot.SimulatorWorld(Planner)
pafot.sumo(ads_hertz=5)
pafot.explore(Planner, holds=holds, blame="egoo")
pafot.explore(Planner, holds=holds, runz=3)
pafot.explore(Planner, holds=holds, workers="all")
pafot.explore(42, holds=holds)
pafot.Scenario(npcs=NPCS, traffic="papr")
pafot.Scenario(npcs=NPCS, vehicles=["trcuk"])
pafot.LaneInstruction("lef", 3.0)
pafot.Perception(Planner, noise={"sped": 1.0})
pafot.strategies.scenarios(traffic="hostil")
pafot.properties.comfort(run, jerkk=3.0)
pafot.check(3.0, name="speed", atmost=4.0)
check_world(pafot.SimulatorWorld(Toy), npc=3)
seen.replace(otehrs=())
print(seen.ego.sped, run.trace)
print(run.colision)
print(run.ego.spede)
print(run.npcs[0].gapp)
print(run.responsibility == "egoo")
print(pafot.Cell.FRNT)
""".strip().splitlines()

RIGHT = """
pafot.search(test)
pafot.search(ads=Planner, vehicles=("car", "van"), traffic="everyday", algorithm="random", fitness="npcs.ttc")
pafot.search(ads=make, world=pafot.World("highway-v0", ends="duration", ego="truck"), vehicles="truck")
pafot.search(ads=pafot.Perception(Planner, latency=0.3, noise={"speed": 0.1}), world=pafot.sumo("net.xml", ads_hz=5))
pafot.search(ads=pafot.policies.sb3("model.zip"), against=pafot.policies.process(["./planner"]), blame="ego")
pafot.search(ads=Planner, world=pafot.SimulatorWorld(Toy))
pafot.search(ads="planner:Planner", against="ads", world="module:factory", fitness=lambda trace: trace.duration)
pafot.search(ads=untyped, world=untyped, blame="ego", runs=3)
pafot.explore(lambda: Planner(), holds=holds, workers="auto", corpus="saved", world=pafot.Highway(ego="truck"))
pafot.Scenario(npcs=NPCS, vehicles=["truck"]).npcs[0][0].speed + pafot.Highway(ego="truck").ego.length
pafot.check(abs(run.ego.jerk) + run.npcs[0].gap.min(), name="jerk", at_most=20)
print(run.responsibility == "ego", run.outcome == "collision", seen.replace(others=()).others[0].speed)
check_world(pafot.SimulatorWorld(Toy), ads=Planner, npcs=3)
reveal_type(pafot.search(ads=Planner)(holds))
reveal_type(run.ego.speed)
""".strip().splitlines()


def test_mypy_finds_each_mistake_and_nothing_else(tmp_path):
    names = [f"reveal_type(pafot.{name})" for name in pafot.__all__]
    lines = [*HEAD.strip().split("\n"), *(f"    {line}" for line in [*MISTAKES, *RIGHT, *names])]
    (tmp_path / "user.py").write_text("\n".join(lines), encoding="utf-8")
    (tmp_path / "mypy.ini").write_text(CONFIG, encoding="utf-8")
    command = [
        sys.executable,
        "-m",
        "mypy",
        f"--cache-dir={os.devnull}",
        "--no-pretty",
        "--no-color-output",
        "user.py",
    ]
    environ = {**os.environ, "MYPYPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environ, capture_output=True, text=True, check=False
    )
    said = re.findall(r"^user\.py:(\d+): (\w+): (.*)$", done.stdout, re.MULTILINE)
    wrong = {lines[int(number) - 1].strip() for number, kind, _ in said if kind == "error"}
    assert wrong == set(MISTAKES), done.stdout + done.stderr
    types = [
        text.removeprefix("Revealed type is ")
        for *_, text in said
        if text.startswith("Revealed type is ")
    ]
    assert len(types) == len(names) + 2
    assert '"Any"' not in types
    assert types[:2] == [
        '"def (run: pytest_pafot.oracle.run.Run)"',
        '"numpy.ndarray[tuple[Any, ...], numpy.dtype[numpy.float64]]"',
    ]


@pytest.mark.parametrize(("typed", "names"), [
    (AlgorithmName, ALGORITHMS),
    (FitnessName, FITNESSES),
    (Instructions, LANE_SHARES),
    (Noise, NOISES),
    (Style, STYLES),
    (VehicleName, READY),
])  # fmt: skip
def test_names_are_those_that_types_list(typed, names):
    assert sorted(get_args(typed)) == sorted(names)


def test_explore_takes_the_arguments_of_the_mark_and_options_of_sessions():
    common = SearchArguments.__annotations__.keys() - {
        "ads",
        "world",
        "runs",
        "generations",
        "seed",
    }
    own = ExploreArguments.__annotations__.keys() - common
    assert common <= ExploreArguments.__annotations__.keys()
    assert not any(BY_NAME[name].is_argument for name in own)
