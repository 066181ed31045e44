"""What the block of a failure, the summaries of a session and the report page say."""

from collections import Counter
from dataclasses import replace
from datetime import date

import numpy as np

from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import Bounded
from pytest_pafot.findings.shrink import Shrunk, described
from pytest_pafot.findings.sighting import NOT_REPEATED, Alike
from pytest_pafot.findings.verdict import CHECK_FAILED, PROCESS_CRASH
from pytest_pafot.model.instructions import Cell, LaneInstruction, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import SURVIVES, AdsError, Outcome
from pytest_pafot.oracle.run import Run
from pytest_pafot.report import terminal
from pytest_pafot.report.page import session_facts
from pytest_pafot.report.session_record import MAX_LISTED, finding_entry
from pytest_pafot.report.terminal import block_lines, found_line
from pytest_pafot.searches.events import Ending, Progress, Search, concluded
from pytest_pafot.world import World
from tests.findings.builders import plain_finding, sighting
from tests.report.builders import (
    REAL_SEARCH,
    as_seen,
    cut_in_trace,
    finding_of,
    page_of,
    real_page,
    rear_trace,
    scenario,
    session_of,
    view_of,
)
from tests.report.test_block import AGAIN, HARDER, of
from tests.report.test_block import seen as failed
from tests.report.test_check_view import checked, peaks, shown
from tests.report.test_crossing_view import crash, mixed
from tests.report.test_finding_view import MovingLeft
from tests.report.test_job_summary import finding, search, told
from tests.report.test_lane_instructions import IN_LANES, ON_GRID, cut_in
from tests.report.test_page import Reader
from tests.report.test_terminal import FIND, SEARCH, named

CUT_IN, AHEAD = PositionInstruction(Cell.FRONT_LEFT, 20.0), PositionInstruction(Cell.FRONT, 0.0)
# the scenario as it was found and after it was simplified, and whether nothing simpler is possible
SHRUNK = [
    ([[CUT_IN, AHEAD], [AHEAD]], [[AHEAD]], True),
    ([[CUT_IN, AHEAD]], [[AHEAD]], True),
    ([[CUT_IN, AHEAD]], [[AHEAD]], False),
    ([[CUT_IN]], [[AHEAD]], True),
    (None, [[AHEAD]], False),
    (None, [[AHEAD]], True),
]
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
VERDICT = "The ego is responsible."
ORIGINAL = Scenario(npcs=[[PositionInstruction(2, 8.0)] * 2, [PositionInstruction(4, 20.0)]])
ACCEPTED = {"xfail": "issue 12", "xfail_until": date(2027, 1, 31)}
WRAPPED = {"world": plain_finding().world | {"wrappers": ["t.py::wrap"]}}
# what a session saw of a finding, and the number of runs of its search; None for a replay
BLOCKS = {
    "new": ({}, 40),
    "of one run": ({"alike": Alike()}, 1),
    "no other run": ({"alike": Alike()}, 9),
    "the worst run": ({"severity": HARDER}, 40),
    "replay": ({"label": "still failing"}, None),
    "drifted": ({"label": "drifted", "detail": "numpy 2 instead of 1"}, None),
    "not accepted": ({"finding": ACCEPTED, "label": "still failing", "beyond": "NPC 1 hit the ego"}, None),
    "accepted": ({"finding": ACCEPTED, "label": "accepted"}, None),
    "reference": ({"expect": {"against": "idm"}}, 40),
    "simplified": ({"finding": {"shrunk": Shrunk(rollouts=5, before=described(ORIGINAL))}}, None),
    "not saved": ({"path": "", "detail": "read-only file system"}, None),
    "not to be saved": ({"path": "", "detail": "--pafot-save=none"}, None),
    "not updated": ({"detail": "could not be updated: no room"}, None),
    "draws": ({"finding": {"flaky": NOT_REPEATED}}, None),
    "draws in wrappers": ({"finding": {"flaky": NOT_REPEATED} | WRAPPED}, None),
    "decides differently": ({"finding": {"flaky": f"{NOT_REPEATED}: x differs. It had decided differently"}}, None),
    "survives": ({"finding": {"flaky": f"{NOT_REPEATED}: x of NPC 1 differs; {SURVIVES}"}}, None),
    "flaky": ({"finding": {"flaky": "another reason"}}, None),
    "check": ({"expect": CHECK, "headline": "braking = 6.0 > 5 m/s^2", "sentences": ("Also.",)}, None),
    "measure": ({"expect": {"assertion": "run.min_ttc > N"}, "sentences": ()}, None),
    "error": ({"expect": RAISED, "headline": "ZeroDivisionError: division by zero", "sentences": ()}, None),
    "crash": ({"expect": CRASHED, "headline": "died", "sentences": ()}, None),
    "hang": ({"expect": {"outcome": Outcome.HANG, "npc": None}, "sentences": ()}, None),
}  # fmt: skip


