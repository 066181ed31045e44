"""The interface between a search and a world: members that every world has, and optional capabilities.

A user-defined world only needs to satisfy :class:`WorldLike`. For each optional capability that a search asks for, a
function in this module finds out whether a world has it, so that the search does not look at the world's class.
"""

from __future__ import annotations

import inspect
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import FunctionType
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from pytest_pafot.attribution.responses import FOLLOWING
from pytest_pafot.attribution.takeovers import STEADY_BRAKING
from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.scenario import PositionInstruction, Scenario, ScenarioError
from pytest_pafot.model.trace import Trace
from pytest_pafot.oracle.run import ReferenceWorld, Run
from pytest_pafot.support.errors import driven_by, plain_number
from pytest_pafot.world.driving.ads import AdsFactory, is_vehicle_class
from pytest_pafot.world.kernel.action import Drive
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.limits import HANG_LIMIT
from pytest_pafot.world.roads.network import Meeting
from pytest_pafot.world.roads.straight import StraightRoad

if TYPE_CHECKING:
    from pytest_pafot.searching.space import SearchSpace


@dataclass(frozen=True, slots=True)
class FirstDecision:
    """The input that an ADS receives at its first decision and the output that it must return, for error messages."""

    is_si: bool
    """True if the ADS receives a :class:`pafot.Observation`, and not an environment's own observation."""
    text: str
    """A sentence that states what the ADS receives and what it must return."""


def decision_asked(rollout: Callable[[Scenario, AdsFactory], Trace], scenario: Scenario) -> FirstDecision | None:
    """Find out by a run of ``scenario`` what an ADS receives and must return; return None if no decision is reached."""
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
        """The longest duration of a run [s]; a run of a shorter scenario ends earlier."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, /) -> Trace:
        """Simulate a scenario with a fresh ADS from ``ads_factory()``; equal scenarios give equal traces."""

    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain data: numbers, text, lists, mappings."""


class LockStepping(WorldLike, Protocol):
    """A world in which many runs can proceed together, one decision at a time."""

    def rollout_batch(self, scenarios: Sequence[Scenario], ads_factory: AdsFactory, /) -> list[Trace]:
        """Simulate scenarios with the traces of :meth:`WorldLike.rollout`, in lock step if the ADS has ``batch``."""


class Resumable(WorldLike, Protocol):
    """A world that accepts the first decisions of a run as an argument, in place of the ADS's own."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, /, *, decisions: Sequence[Any] = ()) -> Trace:
        """Simulate a scenario; ``decisions``, in the form of ``Trace.actions``, replace the first calls of the ADS."""


class Lasting(WorldLike, Protocol):
    """A world whose runs can go on after the end of their scenario, and after the world's own longest run."""

    def lasting(self, seconds: float, /) -> WorldLike:
        """Return a world in which a run lasts ``seconds``, and begins as in this world, to the last bit.

        An event such as a collision still ends a run earlier, and so may the road.
        """


class GymReplaying(WorldLike, Protocol):
    """A world whose runs can be repeated with ``env.step`` of a plain gymnasium environment."""

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory, /) -> Trace:
        """Simulate a scenario in gymnasium, to confirm a finding."""


class RoadStart(NamedTuple):
    """The lane and the speed with which the ego must start on a road.

    Attributes:
        lane: the ego's lane, counted from 0 at the left.
        speed: the ego's speed [m/s].
        physics_hz: ticks per second; a gene of a scenario for this road must last a whole number of ticks.
    """

    lane: int
    speed: float
    physics_hz: int


def missing(world: object) -> list[str]:
    """Return the names in :data:`REQUIRED` that a world lacks.

    Properties are not evaluated, because a property may make the world's environment.
    """
    return [name for name in REQUIRED if not hasattr(type(world), name) and not hasattr(world, name)]


def _fits_rollout(world: Any, name: str) -> bool:
    """Return whether a world has a method that runs scenarios like the world's own ``rollout``.

    A method of a base class does not, if a derived class has replaced the ``rollout`` that the method was written for:
    its runs would be those of the base class.
    """
    if not hasattr(world, name):
        return False
    classes = type(world).__mro__
    rollout, method = (
        next((n for n, each in enumerate(classes) if member in vars(each)), -1) for member in ("rollout", name)
    )
    replaced = [vars(each).get("rollout") for each in classes[rollout + 1 : method + 1]]
    return all(each is None or getattr(each, "__isabstractmethod__", False) for each in replaced)


