"""What is said of runs and collisions: explanations, verdicts with their facts, checks."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import LaneInstruction, PositionInstruction, Scenario
from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.attribution.sentences import impact, responsible_sentence
from pytest_pafot.attribution.takeovers import sentence
from pytest_pafot.model.instructions import ACTS, Cell, CrossingInstruction
from pytest_pafot.model.trace import SPEED, Outcome, X
from pytest_pafot.oracle.run import LINE_LENGTH, Run
from tests.attribution import test_responsibility as responsibility
from tests.attribution import test_right_of_way as right_of_way
from tests.helpers.crossing_traces import CROSSES, MERGES, ZONES, junction_trace
from tests.helpers.drives import HZ, crash, driven
from tests.helpers.reference_runs import closing
from tests.helpers.refusals import error_of
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import collision_at
from tests.oracle import test_checks as checks
from tests.oracle import test_crossing_run as crossing_run
from tests.oracle import test_run as runs
from tests.oracle.test_lane_run import in_lanes, rows, run_of

TRACES = {each.name: each.trace for group in SITUATIONS.values() for each in group}
IMPACTS = [
    (None, "front", None, ""), (None, None, None, ""), (3, "rear", Cell.REAR, ""), (3, "rear", None, "from the left"),
    (0, "front", None, "from the left"), (0, "left", None, "from the left"), (0, "right", None, "from ahead"),
    (0, None, None, "from the left"), *((0, "front", cell, "") for cell in Cell), (0, "front", None, ""),
    (1, "left", Cell.LEFT, ""), (1, "right", None, ""), (1, None, Cell.FRONT, ""),
]  # fmt: skip


def test_impacts(snapshot):
    told = {str(each): impact(5.42, *each, 8.19) for each in IMPACTS}
    assert all(impact(5.42, *each) == told[str(each)].partition(",")[0] for each in IMPACTS[8:])
    for side, cell in (("front", Cell.FRONT), ("rear", Cell.REAR)):
        for way in ("along", "towards", "backwards"):
            told[f"{side}, {way}"] = impact(5.42, 0, side, cell, "", 8.19, way)
    assert told == snapshot


def test_responsible_vehicles_and_takeovers(snapshot):
    told = {who: responsible_sentence(who, 2) for who in ("ego", "npc", "both", "none")}
    told["with a takeover"] = responsible_sentence("npc", 2, 1.25)
    told["a fixed object"] = responsible_sentence("ego", None)
    assert {**told, "takeovers": [sentence(1.25), sentence(0.0)]} == snapshot


BRAKES = {
    "none": [],
    "speeds up": [(6.0, -2.0, 25.0)],
    "slows": [(6.0, 0.4, 18.0)],
    "brakes": [(8.0, 6.0, 12.0)],
    "brakes at once": [(5.3, 1.0, 0.0)],
    "brakes twice": [(7.0, 3.0, 17.0), (8.4, -2.0, 19.0), (9.6, 4.0, 12.0)],
}
BACKWARDS = {"brakes": (8.0, [(1.0, 20.0, -3.0)]), "always": (-3.0, []), "stands": (0.0, [])}


def test_verdicts(snapshot):
    slower = driven(105.0, speed=10.0)  # 100 m ahead of the ego, which drives 20 m/s at first
    traces = {name: crash(driven(0.0, brakes=brakes), slower) for name, brakes in BRAKES.items()}
    for name, (speed, brakes) in BACKWARDS.items():
        ego, hit = driven(0.0, speed=speed, brakes=brakes), {"side": "rear", "cell": Cell.REAR}
        traces[f"backwards: {name}"] = crash(ego, driven(-30.0, speed=5.0), **hit)
    traces["a swerve"] = responsibility.swerved()
    traces["right of way"], traces["outside"] = right_of_way.ignored(), right_of_way.outside()
    assert {name: rss_rule(trace).sentences for name, trace in traces.items()} == snapshot


def test_reasons_of_all_situations(snapshot):
    assert {name: " ".join(rss_rule(make()).sentences) for name, make in TRACES.items()} == snapshot


def explained(**given):
    return {name: run.explain() for name, run in given.items()}


def test_explanations(snapshot):
    hit = runs.crash(arrivals=((12,), (None,)))
    disagrees = replace(hit.trace, collision=collision_at(30, cell=Cell.LEFT, side="left"))
    told = explained(
        hit=hit, disagrees=Run(disagrees), safe=Run(closing(ticks=15)), failed=runs.failed(),
        backwards=runs.backwards(-3.2), held=runs.of_chains(runs.HELD), two=runs.of_chains(runs.HELD, runs.BRAKING),
    )  # fmt: skip
    assert {**told, "repr": repr(runs.crash())} == snapshot


def test_explanations_at_junctions(snapshot):
    lines, left = crossing_run.lines_of, Outcome.LEFT_ROUTE
    crash, merged = crossing_run.crash(), {"seconds": 6.0, "outcome": Outcome.COLLISION}
    late = junction_trace((MERGES, 0.0), collision=collision_at(90, cell=Cell.FRONT), **merged)
    told = explained(
        crash=crash, left=Run(replace(junction_trace((CROSSES, 0.0)), outcome=left)), late=Run(late),
        unknown=Run(replace(crash.trace, zones=(), on_way=None)),
    )  # fmt: skip
    for start in (0.0, 10.0, 25.0, -60.0):
        told[f"a start at {start}"] = lines((CROSSES, start))[-2]
    told["alone"] = lines((CROSSES, 0.0), ego_speed=2.0)[-2]
    told["several"] = lines((CROSSES, 0.0), (None, 20.0), (MERGES, 0.0))[-5:]
    told["many"] = lines(*[(CROSSES, -7.0 * number) for number in range(7)])
    told["places"] = {
        where: crossing_run.place(start) for where, start in crossing_run.PLACES.items()
    }
    zone, slots = ZONES[CROSSES], dict(zip(ACTS, (0.5, -1.0, 0.0, 5.0), strict=False))
    for act, slot in slots.items():
        told[act] = CrossingInstruction(CROSSES, slot, 8.6, act).words_from(zone.whence)
    told["no zone"] = CrossingInstruction(CROSSES, 5.0, 8.6, "late").words_from("")
    assert told == snapshot


APART = [("right", -1), ("left", 1), ("left", 0), ("right", 0), ("keep", 0), ("keep", -1), ("keep", 2), ("right", 1),
         ("left", 2), ("keep", 4), ("left", np.nan)]  # fmt: skip


def test_lanes_and_their_tables(snapshot):
    words = {f"{lane} at {apart}": LaneInstruction(lane, 8.0).words(apart) for lane, apart in APART}
    left = run_of(in_lanes("left@8")).trace
    kept = replace(left, executed=Scenario(npcs=[in_lanes("keep@8")], gene_seconds=2.0))
    cut_in = {"lanes": ((0, 1),), "arrivals": ((28, 30),)}
    tables = {
        speed: run_of(in_lanes(f"right@{speed} keep@0"), **cut_in) for speed in (19.6, 10.0, 26.8)
    }
    on_grid = (PositionInstruction(2, 20.0), PositionInstruction(1, 26.8))
    narrow, far = [in_lanes("right@10"), in_lanes("left@10")], [in_lanes("right@10")] * 2
    both = {"lanes": ((1, 1), (2, 1)), "arrivals": ((20, None), (None, 40))}
    tables |= {
        "a lane that does not exist": Run(kept),
        "late": run_of(in_lanes("right@20 keep@0"), lanes=((0, 1),), arrivals=((None, 36),)),
        "given up": run_of(in_lanes("right@10 keep@0"), lanes=((0, 0),), arrivals=((None, 36),)),
        "kept": run_of(
            *[in_lanes("keep@10 keep@10"), in_lanes("keep@5 keep@5")], lanes=((0, 0), (1, 1))
        ),
        "equal": run_of(*[in_lanes("left@8 left@8")] * 3, lanes=((2, 2), (3, 3), (3, 3))),
        "both": run_of(on_grid, in_lanes("left@26.8 keep@8"), **both),
        "narrow": run_of(*narrow, lanes=((0, 0), (2, 2)), arrivals=((28,), (None,))),
        "far": run_of(*far, ego=0, lanes=((1, 1), (2, 2))),
    }
    assert {**words, "tables": {name: rows(run) for name, run in tables.items()}} == snapshot


def test_checks(snapshot):
    told = {
        name: str(checks.made(value, **bounds)) for name, (value, bounds) in checks.CHECKS.items()
    }
    told |= {name: error_of(checks.check, *given) for name, given in checks.IMPOSSIBLE.items()}
    told["an NPC beyond the last"] = error_of(checks.check_npc_beyond)
    told["no check"] = error_of(checks.CheckFailed, "slow")
    assert told == snapshot


# Each sentence against the trace.

NUMBER = r"(\d+\.\d)"
PLACE = re.compile(
    rf"At {NUMBER} s, NPC 0 was (?:in lane (\d), )?(?:{NUMBER} m (ahead of|behind)|next to) the ego"
    r"(?: and coming towards it)?\. It "
)
GAP = r"(?: \((\d+\.\d) m behind NPC 0\))?"
# The time and the gap stand before a phase, or after the first one.
PHASE = re.compile(
    rf"(?:from {NUMBER} s on{GAP} )?(braked|slowed|sped up)(?: from {NUMBER})? to {NUMBER} m/s"
    rf"(?: at up to {NUMBER} m/s\^2)?(?: from {NUMBER} s on)?{GAP}"
)
PAUSE = re.compile(rf"(?:did not brake|stood still) from {NUMBER} s on")


def told_of(trace, sentence, vehicle, since):
    """Check each number of the sentence on what a vehicle did from a tick on against the trace."""
    speeds, deed = np.maximum(trace.states[since:, vehicle, SPEED], 0.0), sentence
    if sentence.startswith("At "):
        place = PLACE.match(sentence)
        assert place
        time, lane, gap, where = place.groups()
        assert float(time) == pytest.approx(since / HZ, abs=0.051)
        lanes = trace.road.numbers(1)[since], trace.road.numbers(0)[since]
        assert lanes[0] in (-1, lanes[1]) if lane is None else lanes[0] == int(lane) != lanes[1]
        if trace.track is None and gap:
            ahead = trace.states[since, 1, X] - trace.states[since, 0, X]
            assert float(gap) == pytest.approx(abs(ahead) - 5.0, abs=0.5)
            assert (ahead > 0) == (where == "ahead of")
    found = [each.groups() for each in PHASE.finditer(deed)]
    phases = [(*each[2:6], each[0] or each[6], each[1] or each[7]) for each in found]
    starts = [since if each[4] is None else round(float(each[4]) * HZ) for each in phases]
    assert len(starts) == len(re.findall("braked|slowed|sped up", deed))
    assert deed.count(" s on") == sum(each[4] is not None for each in phases) + bool(
        PAUSE.search(deed)
    )
    assert starts == sorted(starts)
    assert len(phases) <= 3
    for phase, start, end in zip(phases, starts, [*starts[1:], trace.ticks], strict=False):
        part = speeds[max(start - since - 1, 0) : end - since + 1]
        change, hardest = part[-1] - part[0], -np.diff(part).min() * HZ
        # within a tick, since the time is rounded
        near = speeds[max(end - since - 1, 0) : end - since + 2]
        assert near.min() - 0.06 < float(phase[2]) < near.max() + 0.06
        assert phase[1] is None or float(phase[1]) == pytest.approx(speeds[0], abs=0.06)
        assert (phase[0] == "sped up") == (change > 0)
        assert (phase[0] == "braked") == (change < 0 and hardest >= 0.5)
        assert phase[3] is None or float(phase[3]) == pytest.approx(hardest, abs=0.06)
        if phase[5] and trace.track is None:
            ahead = trace.states[start, 1, X] - trace.states[start, 0, X] - 5.0
            # within the tick of the rounded time
            assert float(phase[5]) == pytest.approx(ahead, abs=1.5)
    if kept := re.search(rf"drove at {NUMBER} m/s", deed):
        assert float(kept[1]) == pytest.approx(speeds[0], abs=0.21)
    if "stood still" in deed:
        assert speeds[0] < 0.05
    if pause := PAUSE.search(deed):
        assert float(pause[1]) == pytest.approx(since / HZ, abs=0.051)
        assert not any(phase[0] == "braked" for phase in phases)


@table("name", TRACES)
def test_each_sentence_is_a_fact(name):
    trace = TRACES[name]()
    run, found, hit = Run(trace), rss_rule(trace), trace.collision
    assert f" after {hit.time:.1f} s, closing at {hit.closing_speed:.1f} m/s" in run.impact
    *_, npc, ego = found.sentences
    since = max(min(found.tick, trace.ticks - 2 * HZ), 0)
    assert npc.startswith(("NPC 0 ", "At "))
    assert ego.startswith("The ego ")
    told_of(trace, npc, 1, since)
    told_of(trace, ego, 0, since)
    told = [*found.sentences, *run.sentences[-1:]]
    assert 3 <= len(told) <= 5
    assert all(
        text[0].isupper() and text.endswith(".") and text.isascii() and "nan" not in text
        for text in told
    )
    assert not {"should", "would", "could", "avoids"} & set(" ".join(found.sentences).split())
    assert max(map(len, run.explain().splitlines())) <= LINE_LENGTH
