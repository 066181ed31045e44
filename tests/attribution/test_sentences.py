"""Sentences on a collision: who hit whom, and what both did, each number against the trace."""

import re

import numpy as np
import pytest

from pytest_pafot.attribution.responsibility import rss_rule
from pytest_pafot.attribution.sentences import impact, responsible_sentence
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import SPEED, X
from pytest_pafot.oracle.run import LINE_LENGTH, Run
from tests.helpers.drives import HZ, crash, driven
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table

TRACES = {each.name: each.trace for group in SITUATIONS.values() for each in group}
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
CLOSING = "after 5.4 s, closing at 8.2 m/s"


@table(("npc", "side", "cell", "whence", "told"), [
    (None, "front", None, "", "the ego hit a fixed object"),
    (None, None, None, "", "the ego hit a fixed object"),
    (3, "rear", Cell.REAR, "", "NPC 3 hit the rear of the ego"),
    (3, "rear", None, "from the left", "NPC 3 hit the rear of the ego"),
    (0, "front", None, "from the left", "the ego hit NPC 0, which came from the left,"),
    (0, "left", None, "from the left", "NPC 0, which came from the left, hit the ego's left side"),
    (0, "right", None, "from ahead", "NPC 0, which came from ahead, hit the ego's right side"),
    (0, None, None, "from the left", "the ego and NPC 0 touched"),
    *((0, "front", cell, "", f"the ego's front hit NPC 0 ({cell.label})") for cell in Cell if cell is not Cell.FRONT),
    (0, "front", Cell.FRONT, "", "the ego's front hit NPC 0"),
    (0, "front", None, "", "the ego's front hit NPC 0"),
    (1, "left", Cell.LEFT, "", "the ego and NPC 1 touched on the ego's left side"),
    (1, "right", None, "", "the ego and NPC 1 touched on the ego's right side"),
    (1, None, Cell.FRONT, "", "the ego and NPC 1 touched"),
])  # fmt: skip
def test_an_impact_says_who_hit_whom_and_how_fast(npc, side, cell, whence, told):
    assert impact(5.42, npc, side, cell, whence, 8.19) == f"{told} {CLOSING}"
    assert impact(5.42, npc, side, cell, whence) == f"{told} {CLOSING.partition(',')[0]}"


@table(
    ("side", "way", "told"),
    [
        ("front", "along", "the ego hit NPC 0 from behind"),
        ("front", "towards", "the ego hit NPC 0 head-on"),
        ("front", "backwards", "the ego's front hit NPC 0"),
        ("rear", "along", "NPC 0 hit the ego from behind"),
        ("rear", "towards", "NPC 0 hit the rear of the ego"),
        ("rear", "backwards", "the ego drove backwards into NPC 0"),
    ],
)
def test_an_impact_says_who_came_from_behind_only_if_that_is_known(side, way, told):
    assert (
        impact(5.42, 0, side, Cell.FRONT if side == "front" else Cell.REAR, "", 8.19, way)
        == f"{told} {CLOSING}"
    )


@table(("responsibility", "told"), [
    ("ego", "The ego is responsible."),
    ("npc", "NPC 2 is responsible."),
    ("both", "The ego and NPC 2 are both responsible."),
    ("none", "Neither the ego nor NPC 2 is responsible."),
])  # fmt: skip
def test_who_is_responsible_is_followed_by_what_a_careful_driver_does(responsibility, told):
    careful = "A careful driver who took control 1.25 s before the impact would have avoided it."
    assert responsible_sentence(responsibility, 2) == told
    assert responsible_sentence(responsibility, 2, 1.25) == f"{told} {careful}"
    assert (
        responsible_sentence("ego", None)
        == "The ego is responsible, because a fixed object does not move."
    )


SLOWER = driven(105.0, speed=10.0)
"""An NPC 100 m ahead of the ego, which drives 20 m/s at first."""


@table(("brakes", "told"), [
    ([], "The ego drove at 20.0 m/s and did not brake from 5.3 s on."),
    ([(6.0, -2.0, 25.0)], "drove at 20.0 m/s, from 6.0 s on sped up to 25.0 m/s and did not brake from 5.3 s on."),
    ([(6.0, 0.4, 18.0)], "drove at 20.0 m/s, from 6.1 s on slowed to 18.2 m/s and did not brake from 5.3 s on."),
    ([(8.0, 6.0, 12.0)], "20.0 m/s and from 8.0 s on (20.0 m behind NPC 0) braked to 12.0 m/s at up to 6.0 m/s^2."),
    ([(5.3, 1.0, 0.0)], "The ego braked from 20.0 to 12.7 m/s at up to 1.0 m/s^2 (46.7 m behind NPC 0)."),
    (
        [(7.0, 3.0, 17.0), (8.4, -2.0, 19.0), (9.6, 4.0, 12.0)],
        "The ego braked to 17.0 m/s at up to 3.0 m/s^2 from 7.0 s on (30.0 m behind NPC 0), from 8.0 s on sped up to "
        "19.0 m/s and from 9.4 s on braked to 13.1 m/s at up to 4.0 m/s^2.",
    ),
])  # fmt: skip
def test_deeds_are_told_from_the_danger_on(brakes, told):
    found = rss_rule(crash(driven(0.0, brakes=brakes), SLOWER))
    npc, ego = found.sentences
    assert told in ego
    assert npc.startswith("At 5.3 s, NPC 0 was ")
    # that a vehicle ahead did not brake is no news
    assert npc.endswith(" ahead of the ego. It drove at 10.0 m/s.")


@table(("speed", "brakes", "told"), [
    (8.0, [(1.0, 20.0, -3.0)], r"The ego .*braked .*to 0\.0 m/s .*and drove backwards at 3\.0 m/s\."),
    (-3.0, [], r"The ego drove backwards at 3\.0 m/s\."),
    (0.0, [], r"The ego stood still from 3\.0 s on\."),
])  # fmt: skip
def test_an_ego_that_drives_backwards_does_not_stand_still(speed, brakes, told):
    trace = crash(
        driven(0.0, speed=speed, brakes=brakes),
        driven(-30.0, speed=5.0),
        side="rear",
        cell=Cell.REAR,
    )
    assert re.fullmatch(told, rss_rule(trace).sentences[-1])


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
