"""gymnasium's wrappers around an environment: which ones change what a policy sees or does, and how they are put on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from pytest_pafot.world.errors import WorldError

NEUTRAL = (OrderEnforcing, PassiveEnvChecker, TimeLimit)
"""What ``gymnasium.make`` itself puts around any environment.

They check, or end an episode, and leave observations and actions as they are. How long a run lasts is for the world to
say, as for the environment's own ``duration``.
"""


def names(env: Any) -> list[str]:
    """The classes of all wrappers around an environment that are not neutral, from the inside out."""
    found = []
    while isinstance(env, gymnasium.Wrapper):
        if type(env) not in NEUTRAL:
            found.append(type(env).__name__)
        env = env.env
    return found[::-1]


def check_bare(env: Any, env_id: str) -> None:
    """Refuse wrappers that come with the registration, in a world that did not ask for any.

    Raises:
        WorldError: naming them.
    """
    added = names(env)
    if added:
        raise WorldError(
            field="env_id",
            expected="an environment whose policies see it as it is",
            received=f"{env_id!r}, which is registered with {' and '.join(added)} around it",
            fix=f"use pafot.World({env_id!r}, wrappers=[]), which runs through env.step with what the registration "
            "adds, and with further wrappers that the list gives",
        )


def put_on(env: Any, wrappers: Sequence[Callable[[Any], Any]]) -> Any:
    """The environment in further wrappers, the first one innermost.

    Raises:
        WorldError: where one of them cannot be put on, naming it.
    """
    outer = env
    for index, wrapper in enumerate(wrappers):
        expected = f"wrappers[{index}]: expected a callable that takes an environment and returns it wrapped"
        try:
            outer = wrapper(outer)
        except Exception as error:
            raise WorldError(
                f"{expected}, received {wrapper!r:.200}, which raised {type(error).__name__}: {error}"
            ) from error
        if not isinstance(outer, gymnasium.Env) or outer.unwrapped is not env.unwrapped:
            raise WorldError(f"{expected}, received {wrapper!r:.200}, which returned {outer!r:.200}")
    return outer