def lock_stepping(world: Any) -> LockStepping | None:
    """Return the world if it can run scenarios in lock step, else None.

    It can if it has ``rollout_batch`` for its ``rollout``, unless its ``has_lock_step`` is false.
    """
    return world if _fits_rollout(world, "rollout_batch") and getattr(world, "has_lock_step", True) else None


def resumable(world: Any) -> Resumable | None:
    """Return the world if its ``rollout`` has a parameter ``decisions`` or passes any on, as ``**options``."""
    rollout = getattr(world.rollout, "__func__", world.rollout)
    takes = _takes_decisions if isinstance(rollout, FunctionType) else _takes_decisions.__wrapped__
    return world if takes(rollout) else None


@lru_cache(maxsize=16)  # a search asks before each run, and reading a signature takes as long as breeding a child
def _takes_decisions(rollout: Callable[..., Any]) -> bool:
    try:
        parameters = inspect.signature(rollout).parameters
    except (TypeError, ValueError):  # builtins without a signature
        return False
    return "decisions" in parameters or any(each.kind is each.VAR_KEYWORD for each in parameters.values())


@dataclass(frozen=True, slots=True)
class Abilities:
    """What a world can do in addition to ``rollout``, as far as a search uses it: the functions of this module."""

    world: Any

    @property
    def missing(self) -> list[str]:
        """The names that a search needs and the world lacks."""
        return missing(self.world)

    @property
    def crossings(self) -> Crossings | None:
        """The ways on which other traffic meets the ego's way; None if the world states none."""
        return crossings(self.world)

    @property
    def has_lane_instructions(self) -> bool:
        """True if NPCs can have Lane-Instructions."""
        return has_lane_instructions(self.world)

    @property
    def has_manoeuvres(self) -> bool:
        """True if NPCs can have manoeuvres."""
        return has_manoeuvres(self.world)

    @property
    def reference_drivers(self) -> tuple[str, ...]:
        """The names of the reference drivers, for ``rollout_reference``."""
        known = reference_world(self.world)
        return () if known is None else tuple(known.reference_drivers)

    @property
    def takes_over(self) -> tuple[str, ...]:
        """The names of the drivers that can take over in a run, for ``take_over``."""
        return takes_over(self.world)

    @property
    def steps_together(self) -> bool:
        """True if ``rollout_batch`` makes runs like those of ``rollout``."""
        return lock_stepping(self.world) is not None

    @property
    def is_resumable(self) -> bool:
        """True if ``rollout`` accepts the first decisions of a run, as ``decisions=``."""
        return resumable(self.world) is not None

    @property
    def lasting(self) -> Callable[[float], WorldLike] | None:
        """The method that gives the world with longer runs; None if it has none."""
        return lasting(self.world)

    @property
    def hang_limit(self) -> float:
        """The wall-clock time after which a decision of the ADS is interrupted [s]."""
        return hang_limit(self.world)

    def space(self, given: Mapping[str, Any]) -> SearchSpace:
        """Return the space of scenarios with the given fields that fits the world."""
        return space_of(self.world, given)

    def check_fits(self, scenario: Scenario) -> None:
        """Refuse a scenario that does not fit the world; the error names the field."""
        check_fits(self.world, scenario)

    @staticmethod
    def looks_si(actions: Sequence[Any]) -> bool:
        """Return whether all actions are a ``Drive`` or a pair of numbers; False if there are no actions."""
        return looks_si(actions)


def lasting(world: Any) -> Callable[[float], WorldLike] | None:
    """Return a world's ``lasting``, which gives the same world with longer runs; None if its class has none.

    A method that runs like a replaced ``rollout``, or that only an object of the class has, is not used: the world of
    longer runs would be another world.
    """
    found: Callable[[float], WorldLike] | None = None
    if hasattr(type(world), "lasting") and _fits_rollout(world, "lasting"):
        found = world.lasting
    return found


