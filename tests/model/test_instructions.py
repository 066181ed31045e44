"""Kinds of instructions: one that only this file has goes through search, files, runs and reports, as the others do."""

import ast
import json
import pickle
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import pytest_pafot
from pytest_pafot import Highway, Run, Scenario, ScenarioError, Step
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.neighbours import Limits, neighbours
from pytest_pafot.findings.shrink import Shrunk, SpeedInterval
from pytest_pafot.model.instructions import KINDS, Instruction, PositionInstruction, roughness
from pytest_pafot.model.instructions.instruction import checked_speed, tenths_within
from pytest_pafot.model.trace import Y
from pytest_pafot.report.terminal import speed_sentences
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.health import Coverage
from pytest_pafot.searching.operators import crossover, mutate
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import CorpusError
from pytest_pafot.world.kernel import director
from tests.findings.builders import plain_finding
from tests.helpers.shrinking import shrink
from tests.report.builders import view_of

PATH = Path("front-2-1f3a9c.pafot.yaml")


@dataclass(frozen=True, slots=True, repr=False)
class Drift(Instruction):
    """An NPC ahead of the ego drifts to a side of its lane after two seconds."""

    offset: float
    speed: float

    name = "drift"
    marks = frozenset({"offset"})
    groups = (("sides", (("drift", "left"), ("drift", "right"))),)
    beside: ClassVar[int] = 0  # what driving by steps reads, with the steps below
    ahead: ClassVar[float] = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "offset", tenths_within("offset", self.offset, -1.5, 1.5))
        object.__setattr__(self, "speed", checked_speed(self.speed))

    @property
    def side(self):
        return "left" if self.offset < 0 else "right"

    @property
    def goal(self):
        return f"drifts {abs(self.offset):g} m to the {self.side}"

    @property
    def steps(self):
        return (Step(after=2.0, offset=self.offset, speed=self.speed),)

    def is_drawn_in(self, space):
        return space.instructions == "cells"

    def varied(self, choices, rng):
        return Drift(round(rng.uniform(-1.5, 1.5), 1), choices.any_speed(rng))

    def counted(self, chain):
        return [(*Instruction.counted(self, chain)[0], ("drift", self.side))]

    @property
    def roughness(self):
        return roughness(round(10 * abs(self.offset)))

    def plainer(self) -> Iterator[Instruction]:
        yield replace(self, offset=float(round(self.offset)))


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    KINDS.append(Drift)
    monkeypatch.setitem(director.DRIVES, Drift, director.BY_STEPS)
    yield
    KINDS.remove(Drift)


def drifting(offset=0.8, speed=20.0, **more):
    return Scenario(npcs=((Drift(offset, speed),),), **more)


def test_canonical_text_is_read_back():
    scenario = Scenario(npcs=((Drift(0.8, 20.0),), (PositionInstruction(2, 15.0),)))
    assert scenario.canonical() == '[[[["drift",20.0,0.8]],[[2,15.0]]],0,1,22.0,10.0]'
    assert Scenario.from_canonical(json.loads(scenario.canonical())) == pickle.loads(pickle.dumps(scenario)) == scenario
    assert str(drifting()).endswith(": drift@20>")
    assert repr(Drift(0.8, 20.0)) == "Drift(0.8, 20.0)"


def test_chain_has_one_alone():
    with pytest.raises(ScenarioError, match=r"npcs\[0\]\[1\]: expected one Drift"):
        Scenario(npcs=((Drift(0.8, 20.0), Drift(0.5, 20.0)),))
    with pytest.raises(ScenarioError, match="or a Drift, received"):
        Scenario(npcs=((8,),))


def test_file_is_written_and_read():
    finding = plain_finding(scenario=drifting())
    text = text_of(finding)
    assert "    - - {offset: 0.8, speed: 20.0}\n" in text
    assert parsed(PATH, text.encode()) == finding
    with pytest.raises(CorpusError, match=r"from -1\.5 to 1\.5"):
        parsed(PATH, text.replace("offset: 0.8", "offset: 1.8").encode())


