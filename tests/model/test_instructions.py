"""Kinds of instructions: two that only this file has go through search, files, runs and reports, as the others do."""

import ast
import json
import math
import pickle
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from inspect import isfunction
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import pytest_pafot
from pytest_pafot import Highway, Manoeuvre, Run, Scenario, ScenarioError, Step, World
from pytest_pafot.campaign.explore import request_of
from pytest_pafot.campaign.request import build_space
from pytest_pafot.corpus.reader import parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.extending import WithStart, register
from pytest_pafot.model.instructions import (
    GROUP,
    KINDS,
    RETURNS,
    Free,
    Instruction,
    PositionInstruction,
    roughness,
)
from pytest_pafot.model.instructions.instruction import Choices, checked_speed, tenths_within
from pytest_pafot.model.instructions.manoeuvre import random_manoeuvre
from pytest_pafot.model.trace import Y
from pytest_pafot.searching.operators import crossover, mutate
from pytest_pafot.searching.space import SearchSpace, sample
from pytest_pafot.support.errors import AdsFactoryError, CorpusError
from pytest_pafot.world.engines import npc_drivers
from pytest_pafot.world.kernel import director
from tests.findings.builders import plain_finding
from tests.helpers.shrinking import shrink
from tests.helpers.tables import table
from tests.report.builders import view_of

PATH = Path("front-2-1f3a9c.pafot.yaml")


@dataclass(frozen=True, slots=True, repr=False)
class Drift(Instruction):
    """An NPC ahead of the ego drifts to a side of its lane after two seconds."""

    offset: float
    speed: float

    name = "drift"
    marks = frozenset({"offset"})
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

    @property
    def roughness(self):
        return roughness(round(10 * abs(self.offset)))

    def plainer(self) -> Iterator[Instruction]:
        yield replace(self, offset=float(round(self.offset)))


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Weave(WithStart):
    """An NPC that has a planner of its own, which steers to and fro."""

    beside: int
    ahead: float
    speed: float
    period: float

    name = "weave"
    marks = frozenset({"beside", "ahead", "period"})
    drives_itself = True

    def __post_init__(self) -> None:
        self.check_start(period=(1.0, 20.0))

    @property
    def goal(self):
        return f"{self.start}, weaves every {self.period:g} s"

    @classmethod
    def drawn(cls, choices, others, rng):
        return cls(**cls.random_start(choices, others, rng), period=round(rng.uniform(4.0, 8.0), 1))

    def planner(self):
        return lambda seen: (0.0, 0.02 * math.sin(2 * math.pi * seen.time / self.period))


def weaving(**changes):
    return Weave(**{"beside": 1, "ahead": 20.0, "speed": 20.0, "period": 4.0} | changes)


@pytest.fixture
def tables():
    """Leave the tables of kinds as they were."""
    before = [(each, each.copy()) for each in (KINDS, director.DRIVES, npc_drivers.MOVERS)]
    yield
    for each, was in before:
        each.clear()
        each.extend(was) if isinstance(each, list) else each.update(was)


@pytest.fixture(autouse=True)
def registered(tables):
    register(Drift, drives="steps")


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


def test_run_and_reports_show_it():
    run = Run(Highway(duration=8.0).rollout(drifting(), lambda: lambda seen: (0.0, 0.0)))
    across = run.trace.states[:, 1, Y]
    assert across[-1] - across[0] == pytest.approx(0.8, abs=0.2)
    assert [each.what for each in run.asked if not each.is_met] == []
    rows = "  NPC 0: drifts 0.8 m to the right, 20.0 m/s\n     2.0 s  2 s later 0.8 m right of the centre"
    assert rows in run.explain()
    views = view_of(run.trace).instructions
    step = "2 s later 0.8 m right of the centre, to 20 m/s at 3 m/s^2"
    assert [each.words for each in views] == ["drifts 0.8 m to the right", step]


# The kinds that others register.


def test_unregistered_kind_is_refused_by_its_name():
    with pytest.raises(
        ScenarioError, match=r"npcs\[0\]\[0\]: expected .* is registered, received Weave.*register\(Weave"
    ):
        Scenario(npcs=((weaving(),),))
    with pytest.raises(
        ScenarioError, match=r"expected the form of one of .*, received \['weave', 20.0, 1, 20.0, 4.0\]"
    ):
        Scenario.from_canonical([[[weaving().plain()]], 0, 1, 22.0, 10.0])


def changed(base=Weave, **values):
    """Return a kind that is like another one, except for some of its attributes."""
    return dataclass(frozen=True, kw_only=True)(type("Changed", (base,), values))