def gym_replaying(world: Any) -> GymReplaying | None:
    """Return the world if its own class defines ``rollout_in_gym``, else None.

    An inherited method is not used: a derived class may change ``rollout``, and the base class's environment would then
    repeat a different run.
    """
    return world if "rollout_in_gym" in vars(type(world)) else None


def road_start(world: Any) -> RoadStart | None:
    """Return the ego's start that a world's ``start`` prescribes; None if the ego may start in any lane and speed."""
    start: tuple[int, float] | None = getattr(world, "start", None)
    return None if start is None else RoadStart(*start, physics_hz=world.physics_hz)


def space_of(world: Any, given: Mapping[str, Any]) -> SearchSpace:
    """Return the space of scenarios with the given fields that fits a world, see ``space_on``."""
    from pytest_pafot.searching.space import space_on  # noqa: PLC0415  (slow to import, and many worlds need none)

    return space_on(world, given, road_start(world))


def unused_roads(world: Any) -> frozenset[Meeting]:
    """Return how roads without NPCs meet the ego's way (crossing, joining, oncoming), if the world's class states it.

    An inherited property is not used: in a derived class, any vehicle may drive on these roads.
    """
    return world.unused_roads if "unused_roads" in vars(type(world)) else frozenset()


def options_without_effect(world: Any, *, drives_itself: bool, simulates: bool) -> dict[str, list[str]]:
    """Return the given options of a world's environment that have no effect in a search, under what has it instead.

    Args:
        world: the world.
        drives_itself: true if the ADS is a vehicle class.
        simulates: true if the ADS gets the environment.
    """
    known = getattr(world, "options_without_effect", None)
    return {} if known is None else known(drives_itself=drives_itself, simulates=simulates)


def left_out(world: Any) -> dict[str, tuple[str, ...]]:
    """Return the methods of a world's environment that change its state, but are not called in runs of a policy."""
    found: dict[str, tuple[str, ...]] = getattr(world, "left_out", {})
    return found


def has_traffic_in_reset(world: Any) -> bool:
    """Return whether a reset of a world's environment changes its traffic, which has no effect on NPCs."""
    return getattr(world, "has_traffic_in_reset", False) is True


def crossings(world: Any) -> Crossings | None:
    """Return the ways on which other traffic meets the ego's way; None if the world states none."""
    found: Crossings | None = getattr(world, "crossings", None)
    return found


def acts_in_si(world: Any, ads: Any) -> bool:
    """Return whether an ADS, given by its factory, acts in SI units in a world, and not by an environment's actions."""
    return is_vehicle_class(ads) or getattr(world, "action_space", None) is None


def least_action_speed(world: Any) -> float:
    """Return the lowest speed to which actions in a world can slow the ego down [m/s]; 0 if the world states none."""
    return float(getattr(world, "least_action_speed", 0.0))


def most_on_grid(world: Any) -> int:
    """Return the largest number of NPCs with cells around the ego's prescribed start; 8 without a prescribed start."""
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
    """Return whether a world drives ``ads``, an ADS or its factory, without Python code in each tick.

    A run then takes about a millisecond.
    False if that is not known before the run, such as of a factory that returns a vehicle class.
    """
    return bool(world.runs_in_kernel(ads)) if hasattr(world, "runs_in_kernel") else False


def has_traffic_styles(world: Any) -> bool:
    """Return whether NPCs in a world keep to the style ``scenario.traffic``, which the world declares."""
    return getattr(world, "has_traffic_styles", False) is True


def has_manoeuvres(world: Any) -> bool:
    """Return whether the NPCs of a world can have manoeuvres."""
    return getattr(world, "has_manoeuvres", False) is True


def has_lane_instructions(world: Any) -> bool:
    """Return whether NPCs in a world can have Lane-Instructions, which the world declares."""
    return getattr(world, "has_lane_instructions", False) is True


def reference_world(world: Any) -> ReferenceWorld | None:
    """Return the world if it has reference drivers, in runs like those of its ``rollout``, else None."""
    return world if _fits_rollout(world, "rollout_reference") and hasattr(world, "reference_drivers") else None


def takes_over(world: Any) -> tuple[str, ...]:
    """Return the names of drivers with which a world declares that its ``take_over`` can be called."""
    if not _fits_rollout(world, "take_over"):
        return ()
    return (*getattr(world, "reference_drivers", ()), *getattr(world, "takes_over", ()))


