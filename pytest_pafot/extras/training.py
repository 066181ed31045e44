"""A training environment, in which some episodes are scenarios, such as saved failures, and others ordinary traffic.

Importing this module registers the environment with gymnasium as ``pafot/Scenarios-v0``.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.error import ResetNeeded
from numpy.random import Generator

from pytest_pafot import CAR, Run, Scenario, Trace, World, WorldError, load
from pytest_pafot.extending import (
    SUFFIX,
    SteppedWorld,
    base_world,
    checked_action,
    drawn_space,
    files_below,
    sample,
)
from pytest_pafot.support.errors import checked_number

Step = tuple[Any, float, bool, bool, dict[str, Any]]
"""What ``step`` of an environment returns."""

Sampler = Callable[[Generator], Scenario]
Scenarios = str | os.PathLike[str] | Sequence[Scenario] | Sampler | None


class TrainingEnv(gymnasium.Env[Any, Any]):
    """The training environment of :func:`training_env`, which has the same arguments.

    Attributes:
        trace: the trace of the last episode if it was a scenario; None during an episode and after ordinary traffic.
    """

    def __init__(self, world: World, scenarios: Scenarios = None, share: float = 0.5) -> None:
        if not isinstance(world, World):
            expected = 'an environment with a reward, such as pafot.World("highway-fast-v0")'
            raise WorldError(field="world", expected=expected, received=f"{world!r:.200}")
        if world.wrappers is not None:
            expected, fix = "a world without wrappers", "put them around the training environment instead"
            raise WorldError(field="world.wrappers", expected=expected, received=f"{world.wrappers!r:.200}", fix=fix)
        if world.planner_hz is not None:
            fix = "leave it out: a policy learns from the environment's own observations and actions"
            raise WorldError(field="world.planner_hz", expected="None", received=f"{world.planner_hz:g}", fix=fix)
        if world.ego != CAR:
            expected, fix = "a car", "ordinary traffic has the environment's own ego, so its class decides on the size"
            raise WorldError(field="world.ego", expected=expected, received=world.ego.described, fix=fix)
        world.check()
        if world.environment.episodes_itself(drives_itself=False):
            expected = (
                "an environment with the `step`, `reset` and road of highway-env, so that NPCs can replace traffic"
            )
            received = f"{world.env_id!r}, which has its own"
            raise WorldError(field="world", expected=expected, received=received)
        share = checked_number(share, "share", "the share of scenarios among the episodes, 0 to 1", least=0.0, most=1.0)
        self.trace: Trace | None = None
        self.observation_space = copy.deepcopy(world.observation_space)
        self.action_space = copy.deepcopy(world.action_space)
        self._world, self._share, self._drawn = world, share, _sampler(world, scenarios)
        self._stepped = SteppedWorld(world)
        self._scenario: Scenario | None = None
        self._steps: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, a scenario or ordinary traffic; the seeds given so far determine all random choices.

        Raises:
            ScenarioError: if the sampler returns a scenario that does not fit the world.
        """
        super().reset(seed=seed)
        self.trace, rng = None, self.np_random
        is_scenario = rng.random() < self._share
        self._scenario = self._drawn(rng) if is_scenario else None
        if self._scenario is not None:
            self._world.check_fits(self._scenario)
            self._steps = self._stepped.scenario(self._scenario)
            seen, info = self._steps.reset()
        else:
            self._steps, seen, info = self._stepped.traffic(int(rng.integers(2**31)))
        return seen, self._with_identity(info)

    def step(self, action: Any) -> Step:
        """Drive with an action up to the next decision, or to the end of the episode.

        Raises:
            BadAction: if the action is not in the action space.
            gymnasium.error.ResetNeeded: if no episode has begun.
        """
        if self._steps is None:
            raise ResetNeeded("step: expected an episode that has begun, received none; call reset() first")
        seen, reward, terminated, truncated, info = self._steps.step(checked_action(action, self.action_space))
        if terminated or truncated:
            self.trace = None if self._scenario is None else self._steps.trace
            self._steps = None
        return seen, reward, terminated, truncated, self._with_identity(info)

    def _with_identity(self, info: dict[str, Any]) -> dict[str, Any]:
        responsible = ""
        if self.trace is not None and self.trace.collision is not None:
            responsible = Run(self.trace).responsibility or "none"
        identity = "" if self._scenario is None else self._scenario.id
        return {**info, "is_scenario": bool(identity), "scenario": identity, "responsible": responsible}


