"""What a careful driver would have done: which takeover is the latest that avoids a collision; by hand and driven."""

import math
from dataclasses import replace

import numpy as np
import pytest

from pytest_pafot import Cell, Highway, PositionInstruction, Run, Scenario
from pytest_pafot.attribution.responsibility import attribute_collision, decide_contested
from pytest_pafot.attribution.takeovers import drive, latest
from pytest_pafot.model.trace import SPEED, Outcome
from pytest_pafot.support.errors import DriverError
from pytest_pafot.world.reference_drivers import HARD_BRAKING, CarefulHuman
from tests.helpers.situations import SITUATIONS
from tests.helpers.tables import table
from tests.helpers.traces import LENGTH, collision_at, trace_of, vehicle

IMPACT, AFTER = 60, 60
"""The tick of the impact, 4 s after the start, and the ticks for which the driver must touch nobody afterwards."""


def crash(ticks=IMPACT):
    """Return a run with the ego at 20 m/s behind an NPC at 10 m/s, which it hits at the last of the ticks."""
    ego = vehicle(0.0, 4.0, speed=20.0, ticks=ticks)
    npc = vehicle(ticks / 15 * 10.0 + LENGTH, 4.0, speed=10.0, ticks=ticks)
    return trace_of(ego, npc, outcome=Outcome.COLLISION)


def taken(trace, ticks=IMPACT + AFTER + 2, hit=None, outcome=Outcome.COMPLETED, **at):
    """Return a run that begins like another one and lasts for some ticks, to a contact if there is one."""
    more = np.repeat(trace.states[-1:], max(ticks - trace.ticks, 0), axis=0)
    states, collision = np.concatenate([trace.states, more]), None
    if hit is not None:
        ticks, outcome, collision = hit, Outcome.COLLISION, collision_at(hit, **at)
    return replace(trace, states=states[: ticks + 1], outcome=outcome, collision=collision)


class Drives:
    """A function that lets the careful driver take over: what becomes of each takeover, and what was asked."""

    def __init__(self, of, longer=True):
        self.of, self.longer, self.ticks, self.seconds = of, longer, [], []

    def __call__(self, trace, tick):
        self.ticks.append(tick)
        return self.of(trace, tick)

    def lasting(self, seconds):
        self.seconds.append(seconds)
        return self if self.longer else None


def scanned(*avoiding, trace=None):
    """Return the latest takeover if those with these numbers avoid the collision, and the ticks that were tried."""
    trace = trace or crash()
    ticks = {trace.ticks - round(number * 3.75) for number in avoiding}
    drives = Drives(lambda given, tick: taken(given) if tick in ticks else given)
    return latest(trace, drives), drives.ticks


@table(("avoiding", "number", "tried"), [
    ((1, 2, 3), 0.25, 3),
    ((3, 4, 5, 6), 0.75, 5),
    ((1, 3, 4, 6, 7, 8), 1.5, 8),
    ((10, 11, 12), 2.5, 12),
    ((11, 12), 0.0, 12),
    ((1, 2, 4, 5, 7, 8, 10, 11), 0.0, 12),
    ((), 0.0, 12),
])  # fmt: skip
def test_latest_takeover_counts_that_two_earlier_ones_confirm(avoiding, number, tried):
    found, ticks = scanned(*avoiding)
    assert found == number
    assert ticks == [IMPACT - round(each * 3.75) for each in range(1, tried + 1)]


def test_what_is_before_the_run_confirms_but_is_no_takeover():
    assert scanned(2, trace=crash(ticks=8)) == (0.5, [4, 0])
    assert scanned(trace=crash(ticks=8)) == (0.0, [4, 0])


@table(("of", "number"), [
    (lambda trace, tick: taken(trace, hit=IMPACT + AFTER), 0.0),
    (lambda trace, tick: taken(trace, hit=IMPACT + AFTER + 1), 0.25),
    # the same vehicle
    (lambda trace, tick: taken(trace, hit=IMPACT + 9, cell=Cell.REAR, side="rear"), 0.0),
    (lambda trace, tick: taken(trace, hit=IMPACT + 9, npc=1, cell=Cell.REAR, side="rear"), 0.25),
    (lambda trace, tick: taken(trace, hit=IMPACT + 9, npc=1), 0.0),
    (lambda trace, tick: taken(trace, hit=IMPACT - 1, npc=1, cell=Cell.REAR, side="rear"), None),
    (lambda trace, tick: taken(trace, ticks=IMPACT, outcome=Outcome.END_OF_ROAD), 0.25),
    (lambda trace, tick: taken(trace, ticks=IMPACT - 1, outcome=Outcome.END_OF_ROAD), None),
    (lambda trace, tick: taken(trace, ticks=IMPACT + 9, outcome=Outcome.INVALID), None),
    (lambda trace, tick: taken(trace, ticks=IMPACT + AFTER, outcome=Outcome.INVALID), 0.25),
    # another run
    (lambda trace, tick: replace(taken(trace), states=taken(trace).states + 0.1), None),
    (lambda trace, tick: taken(trace, ticks=9), None),
])  # fmt: skip
def test_takeover_avoids_if_nothing_counts_that_the_driver_touches(of, number):
    assert latest(crash(), Drives(of)) == number


