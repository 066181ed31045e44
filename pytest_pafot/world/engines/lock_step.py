"""Runs in lock step: an ADS with a method ``batch`` decides for all of them at once.

``batch(observations) -> actions`` gets the :class:`Observations` of the runs that still go on, at one decision tick,
and returns one action for each in the same order. One fresh ADS serves all runs of a batch, so that it may not remember
anything from one decision to the next but by ``observations.runs``, and an action may depend on its own run alone. Then
the runs are those of the same ADS asked one by one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.support.text import shown
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class, make_ads, wants_env
from pytest_pafot.world.driving.perception import ads_and_sight
from pytest_pafot.world.guard.failure import UNFIT, closing, let_through
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.observation import Observation, stacked


class Observations(list[Any]):
    """What the ADS sees in each of the runs that still go on.

    Args:
        runs: the number of each of them among all runs of the batch, the same at every tick, from 0.
        seen: in them, in the same order.
    """

    def __init__(self, runs: Sequence[int], seen: Iterable[Any]) -> None:
        super().__init__(seen)
        self.runs = runs

    @property
    def array(self) -> Any:
        """All of it, made when it is asked for, of shape [runs, vehicles, features].

        In SI units float64, the features those of :class:`pytest_pafot.VehicleState` in their order; runs with fewer
        vehicles than others have NaN in the rows that they lack. In an environment the stack of its own observations.
        """
        return stacked(self) if isinstance(self[0], Observation) else np.stack(self)


class SteppedRun(Protocol):
    """A run that goes from one decision to the next, until it has a trace."""

    trace: Trace | None

    def observe(self) -> Any:
        """What the ADS sees now."""

    def take(self, action: Any, seconds: float) -> None:
        """Drive with a decision that took so long, up to the next one or the end."""


def batching_ads(factory: AdsFactory, hang_limit: float) -> Any:
    """A fresh ADS that decides for many runs at once; None where the factory gives another, which is closed then."""
    if is_vehicle_class(factory) or wants_env(factory):
        return None
    ads = make_ads(factory)
    if not is_vehicle_class(ads) and callable(getattr(ads, "batch", None)):
        return ads
    with closing(ads, hang_limit):
        return None


def rollouts(
    scenarios: Sequence[Scenario],
    factory: AdsFactory,
    start: Callable[[Scenario, HangGuard, Sight | None], SteppedRun],
    rollout: Callable[[Scenario, AdsFactory], Trace],
    hang_limit: float,
) -> list[Trace]:
    """Simulate scenarios, in lock step where the ADS has a method ``batch`` and that works, else one by one.

    Where ``batch`` raises or hangs, all runs are repeated one by one, so that the error is that of its own run.

    ``start`` begins a run in lock step by an ADS that may have a sight, ``rollout`` simulates one by itself.
    Where a decision for one run may take up to ``hang_limit`` [s], one for many may take as many times as long.

    Raises:
        AdsFactoryError: when the factory gives nothing that drives, or ``batch`` not one action for each run.
    """
    ads = batching_ads(factory, hang_limit) if len(scenarios) > 1 else None
    if ads is not None:
        with closing(ads, hang_limit), HangGuard(hang_limit * len(scenarios)) as guard:
            sight = ads_and_sight(ads)[1]
            runs = [start(scenario, guard, sight) for scenario in scenarios]
            traces = _in_lock_step(runs, ads.batch, guard)
        if traces is not None:
            return traces
    return [rollout(scenario, factory) for scenario in scenarios]


def _in_lock_step(
    runs: Sequence[SteppedRun], batch: Callable[[Observations], Any], guard: HangGuard
) -> list[Trace] | None:
    """The traces of all runs; None where ``batch`` raised or hung."""
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
        except UNFIT as error:
            guard.decision_ends()
            let_through(error)
            return None  # nothing is lost: whoever is at fault raises again by itself
        seconds, count = (guard.clock() - started) / len(live), len(live)
        if not isinstance(actions, list) or len(actions) != count:
            raise AdsFactoryError(
                f"ads.batch: expected {count} actions, one for each of {count} observations in the same order, "
                f"received {shown(actions)}; runs that are over are not asked for any more, so that the number changes"
            )
        for run, action in zip(live.values(), actions, strict=True):
            run.take(action, seconds)
        live = {number: run for number, run in live.items() if run.trace is None}
    return [run.trace for run in runs if run.trace is not None]


def _listed(actions: Any) -> Any:
    """What can be iterated over as a list. It may be a generator, and so the ADS's code; anything else as it is."""
    try:
        iterator = iter(actions)
    except TypeError:
        return actions
    return list(iterator)
