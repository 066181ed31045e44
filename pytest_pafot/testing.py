"""A check that a user's own world meets the requirements of a search, for use in the user's tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from itertools import chain, combinations, repeat
from typing import Any

import numpy as np

from pytest_pafot.model.scenario import CrossingInstruction, Scenario
from pytest_pafot.model.trace import ACCELERATION, ANGLE, HEADING, LANE, SPEED, STEERING, Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching.space import sample, space_on
from pytest_pafot.world.codec import OWN, described, from_dict, is_code
from pytest_pafot.world.kernel.bodies import Box, overlap
from pytest_pafot.world.limits import NpcLimits
from pytest_pafot.world.protocol import crossings, hang_limit, lasting, missing, road_start

Ads = Callable[[], Callable[[Any], Any]]

ROUNDING = 1e-6


def check_world(
    world: Any, *, seed: int = 0, runs: int = 8, ads: Ads = lambda: lambda observation: (0.0, 0.0), **space: Any
) -> None:
    """Check with random scenarios that a world meets the requirements of a search.

    - It has all attributes that a search needs, and plain data that a file can store.
    - Traces have the form that test functions and reports expect, also for crossing NPCs if the world has ways for
      them.
    - The same scenario gives the same trace to the last bit, whatever ran before.
    - The scenario as executed, ``trace.executed``, gives the same trace.
    - NPCs stay within the world's ``limits``, if these are a :class:`pytest_pafot.NpcLimits`.
    - An ADS that raises, returns no action or hangs ends its own run and does not affect other runs. An ADS that hangs
      is tried only if the world's ``hang_limit`` is at most one second.
    - If the world has ``lasting``, a run that lasts longer begins as usual, to the last bit.
    - ``from_dict`` gives the same world again, if the world's class has that method or if a file can describe the
      world.

    Args:
        world: the world to check.
        seed: the seed of the scenarios.
        runs: the number of scenarios.
        ads: the factory of an ADS that drives in this world without errors and does not depend on earlier runs. The
            default returns an acceleration and a steering of 0 in SI units.
        space: properties of all scenarios, such as ``npcs``, ``genes`` and ``ego_lane``, as in
            :func:`pytest_pafot.search`.

    Raises:
        AssertionError: if a requirement is not met; the message names it.
    """
    _promise(not (lacking := missing(world)), "a world has all that a search needs", f"no {', '.join(lacking)}")
    ways = {} if (found := crossings(world)) is None else {"crossings": found}
    random, within = np.random.default_rng(seed), space_on(world, {**ways, **space}, road_start(world))
    done = [(scenario, _rollout(world, scenario, ads)) for scenario in (sample(within, random) for _ in range(runs))]
    for scenario, trace in done:
        _check_form(world, scenario, trace)
        _check_limits(world, trace)
    for scenario, trace in done[::-1]:  # in a different order than before
        _check_same(trace, _rollout(world, scenario, ads), "the same scenario gives the same trace")
        _check_same(trace, _rollout(world, trace.executed, ads), "the scenario as executed gives the same trace")
    _check_lasting(world, *done[0], ads)
    _check_faults(world, *done[0], ads)
    _check_round_trip(world, *done[0], ads)


def _promise(is_kept: bool, promise: str, received: str) -> None:
    if not is_kept:
        raise AssertionError(f"expected that {promise}, received {received}")


@contextmanager
def _no_error(promise: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise AssertionError(f"expected that {promise}, received {error!r}") from error


def _rollout(world: Any, scenario: Scenario, ads: Callable[[], Any]) -> Trace:
    with _no_error("a run ends in a trace, whatever the ADS does"):
        trace: Trace = world.rollout(scenario, ads)
    _promise(isinstance(trace, Trace), "rollout returns a pafot.Trace", f"{trace!r:.200}")
    return trace


def _check_same(first: Trace, second: Trace, promise: str) -> None:
    names = {field.name for field in fields(Trace) if field.init} - {
        "scenario",
        "max_decision_seconds",
    }  # these two may differ
    differ = [name for name in sorted(names) if not _is_same(getattr(first, name), getattr(second, name))]
    _promise(not differ, promise, f"a different {', '.join(differ)} for {first.scenario!r}")


def _is_same(first: Any, second: Any) -> bool:
    """Return whether two values are the same to the last bit."""
    if isinstance(first, np.ndarray):
        return isinstance(second, np.ndarray) and (first.shape, first.tobytes()) == (second.shape, second.tobytes())
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(_is_same, first, second))
    return bool(first == second)


def _check_form(world: Any, scenario: Scenario, trace: Trace) -> None:
    """Check the parts of a trace that test functions, measures and report pages read."""
    _promise(trace.error is None, "the ADS of the check drives in this world", f"{trace.error}; give a different ads=")
    states, start = trace.states, trace.states[0]
    _promise(states.shape[1] == len(scenario.npcs) + 1, "states contain the ego and each NPC", f"shape {states.shape}")
    ways = [None if told is None else told.zone for told in scenario.crossings]
    crossing = np.array([isinstance(chain[0], CrossingInstruction) for chain in scenario.npcs])
    on_way = np.full((len(states), len(scenario.npcs)), np.nan) if trace.on_way is None else trace.on_way
    track = np.zeros((1, len(crossing), 1)) if trace.track is None else trace.track[:, 1:]
    boxes = [Box(*row[:3], *size) for row, size in zip(start.tolist(), trace.sizes.tolist(), strict=True)]
    promises = {
        "trace.scenario is the requested scenario": trace.scenario == scenario,
        "states are finite": np.isfinite(states).all(),
        "vehicles have a length and a width": (trace.sizes > 0).all(),
        "the column lane is an index of lanes, or -1": np.isin(states[..., LANE], range(-1, len(trace.lanes))).all(),
        "ads_hz divides physics_hz": trace.physics_hz % trace.ads_hz == 0,
        "no run is longer than longest_run": trace.duration <= world.longest_run + trace.dt,
        "there is a collision if the outcome says so": (trace.outcome is Outcome.COLLISION) == bool(trace.collision),
        "the ego starts as fast as the scenario says": abs(start[0, SPEED] - scenario.ego_speed) < ROUNDING,
        "acceleration and steering of the first row are 0": not start[:, [ACCELERATION, STEERING]].any(),
        "zones are those of the instructions": [None if zone is None else zone.way for zone in trace.zones] == ways,
        "on_way has the places of crossing NPCs, and NaN for others": (np.isfinite(on_way) == crossing).all(),
        "track is recorded if an NPC crosses": trace.track is not None or not crossing.any(),
        "track has NaN only for crossing NPCs": not np.isnan(track[:, ~crossing]).any(),
        "no vehicles touch at the start": not any(overlap(a, b) for a, b in combinations(boxes, 2)),
    }
    for promise, is_kept in promises.items():
        _promise(bool(is_kept), promise, f"something else in {trace!r}")
    with _no_error("Run(trace).explain() describes the run"):
        Run(trace).explain()


def _check_limits(world: Any, trace: Trace) -> None:
    limits, npcs, dt = getattr(world, "limits", None), trace.npcs, trace.dt
    if not isinstance(limits, NpcLimits):
        return
    speed = npcs[..., SPEED]
    acceleration = np.concatenate([np.zeros_like(speed[:1]), np.diff(speed, axis=0) / dt])
    is_standing = (speed[1:] <= ROUNDING) | (speed[:-1] <= ROUNDING)
    jerk = np.where(is_standing, 0.0, np.diff(acceleration, axis=0) / dt)
    turns = (np.diff(npcs[..., HEADING], axis=0) + np.pi) % (2 * np.pi) - np.pi
    angle = npcs[..., HEADING] - trace.lanes[0].heading if trace.track is None else trace.track[:, 1:, ANGLE]
    angle = angle[..., [zone is None for zone in trace.zones] if trace.zones else slice(None)]
    for name, values, low, high in (
        ("speed", speed, 0.0, limits.overspeed * world.speed_limit),
        ("acceleration", acceleration, -limits.braking, limits.acceleration),
        ("jerk", jerk, -limits.jerk, limits.jerk),
        ("heading", angle, -limits.heading, limits.heading),
        ("lateral acceleration", speed[:-1] * turns / dt, -limits.lateral_acceleration, limits.lateral_acceleration),
    ):
        least, most = float(np.min(values, initial=0.0)), float(np.max(values, initial=0.0))
        is_kept = low - ROUNDING <= least and most <= high + ROUNDING
        _promise(is_kept, f"the {name} of NPCs is from {low:g} to {high:g}", f"{least:g} to {most:g}")


def _check_lasting(world: Any, scenario: Scenario, trace: Trace, ads: Ads) -> None:
    if (make := lasting(world)) is None:
        return
    with _no_error("lasting returns a world"):
        longer = _rollout(make(trace.duration + 2.0), scenario, ads)
    begins = _is_same(trace.states, longer.states[: len(trace.states)])
    _promise(begins, "a run that lasts longer begins as usual", f"other states for {scenario!r}")
    is_over = trace.outcome not in (Outcome.SAFE, Outcome.OFF_ROAD) or longer.ticks > trace.ticks
    _promise(is_over, "a run lasts longer in the world of lasting", f"{longer.duration:g} s again, for {scenario!r}")


def _check_faults(world: Any, scenario: Scenario, healthy: Trace, ads: Ads) -> None:
    limit = hang_limit(world)
    faults: list[tuple[str, Callable[[], Any], Outcome]] = [
        ("raises", lambda: 1 / 0, Outcome.ADS_ERROR),
        ("returns None", lambda: None, Outcome.ADS_ERROR),
        ("hangs", lambda: time.sleep(6 * limit), Outcome.HANG),
    ]
    for name, fault, outcome in faults if limit <= 1.0 else faults[:-1]:
        trace = _rollout(world, scenario, partial(_failing_ads, ads, fault))
        is_kept = trace.outcome is outcome and trace.error is not None
        _promise(is_kept, f"an ADS that {name} ends its run as {outcome}", f"{trace.outcome}, {trace.error}")
        _check_same(healthy, _rollout(world, scenario, ads), f"an ADS that {name} does not affect the next run")


def _failing_ads(factory: Ads, fault: Callable[[], Any]) -> Callable[[Any], Any]:
    """Return an ADS that makes its first decision with the ADS of a factory, and fails from its second decision on."""
    decisions: Iterator[Callable[[Any], Any]] = chain([factory()], repeat(lambda observation: fault()))

    def decide(observation: Any) -> Any:
        return next(decisions)(observation)

    return decide


def _check_round_trip(world: Any, scenario: Scenario, trace: Trace, ads: Ads) -> None:
    data, cls = described(world), type(world)
    if data["kind"] == OWN:
        _promise("data" in data, "to_dict returns plain data that a file can store", f"{world.to_dict()!r:.200}")
    if is_code(data) and not (data["kind"] == OWN and hasattr(cls, "from_dict")):
        return
    with _no_error("from_dict accepts the data of to_dict"):
        again = cls.from_dict(world.to_dict()) if data["kind"] == OWN else from_dict(data)
    _promise(described(again) == data, "from_dict(to_dict()) has the same data", f"{described(again)} for {data}")
    _check_same(trace, _rollout(again, scenario, ads), "from_dict(to_dict()) gives the same traces")
