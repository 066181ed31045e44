"""What a finding says on drivers that take over is about what failed: a check, or the collision in the same run."""

import numpy as np
import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.attribution.takeovers import Avoidance
from pytest_pafot.model.trace import SPEED
from pytest_pafot.oracle.run import NoReferenceDriversError
from pytest_pafot.report.terminal import avoided_lines
from pytest_pafot.world import Highway
from tests.helpers.traces import trace_of, vehicle

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
    return next(told for told in found.told if told.run.responsibility == "ego")


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


def test_excused_collision_has_the_driver_that_escapes_it():
    world = Highway(duration=30.0)
    found = pafot.explore(constant_speed.make, holds=is_not_hit, world=world, seed=0, runs=60, shrink_rollouts=0)
    told = next(each for each in found.told if each.finding.expect.escaped_by is not None)
    run, escape = told.run, told.finding.expect.escaped_by
    assert run.responsibility == "npc"
    assert run.escape == escape
    taken = world.take_over(run.trace, round(escape.time * run.trace.physics_hz), "careful-human")
    assert taken.collision is None
    slowed = -np.diff(taken.ego[: run.trace.ticks + 1, SPEED]) * taken.physics_hz
    assert slowed.max() == pytest.approx(escape.braking, abs=1e-3)
    assert told.finding.expect.sentences_on(run) == (*run.sentences[:2], *escape.sentences, run.sentences[2])
    assert [line for line in avoided_lines(told.finding) if line in escape.sentences] == list(escape.sentences)


def test_run_without_its_world_says_that_escape_needs_it():
    with pytest.raises(NoReferenceDriversError, match="escape"):
        _ = pafot.Run(trace_of(vehicle(0.0, 4.0), vehicle(20.0, 4.0))).escape
