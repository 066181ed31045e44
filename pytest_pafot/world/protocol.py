"""The interface between a search and a world: members that every world has, and optional capabilities.

A user-defined world only needs to satisfy :class:`WorldLike`. For each further capability, a function in this module
detects it; no other module looks for methods or classes of worlds.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import PositionInstruction, Scenario, ScenarioError
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import ReferenceWorld
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.limits import HANG_LIMIT
from pytest_pafot.world.roads.network import Meeting
from pytest_pafot.world.roads.straight import StraightRoad


@dataclass(frozen=True, slots=True)
class FirstDecision:
    """The input that an ADS receives at its first decision and the output that it must return, for error messages."""

    is_si: bool
    """True if the ADS receives a :class:`pafot.Observation`, and not an environment's own observation."""
    text: str
    """A sentence that states what the ADS receives and what it must return."""


def decision_asked(rollout: Callable[[Scenario, AdsFactory], Trace], scenario: Scenario) -> FirstDecision | None:
    """Find out the first decision of a world by a run of ``rollout``; return None if the run fails before it."""
    seen: list[Any] = []
    trace = rollout(scenario, lambda: seen.append)  # returns None, so that the error names the expected action
    if not seen or trace.error is None:
        return None
    expected = trace.error.message.removeprefix("expected ").partition(", received")[0]
    observation = seen[0]
    is_si = isinstance(observation, Observation)
    if is_si:
        fields = "time, ego, others, lanes, lane_width, speed_limit"
        given = f"a pafot.Observation ({fields}, and .array of shape {observation.array.shape})"
    elif (shape := getattr(observation, "shape", None)) is None:
        given = f"a {type(observation).__name__}"
    else:
        given = f"an array of shape {tuple(shape)} and type {observation.dtype}"
    return FirstDecision(is_si, f"The ADS was given {given}, and must return {expected}.")


REQUIRED = ("rollout", "to_dict", "speed_limit", "longest_run")
"""The names of all members of :class:`WorldLike`."""


class WorldLike(Protocol):
    """The members that a search needs in any world."""

    @property
    def speed_limit(self) -> float:
        """The highest target speed of NPCs [m/s]."""

    @property
    def longest_run(self) -> float:
        """The duration of a run that nothing ends early [s]."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, /) -> Trace:
        """Simulate a scenario with a fresh ADS from ``ads_factory()``; equal scenarios give equal traces."""

    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain data: numbers, text, lists, mappings."""


class LockStepping(WorldLike, Protocol):
    """A world in which many runs can proceed together, one decision at a time."""

    def rollout_batch(self, scenarios: Sequence[Scenario], ads_factory: AdsFactory, /) -> list[Trace]:
        """Return the traces of :meth:`WorldLike.rollout`; runs are in lock step if the ADS has a method ``batch``."""


