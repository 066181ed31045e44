import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import criticality
from pytest_pafot.findings.shrink import instructions
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import SPEED, AdsError, Outcome
from pytest_pafot.oracle.run import Run
from tests.helpers.hostile import CHARACTERS
from tests.helpers.reference_runs import closing
from tests.helpers.stages import mostly_oracle
from tests.helpers.traces import collision_at, random_states, scenario_of, trace_of, vehicle


def crash(**fields):
    return Run(closing(outcome=Outcome.COLLISION, **fields))


def test_a_run_shows_what_its_trace_records():
    run = crash()
    assert run.collision.side == "front"
    assert run.outcome == Outcome.COLLISION
    assert run.duration == 2.0
    assert run.scenario == run.trace.executed
    assert not run.off_road
    assert run.ads_error is None
    assert run.responsibility == "ego"
    safe = Run(closing(max_decision_seconds=0.3))
    assert (safe.collision, safe.responsibility, safe.max_decision_time) == (None, None, 0.3)


def test_position_rule_is_named_only_when_it_disagrees():
    run = Run(replace(crash().trace, collision=collision_at(30, cell=Cell.LEFT, side="left")))
    assert (run.responsibility, run.second_opinion) == ("ego", "npc")
    assert run.explain().endswith(", position rule: npc")
    assert crash().second_opinion == "ego"
    assert "position" not in crash().explain()
    assert Run(closing()).second_opinion is None


def test_its_measures_are_those_of_the_criticality_functions():
    rng = np.random.default_rng(7)
    states = random_states(rng, 40, 3)
    run = Run(trace_of(states[:, 0], states[:, 1], states[:, 2]))
    assert run.mettc == criticality.mettc(run.trace)
    assert run.min_ttc == criticality.min_ttc(run.trace)
    assert run.min_distance == criticality.min_gap(run.trace)
    assert run.min_centre_distance == criticality.min_centre_distance(run.trace)
    assert run.hardest_brake == criticality.hardest_brake(run.trace)


def test_worst_time_to_contact_has_npc_and_cell():
    worst = Run(closing(ticks=15)).worst_ttc
    assert (worst.npc, worst.time, worst.cell) == (0, 1.0, Cell.FRONT)


def test_cells_are_relative_to_the_road_not_ego():
    ego = vehicle(0.0, 4.0, heading=0.5, speed=0.0, ticks=5)
    run = Run(trace_of(ego, vehicle(-30.0, 4.0, speed=10.0, ticks=5), scenario=scenario_of(1)))
    assert run.worst_ttc.cell == Cell.REAR


def test_npc_in_ego_cell_has_its_previous_cell():
    npc = vehicle(np.array([8.0, 5.0, 2.4, 2.3]), 5.0, lane=1.0)
    run = Run(trace_of(vehicle(np.zeros(4), 4.0), npc))
    assert run.closest_approach.cell == Cell.FRONT


def test_run_without_approach_has_no_worst_moment():
    run = Run(
        trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=9), vehicle(50.0, 4.0, speed=20.0, ticks=9))
    )
    assert run.worst_ttc is None
    assert run.event_cell is None
    assert run.event_time == run.closest_time


def test_event_is_collision_then_fault_then_worst_moment():
    error = AdsError(kind="ValueError", message="no path", traceback="", tick=6)
    assert crash().event_time == 2.0
    assert Run(closing(outcome=Outcome.ADS_ERROR, error=error)).event_time == pytest.approx(0.4)
    assert Run(closing(outcome=Outcome.OFF_ROAD, off_road_tick=3)).event_time == pytest.approx(0.2)
    assert Run(closing(ticks=15)).event_time == 1.0


def test_its_repr_fits_the_header_of_a_traceback():
    assert len(repr(crash())) < 80
    assert repr(crash()).startswith("<Run collision after 2.0 s, scenario ")


def test_explanation_covers_event_fault_and_npc_instructions():
    text = crash(arrivals=((12,), (None,))).explain()
    assert text.splitlines() == [
        "The ego hit NPC 0 from behind after 2.0 s, closing at 10.0 m/s (ego",
        "  20.0 m/s, NPC 10.0 m/s)",
        "  At 0.0 s, NPC 0 was 21.0 m ahead of the ego. It drove at 10.0 m/s.",
        "  The ego drove at 20.0 m/s and did not brake.",
        "  The ego is responsible.",
        "  hardest braking by the ego: 0.0 m/s^2",
        "  from [s]  NPC 0                                 NPC 1",
        "       0.0  1 front-left 20.0 m/s in place 0.8 s  2 front 20.0 m/s not reached",
        f"  scenario {crash().scenario.id}, scenario seed 0",
    ]


