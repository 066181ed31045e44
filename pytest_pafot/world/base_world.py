"""A world as a search sees it: what every world has, and what it can do in addition.

A user's world only needs to satisfy :class:`WorldLike`. ``guard/own_worlds.py:base_world`` makes it a
:class:`BaseWorld` once, before the search begins, so that no code of the search asks what a world's class is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from pytest_pafot.attribution.responses import FOLLOWING
from pytest_pafot.attribution.takeovers import STEADY_BRAKING
from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.grid import Cell
from pytest_pafot.model.instructions import PositionInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import driven_by, plain_number
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.kernel.action import Drive
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.limits import HANG_LIMIT
from pytest_pafot.world.roads.road import Meeting
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


class BaseWorld(ABC):
    """A world as a search sees it. What a world lacks is as here."""

    @property
    @abstractmethod
    def speed_limit(self) -> float:
        """The highest target speed of NPCs [m/s]."""

    @property
    @abstractmethod
    def longest_run(self) -> float:
        """The longest duration of a run [s]; a run of a shorter scenario ends earlier."""

    @abstractmethod
    def rollout(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario with a fresh ADS. A decision that exceeds :attr:`hang_limit` ends the run."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the world as plain data: numbers, text, lists, mappings."""

    @property
    def given(self) -> Any:
        """The world as the user gave it."""
        return self

    @property
    def missing(self) -> tuple[str, ...]:
        """The names in :data:`REQUIRED` that the world lacks; without them it is no world."""
        return ()

    @property
    def hang_limit(self) -> float:
        """The wall-clock time after which a decision of the ADS is interrupted [s]."""
        return HANG_LIMIT

    # The road, and how the ego starts and acts on it.

    @property
    def road_start(self) -> RoadStart | None:
        """The ego's start that the road prescribes; None if the ego may start in any lane and at any speed."""
        return None

    @property
    def straight_road(self) -> StraightRoad | None:
        """The road if it is straight, else None."""
        return None

    @property
    def crossings(self) -> Crossings | None:
        """The ways on which other traffic meets the ego's way; None if the world states none."""
        return None

    @property
    def unused_roads(self) -> frozenset[Meeting]:
        """The ways in which roads without NPCs meet the ego's way: crossing, joining, oncoming."""
        return frozenset()

    @property
    def action_space(self) -> Any:
        """The gymnasium space of actions; None if the ADS acts in SI units."""
        return None

    @property
    def left_out(self) -> Mapping[str, tuple[str, ...]]:
        """The methods of the environment that change its state, but are not called in runs of a policy."""
        return {}

    def options_without_effect(self, *, drives_itself: bool, simulates: bool = False) -> dict[str, list[str]]:
        """Return the given options of the environment that have no effect in a search, under what has it instead.

        Args:
            drives_itself: true if the ADS is a vehicle class.
            simulates: true if the ADS gets the environment.
        """
        return {}

    # What NPCs can do.

    has_traffic_styles: bool = False
    """True if NPCs keep to the style ``scenario.traffic``."""

    has_lane_instructions: bool = False
    """True if NPCs can have Lane-Instructions."""

    def can_drive(self, vehicle: VehicleType) -> bool:
        """Return whether an NPC that does not cross can be a given vehicle; without more knowledge, only a car."""
        return vehicle == CAR

    @property
    def packages(self) -> tuple[str, ...]:
        """The names of the installed packages whose versions change runs, in addition to those of every world."""
        return ()

    # How runs can be made, in addition to ``rollout``.

    @property
    def is_resumable(self) -> bool:
        """True if ``rollout`` accepts the first decisions of a run, as ``decisions=``."""
        return False

    @property
    def can_go_on(self) -> bool:
        """True if runs can go on after the end of their scenario, by :meth:`lasting`."""
        return False

    def lasting(self, seconds: float) -> BaseWorld:
        """Return a world in which a run lasts some seconds, and begins as in this world, to the last bit.

        An event such as a collision still ends a run earlier, and so may the road.
        """
        raise NotImplementedError

    @property
    def replays_in_gym(self) -> bool:
        """True if :meth:`rollout_in_gym` repeats a run with ``env.step`` of a plain gymnasium environment."""
        return False

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario in gymnasium, to confirm a finding."""
        raise NotImplementedError

    @property
    def reference_drivers(self) -> tuple[str, ...]:
        """The names of the reference drivers, for :meth:`rollout_reference`."""
        return ()

    def rollout_reference(self, scenario: Scenario, name: str) -> Trace:
        """Simulate a scenario with a reference driver in the ego's place."""
        raise NotImplementedError

    @property
    def drivers(self) -> tuple[str, ...]:
        """The names of the drivers that can take over in a run, by :meth:`take_over`."""
        return ()

    def take_over(self, trace: Trace, tick: int, name: str) -> Trace:
        """Simulate a run again, with a driver in the ego's place from a tick on."""
        raise NotImplementedError

    def runs_in_kernel(self, ads: Any) -> bool:
        """Return whether ``ads``, an ADS or its factory, is driven without Python code in each tick.

        A run then takes about a millisecond. False if that is not known before the run, such as of a factory that
        returns a vehicle class.
        """
        return False

    def check_fits(self, scenario: Scenario) -> None:  # noqa: B027  (some worlds have no such check)
        """Refuse a scenario that does not fit the world; the error names the field."""

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """Describe the first decision of an ADS; return None if the world cannot, or the run fails before it."""
        return None

    # What follows from these.

    def space(self, given: Mapping[str, Any]) -> SearchSpace:
        """Return the space of scenarios with the given fields that fits the world, see ``space_on``."""
        from pytest_pafot.searching.space import space_on  # noqa: PLC0415  (slow to import, and many worlds need none)

        return space_on(float(self.speed_limit), float(self.longest_run), given, self.road_start)

    @property
    def most_on_grid(self) -> int:
        """The largest number of NPCs with cells around the ego's prescribed start; 8 without a prescribed start."""
        start = self.road_start
        return len(Cell) if start is None else next(n for n in range(len(Cell), -1, -1) if self._has_cells(start, n))

    def _has_cells(self, start: RoadStart, npcs: int) -> bool:
        chains = tuple((PositionInstruction(cell, 0.0),) for cell in list(Cell)[:npcs])
        try:
            if npcs:
                self.check_fits(Scenario(npcs=chains, ego_lane=start.lane, ego_speed=start.speed, gene_seconds=1.0))
        except ScenarioError:
            return False
        return True

    def run_of(self, trace: Trace) -> Run:
        """Return a trace that was made in this world as a test function sees it."""
        world = self.given if self.reference_drivers else None
        return Run(trace, world=world, take_over=self.taking_over(trace))

    def taking_over(self, trace: Trace) -> TakingOver | None:
        """Return how drivers can take over in a run of this world; None if no driver can.

        If ``steady-braking`` is none of :attr:`drivers`, it is an ADS that brakes after the recorded decisions. This
        needs a world that accepts ``decisions``, and an ADS whose actions look like SI units. Whether they are is seen
        only in the run, in which the ego brakes at that rate or not.
        """
        declared = self.drivers
        by_decisions = STEADY_BRAKING not in declared and self.is_resumable and self.looks_si(trace.actions)
        drivers = (*declared, STEADY_BRAKING) if by_decisions else declared
        return TakingOver(self, drivers, by_decisions) if drivers else None

    @staticmethod
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


