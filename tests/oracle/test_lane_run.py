"""A run says where the lanes of Lane-Instructions are relative to the ego."""

from dataclasses import replace

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import LaneInstruction, PositionInstruction, Run, Scenario
from pytest_pafot.model.trace import ACROSS
from pytest_pafot.oracle.run import LINE_LENGTH, arrival, lanes_apart
from tests.helpers.traces import trace_of, vehicle


def lane_text(trace, npc, gene):
    return trace.executed.npcs[npc][gene].words(lanes_apart(trace, npc, gene))


def in_lanes(text):
    """Return a chain from a text such as "left@22 keep@24.5"."""
    pairs = (gene.split("@") for gene in text.split())
    return tuple(LaneInstruction(lane, float(speed)) for lane, speed in pairs)


def run_of(*chains, ego=1, lanes=(0,), arrivals=(), **fields):
    """Return a run of 4 s whose genes last 2 s; ``lanes`` are the lanes of each NPC, one for each half of the run."""
    halves = [np.repeat(np.resize(each, 2) * 4.0, (30, 31)) for each in lanes]
    cars = [
        vehicle(np.full(61, 40.0 * (npc + 1)), half, speed=20.0) for npc, half in enumerate(halves)
    ]
    scenario = Scenario(npcs=chains, gene_seconds=2.0)
    return Run(
        trace_of(
            vehicle(0.0, ego * 4.0, speed=20.0),
            *cars,
            scenario=scenario,
            arrivals=arrivals,
            **fields,
        )
    )


def rows(run):
    """Return the table of genes without the lines around it."""
    lines = run.explain().splitlines()
    return lines[
        next(number for number, line in enumerate(lines) if line.startswith("  from [s]")) + 1 : -1
    ]


@pytest.mark.parametrize(
    ("lane", "npc", "words"),
    [
        ("right", 0, "from the left into the ego's lane"),
        ("left", 2, "from the right into the ego's lane"),
        ("left", 1, "out of the ego's lane to the left"),
        ("right", 1, "out of the ego's lane to the right"),
        ("keep", 1, "keep the ego's lane"),
        ("keep", 0, "keep the lane left of the ego"),
        ("keep", 3, "keep the 2nd lane right of the ego"),
        ("right", 2, "into the 2nd lane right of the ego"),
        ("left", 3, "into the lane right of the ego"),
    ],
)
def test_lane_is_named_relative_to_the_egos(lane, npc, words):
    run = run_of(in_lanes(f"{lane}@8"), lanes=((npc, npc),))
    assert lane_text(run.trace, 0, 0) == words


@pytest.mark.parametrize(
    ("run", "gene", "words"),
    [
        (
            run_of(in_lanes("keep@8"), ego=0, lanes=((4, 4),)),
            0,
            "keep the 4th lane right of the ego",
        ),
        # the ego is off the road
        (run_of(in_lanes("left@8"), ego=-1, lanes=((1, 1),)), 0, "one lane left"),
        # the run never reached this gene
        (run_of(in_lanes("keep@8 keep@8 keep@8 left@8")), 3, "one lane left"),
    ],
)
def test_lane_is_counted_from_the_egos_if_both_are_known(run, gene, words):
    assert lane_text(run.trace, 0, gene) == words


def test_lane_that_does_not_exist_is_kept():
    asked = run_of(in_lanes("left@8")).trace
    trace = replace(asked, executed=Scenario(npcs=[in_lanes("keep@8")], gene_seconds=2.0))
    assert lane_text(trace, 0, 0) == "keep the lane left of the ego"


@pytest.mark.parametrize(("speed", "end"), [
    ("19.6", "reached at 1.9 s"),
    ("10.0", "in place from 1.9 s, slowest 20.0 m/s"),
    ("26.8", "in place from 1.9 s, fastest 20.0 m/s"),
])  # fmt: skip
def test_cut_in_reads_in_two_short_lines_that_say_if_its_speed_was_not_reached(speed, end):
    run = run_of(in_lanes(f"right@{speed} keep@0"), lanes=((0, 1),), arrivals=((28, 30),))
    assert rows(run) == [
        f"       0.0  from the left into the ego's lane {speed} m/s {end}",
        "       2.0  keep the ego's lane 0.0 m/s",
    ]


def test_lane_change_may_end_in_the_next_gene():
    run = run_of(in_lanes("right@20 keep@0"), lanes=((0, 1),), arrivals=((None, 36),))
    assert rows(run)[0].endswith("reached at 2.4 s")


