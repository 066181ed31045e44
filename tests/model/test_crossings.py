"""Instructions at a zone, and the planned times and places of NPCs on their ways."""

import json
import math
import pickle

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from pytest_pafot.model.crossings import APART, LENGTH, STEP
from pytest_pafot.model.instructions import (
    Cell,
    CrossingInstruction,
    LaneInstruction,
    PositionInstruction,
    ScenarioError,
    instruction_of,
)
from pytest_pafot.model.scenario import Scenario, on_grid, retimed
from tests.helpers.crossings import junction
from tests.helpers.refusals import refused
from tests.helpers.tables import table

JUNCTION = junction()
EACH = 0.005
"""The duration of a step of the oracle [s]."""

crossings = st.builds(
    CrossingInstruction,
    st.sampled_from(sorted(JUNCTION.ways)),
    st.integers(-50, 50).map(lambda tenths: tenths / 10),
    st.integers(30, 120).map(lambda tenths: tenths / 10),
    st.sampled_from(["pass", "hold", "stop", "late"]),
)
cells = st.lists(st.integers(1, 8), min_size=1, max_size=4)
chains = st.lists(crossings.map(lambda one: [one]) | cells, min_size=1, max_size=6)


def mixed(npcs):
    """Return chains of instructions from chains of cells."""
    return [
        [each if isinstance(each, CrossingInstruction) else one(each) for each in chain]
        for chain in npcs
    ]


def one(cell=2, speed=20.0):
    return PositionInstruction(cell, speed)


def crosses(**changes):
    return CrossingInstruction(**({"zone": "o1>o3", "slot": 0.5, "speed": 8.6} | changes))


WRONG = {
    "no exit": ({"zone": "o1"}, "zone"),
    "two exits": ({"zone": "o1>o3>o2"}, "zone"),
    "a long name": ({"zone": "a" * 31 + ">b"}, "zone"),
    "a line": ({"zone": "o1>o3\n"}, "zone"),
    "an unknown act": ({"act": "wave"}, "act"),
    "a slot between tenths": ({"slot": 0.55}, "slot"),
    "a late slot": ({"slot": 5.1}, "slot"),
    "no slot": ({"slot": math.nan}, "slot"),
    "a text as a slot": ({"slot": "1"}, "slot"),
    "no speed": ({"speed": 0}, "speed"),
    "a speed between tenths": ({"speed": 8.65}, "speed"),
}


class TestInstructions:
    def test_crossing_instruction_accepts_plain_and_numpy_numbers(self):
        gene = CrossingInstruction("o1>o3", np.float64(0.5), np.int64(8))
        assert gene == CrossingInstruction("o1>o3", 0.5, 8.0, "pass")
        assert (type(gene.slot), type(gene.speed)) == (float, float)
        assert len({gene, crosses(speed=8)}) == 1

    @given(st.integers(-50, 50))
    def test_slots_are_tenths_however_they_were_computed_and_never_minus_zero(self, tenths):
        assert crosses(slot=tenths * 0.1).slot == crosses(slot=tenths / 10).slot == tenths / 10
        assert math.copysign(1, crosses(slot=-0.0).slot) == 1

    @table(("changes", "field"), WRONG.values())
    def test_what_is_wrong_is_refused_by_name(self, changes, field):
        with refused(field, ScenarioError):
            crosses(**changes)


KEEPS = LaneInstruction("keep", 1)
SEVERAL = {
    "two": [crosses(), crosses()],
    "then one on the grid": [crosses(), one()],
    "after one on the grid": [one(), crosses()],
    "after one in a lane": [KEEPS, crosses()],
    "then one in a lane": [crosses(), KEEPS],
}
"""Chains of instructions of which one is at a zone."""