gymnasium.register(id="pafot/Scenarios-v0", entry_point=f"{__name__}:TrainingEnv")


def training_env(world: World, scenarios: Scenarios = None, share: float = 0.5) -> TrainingEnv:
    """Return a gymnasium environment to train a policy in scenarios, such as its failures, and in ordinary traffic.

    Observations, actions and reward are those of the world's environment. An episode is either a scenario or ordinary
    traffic. A scenario is the same run, to the last bit, as the world's ``rollout`` with the same actions, and ends at
    the ego's first contact. Ordinary traffic is the environment's own random traffic as without this package. Compiled
    code drives it if :mod:`pytest_pafot.world.engines.ordinary_traffic` supports the environment.

    In addition to the environment's own values, ``info`` has ``is_scenario``, ``scenario`` (the id; empty in ordinary
    traffic) and ``responsible`` (``ego``, ``npc``, ``both`` or ``none`` after a crash in a scenario; otherwise empty).

    Args:
        world: the world. Its environment must have a ``step``, ``reset`` and road of highway-env. The world must not
            have ``planner_hz``, wrappers, or an ``ego`` that is no car; put wrappers around the returned environment.
        scenarios: a folder with saved scenarios in it or below it; a sequence of scenarios; or a function that samples
            a scenario with a numpy ``Generator``. By default scenarios are random, like the first scenarios of a
            search.
        share: the share of scenarios among the episodes, 0 to 1.

    Raises:
        WorldError: if the environment of the world cannot be used for training.
        ValueError: if the share is out of range, there is no scenario, or an object is not a scenario.
        ScenarioError: if a scenario does not fit the world.
        CorpusError: if the file of a saved scenario cannot be used.
    """
    return TrainingEnv(world, scenarios, share)


def random_scenarios(world: Any) -> Sampler:
    """Return a sampler of random scenarios, like the first scenarios of a search with default settings in a world."""
    return partial(sample, base_world(world).space(drawn_space(world, {})))


def _sampler(world: World, scenarios: Scenarios) -> Sampler:
    """Return a function that samples a scenario from what the user gave as ``scenarios``."""
    if scenarios is None:
        return random_scenarios(world)
    if isinstance(scenarios, str | os.PathLike):
        scenarios = _saved_in(Path(scenarios), world)
    elif callable(scenarios):
        return scenarios
    known = tuple(scenarios) if isinstance(scenarios, Iterable) else (scenarios,)
    if not all(isinstance(each, Scenario) for each in known):
        expected = (
            "a folder with saved scenarios, several pafot.Scenario, or a function of a numpy Generator that samples"
        )
        raise ValueError(
            f"scenarios: expected {expected} one, received {scenarios!r:.200}; without this argument they are random"
        )
    if not known:
        raise ValueError("scenarios: expected at least one, received none")
    for each in known:
        world.check_fits(each)
    return lambda rng: known[int(rng.integers(len(known)))]


def _saved_in(folder: Path, world: World) -> list[Scenario]:
    """Return the scenarios of all corpus files in and below a folder, sorted by path."""
    files = files_below(folder)
    if not files:
        received = f"{folder}, {'which has none' if folder.is_dir() else 'which is not a folder'}"
        fix = "a search saves them, such as a test with @pafot.search, or pafot.explore(..., corpus=...)"
        raise ValueError(f"scenarios: expected a folder with saved scenarios, *{SUFFIX}, received {received}; {fix}")
    scenarios = []
    for file in files:
        saved = load(file)
        saved.check_fits(world)
        scenarios.append(saved.scenario)
    return scenarios
