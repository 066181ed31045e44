"""A scenario as an episode that is given its actions: the run of ``World.rollout``, the reward of the environment."""

from __future__ import annotations

from typing import Any, cast

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world.driving.hang_guard import HangGuard
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.engines.episode import Step
from pytest_pafot.world.engines.policy_engine import begin
from pytest_pafot.world.gym_environment import GymEnvironment
from pytest_pafot.world.run_config import Rules


class ScenarioSteps:
    """One scenario, which fits the rules, in an environment that has no steps of its own."""

    def __init__(self, environment: GymEnvironment, rules: Rules, scenario: Scenario) -> None:
        self._run = begin(environment, rules, scenario, HangGuard(rules.hang_limit), None)
        self._env = cast("Policy", self._run.traffic.driver).env
        self._env.action_space.seed(scenario.seed)

    @property
    def trace(self) -> Trace | None:
        """Of the run, once that is over."""
        return self._run.trace

    def reset(self) -> tuple[Any, dict[str, Any]]:
        """What the reset of the environment returns."""
        seen = self._run.observe()
        return seen, self._env._info(seen, self._env.action_space.sample())

    def step(self, action: Any) -> Step:
        """What the step of the environment returns, of an action that it has.

        The run is over at the tick of first contact, and then the ego counts as crashed: highway-env, which is asked
        for the reward, does not look for contact itself here. A run that is over in another way is truncated.
        """
        run, env = self._run, self._env
        run.take(action, 0.0)
        trace = run.trace
        if trace is not None and trace.error is not None:
            raise RuntimeError(f"{trace.error.kind}: {trace.error.message}\n{trace.error.traceback}")
        seen = run.observe()
        env.vehicle.crashed = trace is not None and trace.collision is not None
        reward, is_terminated = float(env._reward(action)), bool(env._is_terminated())
        return seen, reward, is_terminated, trace is not None and not is_terminated, env._info(seen, action)