def test_search_varies_it():
    rng, space = np.random.default_rng(0), SearchSpace(npcs=1)
    children = [mutate(drifting(), space, rng) for _ in range(20)]
    assert {type(child.npcs[0][0]) for child in children} == {Drift}
    assert len({child.npcs for child in children}) > 15
    first, second = crossover(drifting(0.8), drifting(-0.8), rng)
    assert (first.npcs, second.npcs) == (drifting(-0.8).npcs, drifting(0.8).npcs)
    assert Drift(0.8, 20.0).is_drawn_in(space)


def test_a_kind_has_to_say_which_searches_draw_it():
    class Undecided(Drift):
        is_drawn_in = Instruction.is_drawn_in

    with pytest.raises(TypeError, match=r"abstract method '?is_drawn_in"):
        Undecided(0.8, 20.0)


def test_shrinking_rounds_its_numbers():
    def fails(scenario):
        return scenario if type(scenario.npcs[0][0]) is Drift and scenario.npcs[0][0].offset > 0.5 else None

    simplest, how = shrink(drifting(0.8, 21.3, seed=5), fails, rollouts=1000, top_speed=26.8)
    assert (simplest.npcs, simplest.seed, how.is_minimal) == (drifting(1.0, 20.0).npcs, 0, True)


def test_neighbours_move_it():
    limits = Limits(fits=lambda scenario: True, top_speed=26.8, longest_run=60.0)
    moved = {each.npcs[0][0] for each in islice(neighbours(drifting(), 1.0, limits), 10)}
    assert {type(each) for each in moved} == {Drift}
    assert len(moved) > 5


def test_run_coverage_and_reports_show_it():
    run = Run(Highway(duration=8.0).rollout(drifting(), lambda: lambda seen: (0.0, 0.0)))
    across = run.trace.states[:, 1, Y]
    assert across[-1] - across[0] == pytest.approx(0.8, abs=0.2)
    assert [each.what for each in run.asked if not each.is_met] == []
    rows = "  NPC 0: drifts 0.8 m to the right, 20.0 m/s\n     2.0 s  2 s later 0.8 m right of the centre"
    assert rows in run.explain()
    coverage = Coverage.of([Evaluation.of(run.trace, fitness=0.0, failing=False)])
    assert coverage.describe(26.8) == "reached 1/2 sides, 1/6 speed bins; requested 1/2, 1/6"
    views = view_of(run.trace).instructions
    step = "2 s later 0.8 m right of the centre, to 20 m/s at 3 m/s^2"
    assert [each.words for each in views] == ["drifts 0.8 m to the right", step]
    told = Shrunk(rollouts=3, speeds=(SpeedInterval(npc=0, gene=0, low=19.0, high=20.5),))
    (sentence,) = speed_sentences(plain_finding(scenario=drifting(), shrunk=told))
    assert sentence == "NPC 0 from 0 s drifts 0.8 m to the right: any speed from 19.0 to 20.5 m/s still fails"


ASKED_ELSEWHERE = {
    "extras/algorithms/av_fuzzer.py": 2,  # its operators are defined for Lane-Instructions alone
    "world/run_config.py": 1,  # who starts on a way that crosses
}
"""For each file the number of questions of kind. They may only fall."""


def test_kinds_are_asked_only_in_their_files():
    kinds = {kind.__name__ for kind in KINDS}
    found = {}
    package = Path(pytest_pafot.__file__).parent
    for path in package.rglob("*.py"):
        text = path.read_text("utf-8")
        if path.parent == package / "model" / "instructions" or not any(kind in text for kind in kinds):
            continue
        count = sum(is_asked(node, kinds) for node in ast.walk(ast.parse(text)))
        found |= {path.relative_to(package).as_posix(): count} if count else {}
    there = {path: count for path, count in ASKED_ELSEWHERE.items() if (package / path).exists()}  # without extras, too
    assert found == there, "let the instruction say it, in pytest_pafot/model/instructions/"


def is_asked(node, kinds):
    """Return whether code asks for a kind: by `isinstance`, `issubclass`, a comparison with a class, or a case."""
    match node:
        case ast.Call(func=ast.Name("isinstance" | "issubclass"), args=[_, classes]):
            asked = classes
        case ast.Compare():
            asked = node
        case ast.MatchClass():
            asked = node.cls
        case _:
            return False
    return any(isinstance(each, ast.Name) and each.id in kinds for each in ast.walk(asked))
