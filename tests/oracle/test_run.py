import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Cell, PositionInstruction, Run, Scenario, criticality
from pytest_pafot.findings.shrink import instructions
from pytest_pafot.model.trace import SPEED, AdsError, Outcome
from tests.helpers.hostile import CHARACTERS
from tests.helpers.reference_runs import closing
from tests.helpers.stages import mostly_oracle
from tests.helpers.tables import table
from tests.helpers.traces import collision_at, random_states, scenario_of, trace_of, vehicle
from tests.oracle.test_lane_run import rows


def crash(**fields):
    return Run(closing(outcome=Outcome.COLLISION, **fields))


def test_a_run_shows_what_its_trace_records():
    run = crash()
    assert (run.collision.side, run.outcome, run.duration) == ("front", Outcome.COLLISION, 2.0)
    assert run.scenario == run.trace.executed
    assert (run.off_road, run.ads_error, run.responsibility) == (False, None, "ego")
    safe = Run(closing(max_decision_seconds=0.3))
    assert (safe.collision, safe.responsibility, safe.max_decision_time) == (None, None, 0.3)


def test_position_rule_is_named_only_when_it_disagrees():
    run = Run(replace(crash().trace, collision=collision_at(30, cell=Cell.LEFT, side="left")))
    assert (run.responsibility, run.second_opinion) == ("ego", "npc")
    assert "position" in run.explain()
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
    ego, npc = (vehicle(x, 4.0, speed=20.0, ticks=9) for x in (0.0, 50.0))
    run = Run(trace_of(ego, npc))
    assert (run.worst_ttc, run.event_cell) == (None, None)
    assert run.event_time == run.closest_time


def test_event_is_collision_then_fault_then_worst_moment():
    error = AdsError(kind="ValueError", message="no path", traceback="", tick=6)
    assert crash().event_time == 2.0
    assert Run(closing(outcome=Outcome.ADS_ERROR, error=error)).event_time == pytest.approx(0.4)
    assert Run(closing(outcome=Outcome.OFF_ROAD, off_road_tick=3)).event_time == pytest.approx(0.2)
    assert Run(closing(ticks=15)).event_time == 1.0


def test_its_repr_fits_the_header_of_a_traceback():
    assert len(repr(crash())) < 80


def backwards(speed, outcome=Outcome.COLLISION):
    """Return a run whose ego has this speed from 2 s on."""
    ego = vehicle(0.0, 4.0, speed=20.0, ticks=45)
    ego[30:, SPEED] = speed
    return Run(trace_of(ego, vehicle(50.0, 4.0, speed=20.0, ticks=45), outcome=outcome))


@pytest.mark.parametrize(("speed", "is_told"), [(-3.2, True), (-0.3, False)])
@pytest.mark.parametrize("outcome", [Outcome.COLLISION, Outcome.COMPLETED])
def test_an_ego_that_drives_backwards_is_told(speed, is_told, outcome):
    text = backwards(speed, outcome).explain()
    assert ("backwards, at 3.2 m/s" in text) is is_told


def failed():
    message = "division by zero\nna\u00efve"
    error = AdsError(kind="ZeroDivisionError", message=message, traceback="", tick=15)
    return Run(closing(outcome=Outcome.ADS_ERROR, error=error))


def test_an_explanation_names_the_error_of_the_ads():
    assert "ZeroDivisionError: division by zero na\\xefve" in failed().explain().splitlines()[0]


CALM = (Outcome.COMPLETED, Outcome.COLLISION, Outcome.ADS_ERROR)


@pytest.mark.parametrize("outcome", mostly_oracle(Outcome, *CALM))
@given(
    npcs=st.integers(1, 8), genes=st.integers(1, 30), message=st.text(CHARACTERS, max_size=200), seed=st.integers(0, 99)
)  # fmt: skip
def test_every_explanation_is_short_plain_ascii(outcome, npcs, genes, message, seed):
    states = random_states(np.random.default_rng(seed), 31, npcs + 1)
    scenario, fields = scenario_of(npcs, genes=genes, gene_seconds=0.1), {}
    if outcome in ("ads_error", "hang"):
        fields["error"] = AdsError(kind="E", message=message, traceback="", tick=3)
    if outcome == "collision":
        hit = collision_at(30, npc=npcs - 1, cell=Cell.REAR_RIGHT, ego_speed=0.0)
        fields["collision"] = hit
    if outcome == "off_road":
        fields["off_road_tick"] = 4
    trace = trace_of(*states.swapaxes(0, 1), scenario=scenario, outcome=outcome, **fields)
    lines = Run(trace).explain().split("\n")
    assert len(lines) < 20
    assert all(len(line) < 100 and line.isascii() and line.isprintable() for line in lines)


def test_explanation_of_many_genes_lists_the_last_ones():
    ego, npc = (vehicle(x, 4.0, speed=20.0, ticks=150) for x in (0.0, 50.0))
    chain = [PositionInstruction(1, float(gene)) for gene in range(20)]
    scenario = Scenario(npcs=[chain], gene_seconds=1.0)
    lines = Run(trace_of(ego, npc, scenario=scenario)).explain().splitlines()
    assert "(5 earlier)" in lines[2]
    assert lines[3].split()[0] == "5.0"
    assert lines[-2].split()[0] == "9.0"


HELD = [PositionInstruction(1, 20.0)] * 9
BRAKING = [PositionInstruction(2, 20.0)] * 4 + [PositionInstruction(2, 9.0)] * 5


def of_chains(*npcs):
    """Return a run of these chains, in which all NPCs arrive after 5 s."""
    scenario = Scenario(npcs=npcs, gene_seconds=2.0)
    cars = [vehicle(50.0 * number, 4.0, speed=20.0, ticks=270) for number in range(len(npcs) + 1)]
    arrivals = ((None, None, 75, *[80] * 6),) * len(npcs)
    return Run(trace_of(*cars, scenario=scenario, arrivals=arrivals))


@table(("chains", "expected"), [
    ((HELD,), ["0.0 to 18.0"]), ((HELD, BRAKING), ["0.0 to 8.0", "8.0 to 18.0"]),
])  # fmt: skip
def test_equal_instructions_in_a_row_are_one_row_and_one_instruction(chains, expected):
    times = [re.split(r"  +", row.strip())[0] for row in rows(of_chains(*chains))]
    assert times == expected
    assert instructions(Scenario(npcs=[HELD], gene_seconds=2.0)) == 1