class TestScenarios:
    @given(chains, st.integers(0, 2**40))
    def test_mixed_scenarios_survive_repair_text_and_pickle(self, npcs, seed):
        scenario = Scenario.repaired(mixed(npcs), seed=seed)
        assert Scenario.from_canonical(json.loads(scenario.canonical())) == scenario
        assert pickle.loads(pickle.dumps(scenario)) == scenario
        assert Scenario.repaired(scenario.npcs, seed=seed + 1).npcs == scenario.npcs

    @given(chains)
    def test_repair_leaves_crossing_npcs_alone(self, npcs):
        wanted = mixed(npcs)
        scenario = Scenario.repaired(wanted, seed=3)
        on_cells = [chain for chain in wanted if isinstance(chain[0], PositionInstruction)]
        if on_cells:
            assert scenario.positions == Scenario.repaired(on_cells, seed=3).npcs
        assert [len(chain) for chain in scenario.npcs] == [len(chain) for chain in wanted]
        told = [chain[0] if isinstance(chain[0], CrossingInstruction) else None for chain in wanted]
        assert list(scenario.crossings or [None] * len(wanted)) == told

    @given(chains, chains)
    def test_texts_are_equal_exactly_for_equal_scenarios(self, npcs, others):
        a, b = (Scenario.repaired(mixed(each)) for each in (npcs, others))
        assert (a.canonical() == b.canonical()) == (a == b)

    def test_the_text_tells_every_part(self):
        scenario = Scenario(npcs=[[crosses()], [one(2)]])
        assert scenario.canonical() == '[[[["o1>o3",8.6,0.5,"pass"]],[[2,20.0]]],0,1,22.0,10.0]'
        others = [crosses(zone="o1>o2"), crosses(slot=0.4), crosses(speed=8.5), crosses(act="hold")]
        assert len({Scenario(npcs=[[each], [one(2)]]).id for each in (crosses(), *others)}) == 5

    def test_only_those_on_the_grid_have_positions(self):
        scenario = Scenario(npcs=[[crosses()], [one(2), one(3)], [crosses(slot=-1)]])
        assert scenario.positions == ((one(2), one(3)),)
        assert scenario.crossings == (crosses(), None, crosses(slot=-1))
        assert Scenario(npcs=[[one()]]).crossings == ()
        assert on_grid(scenario.npcs, [[Cell(2), Cell(3)]]) == [(), [Cell(2), Cell(3)], ()]
        lanes = LaneInstruction("left", 8.0), LaneInstruction("keep", 5.0)
        scenario = Scenario(npcs=[lanes, [crosses()], [one(2)]])
        assert scenario.positions == ((one(2),),)
        assert scenario.crossings == (None, crosses(), None)

    @table("chain", SEVERAL.values())
    def test_crossing_npc_has_one_instruction_and_nothing_else(self, chain):
        with refused("npcs[0][1]", ScenarioError):
            Scenario(npcs=[chain])

    def test_an_instruction_at_a_zone_has_no_duration(self):
        assert retimed((crosses(),), 10.0, 3.0) == (crosses(),)
        assert Scenario(npcs=[[one()], [one(3), one(4)]], gene_seconds=4.0).seconds == 8.0
        assert Scenario(npcs=[[one()], [crosses()]], gene_seconds=4.0).seconds == math.inf

    def test_gene_kind_is_recognised_by_its_values(self):
        assert instruction_of(["o1>o3", 8.6, 0.5, "hold"]) == crosses(act="hold")
        assert instruction_of(["left", 8.6]) == LaneInstruction("left", 8.6)


def driven(way, instruction, start, seconds):
    """Return an NPC's place at each step of the oracle, if it drives at its speed, or as fast as bends allow."""
    # every `STEP` metres, and linear between these
    speeds = np.minimum(way.speeds, instruction.speed).tolist()
    last, places = len(speeds) - 1, [start]
    while len(places) * EACH < seconds:
        steps = min(max(places[-1] / STEP, 0.0), last)
        index = min(int(steps), last - 1)
        speed = speeds[index] + (steps - index) * (speeds[index + 1] - speeds[index])
        places.append(places[-1] + speed * EACH)
    return np.array(places)


def occupied(instruction, stretch, seconds=40.0):
    """Return the first and last time within a stretch [s], by driving along, or None if it starts off its way."""
    way, start = JUNCTION.ways[instruction.zone], JUNCTION.start(instruction)
    if not 0 <= start <= way.zone.npc[0]:
        return None
    places = driven(way, instruction, start, seconds)
    if instruction.act != "pass":  # it is unknown when it drives on from its line
        places = np.minimum(places, way.zone.npc[0])
    inside = np.flatnonzero((places >= stretch[0]) & (places <= stretch[1]))
    return (inside[0] * EACH, inside[-1] * EACH) if inside.size else (math.inf, -math.inf)


@given(crossings)
def test_start_is_before_the_way_with_spare_time(instruction):
    way, wanted = JUNCTION.ways[instruction.zone], JUNCTION.planned_entry(instruction)
    places = driven(way, instruction, 0.0, 60.0)
    needed = np.flatnonzero(places >= way.zone.npc[0])[0] * EACH
    assume(abs(needed - wanted) > 0.1 and instruction.act in {"pass", "stop"})
    assert (JUNCTION.start(instruction) < 0) == (needed < wanted)


@given(crossings.filter(lambda each: each.act in {"hold", "late"} and JUNCTION.fits(each)))
def test_waiting_npc_reaches_its_line_when_due(instruction):
    way, start = JUNCTION.ways[instruction.zone], JUNCTION.start(instruction)
    line = way.zone.npc[0] - 2.0
    places, time = start, 0.0
    while line - places > 0.5:
        room = line - places
        speed = min(
            instruction.speed,
            float(way.speeds[int(places / STEP)]),
            0.7 * room,
            math.sqrt(5.0 * room),
        )
        places, time = places + 0.01 * speed, time + 0.01
    wanted = JUNCTION.planned_entry(instruction) - (1.0 if instruction.act == "late" else 0.0)
    starts_at_once = JUNCTION.start(instruction) > line - instruction.speed**2 / 5.0 - 0.5
    assert time < wanted + 1.5 or starts_at_once
    assert time > wanted - 1.5


