"""The worlds of users as a search sees them: what they declare, and a time limit for each decision."""

from __future__ import annotations

import inspect
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache, partial, wraps
from types import FunctionType, MappingProxyType
from typing import Any

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world.base_world import REQUIRED, BaseWorld, BuiltInWorld, FirstDecision, Highway, RoadStart
from pytest_pafot.world.driving.policy import AdsFactory, is_vehicle_class, rewrapped
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard, error_of, patience_with_world, unending
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.limits import HANG_LIMIT
from pytest_pafot.world.roads.road import Meeting, StraightRoad
from pytest_pafot.world.simulator_world import SimulatorWorld


class Hang(Exception):  # noqa: N818  (a world that records the name of the exception then names what happened)
    """The end of a decision that exceeds the hang limit, as the code of a user's world sees it."""


def base_world(world: Any) -> BaseWorld:
    """Return a world as a search sees it: itself if it is one of this package, else an :class:`OwnWorld` around it.

    A world of a class that a user has derived from ours is the user's, because it may do anything.
    """
    if isinstance(world, BaseWorld) and (
        not isinstance(world, BuiltInWorld) or type(world) in (Highway, World, SimulatorWorld)
    ):
        return world
    return OwnWorld(world)


def rollout_of(world: Any, method: str = "rollout") -> Callable[..., Any]:
    """Return the ``rollout`` of any world, with seeded global generators, or another method of it that makes runs.

    Decisions that hang are ended: by the world, or else here.
    """
    return partial(GENERATORS.run, getattr(base_world(world), method))


def _declared(name: str, default: object) -> Any:
    """Return a property with what a world of the user's states under a name, or else the default."""
    return property(lambda self: getattr(self.world, name, default))


def _passed_on(name: str) -> Any:
    """Return a property with a method of a world of the user's, which must have it."""
    return property(lambda self: getattr(self.world, name))


def _is_declared(name: str) -> Any:
    """Return a property that is true only if a world of the user's has True under a name."""
    return property(lambda self: getattr(self.world, name, False) is True)