@table(
    ("kind", "arguments", "message"),
    [
        (int, {"drives": "steps"}, "kind: expected a frozen dataclass of Instruction, received <class 'int'>"),
        (Weave, {"drives": "steps"}, "drives: expected one of itself for a kind with drives_itself = True"),
        (Drift, {"drives": "itself"}, "drives: expected one of grid, lanes, steps, track for a kind with"),
        (Drift, {"drives": "steps", "mover": int}, "drives: .*; only itself has a mover"),
        (Drift, {"drives": "lanes"}, "Drift: expected aimed, .*, received none of aimed, column, lane, target"),
        (changed(planner=None), {"drives": "itself"}, "received none of planner"),
        (changed(goal=Instruction.goal), {"drives": "itself"}, "received none of goal"),
        (changed(name="free"), {"drives": "itself"}, "Changed.name: expected a name that no other kind has"),
        (changed(name="two words"), {"drives": "itself"}, "Changed.name: .*received 'two words'; it has up to 40"),
        (changed(marks=frozenset({"ahead"})), {"drives": "itself"}, "marks: .* Changed would be read as a Manoeuvre"),
        (changed(Drift, marks=frozenset({"lane", "offset"})), {"drives": "steps"}, "a Drift would|Changed.name"),
    ],
)
def test_kind_that_lacks_something_is_not_registered(kind, arguments, message):
    with pytest.raises(ScenarioError, match=message):
        register(kind, **arguments)
    assert kind is Drift or kind not in KINDS


def test_kind_that_is_defined_again_replaces_the_old_one():
    first, second = (changed(name="changed") for _ in range(2))
    for kind in (first, first, second):
        register(kind, drives="itself")
    assert [kind for kind in KINDS if kind.__name__ == "Changed"] == [second]


@pytest.fixture
def register_entries(register):
    return register


def test_file_and_text_import_the_package_of_an_unknown_kind(register_entries, tmp_path, monkeypatch, tables):
    register(Weave, drives="itself")
    scenario = Scenario(npcs=((weaving(),),))
    text, canonical = text_of(plain_finding(scenario=scenario)), json.loads(scenario.canonical())
    (tmp_path / "weaving.py").write_text(
        f"from {__name__} import Weave, register\nregister(Weave, drives='itself')\nprint('imported')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    register_entries(GROUP, weave="weaving")
    for read in (lambda: parsed(PATH, text.encode()).scenario, lambda: Scenario.from_canonical(canonical)):
        KINDS.remove(Weave)
        assert parsed(PATH, text_of(plain_finding(scenario=drifting())).encode()).scenario == drifting()
        assert "weaving" not in sys.modules
        assert read() == scenario
        del sys.modules["weaving"]


def test_keys_of_no_kind_are_refused_with_the_way_out(register_entries):
    register(Weave, drives="itself")
    text = text_of(plain_finding(scenario=Scenario(npcs=((weaving(),),))))
    KINDS.remove(Weave)
    message = (
        r"period: expected one of beside, ahead, .* these are the keys of a Manoeuvre; .* pytest_pafot.instructions"
    )
    with pytest.raises(CorpusError, match=message):
        parsed(PATH, text.encode())
    register_entries(GROUP, weave="no_such_module")
    with pytest.raises(CorpusError, match=r"that no_such_module, which is registered as 'weave' in .*ModuleNotFound"):
        parsed(PATH, text.encode())


def test_default_search_draws_a_quarter_of_a_registered_kind():
    def space_of(world=None, **given):
        return build_space(request_of({"ads": lambda: lambda seen: (0.0, 0.0), **given}), world or Highway())

    before = space_of()
    register(Weave, drives="itself")
    space, rng = space_of(), np.random.default_rng(0)
    assert (before.kinds, space.kinds) == ((), (Weave,))  # nothing samples a Drift
    assert replace(space, kinds=(), lanes=before.lanes, row=before.row) == before
    assert space.plain["kinds"] == ("weave",)
    assert "a quarter of them weave" in space.described
    scenarios = [sample(space, rng) for _ in range(100)]
    kinds = [type(chain[0]) for scenario in scenarios for chain in scenario.npcs]
    assert 0.2 < kinds.count(Weave) / len(kinds) < 0.3
    for scenario in scenarios:
        Highway().check_fits(mutate(scenario, space, rng))
    for given in ({"algorithm": "pafot"}, {"instructions": "lanes"}, {"world": World("roundabout-v0")}):
        assert space_of(**given).kinds == ()


def test_start_is_apart_from_those_of_all_kinds():
    register(Weave, drives="itself")
    rng = np.random.default_rng(0)
    choices = Choices(0, 268, 1, 22.0, 4, (math.inf, math.inf), ("idm",), (2.0, 3.0))
    free = Free(beside=0, ahead=40.0, speed=20.0, driver="idm")
    for _ in range(30):
        chains = [(free,), (random_manoeuvre(choices, [(free,)], rng),)]
        for _ in range(3):
            chains.append((Weave.drawn(choices, chains, rng),))
            chains.append((random_manoeuvre(choices, chains, rng),))
        places = sorted(chain[0].ahead + (5.0 if chain[0].ahead > 0 else 0.0) for chain in chains)
        assert min(np.diff(places)) > 5.5


def test_kind_with_a_planner_drives_by_itself():
    register(Weave, drives="itself")
    scenario = Scenario(npcs=((weaving(),), (Manoeuvre(beside=0, ahead=40.0, speed=20.0),)))
    run = Run(Highway(duration=8.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0)))
    across = run.trace.states[:, 1:, Y]
    assert np.ptp(across[:, 0]) > 0.3
    assert np.ptp(across[:, 1]) == 0
    assert run.as_asked
    bent = World("merge-v0", duration=8.0).rollout(replace(scenario, ego_lane=0), lambda: lambda seen: 1)
    assert (bent.npc_error, np.ptp(bent.states[:, 1, Y]) > 0.3) == (None, True)


