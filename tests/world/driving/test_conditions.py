"""The conditions of one decision: what is recorded of small policies, and that the policy stays as it was."""

import importlib.util
import re
import sys
import threading
from textwrap import dedent, indent
from types import MappingProxyType

import pytest

from pytest_pafot.world.driving.conditions import (
    LONGEST,
    NOBODY,
    Conditions,
    differing_numbers,
    group_conditions,
    parting,
)


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Return a function that imports a module from the source of a policy, in a folder of its own."""
    monkeypatch.syspath_prepend(tmp_path)

    def load(source, name="policy_of_conditions"):
        (tmp_path / f"{name}.py").write_text(dedent(source))
        spec = importlib.util.spec_from_file_location(name, tmp_path / f"{name}.py")
        loaded = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, name, loaded)
        spec.loader.exec_module(loaded)
        return loaded

    load.root = tmp_path
    return load


def recorded(module, source, seen, ads="decide"):
    """Return what is told of a decision of a policy, which decides the same as without."""
    return facts(rows_of(evaluated(module, source, seen, ads)))


ROW = re.compile(r"(?:\S+ )?line (\d+): .*?(?:  \((.*)\))? -> (True|False)")


def facts(rows):
    """Return the line, the values and the outcome in each row."""
    found = [ROW.match(row).groups() for row in rows]
    return [(int(line), values or "", outcome == "True") for line, values, outcome in found]


def watching(module, *others):
    """Return the conditions of the policy's file and of others."""
    files = [module.root / f"{name}_of_conditions.py" for name in ("policy", *others)]
    return Conditions(files, module.root)


def rows_of(conditions, first=MappingProxyType({})):
    """Return the rows of conditions of which nobody knows whom they are about."""
    return [row for whom, rows in group_conditions(conditions, first) for row in rows if not whom]


def evaluated(module, source, seen, ads="decide"):
    """Return the conditions of a decision of a policy, which decides the same as without them."""
    policy = getattr(module(source), ads)
    plain, rows = policy(seen), []
    with watching(module).recorded(policy, rows):
        assert policy(seen) == plain
    return rows


BODIES = {
    "elif": ("if seen > 5: return 1\nelif seen > 2: return 2", [(3, "seen = 3.142", True), (2, "seen = 3.142", False)]),
    "and": ("return seen < 3 and missing > 1 or None is None", [(2, "seen = 3.142", True)]),
    "ternary": ("return 1 if not seen else 2", [(2, "seen = 3.142", False)]),
    "while": ("while seen > 1: seen -= 1", [(2, "seen = 0.142", False)]),
    "for": ("for lane in range(5):\n    if lane == 2: pass", [(3, "lane = 2", True)]),
    "comprehension": ("return [each for each in (1, 2, 9, 3) if each > 5]", [(2, "each = 9", True)]),
    "any": ("return any(each > seen for each in (1, 9))", [(2, "each = 9, seen = 3.142", True)]),
    "walrus": ("return (near := round(seen)) > 2", [(2, "near = 3", True)]),
    "lambda": ("return (lambda lane: lane < 3)(1)", [(2, "lane = 1", True)]),
    "match": ("match seen:\n    case float() if seen > 3: return 1", [(3, "seen = 3.142", True)]),
    "constant": ("while True: return 1", []),
}  # fmt: skip


@pytest.mark.parametrize(("body", "rows"), BODIES.values(), ids=BODIES)
def test_conditions_are_told_with_their_values_the_last_one_first(module, body, rows):
    assert recorded(module, f"def decide(seen):\n{indent(body, '    ')}", 3.14159) == rows


VALUES = """
import enum
import numpy as np

class Mode(enum.Enum):
    FOLLOW = 1

class Vain:
    def __repr__(self):
        raise ValueError
    __str__ = __len__ = __format__ = __repr__

    def __getattr__(self, name):
        raise ValueError

def decide(value):
    return value is None
ads = lambda seen: decide(seen)
value = {value}
"""


@pytest.mark.parametrize(("value", "text"), [
    ("1e-9", "1e-09"),
    ("20.0", "20"),
    ("float('inf')", "inf"),
    ("np.float32(0.5)", "0.5"),
    ("np.zeros((2, 3))", "array of shape (2, 3)"),
    ("[1, 2]", "list of 2"),
    ("'x' * 99", "'xxxxxxxxxxxxxxxxx...'"),
    ("10 ** 5000", "int"),
    ("Mode.FOLLOW", "Mode.FOLLOW"),
    ("Vain()", "Vain"),
    ("'a ::error \\x1b'", r"'a \x3a:error \x1b'"),
])  # fmt: skip
def test_values_are_short_safe_and_call_no_code_of_the_user(module, value, text):
    loaded, rows = module(VALUES.format(value=value)), []
    with watching(module).recorded(loaded.ads, rows):
        loaded.ads(loaded.value)
    assert facts(rows_of(rows)) == [(17, f"value = {text}", False)]


