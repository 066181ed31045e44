"""The block on a failure: what it says, and what it leaves out if it would be longer than twelve lines."""

from collections import Counter
from dataclasses import replace
from datetime import date

import pytest

from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import Bounded
from pytest_pafot.findings.shrink import Shrunk, described
from pytest_pafot.findings.sighting import NOT_REPEATED, Alike
from pytest_pafot.findings.verdict import CHECK_FAILED, PROCESS_CRASH, Severity
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import SURVIVES, Outcome
from pytest_pafot.report.terminal import DRAWS, DRAWS_IN_WRAPPERS, ROOM, block_lines, found_line
from pytest_pafot.searches.events import Search
from pytest_pafot.support.text import wrapped_to
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


def test_a_block_reads_so():
    assert block_lines(seen(), AGAIN, search=of(40)) == [
        "The ego hit NPC 0 from behind after 12.4 s, closing at 8.2 m/s.",
        FACT,
        DEED,
        "The ego is responsible. A careful driver who took control 1.25 s before the",
        "  impact would have avoided it.",
        "At 4.2 s, the policy saw NPC 0 (6.7 m ahead) and chose acceleration 0.2 m/s^2;",
        "  with NPC 0 4 m nearer: acceleration -6.0 m/s^2.",
        "  line 7: gap < 5  (gap = 6.8) -> False",
        "31 of 40 runs failed in the same way. The worst one hits at 11.4 m/s.",
        f"replay {AGAIN}",
    ]


LONG = f"{FACT[:-1]}{', and then it moved on' * 3}."
"""A sentence of two lines."""
LEFT_OUT = (
    "failed in the same way",
    "did not brake",
    "line 7",
    "the policy saw",
    "no generator",
    "reference idm",
)
"""Some words of what a block leaves out, in this order."""
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
    text, lines = block(
        sentences=(FACT, DEED, " ".join([LONG] * 5)), label="drifted", detail="numpy 2 instead of 1"
    )
    assert "Result of the replay: drifted (numpy 2 instead of 1)." in text
    assert "did not brake" not in text
    assert lines <= ROOM
    assert "Result of the replay: still failing." in block(label="still failing")[0]


def test_a_whole_block_has_all_that_is_known():
    original = Scenario(npcs=[[PositionInstruction(2, 8.0)] * 2, [PositionInstruction(4, 20.0)]])
    finding = {"shrunk": Shrunk(rollouts=5, before=described(original)), "flaky": "no generator"}
    more = {
        "finding": finding,
        "runs": 40,
        "label": "accepted",
        "detail": "x" * 100,
        "is_whole": True,
    }
    text, lines = block(**more, beyond="crash", expect={"against": "idm"})
    for part in (
        FACT, DEED, VERDICT, "with NPC 0 hidden, it chose the same", "line 7", "line 9", "x" * 100, "accepted",
        "It was simplified from 2 NPCs", "The reference idm passes this scenario.", "failure differs: crash",
        "no generator",
    ):  # fmt: skip
        assert part in text, part
    assert lines > ROOM + 1


def test_of_what_is_not_saved_the_block_has_the_file_and_no_command():
    lost = seen(path="", detail="read-only file system")
    lines = block_lines(lost, "")
    begin = lines.index("The file would contain:")
    assert lines[begin - 1] == "It was not saved: read-only file system."
    assert lines[begin + 1 :] == [
        f"  {line}" for line in text_of(lost.finding).rstrip().splitlines()
    ]
    asked, _ = block(path="", detail="--pafot-save=none", again="")
    assert "It was not saved: --pafot-save=none." in asked
    assert "The file would contain" not in asked
    assert (
        "The saved file could not be updated: no room."
        in block(detail="could not be updated: no room")[0]
    )


def test_a_failure_that_goes_beyond_an_accepted_one_says_so():
    accepted = {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)}
    text, lines = block(
        finding=accepted, label="still failing", beyond="NPC 1 hit the ego from behind"
    )
    told = "The failure is not accepted. The line `xfail:` in corpus/a.pafot.yaml accepts "
    accepted_one = "The ego's front hit NPC 0 after 12.4 s"
    assert (
        f"{told}`{accepted_one}`, but this failure differs: NPC 1 hit the ego from behind. " in text
    )
    assert lines <= ROOM
    assert "not accepted" not in block(finding=accepted, label="accepted")[0]