@table(("number", "clear"), [(0.5, range(2, 5)), (None, ())])
def test_an_unknown_end_leaves_a_later_number_and_forbids_to_say_that_none_avoids(number, clear):
    cut = taken(crash(), ticks=IMPACT - 1)
    ticks = [IMPACT - round(each * 3.75) for each in clear]
    drives = Drives(lambda trace, tick: taken(trace) if tick in ticks else cut)
    assert latest(crash(), drives) == number


@table("more", [
    {"outcome": Outcome.COMPLETED, "collision": None}, {"collision": collision_at(60, npc=None)},
])  # fmt: skip
def test_without_a_collision_with_a_vehicle_nothing_is_driven(more):
    assert latest(replace(crash(), **more), Drives(lambda *_: pytest.fail("driven"))) is None


def test_drive_goes_on_for_four_seconds():
    drives = Drives(lambda trace, tick: taken(trace, ticks=IMPACT))
    assert drive(crash(), 1.0, drives).ticks == IMPACT
    assert drives.seconds == [pytest.approx(8.0, abs=0.2)]
    assert drives.ticks == [45]


def constantly_driven(cell, speed, ego_speed):
    """Return the run of an ego that keeps its speed, with a vehicle that does so too after a while."""
    world, npcs = Highway(clearance=40.0), [[PositionInstruction(cell, speed)]]
    scenario = Scenario(npcs=npcs, ego_speed=ego_speed, gene_seconds=30.0)
    return world.run_of(world.rollout(scenario, lambda: lambda observation: (0.0, 0.0)))


@pytest.mark.parametrize("closing", [2.0, 3.0, 6.0])
def test_latest_takeover_on_a_highway_is_that_of_the_braking_distance(closing):
    """The driver has watched the danger for longer than it takes to brake fully, so it does so at once.

    At the speed before, the distance to the leader lasts for half of the time of the braking.
    """
    run = constantly_driven(Cell.FRONT, 24.0 - closing, 24.0)
    assert run.trace.npcs[-30:, 0, SPEED] == pytest.approx(24.0 - closing, abs=0.02)
    found = latest(run.trace, run.take_over)
    assert found == math.ceil(closing / (2 * HARD_BRAKING) / 0.25) * 0.25
    hits = [drive(run.trace, found - later, run.take_over).collision for later in (0.0, 0.25)]
    assert hits[0] is None
    assert hits[1] is not None


def test_who_keeps_the_lane_avoids_nobody_who_comes_from_behind():
    run = constantly_driven(Cell.REAR, 26.0, 18.0)
    assert run.collision.side == "rear"
    assert latest(run.trace, run.take_over) == 0.0


def test_careful_human_keeps_braking_for_a_motorcycle_that_is_over_the_line_and_not_yet_in_its_way():
    """Its centre is nearer than half a lane, and its box is narrow."""
    chain = [*map(PositionInstruction, (2, 1, 1, 1, 2), (0.0, 18.0, 18.0, 18.0, 0.0))]
    scenario = Scenario(npcs=[chain], gene_seconds=4.0, vehicles=("motorcycle",))
    assert Highway(ads_hz=15).rollout(scenario, CarefulHuman).outcome is Outcome.COMPLETED


TRACES = {each.name: each.trace for group in SITUATIONS.values() for each in group}


@pytest.mark.parametrize(("seconds", "responsible"), [(1.25, "both"), (0.0, "npc"), (None, "npc")])
def test_an_excuse_does_not_hold_if_a_careful_driver_avoids_the_collision(seconds, responsible):
    found = decide_contested(attribute_collision(TRACES["leader-stops-dead"]()), seconds)
    assert (found.responsibility, found.takeover) == (responsible, seconds)
    faults = ("leader-unanswered", "kept-no-distance") if seconds else (None, None)
    assert (found.fault, found.mistake) == faults


@pytest.mark.parametrize(("seconds", "responsible"), [(0.25, "both"), (0.0, "npc"), (None, "both")])
def test_an_ego_shares_the_responsibility_with_an_npc_that_moved_in_only_if_there_was_time(
    seconds, responsible
):
    trace = TRACES["cut-in-3-m-and-brakes"]()
    found = decide_contested(attribute_collision(trace), seconds)
    assert (found.responsibility, found.fault is None) == (responsible, responsible == "npc")


@pytest.mark.parametrize("name", ["slow-leader-ignored", "hit-from-behind"])
def test_no_careful_driver_is_asked_where_nothing_is_excused(name):
    run = Run(TRACES[name](), take_over=lambda trace, tick: pytest.fail("was asked"))
    assert run.attribution == attribute_collision(run.trace)


def test_an_excuse_holds_where_the_driver_cannot_be_simulated():
    def fails(trace, tick):
        raise DriverError("no such driver")

    fails.lasting = lambda seconds: fails
    run = Run(TRACES["leader-stops-dead"](), take_over=fails)
    assert run.responsibility == "npc"
    assert not any("careful" in each for each in run.sentences)
    with pytest.raises(DriverError):
        run.takeover  # noqa: B018