@pytest.mark.parametrize("made", [None, "left"])
def test_what_is_no_instruction_is_refused_by_the_name_of_its_kind(made):
    kind = changed(name="odd", drawn=classmethod(lambda cls, *others: made), varied=lambda self, *others: made)
    register(kind, drives="itself")
    rng, space = np.random.default_rng(0), SearchSpace(npcs=3, kinds=(kind,))
    with pytest.raises(ScenarioError, match=f"Changed.drawn: expected an instruction.*, received {made!r}; "):
        [sample(space, rng) for _ in range(30)]
    scenario = Scenario(npcs=((kind(beside=1, ahead=20.0, speed=20.0, period=4.0),),))
    with pytest.raises(ScenarioError, match=f"Changed.varied: expected an instruction, received {made!r}; "):
        [mutate(scenario, SearchSpace(npcs=1), rng) for _ in range(30)]


@table(
    ("name", "made", "expected"),
    [
        ("steps", property(lambda self: (1, 2)), r"a list or tuple of pafot\.Step\(\.\.\.\), received \(1, 2\)"),
        ("steps", property(lambda self: None), r"a list or tuple of pafot\.Step\(\.\.\.\), received None"),
        ("goal", property(lambda self: 3), "a text, received 3"),
        ("roughness", property(lambda self: "rough"), "a whole number, received 'rough'"),
        ("weight", property(lambda self: 0.5), r"a whole number, received 0\.5"),
        ("weight", property(lambda self: np.float32(0.5)), r"a whole number, received 0\.5"),
        ("plainer", lambda self: iter([None]), "an instruction, received None"),
        ("plainer", lambda self: 5, "an instruction, received 5"),
        ("plain", lambda self: "it", "a list of texts and numbers, received 'it'"),
        ("in_file", lambda self: [1], r"a dict of its fields, received \[1\]"),
        ("read", classmethod(lambda cls, plain=(): plain), r"an instruction, received \(\)"),
        ("small", staticmethod(lambda: [3]), r"a list or tuple of instructions, received \[3\]"),
        ("mixed", lambda self: (self, None), r"two instructions or None, received \(Changed\(.*\), None\)"),
        ("shown", lambda self: "it", "a dict of the fields of a view, received 'it'"),
        ("lasting", lambda self: 0.5, r"a whole number or None, received 0\.5"),
        ("slot_asked", property(lambda self: "1 s"), "a number or None, received '1 s'"),
        ("is_drawn_in", lambda self: None, "True or False, received None"),
        ("target", property(lambda self: None), "a text or a whole number, received None"),
        ("code", property(lambda self: []), r"a value that can be hashed, received \[\]"),
        ("goal", cached_property(lambda self: 3), "a text, received 3"),
        ("text", cached_property(lambda self: 3), "a text, received 3"),
        ("plain", cache(lambda self: "it"), "a list of texts and numbers, received 'it'"),
    ],
)
def test_wrong_return_of_a_kind_is_refused_by_the_name_of_its_method(name, made, expected):
    kind = changed(**{name: made})
    for _ in range(2):  # as in a notebook
        register(kind, drives="itself")
    one = kind(beside=1, ahead=20.0, speed=20.0, period=4.0)
    with pytest.raises(ScenarioError, match=rf"\w+\.{name}: expected {expected}; correct this property or method"):
        list(getattr(one, name)())