@table(("world", "flaky", "advice"), [
    ({}, NOT_REPEATED, DRAWS),
    ({"wrappers": ["t.py::wrap"]}, NOT_REPEATED, DRAWS_IN_WRAPPERS),
    ({}, f"{NOT_REPEATED}: x of NPC 1 differs. The policy had decided differently", DRAWS),
    ({}, f"{NOT_REPEATED}: x of NPC 1 differs; {SURVIVES}", "it was not simplified, because its runs differ"),
    ({}, "another reason", "it was not simplified, because its runs differ"),
])  # fmt: skip
def test_a_flaky_failure_comes_with_what_to_do(world, flaky, advice):
    finding = {"flaky": flaky, "world": plain_finding().world | world}
    text, _ = block(sentences=(VERDICT,), moment=None, finding=finding)
    flaky = flaky.replace(f"; {SURVIVES}", f". {SURVIVES[0].upper()}{SURVIVES[1:]}")
    assert f"Flaky: {flaky}. {advice[0].upper()}{advice[1:]}." in text


def test_the_runs_that_failed_alike_have_their_worst_only_if_it_is_worse():
    assert (
        "31 of 40 runs failed in the same way. The worst one hits at 11.4 m/s." in block(runs=40)[0]
    )
    assert "in the same way" not in block(runs=1, alike=Alike())[0]
    assert "No other run failed in the same way. replay" in block(runs=9, alike=Alike())[0]
    assert "31 of 40 runs failed in the same way. replay" in block(runs=40, severity=HARDER)[0]
    assert "in the same way" not in block()[0]


ERROR = (
    '  File "t.py", line 14, in raises\n    return 1 / gap\n           '
    "~~^~~~\nZeroDivisionError: division by zero\n"
)
NO_HIT = {"npc": None, "cell": None, "side": None}
CHECK = {
    "failure": CHECK_FAILED,
    "check": Bounded(value=6.0, at_most=5.0, at_least=None, unit="m/s^2"),
}
RAISED = {"outcome": Outcome.ADS_ERROR, "traceback": ERROR, "time": 3.8} | NO_HIT
CRASHED = {"failure": PROCESS_CRASH, "outcome": Outcome.COMPLETED} | NO_HIT
ALSO = f"Also in this run: {HEADLINE}; ego at fault."


@table(("expect", "headline", "sentences", "assertion", "lines"), [
    (CHECK, "braking = 6.0 > 5 m/s^2", (ALSO,), {},
     ["The check fails: braking = 6.0 > 5 m/s^2.", *wrapped_to(ALSO, 80)]),
    ({"assertion": "run.min_ttc > N"}, HEADLINE, (), {"text": "assert 0.0 > 1.0"},
     ["t.py:52: assert 0.0 > 1.0 (run.min_ttc > N).", f"{HEADLINE}."]),
    # which the headline has
    ({"assertion": "not run.off_road"}, "left the road", (), {"text": "left"},
     ["t.py:52: left the road."]),
    (RAISED, "ZeroDivisionError: division by zero", (), {"place": ""},
     ["The policy failed after 3.8 s: ZeroDivisionError: division by zero.", *ERROR.splitlines()[:2]]),
    (CRASHED, "died", (), {"text": "It was ended by SIGABRT"}, ["It was ended by SIGABRT."]),
])  # fmt: skip
def test_what_is_no_plain_collision_begins_with_what_failed_and_where(
    expect, headline, sentences, assertion, lines
):
    failure = seen(expect=expect, headline=headline, sentences=sentences, moment=None)
    where = {"place": "t.py:52"} if assertion else {}
    assert block_lines(failure, AGAIN, **where | assertion) == [*lines, f"replay {AGAIN}"]


@pytest.mark.parametrize("width", [40, 60, 120])
def test_a_block_fits_the_terminal_except_for_its_command(width):
    *lines, command = block_lines(seen(), AGAIN, search=of(40), width=width)
    assert max(map(len, lines)) <= width
    assert command == f"replay {AGAIN}"
    assert " ".join(" ".join(lines).split()) == " ".join(
        " ".join(block_lines(seen(), "", search=of(40))).split()
    )


@table(("expect", "what"), [
    ({}, "a collision"),
    ({"outcome": Outcome.HANG, "npc": None}, "a hang in the policy"),
    (RAISED, "an error in the policy"),
    ({"assertion": "run.min_ttc > N"}, "a failed assertion"),
    (CHECK, "a failed check"),
    (CRASHED, "a process crash"),
])  # fmt: skip
def test_a_new_finding_has_one_line_while_its_search_continues(expect, what):
    assert found_line(seen(expect=expect, node_id="t\xe9::x")) == f"pafot: found {what}: t\\xe9::x"
    lost = seen(expect=expect, node_id="t", path="", detail="no room")
    assert found_line(lost) == f"pafot: found {what}: t, not saved: no room"
