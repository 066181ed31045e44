"""A search's stored state loads unchanged, and nothing else loads."""

import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import date
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot.algorithms.evaluation import Evaluation, Health
from pytest_pafot.attribution.responsibility import Fault, Manoeuvre, Mistake, Responsibility
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.sighting import (
    Beyond,
    Died,
    Discovery,
    Finished,
    FoundElsewhere,
    Judged,
    NotFound,
    NotMade,
    NotSearched,
    Replay,
    Seen,
    Shows,
    Which,
)
from pytest_pafot.findings.verdict import Severity, Signature, Verdict
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import Collision, Outcome, Side
from pytest_pafot.oracle.run import Run
from pytest_pafot.plugin.item import packed
from pytest_pafot.report.messages import from_plain, plain
from pytest_pafot.strategies import scenarios
from pytest_pafot.support.errors import FieldError
from tests.findings.builders import findings, plain_finding, tried
from tests.helpers.hostile import CHARACTERS
from tests.helpers.refusals import refused
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

texts, counts = st.text(CHARACTERS, max_size=8), st.integers(0, 2**40)
finite = st.floats(allow_nan=False, allow_infinity=False)


def one_of(literal):
    return st.sampled_from(get_args(literal))


def maybe(strategy):
    return st.none() | strategy


signatures = st.builds(
    Signature,
    outcome=st.sampled_from(Outcome),
    responsibility=one_of(Responsibility),
    mistake=maybe(one_of(Mistake)),
    fault=maybe(one_of(Fault)),
    side=maybe(one_of(Side)),
    cell=maybe(st.sampled_from(Cell)),
    **dict.fromkeys(("failure", "assertion"), texts),
    **dict.fromkeys(("npc_manoeuvre", "ego_manoeuvre"), maybe(one_of(Manoeuvre))),
)
collisions = st.builds(
    Collision,
    side=one_of(Side),
    cell=st.sampled_from(Cell),
    **dict.fromkeys(("tick", "npc"), counts),
    **dict.fromkeys(("time", "ego_speed", "npc_speed", "closing_speed"), finite),
)


def tuples(strategy, most=2):
    return st.lists(strategy, max_size=most).map(tuple)


evaluations = st.builds(
    Evaluation,
    fitness=st.floats(),
    outcome=st.sampled_from(Outcome),
    duration=finite,
    **dict.fromkeys(("scenario", "executed"), scenarios()),
    **dict.fromkeys(("failing", "interaction", "discarded"), st.booleans()),
    **dict.fromkeys(("genes_started", "genes_reached"), counts),
    kind=maybe(signatures),
    margins=tuples(st.tuples(texts, st.floats(allow_nan=False))),
    collision=maybe(collisions),
)
counters = st.dictionaries(st.sampled_from(("cell", "lane", "zone")), counts).map(Counter)
healths = st.builds(Health, evaluated=counts, simulated=counts, failing=counts, ended=counters)


@given(evaluations | healths)
def test_stored_value_comes_back_equal_from_json(value):
    text = json.dumps(plain(value), allow_nan=False)
    back = from_plain(type(value), json.loads(text))
    assert back == value
    assert json.dumps(plain(back)) == text  # also what is not compared, such as faults


def test_set_is_stored_in_one_fixed_order():
    assert plain(frozenset("dbca")) == ["a", "b", "c", "d"]


@dataclass(frozen=True)
class Steps:
    size: float
    number: int
    found: Mapping[str, tuple[Cell, ...]]
    model: Any = None


def test_custom_dataclass_is_stored_without_untyped_fields():
    stored = plain(Steps(0.5, 3, {"a": (Cell.FRONT,)}, model=object()))
    assert from_plain(Steps, stored) == Steps(0.5, 3, {"a": (Cell.FRONT,)})


def test_what_json_cannot_hold_is_refused():
    with pytest.raises(ValueError, match="JSON"):
        plain([object()])


WRONG_DATA = [
    (float, "fast", ""),
    (float, True, ""),
    (int, 1.0, ""),
    (int, True, ""),
    (bool, 1, ""),
    (Outcome, "flew", ""),
    (Outcome, ["safe"], ""),
    (tuple[int, ...], {"0": 1}, ""),
    (tuple[int, ...], [1, None], "[1]"),
    (tuple[tuple[str, float], ...], [["a", 1.0], ["b", 1.0, 2.0]], "[1]"),
    (Steps, [0.5, 3], ""),
    (Steps, [0.5, 3, [["a", [9]]]], "[2][0][1][0]"),
    (Evaluation, plain([None]) * 17, "[0]"),
    (Evaluation, [[[[[4, -1.0]]], 0, 0, 1.0, 1.0]] * 17, "[0].speed"),
    (Collision | None, [], ""),
]


@table(("kind", "data", "place"), WRONG_DATA)
def test_wrong_data_is_refused_with_its_place(kind, data, place):
    with refused(place, FieldError):
        from_plain(kind, data)


@table(("text", "number"), [("inf", math.inf), ("-inf", -math.inf), ("nan", math.nan)])
def test_infinite_and_nan_numbers_are_stored_as_text(text, number):
    assert plain(number) == text
    assert repr(from_plain(float, text)) == repr(number)


@given(findings(), texts)
def test_a_sighting_is_read_as_it_was_sent_without_what_stays_in_its_process(finding, text):
    observed = Discovery(ended=Judged(verdict=Verdict(kind="failed")))
    made = replace(finding, trace=None)
    seen = Seen(finding=made, node_id=text, sentences=(text,), observed=observed)
    raised = Verdict(kind="failed", exception=ValueError(text))
    sent = packed(seen.with_observed(ended=Judged(verdict=raised)))
    assert from_plain(Seen, json.loads(sent)) == seen
    assert sent.isascii()
    assert from_plain(Seen, json.loads(sent)).observed.ended.verdict.exception is None


@table("acceptance", ["not accepted", "accepted", Beyond(why="NPC 1 hits the ego")])
@table("search", [NotSearched(), NotFound(runs=40, drawn=30), FoundElsewhere(id="hit-2")])
def test_a_replay_is_read_as_it_was_sent_without_its_runs(acceptance, search):
    run = Run(trace_of(vehicle(0.0, speed=20.0, ticks=3)))
    hits = Verdict(kind="failed", severity=Severity(kind="collision", value=8.2, unit="m/s"))
    died = Died(end="was ended by SIGSEGV", pid=7)
    sent, read = (
        Replay(
            tries=(
                tried(Shows.HANDLED),
                tried(Shows.ONLY_NOTED, Which.CONTINUED, ended=died),
                tried(Shows.SAME, Which.AS_SAVED_AGAIN, ended=first, repeats=False),
            ),
            reference=(tried(Shows.ONLY_NOTED, Which.CONTINUED, ended=NotMade()),),
            acceptance=acceptance,
            search=search,
        )
        for first in (Finished(verdict=hits, run=run), Judged(verdict=hits))
    )
    assert from_plain(Replay, json.loads(packed(sent))) == read
    assert sent.ran.run is run
    with pytest.raises(ValueError, match="expected a run of this process"):
        read.ran  # noqa: B018


def test_a_day_and_a_mapping_are_read_strictly():
    data = plain(plain_finding(xfail="issue 12", xfail_until=date(2027, 1, 31)))
    for place, wrong in ((-1, 3), (-1, "31.1.2027"), (3, [])):
        with pytest.raises(FieldError):
            from_plain(Finding, [*data[:place], wrong, *data[place:][1:]])