@dataclass(frozen=True, slots=True)
class TakingOver:
    """The ability of a world to repeat a run in which a driver takes over from the ego.

    Attributes:
        world: the world.
        drivers: the names with which it may be called.
        by_decisions: True if ``steady-braking`` is not a driver of the world, but an ADS that brakes after the recorded
            decisions.
    """

    world: BaseWorld
    drivers: tuple[str, ...]
    by_decisions: bool

    def __call__(self, trace: Trace, tick: int, name: str) -> Trace:
        """Simulate a run again, with a driver by name in the ego's place from a tick on.

        Raises:
            DriverError: if the world raises, or does not return a trace.
        """
        is_by_decisions = self.by_decisions and name == STEADY_BRAKING
        with driven_by(self.world.given, "rollout(decisions=...)" if is_by_decisions else "take_over", name):
            taken: object
            if is_by_decisions:
                first = trace.actions[: bisect_left(trace.decision_ticks, tick)]
                resumed: Callable[..., object] = self.world.rollout  # which accepts decisions: the world is resumable
                taken = resumed(trace.scenario, lambda: lambda *seen: BRAKING, decisions=first)
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
        if not self.world.can_go_on:
            return None
        with driven_by(self.world.given, "lasting"):
            longer = self.world.lasting(seconds)
            if longer.missing:
                raise TypeError(f"expected a world, received {longer!r:.100}")
        return replace(self, world=longer)


BRAKING = (-FOLLOWING.deceleration, 0.0)
"""The action that brakes steadily without steering, for an ADS that acts in SI units [m/s^2, rad]."""
