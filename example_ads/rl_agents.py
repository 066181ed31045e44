"""Planners of rl-agents, by the author of highway-env, which look ahead in a copy of their environment.

Kind (b), for ``pafot.World("highway-v0")``. Needs two environment variables, each with the folder of a clone:

- ``RL_AGENTS``: https://github.com/eleurent/rl-agents (commit 84df15e, MIT licence);
- ``FINITE_MDP``: https://github.com/eleurent/finite-mdp (commit 5d3f409, without a licence file), which needs
  ``pip install gym==0.26.2``.

Nothing in them was changed. The planning, its settings, and the predicted traffic, which is ``env.step`` of a copy, are
theirs. The adapter passes the environment and a constant seed.
"""

from __future__ import annotations

import json
import logging
from typing import Any

from . import import_from_clone

CLONE = import_from_clone("RL_AGENTS", "eleurent/rl-agents", "84df15ea977271e6a4d015f10f9f355f7e866890", "rl_agents")
import_from_clone("FINITE_MDP", "eleurent/finite-mdp", "5d3f409363c822f3aa8b22e08d3e9807c29fb178", "finite_mdp")
from rl_agents.agents.common.factory import agent_factory  # noqa: E402 - of the clone

SETTINGS = CLONE / "scripts" / "configs" / "HighwayEnv" / "agents"
logging.getLogger("rl_agents").setLevel(logging.ERROR)


class Agent:
    """One of their agents.

    Args:
        env: the environment in which the agent drives.
        settings: the name of the agent's folder in their settings for highway-env.
    """

    def __init__(self, env: Any, settings: str) -> None:
        config = json.loads((SETTINGS / settings / "baseline.json").read_text(encoding="utf-8"))
        self._agent = agent_factory(env.unwrapped, config)
        self._agent.seed(0)

    def __call__(self, observation: Any) -> int:
        """Return a meta-action of highway-env."""
        return int(self._agent.act(observation))


def make(env: Any) -> Agent:
    """Return their optimistic planner, which searches sequences of actions in copies of the environment."""
    return Agent(env, "DeterministicPlannerAgent")


def value_iteration(env: Any) -> Agent:
    """Return their value iteration, which solves the decision process of times to collision that highway-env makes."""
    return Agent(env, "ValueIterationAgent")


def mcts(env: Any) -> Agent:
    """Return their Monte Carlo tree search."""
    return Agent(env, "MCTSAgent")