def test_lane_change_that_was_given_up_has_not_arrived():
    """The next gene keeps the old lane, so an arrival in it is not one in the new lane."""
    run = run_of(in_lanes("right@10 keep@0"), lanes=((0, 0),), arrivals=((None, 36),))
    assert arrival(run.trace, 0, 0) is None
    assert rows(run)[0].endswith("not reached")


def test_next_change_does_not_end_the_one_before():
    run = run_of(in_lanes("right@10 right@10"), lanes=((0, 1),), arrivals=((None, 50),))
    assert [arrival(run.trace, 0, gene) for gene in (0, 1)] == [None, 50]


def test_npcs_that_go_on_as_before_need_no_row():
    run = run_of(in_lanes("keep@10 keep@10"), in_lanes("keep@5"), lanes=((0, 0), (1, 1)))
    assert len(rows(run)) == 2  # NPC 1 has no instruction in the second gene
    run = run_of(in_lanes("keep@10 keep@10"), in_lanes("keep@5 keep@5"), lanes=((0, 0), (1, 1)))
    assert rows(run) == [
        "       0.0 to 4.0  keep the lane left of the ego 10.0 m/s  keep the ego's lane 5.0 m/s"
    ]


def test_equal_changes_in_a_row_are_all_told():
    run = run_of(*[in_lanes("left@8 left@8")] * 3, lanes=((2, 2), (3, 3), (3, 3)))
    assert [row.split() for row in rows(run)] == [
        ["0.0", *["left", "8.0"] * 3],
        ["2.0", *["left", "8.0"] * 3],
    ]


def test_both_kinds_share_a_table():
    on_grid = (PositionInstruction(2, 20.0), PositionInstruction(1, 26.8))
    run = run_of(
        on_grid,
        in_lanes("left@26.8 keep@8"),
        lanes=((1, 1), (2, 1)),
        arrivals=((20, None), (None, 40)),
    )
    assert rows(run) == [
        "       0.0  2 front 20.0 m/s reached 1.3 s     into the ego's lane 26.8 m/s in place 2.7 s",
        "       2.0  1 front-left 26.8 m/s not reached  keep the ego's lane 8.0 m/s",
    ]


def test_header_fits_above_two_wide_columns():
    chains = [in_lanes("left@26.8 keep@20 " + "keep@20.5 keep@21 " * 3)] * 2
    scenario = Scenario(npcs=chains, gene_seconds=0.5)
    cars = (vehicle(40.0 * npc, 8.0, speed=20.0, ticks=60) for npc in (1, 2))
    lines = (
        Run(trace_of(vehicle(0.0, 4.0, speed=20.0, ticks=60), *cars, scenario=scenario))
        .explain()
        .splitlines()
    )
    assert max(map(len, lines)) <= LINE_LENGTH
    assert any(line.endswith("(3 earlier)") for line in lines)


def test_lanes_of_a_bend_are_counted_across_it():
    scenario = Scenario(npcs=[in_lanes("right@8 keep@8 left@8")], ego_speed=8.0, gene_seconds=4.0)
    trace = pafot.World("racetrack-v0", planner_hz=5).rollout(
        scenario, lambda: lambda seen: (-0.2, 0.0)
    )
    # the ego keeps 0, lanes are 5 m wide
    npc_across = trace.track[:: 4 * trace.physics_hz, 1, ACROSS]
    assert npc_across[:3] == pytest.approx([-5.0, 0.0, 0.0], abs=0.5)
    words = [lane_text(trace, 0, gene) for gene in range(3)]
    assert words == [
        "from the left into the ego's lane",
        "keep the ego's lane",
        "out of the ego's lane to the left",
    ]


def test_two_columns_drop_words_until_they_fit():
    """The arrival in the ego's lane comes before the side, and a table of more lanes has only the targets."""
    cut_ins = [in_lanes("right@10"), in_lanes("left@10")]
    run = run_of(*cut_ins, lanes=((0, 0), (2, 2)), arrivals=((28,), (None,)))
    expected = "       0.0  into the ego's lane 10.0 m/s in place 1.9 s  into the ego's lane 10.0 m/s not reached"
    assert rows(run) == [expected]
    far = [in_lanes("right@10"), in_lanes("right@10")]
    run = run_of(*far, ego=0, lanes=((1, 1), (2, 2)))
    assert rows(run) == ["       0.0  right 10.0  right 10.0"]