class Resumable(WorldLike, Protocol):
    """A world whose runs can start with given decisions."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, /, *, decisions: Sequence[Any] = ()) -> Trace:
        """Simulate a scenario; the first ``decisions``, in the form of ``Trace.actions``, replace those of the ADS."""


class GymReplaying(WorldLike, Protocol):
    """A world whose runs can be repeated with ``env.step`` of a plain gymnasium environment."""

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory, /) -> Trace:
        """Simulate a scenario in gymnasium, to confirm a finding."""


class RoadStart(NamedTuple):
    """The ego's start on a road that prescribes it: the lane, counted from 0 at the left, and the speed [m/s].

    There are ``physics_hz`` ticks per second, and a gene lasts a whole number of ticks.
    """

    lane: int
    speed: float
    physics_hz: int


def missing(world: object) -> list[str]:
    """Return the names in :data:`REQUIRED` that a world lacks.

    Properties are not evaluated, because they may make an environment.
    """
    return [name for name in REQUIRED if not hasattr(type(world), name) and not hasattr(world, name)]


def lock_stepping(world: Any) -> LockStepping | None:
    """Return the world if it has ``rollout_batch`` and ``has_lock_step`` is not false, else None."""
    return world if hasattr(world, "rollout_batch") and getattr(world, "has_lock_step", True) else None


def resumable(world: Any) -> Resumable | None:
    """Return the world if its ``rollout`` has a parameter ``decisions``, else None."""
    try:
        return world if "decisions" in inspect.signature(world.rollout).parameters else None
    except (TypeError, ValueError):  # builtins without a signature
        return None


def gym_replaying(world: Any) -> GymReplaying | None:
    """Return the world if its own class defines ``rollout_in_gym``, else None.

    An inherited method does not count: a derived class may do anything in its ``rollout``, and the environment of its
    base class would not confirm that.
    """
    return world if "rollout_in_gym" in vars(type(world)) else None


def road_start(world: Any) -> RoadStart | None:
    """Return the ego's start that a world's ``start`` prescribes; None if any lane and speed is possible."""
    start: tuple[int, float] | None = getattr(world, "start", None)
    return None if start is None else RoadStart(*start, physics_hz=world.physics_hz)


def unused_roads(world: Any) -> frozenset[Meeting]:
    """Return the kinds of meetings with roads on which no NPC drives, if the world's own class states them.

    An inherited property does not count: in a derived class any vehicle may drive on these roads.
    """
    return world.unused_roads if "unused_roads" in vars(type(world)) else frozenset()


def crossings(world: Any) -> Crossings | None:
    """Return the ways on which other traffic meets the ego's way; None if the world states none."""
    found: Crossings | None = getattr(world, "crossings", None)
    return found


def most_on_grid(world: Any) -> int:
    """Return how many NPCs have a cell at the ego's prescribed start; 8 if the world prescribes no start."""
    start = road_start(world)
    return len(Cell) if start is None else next(n for n in range(len(Cell), -1, -1) if _has_cells(world, start, n))


def _has_cells(world: Any, start: RoadStart, npcs: int) -> bool:
    chains = tuple((PositionInstruction(cell, 0.0),) for cell in list(Cell)[:npcs])
    try:
        if npcs:
            check_fits(world, Scenario(npcs=chains, ego_lane=start.lane, ego_speed=start.speed, gene_seconds=1.0))
    except ScenarioError:
        return False
    return True


def straight_road(world: Any) -> StraightRoad | None:
    """Return the road of a world if it is a :class:`StraightRoad`, else None."""
    road = getattr(world, "road", None)
    return road if isinstance(road, StraightRoad) else None


def runs_in_kernel(world: Any, ads: Any) -> bool:
    """Return whether a world drives an ADS, or its factory, only in compiled code, so that a run takes milliseconds."""
    return bool(world.runs_in_kernel(ads)) if hasattr(world, "runs_in_kernel") else False


def reference_world(world: Any) -> ReferenceWorld | None:
    """Return the world if it has reference drivers, else None."""
    return world if hasattr(world, "rollout_reference") and hasattr(world, "reference_drivers") else None


def taking_over(world: Any) -> Callable[[Trace, int, str], Trace] | None:
    """Return a world's ``take_over``, which lets a reference driver take over during a run; None without."""
    found: Callable[[Trace, int, str], Trace] | None = getattr(world, "take_over", None)
    return found


def hang_limit(world: Any) -> float:
    """Return the longest decision of the ADS that a world allows, in wall-clock time [s]."""
    return float(getattr(world, "hang_limit", HANG_LIMIT))


def check_fits(world: Any, scenario: Scenario) -> None:
    """Check a scenario against a world, if it can do so without a run; its error names the field."""
    if hasattr(world, "check_fits"):
        world.check_fits(scenario)


def first_decision(world: Any, scenario: Scenario) -> FirstDecision | None:
    """Return a world's first decision in a scenario; None if it does not state one, or the run fails before it."""
    asked: FirstDecision | None = world.first_decision(scenario) if hasattr(world, "first_decision") else None
    return asked