@given(crossings)
def test_passing_npc_occupies_each_stretch_while_driving_through(instruction):
    assume(instruction.act == "pass")
    way = JUNCTION.ways[instruction.zone]
    for stretch in (way.zone.npc, (way.zone.npc[0] - 3, way.zone.npc[0] + 2)):
        seen = occupied(instruction, stretch)
        assume(seen is not None and seen[0] > 0.1)
        assert JUNCTION.windows(instruction, stretch) == pytest.approx(seen, abs=0.15)


def test_npc_that_does_not_pass_occupies_its_place():
    for act in ("hold", "stop", "late"):
        assert JUNCTION.windows(crosses(act=act), (90.0, 98.0))[1] == math.inf
        first, last = JUNCTION.windows(crosses(act=act), (60.0, 70.0))
        assert last - first == pytest.approx(10 / 8.6)


passing = crossings.filter(lambda each: each.act == "pass" and JUNCTION.fits(each))


@given(passing, passing)
def test_npcs_clash_exactly_if_they_meet_in_time(a, b):
    pairs = [(names, (x, y)) for names, ((x, y),) in JUNCTION.meetings.items()]
    pairs += [(names[::-1], (y, x)) for names, (x, y) in pairs]
    pairs += [((name, name), (way.zone.npc, way.zone.npc)) for name, way in JUNCTION.ways.items()]
    stretches = dict(pairs).get((a.zone, b.zone))
    assert JUNCTION.clash(a, b) == JUNCTION.clash(b, a)
    if stretches is None:
        assert not JUNCTION.clash(a, b)
        return
    one, other = occupied(a, stretches[0]), occupied(b, stretches[1])
    apart = max(one[0] - other[1], other[0] - one[1])
    assume(abs(apart - APART) > 0.2)
    room = room_between(a, b, stretches[0][0]) if a.zone[:2] == b.zone[:2] else math.inf
    if apart < APART or room < LENGTH:
        assert JUNCTION.clash(a, b)
    elif room > LENGTH + (APART + 0.2) * 12:
        assert not JUNCTION.clash(a, b)


def room_between(a, b, until):
    """Return the least distance of two NPCs in the lane from which both come [m]; negative if one overtakes."""
    places = [driven(JUNCTION.ways[each.zone], each, JUNCTION.start(each), 40.0) for each in (a, b)]
    ahead = places[0] - places[1]
    ahead = ahead[np.minimum(*places) <= until]
    return float((ahead * (1 if ahead[0] > 0 else -1)).min())


def test_npcs_of_one_lane_stay_in_order():
    slow = crosses(slot=5.0, speed=4.0)
    assert JUNCTION.start(slow) > JUNCTION.start(crosses(zone="o1>o2", slot=0.5, speed=10.0))
    assert JUNCTION.clash(slow, crosses(zone="o1>o2", slot=0.5, speed=10.0))
    assert not JUNCTION.clash(slow, crosses(zone="o1>o2", slot=0.5, speed=4.0))
    assert not JUNCTION.clash(slow, crosses(zone="o3>o1", slot=0.5, speed=10.0))


@table(("changes", "fits"), [
    ({}, True),
    ({"zone": "o1>o4"}, False),
    # 12.5 s to the zone, which is 90 m from the way's beginning
    ({"slot": 5.0, "speed": 9.0}, False),
    ({"slot": 5.0, "speed": 7.0}, True),
    # it should enter its zone before the run begins
    ({"zone": "o3>o1", "slot": -5.0, "speed": 3.0}, False),
    # it enters its zone after 1 s, at the latest
    ({"zone": "o3>o1", "slot": -4.0, "speed": 8.0}, True),
    ({"zone": "o3>o1", "slot": -4.0, "speed": 8.0, "act": "stop"}, True),
    ({"zone": "o3>o1", "slot": -4.0, "speed": 8.0, "act": "hold"}, True),
    # 6.4 m are not enough to stop
    ({"zone": "o3>o1", "slot": -4.2, "speed": 8.0, "act": "hold"}, False),
    ({"act": "hold"}, True),
])  # fmt: skip
def test_npc_fits_if_it_can_start_and_act(changes, fits):
    assert JUNCTION.fits(crosses(**changes)) == fits


def test_standing_npc_clashes_with_all_later_ones():
    stands = crosses(slot=1.0, act="stop")
    assert JUNCTION.clash(stands, crosses(slot=5.0))
    assert not JUNCTION.clash(stands, crosses(slot=-1.5))


def test_zones_follow_the_order_of_the_ego_way():
    assert [zone.way for zone in JUNCTION.zones] == ["o3>o1", "o2>o1", "o1>o3", "o1>o2"]


@table(("along", "expected"), [(0.0, 0.0), (24.0, 2.0), (160.0, 160 / 12)])
def test_times_on_uniform_way_are_places_over_speed(along, expected):
    way = JUNCTION.ways["o1>o3"]
    assert way.time_at(along, 50.0) == pytest.approx(expected)
    assert way.place_at(expected, 50.0) == pytest.approx(along)
    assert way.length == 160.0
