"""The actions of ADSs that act as an environment defines, and the environment in which they may simulate."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from pytest_pafot.model.scenario import rng_of
from pytest_pafot.support.errors import BadAction, WorldError
from pytest_pafot.support.text import shown
from pytest_pafot.world.kernel.action import hint_at
from pytest_pafot.world.stock import Road, class_from_path


def check_action_space(space: Any, wrappers: Sequence[str] = ()) -> None:
    """Raise a :class:`WorldError` for an action space that is not for one vehicle.

    ``wrappers`` are the names of the wrappers that have made it from another; empty if it is the environment's own.
    """
    if isinstance(space, (spaces.Discrete, spaces.Box)):
        return
    expected, received = "a discrete or continuous action for one vehicle", f"the space {space}"
    if wrappers:
        received = f"{received} in {', '.join(wrappers)}"
        fix = "let the wrappers' action_space be a Discrete or a Box"
        raise WorldError(field="wrappers", expected=expected, received=received, fix=fix)
    fix = "multi-agent actions have no single ego"
    raise WorldError(field="config.action", expected=expected, received=received, fix=fix)


def checked_action(action: Any, space: Any) -> Any:
    """Return an action as its space requires: as an int, or as a float array with the shape of the space.

    Raises:
        BadAction: for an action of another kind or shape than the space has; numbers outside its bounds are the
            environment's to limit.
    """
    is_choice = isinstance(space, spaces.Discrete)
    expected = f"expected finite numbers of shape {space.shape}"
    if is_choice:
        expected = f"expected a whole number from {space.start} to {space.start + space.n - 1}"
    try:
        given = np.asarray(action)
    except (TypeError, ValueError):  # such as rows of different lengths
        raise _bad(expected, action) from None
    if is_choice:
        if given.size != 1 or given.dtype.kind not in "iu" or not space.contains(int(given.reshape(()))):
            raise _bad(expected, action, _hint_at_choice(given, space))
        return int(given.reshape(()))
    if given.dtype.kind not in "iuf" or given.shape != space.shape or not np.isfinite(given).all():
        raise _bad(expected, action)
    return np.array(given, dtype=np.result_type(given, np.float32))  # a copy: the ADS may reuse its array


def _bad(expected: str, action: Any, hint: str = "") -> BadAction:
    hint = hint_at(action) or hint
    return BadAction(f"{expected}, received {shown(action)}{f'; {hint}' if hint else ''}")


def _hint_at_choice(array: Any, space: Any) -> str:
    """Return a hint for an array that an ADS returned in place of an action's number; empty if none fits."""
    if array.dtype.kind == "f" and array.shape == (2,) and space.n != 2:
        return (
            "planners in SI units drive without world=, or in a pafot.World(..., planner_hz=5); for a command, write "
            "@planner after the name"
        )
    if array.dtype.kind == "f" and array.size == space.n:
        return "if these are values of the actions, return the number of the largest: `int(np.argmax(...))`"
    if array.dtype.kind == "f" and array.size == 1:
        return "return `int(...)` of it"
    return ""


def copies_on(objects: Sequence[Any], road: Road) -> list[Any]:
    """Copy a road's fixed objects to a different road."""
    copies = [copy.copy(each) for each in objects]
    for each in copies:
        each.road = road
    return copies


class View:
    """An environment for a planner to copy and simulate in, with the run's state but without the NPCs' genes.

    The ego is a copy of the run's ego. Every other vehicle is of the environment's own traffic class, in the NPC's
    state, and with the current speed as its desired speed, because an observer cannot know more.
    """

    def __init__(self, env: Any, run_env: Any) -> None:
        self.env = env
        self._run_env = run_env
        self._traffic = class_from_path(env.config["other_vehicles_type"])
        self.show(0)

    def show(self, tick: int) -> None:
        """Update the view to the run's state."""
        source, env = self._run_env, self.env
        road = Road(
            source.road.network,
            np_random=rng_of(tick),
            neighbour_vehicles_connected_lanes=source.road.neighbour_vehicles_connected_lanes,
        )
        ego = copy.copy(source.vehicle)
        ego.road = road
        ego.position = np.array(source.vehicle.position)
        ego.action = dict(source.vehicle.action)
        ego.check_collisions = True
        road.objects = copies_on(source.road.objects, road)
        road.vehicles = [ego]
        for each in source.road.vehicles:
            if each is not source.vehicle:
                state = np.array(each.position), float(each.heading), float(each.speed)
                road.vehicles.append(self._traffic(road, *state))
        env.road = road
        env.controlled_vehicles = [ego]
        env.np_random = road.np_random
        env.steps, env.time, env.done = source.steps, source.time, False
        env.define_spaces()
        env.action_space.seed(tick)  # planners sample from it
        env.observation_space.seed(tick)