@pytest.mark.parametrize(("speed", "is_told"), [(-3.2, True), (-0.3, False)])
@pytest.mark.parametrize("outcome", [Outcome.COLLISION, Outcome.COMPLETED])
def test_an_ego_that_drives_backwards_is_told(speed, is_told, outcome):
    ego = vehicle(0.0, 4.0, speed=20.0, ticks=45)
    ego[30:, SPEED] = speed
    text = Run(trace_of(ego, vehicle(50.0, 4.0, speed=20.0, ticks=45), outcome=outcome)).explain()
    assert ("  the ego drove backwards, at 3.2 m/s after 2.0 s" in text.splitlines()) is is_told


def test_an_explanation_names_the_error_of_the_ads():
    error = AdsError(
        kind="ZeroDivisionError", message="division by zero\nnaïve", traceback="", tick=15
    )
    headline = Run(closing(outcome=Outcome.ADS_ERROR, error=error)).explain().splitlines()[0]
    assert headline == "ADS error after 1.0 s: ZeroDivisionError: division by zero na\\xefve"


def test_explanation_of_a_safe_run_names_worst_moment():
    lines = Run(closing(ticks=15)).explain().splitlines()
    assert lines[0] == "no collision in 1.0 s"
    assert lines[1] == "  smallest time to contact: 1.10 s, NPC 0 in cell 2 (front) at 1.0 s"


@pytest.mark.parametrize(
    "outcome", mostly_oracle(Outcome, Outcome.COMPLETED, Outcome.COLLISION, Outcome.ADS_ERROR)
)
@given(
    npcs=st.integers(1, 8),
    genes=st.integers(1, 30),
    message=st.text(CHARACTERS, max_size=200),
    seed=st.integers(0, 99),
)
def test_every_explanation_is_short_plain_ascii(outcome, npcs, genes, message, seed):
    rng = np.random.default_rng(seed)
    states = random_states(rng, 31, npcs + 1)
    error = (
        AdsError(kind="E", message=message, traceback="", tick=3)
        if outcome in ("ads_error", "hang")
        else None
    )
    scenario = scenario_of(npcs, genes=genes, gene_seconds=0.1)
    collision = (
        collision_at(30, npc=npcs - 1, cell=Cell.REAR_RIGHT, ego_speed=0.0)
        if outcome == "collision"
        else None
    )
    trace = trace_of(
        *states.swapaxes(0, 1), scenario=scenario, outcome=outcome, error=error, collision=collision
    )
    trace = replace(trace, off_road_tick=4 if outcome == "off_road" else None)
    lines = Run(trace).explain().split("\n")
    assert len(lines) < 20
    assert all(len(line) < 100 and line.isascii() and line.isprintable() for line in lines)


def test_explanation_of_many_genes_lists_the_last_ones():
    trace = trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=150),
        vehicle(50.0, 4.0, speed=20.0, ticks=150),
        scenario=Scenario(
            npcs=[[PositionInstruction(1, float(gene)) for gene in range(20)]], gene_seconds=1.0
        ),
    )
    lines = Run(trace).explain().splitlines()
    assert "(5 earlier)" in lines[2]
    assert lines[3].split()[0] == "5.0"
    assert lines[-2].split()[0] == "9.0"


def test_equal_instructions_in_a_row_are_one_row_and_one_instruction():
    chains = [
        [PositionInstruction(1, 20.0)] * 9,
        [PositionInstruction(2, 20.0)] * 4 + [PositionInstruction(2, 9.0)] * 5,
    ]
    for npcs, expected in ((chains[:1], ["0.0 to 18.0"]), (chains, ["0.0 to 8.0", "8.0 to 18.0"])):
        scenario = Scenario(npcs=npcs, gene_seconds=2.0)
        vehicles = [
            vehicle(50.0 * number, 4.0, speed=20.0, ticks=270) for number in range(len(npcs) + 1)
        ]
        trace = trace_of(
            *vehicles, scenario=scenario, arrivals=((None, None, 75, *[80] * 6),) * len(npcs)
        )
        lines = Run(trace).explain().splitlines()
        table = lines[
            next(n for n, line in enumerate(lines) if line.startswith("  from [s]")) + 1 : -1
        ]
        assert [re.split(r"  +", line.strip())[0] for line in table] == expected
        assert "1 front-left 20.0 m/s reached at 5.0 s" in table[0] or len(npcs) == 2
    assert instructions(Scenario(npcs=chains[:1], gene_seconds=2.0)) == 1