def test_blocks_read_so(snapshot):
    blocks = {}
    for name, (changes, runs) in BLOCKS.items():
        what = failed(**{"moment": None} | changes)
        assertion = {"place": "t.py:52", "text": "assert 0.0 > 1.0"} if name == "measure" else {}
        command = "" if not what.path else AGAIN
        lines = block_lines(
            what, command, search=of(runs), is_whole=name == "simplified", **assertion
        )
        blocks[name] = "\n".join([found_line(what), *lines])
    blocks["whole"] = "\n".join(block_lines(failed(), AGAIN, search=of(40), is_whole=True))
    assert blocks == snapshot


def summary(**changes):
    return "\n".join(terminal.search_lines(replace(SEARCH, **changes), width=120))


def test_the_summary_of_a_search_reads_so(snapshot):
    finds = tuple(named(f"front-2-{number}", alike=Alike(runs=number)) for number in range(6))
    severity = replace(HARDER, value=3.0)
    hard = sighting("hard", severity=severity, alike=Alike(runs=11, severity=HARDER))
    texts = {
        f"{at_fault} and {other} of {runs} random runs": summary(
            random=Counter(at_fault=at_fault, otherwise=other, runs=runs)
        )
        for at_fault, other, runs in ((1, 15, 20), (0, 0, 20), (3, 15, 44))
    }
    texts |= {f"ended: {reason}": summary(reason=reason, asked={"runs": 100}) for reason in Ending}
    texts["many"] = summary(finds=finds, random=Counter(runs=20, at_fault=3), no_worse={"a": "hit"})
    texts["severity"] = summary(finds=(hard,))
    texts["decisions"] = summary(
        decisions=Counter(search=3923, shrink=8357), more_runs=Counter(shrink=3, moment=4)
    )
    quiet = replace(
        SEARCH, kinds=Counter(passed=48), finds=(), known={}, warnings=(), notes=(), random=Counter(runs=48),
        drawn="3 to 6 NPCs in hostile traffic; the ego starts at 12 to 26.8 m/s in lanes 0 to 3",
    )  # fmt: skip
    texts["whole"] = "\n".join(terminal.search_lines(quiet, is_whole=True))
    flaky = named("rear-6-222222", flaky=NOT_REPEATED)
    texts["failure"] = terminal.failure_message(replace(SEARCH, finds=(FIND, flaky)))
    assert texts == snapshot


def test_the_summary_of_a_session_reads_so(snapshot):
    flaky = named("rear-6-222222", flaky=NOT_REPEATED, alike=Alike())
    lost = named("left-8-333333", path="", detail="read-only file system")
    other = replace(
        SEARCH, node_id="tests/test_safety.py::test_other[search]", finds=(flaky, lost),
        more_runs=Counter(known=3, shrink=49), known={}, warnings=(), notes=(),
    )  # fmt: skip
    running = Search(node_id="tests/test_safety.py::test_third[search]", seed=1)
    session = session_of(
        searches=[SEARCH, running, other],
        seen=[
            sighting("saved-a", label="fixed"),
            sighting("saved-b", label="still failing"),
            sighting("saved-c", label="drifted", detail="numpy 2 instead of 1"),
        ],
        left=["corpus/x.pafot.yaml", "corpus/y.pafot.yaml"],
        problems=["a fault in the page"],
        written=["report: report.html (1 finding)"],
        notes=["processes are off"],
    )
    assert "\n".join(terminal.session_lines(session)) == snapshot


def test_replays_that_pass_read_so(snapshot):
    passes = replace(sighting("saved-a", label="passes"), test="t")
    ran = replace(
        SEARCH, node_id="t[search]", reason=Ending.RUNS, kinds=Counter(passed=297, invalid=3)
    )
    searches = {
        "no search": None,
        "searched": ran,
        "in another scenario": replace(ran, failures=(("hit-2", passes.finding.signature),)),
        "interrupted": replace(ran, reason=Ending.INTERRUPTED),
        "random": replace(ran, random=Counter(runs=297)),
        "some random": replace(ran, random=Counter(runs=20)),
    }
    assert {
        name: "\n".join(
            terminal.replay_lines([concluded(passes, {"t": each} if each else {})], 200)
        )
        for name, each in searches.items()
    } == snapshot