@table(
    ("name", "made", "plain"),
    [
        ("is_drawn_in", np.bool_(True), True),
        ("roughness", np.int64(3), 3),
        ("lasting", np.uint8(3), 3),
        ("slot_asked", np.float32(0.5), 0.5),
        ("goal", np.str_("ahead"), "ahead"),
        ("plain", ["it", np.int64(3), [np.float32(0.5)]], ["it", 3, [0.5]]),
        ("in_file", {"at": {"speed": np.int64(3), "is_late": np.bool_(False)}}, {"at": {"speed": 3, "is_late": False}}),
    ],
)
def test_numbers_of_numpy_that_a_kind_returns_are_as_good_as_plain_ones(name, made, plain):
    kind = changed(**{name: lambda self, *others: made})
    register(kind, drives="itself")
    returned = getattr(kind(beside=1, ahead=20.0, speed=20.0, period=4.0), name)()
    assert repr(returned) == repr(plain)


def test_every_type_that_an_instruction_promises_is_checked():
    members = [getattr(each, "fget", getattr(each, "__func__", each)) for each in vars(Instruction).values()]
    promised = {each.__annotations__["return"] for each in members if isfunction(each)}
    assert promised - {*RETURNS} == {"Any"}


def test_cached_property_of_a_kind_is_computed_once():
    computed = []
    kind = changed(remark=cached_property(lambda self: computed.append(self) or "once"))
    register(kind, drives="itself")
    one = kind(beside=1, ahead=20.0, speed=20.0, period=4.0)
    assert (one.remark, one.remark, len(computed)) == ("once", "once", 1)


def test_kind_that_is_registered_often_answers_as_before():
    kind = changed(remark=property(lambda self: "often"))
    for _ in range(1200):  # more than there can be calls within calls
        register(kind, drives="itself")
    assert kind(beside=1, ahead=20.0, speed=20.0, period=4.0).remark == "often"


def test_remark_of_a_kind_stays_in_its_comment():
    kind = changed(remark=property(lambda self: "left\nexpect: {outcome: safe}\x1b[31m\u2028xfail: no"))
    register(kind, drives="itself")
    given = kind(beside=1, ahead=20.0, speed=20.0, period=4.0)
    text = text_of(replace(plain_finding(), scenario=Scenario(npcs=((given,),))))
    (line,) = [each for each in text.splitlines() if "left" in each]
    assert "outcome: safe" in line
    assert "\x1b" not in text
    assert "xfail: no" in line


def test_error_that_a_kind_raises_is_its_own():
    kind = changed(roughness=property(lambda self: 1 // 0))
    register(kind, drives="itself")
    with pytest.raises(ZeroDivisionError):
        assert kind(beside=1, ahead=20.0, speed=20.0, period=4.0).roughness


def test_simpler_instructions_without_an_end_are_shrunk():
    def plainer(self):
        while True:
            yield replace(self, period=5.0)

    rough = property(lambda self: int(self.period != 5.0))
    kind = changed(name="endless", plainer=plainer, roughness=rough)
    register(kind, drives="itself")
    scenario = Scenario(npcs=((kind(beside=1, ahead=20.0, speed=20.0, period=7.3),),))
    simplest, _ = shrink(scenario, lambda each: each if type(each.npcs[0][0]) is kind else None, rollouts=500)
    assert simplest.npcs[0][0].period == 5.0


def test_error_of_a_kinds_planner_names_the_kind():
    kind = changed(name="late", planner=lambda self: lambda seen: 1 / 0)
    register(kind, drives="itself")
    scenario = Scenario(npcs=((kind(beside=1, ahead=20.0, speed=20.0, period=4.0),),))
    trace = Highway().rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    assert trace.users_error_text.startswith("the driver late failed: ZeroDivisionError")
    kind = changed(name="late", planner=lambda self: 3)
    register(kind, drives="itself")
    scenario = Scenario(npcs=((kind(beside=1, ahead=20.0, speed=20.0, period=4.0),),))
    with pytest.raises(AdsFactoryError, match=r"npcs\[0\]\[0\].planner: expected the factory to return an ADS"):
        Highway().rollout(scenario, lambda: lambda seen: (0.0, 0.0))


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