@dataclass(frozen=True, slots=True)
class TakingOver:
    """The ability of a world to repeat a run in which a driver takes over from the ego.

    Attributes:
        world: the world.
        drivers: the names with which it may be called.
        by_decisions: True if ``steady-braking`` is not a driver of the world, but an ADS that brakes after the recorded
            decisions.
    """

    world: Any
    drivers: tuple[str, ...]
    by_decisions: bool

    def __call__(self, trace: Trace, tick: int, name: str) -> Trace:
        """Simulate a run again, with a driver by name in the ego's place from a tick on.

        Raises:
            DriverError: if the world raises, or does not return a trace.
        """
        is_by_decisions = self.by_decisions and name == STEADY_BRAKING
        with driven_by(self.world, "rollout(decisions=...)" if is_by_decisions else "take_over", name):
            if is_by_decisions:
                first = trace.actions[: bisect_left(trace.decision_ticks, tick)]
                taken = self.world.rollout(trace.scenario, lambda: lambda *seen: BRAKING, decisions=first)
            else:
                taken = self.world.take_over(trace, tick, name)
            if not isinstance(taken, Trace):
                raise TypeError(f"expected a pafot.Trace, received {taken!r:.100}")
        return taken

    def lasting(self, seconds: float) -> TakingOver | None:
        """Return the ability to repeat runs that last some seconds; None if the world cannot go on.

        Raises:
            DriverError: if the world's ``lasting`` raises, or does not return a world.
        """
        make = lasting(self.world)
        if make is None:
            return None
        with driven_by(self.world, "lasting"):
            longer = make(seconds)
            if missing(longer):
                raise TypeError(f"expected a world, received {longer!r:.100}")
        return replace(self, world=longer)


BRAKING = (-FOLLOWING.deceleration, 0.0)
"""The action that brakes steadily without steering, for an ADS that acts in SI units [m/s^2, rad]."""


def taking_over(world: Any, trace: Trace) -> TakingOver | None:
    """Return how drivers can take over in a run of a world; None if no driver can.

    The drivers are those that the world declares: its ``reference_drivers``, and names in its optional ``takes_over``,
    which are not reference drivers. If ``steady-braking`` is none of them, it is an ADS that brakes after the recorded
    decisions. This needs a world that accepts ``decisions``, and an ADS whose actions look like SI units. Whether they
    are is seen only in the run, in which the ego brakes at that rate or not.
    """
    declared = takes_over(world)
    by_decisions = STEADY_BRAKING not in declared and resumable(world) is not None and looks_si(trace.actions)
    drivers = (*declared, STEADY_BRAKING) if by_decisions else declared
    return TakingOver(world, drivers, by_decisions) if drivers else None


def run_of(world: Any, trace: Trace, decision_limit: float | None = None) -> Run:
    """Return a trace that was made in a world as a test function sees it."""
    take_over = taking_over(world, trace)
    return Run(trace, decision_limit=decision_limit, world=reference_world(world), take_over=take_over)


def looks_si(actions: Sequence[Any]) -> bool:
    """Return whether all actions are a ``Drive`` or a pair of numbers; False if there are no actions."""
    return bool(actions) and all(
        isinstance(action, Drive)
        or (
            isinstance(action, (tuple, list, np.ndarray))
            and np.shape(action) == (2,)
            and all(plain_number(value) is not None for value in action)
        )
        for action in actions
    )


def hang_limit(world: Any) -> float:
    """Return the wall-clock time after which a world interrupts a decision of the ADS [s]."""
    return float(getattr(world, "hang_limit", HANG_LIMIT))


def check_fits(world: Any, scenario: Scenario) -> None:
    """Refuse a scenario that does not fit a world; the error names the field. Some worlds have no such check."""
    if hasattr(world, "check_fits"):
        world.check_fits(scenario)


def first_decision(world: Any, scenario: Scenario) -> FirstDecision | None:
    """Describe the first decision of an ADS in a world; return None if the world cannot, or fails before it."""
    asked: FirstDecision | None = world.first_decision(scenario) if hasattr(world, "first_decision") else None
    return asked