def test_progress_and_remarks_read_so(snapshot):
    progress = Progress(
        node_id="x",
        generation=3,
        generations=None,
        budget=400,
        runs=4,
        failing=2,
        finds=1,
        seconds=0.5,
    )
    states = {
        "runs": {"left": 50, "decision_seconds": 0.01},
        "generations": {"generations": 100, "budget": None},
        "minutes": {"seconds": 4.0, "left": 396, "decision_seconds": 0.01},
        "hours": {"seconds": 80.0, "left": 7920, "decision_seconds": 0.2},
        "limited": {"seconds": 80.0, "left": 7920, "is_limited": True},
        "begins": {"runs": 0, "seconds": 0.0},
        "shrinking": {"phase": "shrinking saved-front-2-1f3a9c, run 3 of at most 300"},
    }
    lines = {
        name: terminal.progress_line(replace(progress, **each), 200)
        for name, each in states.items()
    }
    lines["flaky"] = sighting(finding={"flaky": NOT_REPEATED}).remark
    lines["hang"] = sighting(
        finding={"expect": replace(FIND.finding.expect, outcome=Outcome.HANG)}
    ).remark
    for found, simplest, is_minimal in SHRUNK:
        before = "" if found is None else described(Scenario.repaired(found))
        shrunk = Shrunk(rollouts=5, is_minimal=is_minimal, before=before)
        made = plain_finding(scenario=Scenario.repaired(simplest), shrunk=shrunk)
        lines[f"{before} -> {described(made.scenario)}, {is_minimal}"] = terminal.shrunk_lines(made)
    original, paper = (Scenario.repaired([[AHEAD]], traffic=each) for each in ("hostile", "paper"))
    made = plain_finding(scenario=paper, shrunk=Shrunk(rollouts=5, before=described(original)))
    lines["traffic"] = terminal.shrunk_lines(made)
    hits = [replace(HARDER, value=float(speed)) for speed in (3, 8, 1, 9, 5, 7, 2)]
    finds = [
        sighting(f"at-{n}", severity=each, headline="50 % hit", sentences=("Who.",))
        for n, each in enumerate(hits)
    ]
    lines["annotations"] = terminal.annotation_lines(finds)
    lines["annotations with a page"] = terminal.annotation_lines(finds, "r%.html")[-1]
    assert lines == snapshot


def test_the_summary_of_a_job_reads_so(snapshot):
    moment = Moment(time=4.2, npc=0, seen="9.9 m ahead", action="acceleration 0.3 m/s^2")
    many = [finding(str(number)) for number in range(3)]
    many += [finding(f"k{number}", "still failing") for number in range(4)]
    worse = finding(
        "f",
        "still failing",
        severity=HARDER,
        before=replace(HARDER, value=8.0),
        reference_passes=False,
    )
    worst = Alike(runs=3, number=2, severity=replace(HARDER, value=20.0))
    fixed = [finding(f"f{number}", "fixed", headline="") for number in range(MAX_LISTED + 5)]
    failing = {"test_it.py::x[search]": "the search tested too little: 40 runs, rejected"}
    faults = {
        "warnings": ["a: over"],
        "problems": ["no space"],
        "left": ["c/t/x/a.yaml", "c/t/x/b.yaml"],
    }
    drawn = search(random=Counter(runs=20, at_fault=1, otherwise=15, checks=14))
    assert {
        "nothing": told(searches=[search()]),
        "labels": told(finding("c", "fixed", headline="", searched=40), finding("b", "still failing"), finding(),
                       searches=[search(finds=(finding(),))]),
        "a failure": told(finding(sentences=("NPC 0 braked.", VERDICT), moment=moment), finding("b", moment=moment)),
        "accepted": told(finding(label="accepted", finding=ACCEPTED)),
        "not saved": told(finding(path="", detail="--pafot-save=none"), searches=[search()]),
        "worse": told(worse, finding(severity=HARDER, alike=worst)),
        "five of eight": told(*many, finding("c", "drifted"), page="report.html"),
        "many fixed": told(*fixed).splitlines()[-3:],
        "random": told(searches=[drawn, replace(search(random=Counter(runs=19, at_fault=2)), node_id="y[search]")]),
        "faults": told(searches=[search()], reasons=failing, results=dict.fromkeys(failing, "failed"), **faults),
    } == snapshot  # fmt: skip


# --- the page


def words_of(page):
    """Return the text of a page without its scripts and styles."""
    return "\n".join(
        each.replace("\u00a0", " ").strip() for each in Reader(page).words if each.strip()
    )


