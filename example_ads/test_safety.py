"""The main job: search each policy of this folder for collisions that it should not have.

    pytest example_ads --pafot-runs=20

The constant-speed policy and the blind lane changer fail within seconds, as they should, each with 23 of 25 seeds that
were tried. Every distinct find is saved in ``pafot_corpus/`` beside this file and is a test of its own from then on.
"""

from __future__ import annotations

import pytest_pafot as pafot
from example_ads import blind_lane_change, ppo


@pafot.search(blame="ego")
def test_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """Bare defaults: two NPCs on four lanes, for the policies that the fixture ``ads`` lists."""
    assert not run.collision, run.explain()


@pafot.search(ads=blind_lane_change.make)
def test_never_hit_in_the_side(run: pafot.Run) -> None:
    """A property of one's own: whoever is to blame, who looks before changing lanes is seldom hit in the side."""
    side = run.collision.side if run.collision else None
    assert side not in {"left", "right"}, run.explain()


@pafot.search(blame="ego", ads=ppo.make, world=pafot.World("highway-v0"))
def test_ppo_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """A learned policy, in the environment that it was trained for, whose episodes last 40 s."""
    assert not run.collision, run.explain()


@pafot.search(blame="ego", ads="fiss", world=pafot.Highway(duration=30.0))
def test_fiss_is_never_at_fault_in_a_collision(run: pafot.Run) -> None:
    """A published planner; it thinks for some milliseconds a decision, so its scenarios are half as long."""
    assert not run.collision, run.explain()
