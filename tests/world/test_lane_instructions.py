"""NPCs under Lane-Instructions: their own lane or the next one, at a speed, wherever the ego is."""

from __future__ import annotations

import numpy as np
import pytest

from pytest_pafot.model.instructions import LaneInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import LANE, SPEED, Outcome, X, Y
from pytest_pafot.world import Highway
from tests.helpers.world_cases import constant_speed


def chain(*genes):
    """Return a chain from texts such as "left@22.5"."""
    pairs = (gene.split("@") for gene in genes)
    return tuple(LaneInstruction(lane, float(speed)) for lane, speed in pairs)


def scenario(*chains, **fields):
    return Scenario(npcs=chains, **({"gene_seconds": 5.0} | fields))


def drive(given, ego=constant_speed, **world):
    return Highway(**({"duration": 20.0} | world)).rollout(given, ego)


def test_npcs_start_like_those_of_av_fuzzer():
    trace = drive(scenario(chain("keep@22"), chain("keep@22")))
    assert trace.npcs[0, :, LANE].tolist() == [0, 1]
    assert np.all(trace.npcs[0, :, X] - trace.ego[0, X] > 40)


@pytest.mark.parametrize("ego_lane", [0, 3])
def test_missing_lane_makes_npcs_start_in_nearest_cells(ego_lane):
    trace = drive(scenario(*[chain("keep@22")] * 5, ego_lane=ego_lane, ego_speed=20.0))
    places = {tuple(row) for row in trace.npcs[0, :, [X, Y]].T.tolist()}
    assert len(places) == 5
    assert np.all(trace.npcs[0, :, LANE] >= 0)


def test_keep_instruction_drives_its_speed_from_first_tick():
    trace = drive(scenario(chain("keep@10"), ego_speed=22.0))
    assert trace.npcs[75, 0, SPEED] == pytest.approx(10.0, abs=0.2)
    assert np.all(trace.npcs[:, 0, LANE] == 0)
    assert trace.arrivals == ((0,),)


@pytest.mark.parametrize(("lane", "end"), [("left", 0), ("right", 2)])
def test_left_and_right_mean_one_lane_from_npc(lane, end):
    trace = drive(scenario(chain("keep@26"), chain(f"{lane}@15"), ego_speed=15.0))
    (tick,) = trace.arrivals[1]
    assert 0 < tick <= 75
    assert trace.npcs[0, 1, LANE] == 1
    assert np.all(trace.npcs[tick:, 1, LANE] == end)
    assert trace.npcs[tick, 1, Y] == pytest.approx(4.0 * end, abs=0.5)


def test_each_gene_counts_lanes_anew():
    trace = drive(scenario(chain("right@26", "right@26", "right@26", "left@26"), ego_speed=10.0))
    assert trace.npcs[[0, 74, 149, 224, 299], 0, LANE].tolist() == [0, 1, 2, 3, 2]


def test_only_one_of_two_npcs_enters_a_gap():
    beside = chain("keep@20", "right@20"), chain("keep@26", "keep@26"), chain("keep@20", "left@20")
    trace = drive(scenario(*beside, ego_speed=15.0), duration=10.0)
    assert np.ptp(trace.npcs[75, [0, 2], X]) < 0.5, "they should be side by side"
    assert trace.outcome is Outcome.SAFE
    assert trace.npcs[-1, [0, 2], LANE].tolist() == [1, 2]


def test_npc_without_target_lane_stays_in_its_own():
    trace = drive(scenario(chain("left@20", "left@12")))
    assert np.all(trace.npcs[:, 0, LANE] == 0)
    assert trace.arrivals == ((0, 75),)
    assert trace.npcs[149, 0, SPEED] == pytest.approx(12.0, abs=0.2)


def test_npc_waits_until_the_one_beside_it_has_left_the_lane():
    """Side by side, both have the instruction to change to the right; the line on the right of lane 1 is at 6 m."""
    trace = drive(scenario(*[chain("keep@20", "right@20")] * 2, ego_speed=10.0, gene_seconds=3.0))
    moves = int(np.argmax(trace.npcs[:, 0, Y] > 1e-6))
    assert np.ptp(trace.npcs[moves, :, X]) < 0.5
    assert trace.npcs[moves - 1, 1, Y] - 1.0 > 6.0
    assert trace.npcs[-1, :, LANE].tolist() == [1, 2]


def test_npc_does_not_steer_into_another_npc():
    """NPC 0, to the left of NPC 1 and equally fast, has the instruction to move over; NPC 1 stays where it is."""
    trace = drive(scenario(chain("right@22", "keep@22"), chain("keep@22", "keep@22")), duration=10.0)
    assert trace.outcome is Outcome.SAFE
    assert trace.arrivals[0] == (None, 75)
    assert np.all(trace.npcs[:, 0, LANE] == 0)
