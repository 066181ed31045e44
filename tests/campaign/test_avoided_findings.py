"""What a finding says on drivers that take over is about what failed: a check, or the collision in the same run."""

import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.attribution.mistakes import Avoidance
from pytest_pafot.world import Highway

WORLD = Highway(duration=20.0)


def covers_ground(run):
    pafot.check(run.min_distance, name="distance", at_least=0.1)


def has_headway(run):
    assert run.headway.min() > 0.4


def is_not_hit(run):
    assert not run.collision


def first(holds):
    """Return the first finding of a search whose run also has a collision, and its run."""
    found = pafot.explore(
        constant_speed.make, holds=holds, world=WORLD, seed=5, runs=30, genes=2, shrink_rollouts=0, blame="ego"
    )
    return next(told for told in found.sightings if told.run.responsibility == "ego")


@pytest.mark.parametrize("holds", [covers_ground, has_headway])
def test_braking_is_only_told_of_collisions(holds):
    told = first(holds)
    assert told.run.collision is not None
    assert told.finding.expect.avoided_by is None


def test_collision_is_avoidable_until_last_successful_braking():
    told = first(is_not_hit)
    avoided, trace = told.finding.expect.avoided_by, told.run.trace
    runs = {tick: WORLD.take_over(trace, tick, "steady-braking") for tick in range(0, trace.ticks, 3)}
    free = [tick for tick, taken in runs.items() if taken.duration >= WORLD.duration - 1e-6]
    assert avoided == Avoidance(time=round(max(free) / trace.physics_hz, 3), braking=6.0)