def test_the_page_reads_so(monkeypatch, snapshot):
    def ended(reason, kind="passed"):
        return Search(node_id="t.py::test_c[search]", reason=reason, kinds=Counter({kind: 4}))

    failures = {
        ("t.py::test_c[search]", "call"): "E   ValueError: no <plan>",
        ("t.py::test_d", "setup"): "x",
    }
    pages = {
        "two findings": real_page(),
        "errors": page_of(searches=(ended(Ending.ERROR),), failures=failures),
        "nothing": page_of(searches=(ended(Ending.RUNS),)),
        "out of time": page_of(searches=(ended(Ending.MAX_TIME),)),
        "interrupted": page_of(searches=(ended(Ending.INTERRUPTED),), exit=2),
        "known": page_of(searches=(ended(Ending.RUNS, "failed"),)),
    }
    monkeypatch.setattr("pytest_pafot.report.page.WHOLE", 1)
    further = as_seen(
        view_of(rear_trace()), finding={"id": "z1"}, headline="hit <b>", path="a b.pafot.yaml"
    )
    pages["further"] = page_of(view_of(cut_in_trace()), further, searches=(REAL_SEARCH,))
    replays = [
        sighting(f"t{n}", label=label)
        for n, label in enumerate(("fixed", "still failing", "fixed"))
    ]
    texts = {name: words_of(page) for name, page in pages.items()}
    texts["facts"] = [f"{name}: {fact}" for name, fact in session_facts([], replays)]
    assert texts == snapshot


def view_words(view):
    """Return what the page says about one finding."""
    parts = {
        "headline": view.headline,
        "besides": view.besides,
        "deed": view.deed,
        "sentences": [*view.sentences],
        "happened": [f"{title}: {words}" for title, words, _ in view.view["happened"]],
        "moment": [str(each) for each in view.view["moment"]],
        "instructions": [row.words for row in view.instructions if row.words],
        "assertion": view.assertion,
    }
    return {name: part for name, part in parts.items() if part}


def test_findings_on_the_page_read_so(snapshot):
    trace = cut_in_trace()
    check = checked(3.0, trace.ticks, at_most=2.5)
    room = checked(Run(trace).min_ttc, trace.ticks, name="room", unit="s", at_least=1.5)
    error = AdsError(kind="ValueError", message="no plan", traceback=ERROR, tick=30)
    raising = replace(trace, outcome=Outcome.ADS_ERROR, collision=None, error=error)
    raised = finding_of(raising)
    raised = replace(raised, expect=replace(raised.expect, traceback=ERROR))
    before = described(scenario([(2, 8.0)] * 2, [(4, 20.0)]), finding_of(trace).longest_run)
    simplified = replace(finding_of(trace), shrunk=Shrunk(rollouts=41, before=before))
    rear = finding_of(rear_trace())
    avoided = replace(rear, expect=replace(rear.expect, takeover=1.25))
    world = World("highway-v0", duration=15.0)
    moving = world.rollout(
        scenario([(8, 20.0)], gene_seconds=15.0, ego_speed=20.0), lambda: MovingLeft
    )
    everyday = replace(plain_finding().scenario, traffic="everyday")
    asked, stayed = (
        replace(cut_in().scenario, npcs=((LaneInstruction(lane, 25.0), *IN_LANES[1:]), ON_GRID))
        for lane in ("left", "keep")
    )
    views = {
        "cut-in": view_of(trace, simplified),
        "rear": view_of(rear_trace(), avoided),
        "lane change": view_of(moving, finding_of(moving, world=world.to_dict())),
        "error": view_of(raising, raised, headline="ValueError: no plan"),
        "crossings": crash(),
        "crossing and merging": mixed(),
        "lanes": view_of(cut_in()),
        "requested lanes": view_of(replace(cut_in(), scenario=asked, executed=stayed)),
        "check": shown(peaks(t61=35.1, t62=20.0), at_most=20),
        "check with a moment": shown(35.1, at_most=20, at=4.2, npc=0),
        "check without a moment": shown(35.1, at_most=20),
        "check broken twice": shown(peaks(t30=21, t45=35, t46=1), at_most=20),
        "check that rises": shown(np.linspace(0.0, 30.0, 301), at_most=20),
        "check that falls": shown(np.linspace(30.0, 0.0, 301), at_most=20),
        "check and collision": view_of(trace, finding_of(trace), check=check, headline=str(check)),
        "room": view_of(trace, finding_of(trace), check=room, headline=str(room)),
    }
    texts = {name: view_words(view) for name, view in views.items()}
    texts["traffic"] = finding_entry(sighting(finding={"scenario": everyday}))["traffic"]
    assert texts == snapshot