def test_truth_is_asked_for_once(module):
    source = """
    class Counting:
        calls = 0

        def __bool__(self):
            self.calls += 1
            return self.calls > 9

    def decide(seen):
        counting = Counting()
        if counting or seen:
            pass
        return counting.calls
    """
    assert recorded(module, source, 0)[0] == (11, "counting = Counting, seen = 0", False)


def test_a_long_condition_is_whole_and_one_of_a_program_is_left_out_whole(module):
    name = "a_name_that_is_longer_than_most"
    tests = [f"{name}.real > {number} and {name}.imag < {'1' * 40}" for number in range(9)]
    tests.append(" and ".join([f"{name} > 1"] * LONGEST))
    body = "\n".join(f"    if {each}: pass" for each in tests)
    rows = rows_of(evaluated(module, f"def decide({name}):\n{body}", 3.0))
    assert tests[8] in rows[1]
    assert facts(rows)[1] == (10, f"{name}.real = 3", False)
    assert [line for line, *_ in facts(rows)] == [*range(11, 1, -1)]
    assert len(rows[0]) < 60


FREE = """
def decide(gaps):
    if len(gaps) > 9: return "none"
    for gap in gaps:
        if gap < 0: continue
        if gap < 10: return "stay"
    return "change" if gaps else "stay"
"""


def test_conditions_that_come_out_otherwise_in_another_decision_are_first(module):
    here = evaluated(module, FREE, (30.0, 20.0, 40.0))
    there = evaluated(module, FREE, (30.0, 8.0, 40.0))
    rows = rows_of(here, parting(here, there, "with NPC 0 nearer", is_other=True))
    assert "with NPC 0 nearer" in rows[0]
    assert facts(rows) == [
        (6, "gap = 20", False), (7, "gaps = tuple of 3", True), (5, "gap = 40", False), (3, "len(gaps) = 3", False)
    ]  # fmt: skip
    there = evaluated(module, FREE, (30.0, 52.0, 40.0))
    assert not parting(here, there, "", is_other=True)
    # conditions with other values are those of an answer that stays the same
    rows = rows_of(here, parting(here, there, "with NPC 0 further away", is_other=False))[:2]
    assert facts(rows) == [(6, "gap = 20", False), (5, "gap = 20", False)]
    assert all("NPC 0 further away" in row for row in rows)


def whom_of(module, source, seen, nudges):
    """Return the conditions of a decision, and whom they are about by decisions with one vehicle a little elsewhere."""
    here, whom = evaluated(module, source, seen), {}
    for npc, nudged in enumerate(nudges):
        for number in differing_numbers(here, evaluated(module, source, nudged)):
            whom[number] = (*whom.get(number, ()), npc)
    return here, whom


def test_conditions_are_grouped_by_the_vehicle_whose_place_their_values_change_with(module):
    """The NPC that is asked about is first, and has its own evaluation of a loop over all."""
    nudges = [(30.01, 8.0, 40.0), (30.0, 8.01, 40.0), (30.0, 8.0, 40.01)]
    here, whom = whom_of(module, FREE, (30.0, 8.0, 40.0), nudges)
    groups = group_conditions(here, npc=0, whom=whom)
    assert [(who, facts(rows)) for who, rows in groups] == [
        ("NPC 0", [(6, "gap = 30", False), (5, "gap = 30", False)]),
        (NOBODY, [(3, "len(gaps) = 3", False)]),
        ("NPC 1", [(6, "gap = 8", True), (5, "gap = 8", False)]),
    ]
    # the loop ended before
    assert [who for who, _ in group_conditions(here, npc=2, whom=whom)] == [NOBODY, "NPC 1"]


TRACKS = """
from dataclasses import dataclass

class Track(tuple):
    pass

@dataclass
class Wish:
    gaps: object

def decide(seen):
    wish = {made}
    return wish is None
"""


MADE = ["Track(seen[:1])", "[seen[0]]", "Wish(seen[0])", "Wish([Track(seen)[0]])"]


@pytest.mark.parametrize(
    ("made", "who"), [*((each, "NPC 0") for each in MADE), ("Wish(seen)", "NPC 0, NPC 1")]
)
def test_what_is_in_an_object_of_the_user_says_whom_a_condition_is_about(module, made, who):
    nudges = [(30.01, 40.0), (30.0, 40.01)]
    here, whom = whom_of(module, TRACKS.format(made=made), (30.0, 40.0), nudges)
    assert [each for each, _ in group_conditions(here, npc=0, whom=whom)] == [who]