@dataclass(frozen=True, slots=True, repr=False)
class OwnWorld(BaseWorld):
    """A user's world as a search sees it, with guarded decisions.

    What it declares is only used where it is about its own ``rollout``: a method of a base class runs scenarios like
    the ``rollout`` that it was written for, which a derived class may have replaced.
    """

    world: Any

    def __repr__(self) -> str:
        return repr(self.world)

    @property
    def given(self) -> Any:
        """The world as the user gave it."""
        return self.world

    @property
    def missing(self) -> tuple[str, ...]:
        """The names in :data:`REQUIRED` that the world lacks.

        Properties are not evaluated, because a property may make the world's environment. A class lacks all.
        """
        if isinstance(self.world, type):
            return REQUIRED
        lacks = lambda name: not hasattr(type(self.world), name) and not hasattr(self.world, name)  # noqa: E731
        return tuple(filter(lacks, REQUIRED))

    @property
    def speed_limit(self) -> float:
        """The highest target speed of NPCs [m/s]."""
        return float(self.world.speed_limit)

    @property
    def longest_run(self) -> float:
        """The longest duration of a run [s]."""
        return float(self.world.longest_run)

    @property
    def hang_limit(self) -> float:
        """The wall-clock time after which a decision of the ADS is interrupted [s]."""
        return float(getattr(self.world, "hang_limit", HANG_LIMIT))

    to_dict = _passed_on("to_dict")
    """Return the world as plain data."""

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, **given: Any) -> Trace:
        """Simulate a scenario; ``given`` are further arguments of the world's ``rollout``.

        Each decision is interrupted after :attr:`hang_limit`, unless the world does so itself. The world sees a
        :class:`Hang` then, and again at each further call of this ADS. However the world records that, the outcome of
        the run is ``hang``.

        Raises:
            Hang: if the world does not catch exceptions of the ADS.
            Exception: any exception of the world or of the factory.
        """
        __tracebackhide__ = True
        # An inherited statement is not used, because a derived class may call the ADS in a `rollout` of its own.
        if vars(type(self.world)).get("guards_ads", False) is True:  # the class says that it ends decisions that hang
            trace: Trace = self.world.rollout(scenario, ads_factory, **given)
        else:
            with _Watch(self.hang_limit, len(given.get("decisions", ()))) as watch:
                trace = watch.told(self.world.rollout(scenario, watch.guarded(ads_factory), **given))
        if isinstance(trace, Trace) and trace.outcome is Outcome.SAFE and not trace.ended:
            # A run that ends early and does not say why must not look like one that lasted.
            planned = min(scenario.seconds, getattr(self.world, "longest_run", 0.0))
            if trace.duration < planned - 1 / trace.ads_hz:
                return replace(trace, ended=f"{type(self.world).__name__}.rollout")
        return trace

    def _runs_alike(self, name: str) -> bool:
        """Return whether the world has a method that runs scenarios like its ``rollout``."""
        if not hasattr(self.world, name):
            return False
        classes = type(self.world).__mro__
        rollout, method = (
            next((n for n, each in enumerate(classes) if member in vars(each)), -1) for member in ("rollout", name)
        )
        replaced = [vars(each).get("rollout") for each in classes[rollout + 1 : method + 1]]
        return all(each is None or getattr(each, "__isabstractmethod__", False) for each in replaced)

    @property
    def road_start(self) -> RoadStart | None:
        """The ego's start that the world's ``start`` prescribes."""
        start: tuple[int, float] | None = getattr(self.world, "start", None)
        return None if start is None else RoadStart(*start, physics_hz=self.world.physics_hz)

    @property
    def straight_road(self) -> StraightRoad | None:
        """The world's ``road`` if it is a :class:`StraightRoad`."""
        road = getattr(self.world, "road", None)
        return road if isinstance(road, StraightRoad) else None

    crossings = _declared("crossings", None)
    """The ways on which other traffic meets the ego's way."""

    @property
    def unused_roads(self) -> frozenset[Meeting]:
        """The ways in which roads without NPCs meet the ego's way, if the world's class itself states them.

        An inherited property is not used: in a derived class, any vehicle may drive on these roads.
        """
        return self.world.unused_roads if "unused_roads" in vars(type(self.world)) else frozenset()

    action_space = _declared("action_space", None)
    """The gymnasium space of actions."""

    left_out = _declared("left_out", MappingProxyType({}))
    """The methods of the environment that change its state, but are not called in runs of a policy."""

    def options_without_effect(self, *, drives_itself: bool, simulates: bool = False) -> dict[str, list[str]]:
        """Return the given options of the environment that have no effect in a search."""
        known = getattr(self.world, "options_without_effect", None)
        return {} if known is None else known(drives_itself=drives_itself, simulates=simulates)

    has_traffic_styles = _is_declared("has_traffic_styles")
    """True if the world declares that NPCs keep to the style ``scenario.traffic``."""

    has_lane_instructions = _is_declared("has_lane_instructions")
    """True if the world declares that NPCs can have Lane-Instructions."""

    def can_drive(self, vehicle: VehicleType) -> bool:
        """Return whether the world declares that NPCs can be any vehicle; if it does not, they are cars."""
        return vehicle == CAR or getattr(self.world, "has_vehicles", False) is True

    @property
    def is_resumable(self) -> bool:
        """True if ``rollout`` has a parameter ``decisions`` or passes any on, as ``**options``."""
        rollout = getattr(self.world.rollout, "__func__", self.world.rollout)
        takes = _takes_decisions if isinstance(rollout, FunctionType) else _takes_decisions.__wrapped__
        return bool(takes(rollout))

    @property
    def can_go_on(self) -> bool:
        """True if the world's class has ``lasting`` for its ``rollout``.

        A method that only an object of the class has is not used: it may be another world's.
        """
        return hasattr(type(self.world), "lasting") and self._runs_alike("lasting")

    def lasting(self, seconds: float) -> BaseWorld:
        """Return what the world's ``lasting`` returns, which may be no world."""
        return base_world(self.world.lasting(seconds))

    @property
    def replays_in_gym(self) -> bool:
        """True if the world's own class defines ``rollout_in_gym``.

        An inherited method is not used: a derived class may change ``rollout``, and the base class's environment would
        then repeat a different run.
        """
        return "rollout_in_gym" in vars(type(self.world))

    rollout_in_gym = _passed_on("rollout_in_gym")
    """Simulate a scenario in gymnasium."""

    @property
    def takes_over(self) -> tuple[str, ...]:
        """The names of drivers with which the world declares that its ``take_over`` can be called."""
        return tuple(getattr(self.world, "takes_over", ())) if self._runs_alike("take_over") else ()

    take_over = _passed_on("take_over")
    """Simulate a run again, with a driver in the ego's place from a tick on."""

    def runs_in_kernel(self, ads: Any) -> bool:
        """Return whether ``ads`` is driven without Python code in each tick."""
        return bool(self.world.runs_in_kernel(ads)) if hasattr(self.world, "runs_in_kernel") else False

    def check_fits(self, scenario: Scenario) -> None:
        """Refuse a scenario that does not fit the world, if the world can."""
        if hasattr(self.world, "check_fits"):
            self.world.check_fits(scenario)

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """Describe the first decision of an ADS; return None if the world cannot, or the run fails before it."""
        describe: Callable[[Scenario], FirstDecision | None] | None = getattr(self.world, "first_decision", None)
        return None if describe is None else describe(scenario)


