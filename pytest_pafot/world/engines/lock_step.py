"""Runs in lock step, in which an ADS with a method ``batch`` decides for all runs at once.

``batch(observations) -> actions`` receives the :class:`Observations` of all unfinished runs at one decision tick, and
returns one action for each observation, in the same order. One fresh ADS serves all runs of a batch. It may therefore
store state between decisions only separately for each run, by ``observations.runs``, and an action may depend only on
its own run. Under these conditions, the runs are the same as if the ADS were called for one run after another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.driving.policy import Ads, Policy
from pytest_pafot.world.engines.run import SteppedRun
from pytest_pafot.world.guard.failure import UNFIT, closing, let_through
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.observation import Observation, stacked


class Observations(list[Any]):
    """The observations of all unfinished runs.

    Args:
        runs: the number of each unfinished run among all runs of the batch, from 0; it is the same at every tick.
        seen: the observation in each of these runs, in the same order.
    """

    def __init__(self, runs: Sequence[int], seen: Iterable[Any]) -> None:
        super().__init__(seen)
        self.runs = runs

    @property
    def array(self) -> Any:
        """All observations as one array of shape [runs, vehicles, features], made on demand.

        In SI units it is float64, with the fields of :class:`pytest_pafot.VehicleState` as features; missing rows of
        runs with fewer vehicles are NaN. In an environment it is the stack of the environment's own observations.
        """
        return stacked(self) if isinstance(self[0], Observation) else np.stack(self)


def batching_ads(policy: Policy, hang_limit: float) -> Ads | None:
    """Make a fresh ADS and return it if it has ``batch``, which decides for many runs at once; else return None."""
    if not policy.only_observes:
        return None
    ads = policy.make()
    if ads.decides_for_many:
        return ads
    with closing(ads.given, hang_limit):
        return None


def rollouts(
    scenarios: Sequence[Scenario],
    policy: Policy,
    start: Callable[[Scenario, HangGuard, Sight | None], SteppedRun],
    rollout: Callable[[Scenario, AdsFactory], Trace],
    hang_limit: float,
) -> list[Trace]:
    """Simulate scenarios, in lock step if the ADS has a method ``batch`` that works, else one by one.

    If ``batch`` raises or hangs, all runs are repeated one by one, so that the error belongs to the run that causes it.

    ``start`` begins a run in lock step for an ADS with the given sight; ``rollout`` simulates a single run. A decision
    for all n scenarios may take n times ``hang_limit`` [s].

    Raises:
        AdsFactoryError: if the factory returns nothing that drives, or ``batch`` does not return one action per run.
    """
    ads = batching_ads(policy, hang_limit) if len(scenarios) > 1 else None
    if ads is not None:
        with closing(ads.given, hang_limit), HangGuard(hang_limit * len(scenarios)) as guard:
            runs = [start(scenario, guard, ads.sight) for scenario in scenarios]
            traces = _in_lock_step(runs, ads.given.batch, guard)
        if traces is not None:
            return traces
    return [rollout(scenario, policy.factory) for scenario in scenarios]


def _in_lock_step(
    runs: Sequence[SteppedRun], batch: Callable[[Observations], Any], guard: HangGuard
) -> list[Trace] | None:
    """Return the traces of all runs; None if ``batch`` raised or hung."""
    live = {number: run for number, run in enumerate(runs) if run.trace is None}
    while live:
        observations = Observations(list(live), [run.observe() for run in live.values()])
        started = guard.clock()
        try:
            try:
                guard.decision_starts()
                actions = _listed(batch(observations))
            finally:
                guard.decision_ends()
            guard.raise_swallowed()
        except UNFIT as error:
            guard.decision_ends()
            let_through(error)
            return None  # no error is lost: its run raises it again when repeated alone
        seconds, count = (guard.clock() - started) / len(live), len(live)
        if not isinstance(actions, list) or len(actions) != count:
            raise AdsFactoryError(
                f"ads.batch: expected {count} actions, one for each of {count} observations in the same order, "
                f"received {shown(actions)}; the number decreases during a batch, because finished runs are left out"
            )
        for run, action in zip(live.values(), actions, strict=True):
            run.take(action, seconds)
        live = {number: run for number, run in live.items() if run.trace is None}
    return [run.trace for run in runs if run.trace is not None]


def _listed(actions: Any) -> Any:
    """Return an iterable as a list, anything else unchanged; iterating may run the ADS's code in a generator."""
    try:
        iterator = iter(actions)
    except TypeError:
        return actions
    return list(iterator)