def test_an_evaluation_of_another_vehicle_is_no_other_outcome_of_this_one(module):
    """With NPC 1 nearest, a loop over the nearest first comes to it where it came to NPC 0."""
    source = "def decide(gaps):\n    return [1 for gap in sorted(gaps) if gap < 10]\n"
    here, whom = whom_of(module, source, (20.0, 30.0), [(20.01, 30.0), (20.0, 30.01)])
    there = evaluated(module, source, (20.0, 5.0))
    assert parting(here, there, "then", is_other=True, npc=1, whom=whom) == {}
    assert list(parting(here, there, "then", is_other=True)) == ["line 2: gap < 10"]


def test_a_decision_is_compared_until_it_goes_another_way(module):
    source = "def decide(gaps):\n    if gaps[0] < 10:\n        return gaps[1] < 5\n    return gaps[1] < 6\n"
    here, there = evaluated(module, source, (10.0, 5.0)), evaluated(module, source, (9.0, 5.0))
    assert differing_numbers(here, there) == {0}


def test_the_cause_is_before_what_it_causes(module):
    condition = "[1 for gap in gaps if gap < 10] == [] and sum(gaps) < 99"
    source = f"def decide(gaps):\n    return {condition}\n"
    here, there = (evaluated(module, source, seen) for seen in ((20.0,), (5.0,)))
    found = list(parting(here, there, "then", is_other=True))
    assert found == ["line 2: gap < 10", f"line 2: {condition}"]


TWO_FILES = """
from helper_of_conditions import gap

class Planner:
    __limit = 5.0

    def __call__(self, seen):
        return super().__class__ is Planner or gap(seen) < self.__limit

decide = Planner()
"""


def test_conditions_of_several_files_are_told_with_the_file(module):
    module("def gap(seen):\n    return seen if seen > 0 else 0.0\n", "helper_of_conditions")
    policy, conditions, rows = module(TWO_FILES).decide, watching(module, "helper"), []
    with conditions.recorded(policy, rows):
        assert policy(3.0)
    first, *_, last = rows_of(rows)
    assert [each.split()[0] for each in (first, last)] == [
        "policy_of_conditions.py",
        "helper_of_conditions.py",
    ]
    assert facts([last]) == [(2, "seen = 3", True)]
    assert facts([first])[0][0] == 8
    assert "gap(seen) = 3" in first
    assert not Conditions([module.root / "policy_of_conditions.py"], module.root / "elsewhere")


CLOSURE = """
def make():
    state = []

    def decide(seen):
        state.append(seen)
        if seen > 9:
            raise RuntimeError
        state.append(lambda other: other > 1)
        return len(state) > 2
    return decide
"""


@pytest.mark.parametrize("seen", [1, 10], ids=["decides", "raises"])
def test_a_policy_with_state_in_a_closure_is_left_as_it_was(module, seen):
    policy = module(CLOSURE).make()
    conditions, code = watching(module), policy.__code__
    for number in range(2):
        rows = []
        try:
            with conditions.recorded(policy, rows):
                assert policy(seen) is (number == 1)
        except RuntimeError:
            assert (seen, rows) == (10, [])
        else:
            values = f"len(state) = {2 + 2 * number}"
            assert facts(rows_of(rows))[0] == (10, values, number == 1)
        assert policy.__code__ is code
    cells = policy.__closure__[0].cell_contents
    assert len(cells) == (4 if seen == 1 else 2)
    assert [each(2) for each in cells if callable(each)] == [True] * (2 if seen == 1 else 0)


def test_other_threads_are_not_recorded(module):
    policy, rows = module("def decide(seen):\n    return seen > 1\n").decide, []
    with watching(module).recorded(policy, rows):
        thread = threading.Thread(target=policy, args=[3])
        thread.start()
        thread.join()
    assert rows == []


@pytest.mark.parametrize("ads", ["lambda seen: running.send(seen)", "running.send", "Planner()"])
def test_nothing_is_told_of_a_generator_whose_conditions_would_be_missing(module, ads):
    source = f"""
    def steps():
        seen = yield
        while seen != 0:
            seen = yield other(seen)

    def other(seen):
        return seen > 1

    def make():
        running = steps()
        next(running)

        class Planner:
            def __init__(self):
                self.running = running

            def __call__(self, seen):
                return self.running.send(seen)
        return {ads}
    decide = make()
    """
    assert recorded(module, source, 3) == []


def test_nothing_is_told_of_a_file_that_changed_or_cannot_be_read(module):
    policy = module("def decide(seen):\n    return seen > 1\n").decide
    file = module.root / "policy_of_conditions.py"
    for text in ("def decide(seen):\n    return seen > 2\n", "def decide(", "\0"):
        file.write_text(text)
        rows = []
        with watching(module).recorded(policy, rows):
            assert policy(2)
        assert rows == []
    file.write_text("def decide(seen):\n    return 1\n")
    assert not watching(module)  # it has no condition
    file.unlink()
    assert not Conditions([file, module.root], module.root)
