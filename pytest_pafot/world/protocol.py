"""What a search asks of a world: what each one has, and what some can do besides.

A world of the user's own needs to be no more than :class:`WorldLike`. Each capability beyond that has a function here
that finds it; nobody else looks for methods or classes of worlds.
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

# What an ADS is given at its first decision and must return, for the message where it fails there.


@dataclass(frozen=True, slots=True)
class FirstDecision:
    """How a world asks an ADS."""

    is_si: bool
    """Whether the ADS is given a :class:`pafot.Observation`, rather than an environment's own."""
    text: str
    """A sentence that says what it is given and must return."""


def decision_asked(rollout: Callable[[Scenario, AdsFactory], Trace], scenario: Scenario) -> FirstDecision | None:
    """How a world, by its ``rollout``, asks at first in a scenario; None where it does not come so far."""
    seen: list[Any] = []
    trace = rollout(scenario, lambda: seen.append)  # returns None, so that the message says what is expected
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
"""What :class:`WorldLike` has."""


class WorldLike(Protocol):
    """What a search needs of any world."""

    @property
    def speed_limit(self) -> float:
        """Highest target speed of NPCs [m/s]."""

    @property
    def longest_run(self) -> float:
        """How long a run lasts that nothing ends early [s]."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, /) -> Trace:
        """Simulate a scenario with a fresh ADS, which ``ads_factory()`` gives; equal scenarios give equal traces."""

    def to_dict(self) -> dict[str, Any]:
        """The world as plain data: numbers, text, lists, mappings."""


class LockStepping(WorldLike, Protocol):
    """A world in which many runs go from decision to decision together."""

    def rollout_batch(self, scenarios: Sequence[Scenario], ads_factory: AdsFactory, /) -> list[Trace]:
        """The traces of :meth:`WorldLike.rollout`, in lock step where the ADS has a method ``batch``."""


class Resumable(WorldLike, Protocol):
    """A world that can be given the first decisions of a run."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, /, *, decisions: Sequence[Any] = ()) -> Trace:
        """Simulate a scenario; the ADS is not asked for ``decisions``, which are as ``Trace.actions`` has them."""


class GymReplaying(WorldLike, Protocol):
    """A world whose runs can be driven a second time, by ``env.step`` of a plain gymnasium environment."""

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory, /) -> Trace:
        """Simulate a scenario by other means, to confirm a find."""


class RoadStart(NamedTuple):
    """How the ego starts where its road says so: its lane, counted from 0 at the left, and its speed [m/s].

    There are ``physics_hz`` ticks per second, in whole numbers of which genes last.
    """

    lane: int
    speed: float
    physics_hz: int


def missing(world: object) -> list[str]:
    """What a world lacks of :data:`REQUIRED`; properties, which may make an environment, are not evaluated."""
    return [name for name in REQUIRED if not hasattr(type(world), name) and not hasattr(world, name)]


def lock_stepping(world: Any) -> LockStepping | None:
    """The world, where its runs can take place in lock step, which its ``has_lock_step`` may deny."""
    return world if hasattr(world, "rollout_batch") and getattr(world, "has_lock_step", True) else None


def resumable(world: Any) -> Resumable | None:
    """The world, where its ``rollout`` takes ``decisions``."""
    try:
        return world if "decisions" in inspect.signature(world.rollout).parameters else None
    except (TypeError, ValueError):  # builtins without a signature
        return None


def gym_replaying(world: Any) -> GymReplaying | None:
    """The world, where its own class says how to replay in gymnasium.

    What it inherits does not count: a class that derives from a world may do anything in its ``rollout``, which that
    world's environment would not confirm.
    """
    return world if "rollout_in_gym" in vars(type(world)) else None


def road_start(world: Any) -> RoadStart | None:
    """How the ego starts where the road of a world says so, by its ``start``; None where any lane and speed will do."""
    start: tuple[int, float] | None = getattr(world, "start", None)
    return None if start is None else RoadStart(*start, physics_hz=world.physics_hz)


def unused_roads(world: Any) -> frozenset[Meeting]:
    """Return how roads meet the ego's way in a world on which no NPC drives, where its own class says so.

    What it inherits does not count: a class that derives from a world may have anybody drive anywhere.
    """
    return world.unused_roads if "unused_roads" in vars(type(world)) else frozenset()


def crossings(world: Any) -> Crossings | None:
    """Return the ways of a world on which other traffic meets the ego's, where it says so; None without."""
    found: Crossings | None = getattr(world, "crossings", None)
    return found


def most_on_grid(world: Any) -> int:
    """Return how many NPCs have a cell to start in where the road of a world has the ego start; 8 where it does not."""
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
    """The road of a world, where that is straight and the world says so."""
    road = getattr(world, "road", None)
    return road if isinstance(road, StraightRoad) else None


def runs_in_kernel(world: Any, ads: Any) -> bool:
    """Whether a world drives an ADS, or its factory, in compiled code alone, and so runs in a few milliseconds."""
    return bool(world.runs_in_kernel(ads)) if hasattr(world, "runs_in_kernel") else False


def reference_world(world: Any) -> ReferenceWorld | None:
    """The world, where it has reference drivers."""
    return world if hasattr(world, "rollout_reference") and hasattr(world, "reference_drivers") else None


def taking_over(world: Any) -> Callable[[Trace, int, str], Trace] | None:
    """What has a reference driver take over in the midst of a run in a world, where it can."""
    found: Callable[[Trace, int, str], Trace] | None = getattr(world, "take_over", None)
    return found


def hang_limit(world: Any) -> float:
    """Longest decision of the ADS in wall-clock time [s]."""
    return float(getattr(world, "hang_limit", HANG_LIMIT))


def check_fits(world: Any, scenario: Scenario) -> None:
    """Check a scenario against a world, where it can do so without a run; its error names the field."""
    if hasattr(world, "check_fits"):
        world.check_fits(scenario)


def first_decision(world: Any, scenario: Scenario) -> FirstDecision | None:
    """How a world asks an ADS at first in a scenario; None where it does not tell, or does not come so far."""
    asked: FirstDecision | None = world.first_decision(scenario) if hasattr(world, "first_decision") else None
    return asked