@lru_cache(maxsize=16)  # a search asks before each run, and reading a signature takes as long as breeding a child
def _takes_decisions(rollout: Callable[..., Any]) -> bool:
    try:
        parameters = inspect.signature(rollout).parameters
    except (TypeError, ValueError):  # builtins without a signature
        return False
    return "decisions" in parameters or any(each.kind is each.VAR_KEYWORD for each in parameters.values())


class _WorldGuard(HangGuard):
    """A guard that also knows how long the world has not asked the ADS."""

    def __init__(self, limit: float) -> None:
        super().__init__(limit)
        self.turned = self.clock()
        self._patience = patience_with_world(limit)

    def is_stuck(self) -> bool:
        """Return whether the world has neither asked the ADS nor ended its run for too long."""
        return self.started is None and self.clock() - self.turned > self._patience


class _Watch:
    """The guard of the ADSs of one run, in any thread in which the world calls them.

    Attributes:
        decisions: the number of decisions so far, including those that were given to the world.
        hang: the error of a decision that was interrupted; None if there was none.
        is_cut: True if the time of the search is over. The run ends with ``OutOfTime`` then, when its world ends it.
    """

    def __init__(self, limit: float, decisions: int) -> None:
        self.decisions = decisions
        self.hang: AdsError | None = None
        self.is_cut = False
        self._limit = limit
        self._guards: dict[int, _WorldGuard] = {}
        self._stack = ExitStack()

    def __enter__(self) -> _Watch:
        # Entered before the run, since a built-in world inside a user's world has a guard of its own, which must end
        # before this one.
        self._guard()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, rest: object) -> None:
        self._stack.__exit__(kind, error, None)
        if isinstance(error, AdsHang):  # in the world's own code, which waits for an ADS in another thread
            raise Hang(str(error)) from None
        if self.is_cut and isinstance(error, Exception):
            raise OutOfTime from None

    def guarded(self, factory: Callable[..., Any]) -> Callable[..., Any]:
        """Return a factory of the same ADSs under guard. Vehicle classes drive themselves, inside a built-in world."""
        if is_vehicle_class(factory):
            return factory

        @wraps(factory, updated=())
        def make(*arguments: Any, **named: Any) -> Any:
            __tracebackhide__ = True
            with unending():
                ads = factory(*arguments, **named)
            if is_vehicle_class(ads) or not callable(ads):
                return ads
            return rewrapped(ads, lambda inner: _GuardedAds(inner, self))

        return make

    def call(self, ads: Callable[..., Any], *seen: Any, **named: Any) -> Any:
        """Call an ADS under guard.

        Raises:
            Hang: if it was interrupted, now or in an earlier call of this run, or if the time of the search is over.
            Exception: any exception of the ADS.
        """
        __tracebackhide__ = True
        if self.hang is not None or self.is_cut:
            raise Hang("the time limit of the search is over" if self.hang is None else self.hang.message)
        guard = self._guard()
        started = guard.clock()
        try:
            try:
                with guard.decision():
                    action = ads(*seen, **named)
            finally:
                guard.turned = guard.clock()
        except OutOfTime as error:  # for the world an error like others, since it may ask in a thread
            self.is_cut = True
            raise Hang("the time limit of the search is over") from error
        except AdsHang as error:
            if guard.clock() - started <= guard.limit:  # of the guard of a built-in world around this one
                raise
            self.hang = error_of(error, 0, guard)
            raise Hang(self.hang.message) from None
        self.decisions += 1
        return action

    def told(self, trace: Trace) -> Trace:
        """Return the trace of the run, with the outcome ``hang`` if a decision was interrupted.

        Raises:
            OutOfTime: if the time of the search is over, although the world has caught that.
        """
        if self.is_cut:
            raise OutOfTime
        if self.hang is None or not isinstance(trace, Trace):
            return trace
        asked = self.decisions * (trace.physics_hz // trace.ads_hz)
        if self.decisions < len(trace.decided):
            asked = trace.decided[self.decisions]
        tick = min(asked, trace.ticks) if trace.error is None else trace.error.tick
        return replace(trace, outcome=Outcome.HANG, collision=None, error=replace(self.hang, tick=tick))

    def _guard(self) -> _WorldGuard:
        thread = threading.get_ident()
        if thread not in self._guards:
            self._guards[thread] = self._stack.enter_context(_WorldGuard(self._limit))
        return self._guards[thread]


class _GuardedAds:
    """An ADS under guard. All of its attributes are those of the ADS, also those that a world sets."""

    def __init__(self, ads: Callable[..., Any], watch: _Watch) -> None:
        object.__setattr__(self, "_ads", ads)
        object.__setattr__(self, "_watch", watch)

    def __call__(self, *seen: Any, **named: Any) -> Any:
        """Call the ADS."""
        __tracebackhide__ = True
        return self._watch.call(self._ads, *seen, **named)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute of the ADS."""
        setattr(self._ads, name, value)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the ADS."""
        return getattr(self._ads, name)
