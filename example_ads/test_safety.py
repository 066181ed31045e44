"""Searches of the policies in this folder for collisions that they should not have.

    pytest example_ads --pafot-runs=20

The constant-speed policy and the blind lane changer fail within seconds, as they should, each with 23 of 25 tried
seeds. Every distinct finding is saved in ``pafot_corpus/`` next to this file and is its own test from then on.
"""

from __future__ import annotations

import pytest_pafot as pafot
from example_ads import blind_lane_change, ppo


@pafot.search(blame="ego")
def test_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search with the defaults, for each policy of the fixture ``ads``."""
    assert not run.collision, run.explain()


@pafot.search(ads=blind_lane_change.make)
def test_never_hit_in_the_side(run: pafot.Run) -> None:
    """Check your own property: a driver that looks before changing lanes is seldom hit in the side."""
    side = run.collision.side if run.collision else None
    assert side not in {"left", "right"}, run.explain()


@pafot.search(blame="ego", ads=ppo.make, world=pafot.World("highway-v0"))
def test_ppo_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search a learned policy in the environment that it was trained for, whose episodes last 40 s."""
    assert not run.collision, run.explain()


@pafot.search(blame="ego", ads="fiss", world=pafot.Highway(duration=30.0))
def test_fiss_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search a published planner; it needs some milliseconds a decision, so its scenarios are half as long."""
    assert not run.collision, run.explain()


@pafot.search(blame="ego", ads="expert", world=pafot.metadrive(observation="lidar"))
def test_metadrives_expert_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search a policy of a simulator, which reads the simulator's own lidar and sets its pedal and steering."""
    assert not run.collision, run.explain()
