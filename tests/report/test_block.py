"""The block on a failure: what it says, and what it leaves out if it would be longer than twelve lines."""

from collections import Counter
from dataclasses import replace
from datetime import date

import pytest

from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.sighting import NOT_REPEATED, Alike
from pytest_pafot.findings.verdict import Severity
from pytest_pafot.model.trace import SURVIVES
from pytest_pafot.report.terminal import DRAWS, DRAWS_IN_WRAPPERS, ROOM, block_lines, found_line
from pytest_pafot.searches.events import Search
from tests.findings.builders import plain_finding, sighting
from tests.helpers.tables import table

FACT = "NPC 0 moved into lane 1 at 2.1 s, 2.8 m ahead of the ego."
DEED = "The ego drove at 20.0 m/s and did not brake from 2.1 s on."
VERDICT = "The ego is responsible. A careful driver who took control 1.25 s before the impact would have avoided it."
HEADLINE = "The ego hit NPC 0 from behind after 12.4 s, closing at 8.2 m/s"
ROWS = (("", ("line 7: gap < 5  (gap = 6.8) -> False", "line 9: lane == 1 -> True")),)
MOMENT = Moment(
    time=4.2, npc=0, seen="6.7 m ahead", action="acceleration 0.2 m/s^2", hidden="",
    otherwise="4 m nearer: acceleration -6.0 m/s^2", conditions=ROWS,
)  # fmt: skip
HIT, HARDER = (Severity(kind="collision", value=speed, unit="m/s") for speed in (8.2, 11.4))
AGAIN = "pytest corpus/a.pafot.yaml"
EXPECT = plain_finding().expect


def seen(*, expect=None, finding=None, **more):
    """Return what a session saw of a collision, with all that is told of one."""
    changed = {"expect": replace(EXPECT, **expect or {})} | (finding or {})
    known = {
        "headline": f"{HEADLINE}; ego at fault",
        "sentences": (FACT, DEED, VERDICT),
        "path": "corpus/a.pafot.yaml",
    }
    known |= {
        "moment": MOMENT,
        "severity": HIT,
        "alike": Alike(runs=30, number=28, severity=HARDER, least=HIT),
    }
    return sighting("a", finding=changed, **known | more)


def of(runs):
    """Return a search of so many runs; None for a replay."""
    return Search(node_id="t", kinds=Counter(failed=runs)) if runs else None


def block(again=AGAIN, runs=0, *, is_whole=False, **more):
    """Return the text of a block, whose lines are joined, and the number of its lines."""
    lines = block_lines(seen(**more), again, search=of(runs), is_whole=is_whole)
    return " ".join(" ".join(lines).split()), len(lines)


LONG = f"{FACT[:-1]}{', and then it moved on' * 3}."
"""A sentence of two lines."""
LEFT_OUT = ("31 of 40", "did not brake", "line 7", "6.7 m ahead", "no generator", "idm")
"""Values in the parts that a block leaves out, in this order."""
REFERENCE = {"expect": {"against": "idm"}}


@table("count", [0, 1, 2, 3, 4, 5, 8])
def test_a_block_that_would_be_too_long_leaves_out_what_is_less_important(count):
    """The headline, the verdict and the command stay, however long the rest is."""
    verdict = " ".join([VERDICT, *[LONG] * count])
    long = {
        "sentences": (FACT, DEED, verdict),
        "runs": 40,
        "finding": {"flaky": "no generator"},
    } | REFERENCE
    text, lines = block(**long)
    there = [words in text for words in LEFT_OUT]
    assert there == sorted(there)  # what is left out is the first of the list
    assert lines <= ROOM or not any(there)
    assert all(each in text for each in (HEADLINE, verdict, f"replay {AGAIN}"))
    assert all(words in block(**long, is_whole=True)[0] for words in LEFT_OUT)


def test_what_a_replay_was_stays_longest():
    long = (FACT, DEED, " ".join([LONG] * 5))
    text, lines = block(sentences=long, label="drifted", detail="numpy 2 instead of 1")
    assert "drifted (numpy 2" in text
    assert DEED not in text
    assert lines <= ROOM


def test_of_what_is_not_saved_the_block_has_the_file_and_no_command():
    lost = seen(path="", detail="read-only file system")
    file = [f"  {line}" for line in text_of(lost.finding).rstrip().splitlines()]
    assert block_lines(lost, "")[-len(file) :] == file
    assert "pafot: 3" not in block(path="", detail="--pafot-save=none", again="")[0]


def test_a_failure_that_goes_beyond_an_accepted_one_says_so():
    accepted = {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)}
    text, lines = block(finding=accepted, label="still failing", beyond="NPC 1 hit it")
    assert "NPC 1 hit it" in text
    assert lines <= ROOM


@table(("world", "flaky", "advice"), [
    ({}, NOT_REPEATED, DRAWS),
    ({"wrappers": ["t.py::wrap"]}, NOT_REPEATED, DRAWS_IN_WRAPPERS),
    ({}, f"{NOT_REPEATED}: x of NPC 1 differs. It had decided differently", DRAWS),
    ({}, f"{NOT_REPEATED}: x of NPC 1 differs; {SURVIVES}", None),
    ({}, "another reason", None),
])  # fmt: skip
def test_only_a_policy_or_wrapper_that_seems_to_draw_is_given_advice(world, flaky, advice):
    finding = {"flaky": flaky, "world": plain_finding().world | world}
    text, _ = block(sentences=(VERDICT,), moment=None, finding=finding)
    assert [each for each in (DRAWS, DRAWS_IN_WRAPPERS) if each[1:] in text] == [advice] * bool(
        advice
    )


@table(("runs", "more", "numbers"), [
    (40, {}, (True, True)), (40, {"severity": HARDER}, (True, False)), (9, {"alike": Alike()}, (False, False)),
    (None, {}, (False, False)),
])  # fmt: skip
def test_the_runs_that_failed_alike_have_their_worst_only_if_it_is_worse(runs, more, numbers):
    text, _ = block(runs=runs, **more)
    assert ("31 of 40" in text, "11.4 m/s" in text) == numbers


@pytest.mark.parametrize("width", [40, 60, 120])
def test_a_block_fits_the_terminal_except_for_its_command(width):
    *lines, command = block_lines(seen(), AGAIN, search=of(40), width=width)
    assert max(map(len, lines)) <= width
    assert command == f"replay {AGAIN}"
    assert " ".join(" ".join(lines).split()) == " ".join(
        " ".join(block_lines(seen(), "", search=of(40))).split()
    )


def test_the_line_of_a_new_finding_is_ascii():
    assert found_line(seen(node_id="t\xe9::x")).endswith(": t\\xe9::x")
