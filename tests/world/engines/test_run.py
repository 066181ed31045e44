"""The record of a run, and of a collision."""

import random

import pytest

from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import HEADING, X, Y
from pytest_pafot.world import Highway
from pytest_pafot.world.engines.run import VehiclesOfRun
from pytest_pafot.world.kernel.bodies import Body, Box, overlap, side_hit
from tests.helpers.world_cases import random_scenario


def weaving():
    return lambda observation: (0.0, 0.04 if int(observation.time / 3) % 2 else -0.04)


def test_side_hit_is_that_of_last_tick_apart():
    rng, differ = random.Random(5), 0
    for _ in range(160):
        trace = Highway(duration=30.0).rollout(random_scenario(rng, lanes=4, speed_limit=26.8), weaving)
        if (hit := trace.collision) is None:
            continue
        both = [0, hit.npc + 1]
        (ego, npc), overlapping = (
            [Box(*pose, *size) for pose, size in zip(poses.tolist(), trace.sizes[both].tolist(), strict=True)]
            for poses in trace.states[hit.tick - 1 : hit.tick + 1, both][..., [X, Y, HEADING]]
        )
        assert not overlap(ego, npc)
        assert hit.side == side_hit(ego, npc)
        differ += side_hit(*overlapping) != hit.side
    assert differ, "the tick of the contact would tell the same"


def test_record_has_no_room_for_ticks_beyond_the_run():
    """The kernel writes without looking at each index, so one look must keep it within its buffer."""
    world, scenario = Highway(), Scenario.repaired([[PositionInstruction(2, 20.0)]], seed=1, ego_lane=1, ego_speed=20.0)
    run = VehiclesOfRun(world.rules, scenario, Body(5.0, 2.0), lambda: world.stock_road)
    for _ in range(world.rules.ticks(scenario)):
        run.loop.moved()
    with pytest.raises(IndexError, match="expected room for tick"):
        run.loop.moved()
