"""The record of a collision."""

import random

from pytest_pafot.model.trace import HEADING, X, Y
from pytest_pafot.world import Highway
from pytest_pafot.world.kernel.bodies import Box, overlap, side_hit
from tests.helpers.world_cases import random_scenario


def weaving():
    return lambda observation: (0.0, 0.04 if int(observation.time / 3) % 2 else -0.04)


def test_side_hit_is_that_of_last_tick_apart():
    rng, differ = random.Random(5), 0
    for _ in range(160):
        trace = Highway(duration=30.0).rollout(random_scenario(rng, lanes=4, speed_limit=26.8), weaving)
        if (hit := trace.collision) is None:
            continue
        (ego, npc), overlapping = (
            [
                Box(*trace.states[tick, vehicle, [X, Y, HEADING]].tolist(), *trace.sizes[vehicle].tolist())
                for vehicle in (0, hit.npc + 1)
            ]
            for tick in (hit.tick - 1, hit.tick)
        )
        assert not overlap(ego, npc)
        assert hit.side == side_hit(ego, npc)
        differ += side_hit(*overlapping) != hit.side
    assert differ, "the tick of the contact would tell the same"
