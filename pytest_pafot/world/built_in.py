"""The common base of :class:`pytest_pafot.Highway` and :class:`pytest_pafot.World`, with runs of reference drivers."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, Self, cast

from pytest_pafot.attribution.avoidance import HARDEST
from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR, VehicleName, VehicleType
from pytest_pafot.support.errors import FieldError, WorldError
from pytest_pafot.world.base_world import BaseWorld, FirstDecision, RoadStart, decision_asked
from pytest_pafot.world.engines.egos import planner_run
from pytest_pafot.world.engines.run import OwnEnds, VehiclesOfRun
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.limits import TOP_SPEED, NpcLimits
from pytest_pafot.world.reference_drivers import REFERENCES, TAKING_OVER, ReferenceDriver
from pytest_pafot.world.roads.road import Road
from pytest_pafot.world.roads.straight import StraightRoad
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.validation import number_within

WATCHED = 6.0
"""The time for which a reference driver watches before it takes over [s], long enough to notice every vehicle."""


class RecordedBody(Body):
    """The ego of a recorded run: it repeats the recorded states up to a tick, and afterwards obeys its controls.

    The states up to the tick are equal to the last bit for every kind of ADS. Repeating the ADS's decisions instead
    would achieve that only for planners.
    """

    def __init__(self, trace: Trace, tick: int) -> None:
        super().__init__(*trace.sizes[0])
        self._rows = iter(trace.ego[1 : tick + 1].tolist())

    def step(self, dt: float) -> None:
        """Take the state of the next recorded tick; after the last recorded tick, move like any body."""
        row = next(self._rows, None)
        if row is None:
            super().step(dt)
            return
        self.place(*row[:4])
        self.acceleration, self.steering = row[4:6]


@dataclass(slots=True)
class Relief:
    """A reference driver that takes over at ``time`` [s]; shortly before, it only watches."""

    driver: ReferenceDriver
    time: float

    def __call__(self, observation: Observation) -> tuple[float, float]:
        """Return the driver's acceleration [m/s^2] and steering [rad]; zeros before it takes over."""
        if observation.time >= self.time:
            return self.driver(observation)
        if observation.time >= self.time - WATCHED:
            self.driver.watch(observation)
        return 0.0, 0.0


BOUNDS = (("clearance", 0.0, 50.0), ("headway", 0.0, 10.0), ("hang_limit", 0.01, 86400.0))
"""The fields that both built-in worlds have, with their smallest and largest accepted values."""


LASTS = (0.01, 86400.0)
"""The smallest and the largest accepted duration of runs that last longer [s]."""


class EgoVehicle(Protocol):
    """The ego's vehicle: a field that takes a vehicle or the name of a ready one, and gives a vehicle."""

    def __get__(self, world: Any, of: Any = None, /) -> VehicleType: ...
    def __set__(self, world: Any, given: VehicleType | VehicleName, /) -> None: ...


class BuiltInWorld(BaseWorld):
    """The base class of this package's worlds, in which reference drivers can take the ego's place."""

    clearance: float
    headway: float
    limits: NpcLimits
    hang_limit: float
    lasts: float | None
    ego: VehicleType

    @property
    def observation_space(self) -> Any:
        """The gymnasium space of observations; None if the ADS receives a :class:`pytest_pafot.Observation`."""
        return None

    @property
    def rules(self) -> Rules:
        """The settings that all runs have in common."""
        rules, lasts = self._rules, self.lasts
        if lasts is None:
            return rules
        return replace(rules, lasts=min(lasts, (rules.road.length - rules.ego_start) / TOP_SPEED))

    @property
    @abstractmethod
    def _rules(self) -> Rules:
        """The settings that all runs have in common if their scenario and ``duration`` decide how long they last."""

    @property
    @abstractmethod
    def network(self) -> Any:
        """The road as a road network of highway-env."""

    @property
    def stock_road(self) -> Any:
        """The road as a road of highway-env without vehicles."""
        from pytest_pafot.world.stock import Road  # noqa: PLC0415  (imports highway-env)

        return Road(self.network)

    @property
    @abstractmethod
    def road(self) -> Road:
        """The road."""

    @property
    def start(self) -> tuple[int, float] | None:
        """The lane and speed [m/s] with which the ego must start; None on a straight road, which allows any."""
        return self.road.prescribed

    @property
    def road_start(self) -> RoadStart | None:
        """The lane and speed of :attr:`start`, with the ticks per second; None on a straight road."""
        return None if self.start is None else RoadStart(*self.start, physics_hz=self.rules.physics_hz)

    @property
    def straight_road(self) -> StraightRoad | None:
        """The road if it is straight, else None."""
        return self.road if isinstance(self.road, StraightRoad) else None

    has_traffic_styles = True
    """True, because NPCs keep to the style of a scenario's traffic."""

    has_lane_instructions = True
    """True, because NPCs can have Lane-Instructions."""

    def can_drive(self, vehicle: VehicleType) -> bool:
        """Return whether an NPC that does not cross can be a given vehicle: it follows all bends of the road."""
        return self.rules.road.can_drive(vehicle)

    can_go_on = True
    """True, because :meth:`lasting` gives this world with longer runs."""

    replays_in_gym = True
    """True, because ``rollout_in_gym`` repeats a run with ``env.step``."""

    @property
    def longest_run(self) -> float:
        """The longest duration of a run [s]; a run of a shorter scenario ends earlier."""
        return self.rules.duration if self.rules.lasts is None else self.rules.lasts

    @property
    def crossings(self) -> Crossings | None:
        """The ways of other traffic that meet the ego's way; None if there are none."""
        return self.rules.crossings

    @property
    def reference_drivers(self) -> tuple[str, ...]:
        """The names of the reference drivers (:mod:`pytest_pafot.world.reference_drivers`)."""
        return tuple(REFERENCES)

    @property
    def takes_over(self) -> tuple[str, ...]:
        """The names of the drivers that can take over but are no reference drivers."""
        return tuple(name for name in TAKING_OVER if name not in REFERENCES)

    @property
    def drivers(self) -> tuple[str, ...]:
        """The names of all drivers that can take over."""
        return (*self.reference_drivers, *self.takes_over)

    def check_fits(self, scenario: Scenario) -> None:
        """Check a scenario against this world.

        Raises:
            ScenarioError: if the scenario does not fit; the error names the field.
            WorldError: if the environment cannot be used.
        """
        self.rules.check_fits(scenario)

    def lasting(self, seconds: float) -> Self:
        """Return this world with runs of ``seconds``, longer than its scenarios and its own duration allow.

        The road, the environment and its configuration stay the same, so a run begins as in this world, to the last
        bit. NPCs with the longest chain go on with its last instruction; the others still keep their lane and speed.
        On a straight road, runs end before an ego at top speed could reach the end of the road.

        Raises:
            WorldError: if ``seconds`` is not a number from 0.01 to 86400.
        """
        longer = copy.copy(self)  # with its road and environment, which take long to make
        object.__setattr__(longer, "lasts", number_within("lasting", seconds, *LASTS))
        return longer

    def rollout_reference(self, scenario: Scenario, name: str) -> Trace:
        """Simulate a scenario with a reference driver in the ego's place.

        The driver works in SI units on this road, decides at every physics tick, and does not know the future.

        Args:
            scenario: the scenario to run; it is checked against this world.
            name: one of :attr:`reference_drivers`.

        Raises:
            WorldError: if there is no reference driver with this name.
            ScenarioError: if the scenario does not fit this world.
        """
        return self._driven_by(lambda: (_reference_driver(name), None), scenario)

    def take_over(self, trace: Trace, tick: int, name: str) -> Trace:
        """Simulate a run again, and let a reference driver take over the ego at a tick.

        Up to that tick, the ego repeats its states in the trace, so the NPCs repeat their states, too. The driver
        watches for the last 6 s before that tick, and from then on drives as in :meth:`rollout_reference`.

        Args:
            trace: the trace of a run in this world.
            tick: the tick at which the driver decides for the first time.
            name: one of :attr:`reference_drivers` or :attr:`takes_over`.

        Raises:
            WorldError: for an unknown name, a tick that the run does not have, or a trace with a different tick rate.
            ScenarioError: if the trace's scenario does not fit this world.
        """
        if not 0 <= tick <= trace.ticks:
            raise WorldError(field="tick", expected=f"a tick of the run, 0 to {trace.ticks}", received=repr(tick))
        if trace.physics_hz != self.rules.physics_hz:
            expected = f"a run in this world, with {self.rules.physics_hz} ticks per second"
            raise WorldError(field="trace", expected=expected, received=f"a run with {trace.physics_hz}")
        seconds = tick / trace.physics_hz
        return self._driven_by(
            lambda: (Relief(_reference_driver(name, TAKING_OVER), seconds), self._repeated(trace, tick)), trace.executed
        )

    def _repeated(self, trace: Trace, tick: int) -> Body:
        """Return an ego that does in a run up to a tick what that of a trace did."""
        return RecordedBody(trace, tick)

    def _driven_by(
        self, driver_of: Callable[[], tuple[Callable[[Observation], Any], Body | None]], scenario: Scenario
    ) -> Trace:
        self.rules.check_fits(scenario)
        every_tick = replace(self.rules, ads_hz=self.rules.physics_hz, policy_hz=self.rules.ads_hz)

        def driven(scenario: Scenario, factory: Callable[[], Any]) -> Trace:
            driver, body = factory()
            return self._planned(every_tick, scenario, driver, body=body)

        # Reference drivers draw nothing, but the user's code that ends runs may.
        has_code = self.rules.ends or self.rules.ends_in_steps
        return GENERATORS.run(driven, scenario, driver_of) if has_code else driven(scenario, driver_of)

    def _planned(
        self,
        rules: Rules,
        scenario: Scenario,
        ads: Callable[[Observation], Any],
        decisions: Sequence[Any] = (),
        body: Body | None = None,
    ) -> Trace:
        """Simulate a scenario by the given rules with a planner in SI units; see :func:`planner_run`."""
        guard = HangGuard(rules.hang_limit)
        stock_road = lambda: self.stock_road  # noqa: E731  (to make it imports highway-env)
        run = planner_run(rules, scenario, stock_road, ads, guard, decisions=decisions, body=body)
        run.ends = self._own_ends(rules, scenario, run.vehicles, guard)
        return run.finish()

    def _own_ends(self, rules: Rules, scenario: Scenario, vehicles: VehiclesOfRun, guard: HangGuard) -> OwnEnds | None:
        """Return what may end a run before its time, in the environment of this world; None if nothing does."""
        return None

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """Describe the first decision of an ADS in a scenario; return None if the run fails before that decision."""
        return decision_asked(self.rollout, scenario)

    def _check_fields(self) -> None:
        for name, low, high in BOUNDS:
            object.__setattr__(self, name, number_within(name, getattr(self, name), low, high))
        if self.lasts is not None:
            object.__setattr__(self, "lasts", number_within("lasts", self.lasts, *LASTS))
        if not isinstance(self.limits, NpcLimits):
            raise WorldError(field="limits", expected="pafot.NpcLimits(...)", received=repr(self.limits))
        try:
            object.__setattr__(self, "ego", VehicleType.of(self.ego))
        except FieldError as error:
            raise WorldError(f"ego: {error}") from None
        if self.ego.braking < HARDEST:
            expected = f"a vehicle that brakes with at least {HARDEST:g} m/s^2, as the rules require of every driver"
            received = f"{self.ego.described}, with {self.ego.braking:g}"
            raise WorldError(field="ego", expected=expected, received=received)

    def _to_dict(self, **without: Any) -> dict[str, Any]:
        """Return the fields as plain data: all but how long it runs, which a file decides."""
        data = asdict(cast("Any", replace)(self, **without))
        for name in ("lasts", "ego", *without):
            del data[name]
        return data if self.ego == CAR else {**data, "ego": self.ego.plain()}

    def _rules_on(
        self,
        road: Road,
        *,
        physics_hz: int,
        ads_hz: int,
        duration: float,
        obstacles: tuple[tuple[float, float, float, float, float], ...] = (),
    ) -> Rules:
        if not road.can_drive(self.ego):
            expected = "a vehicle that can follow the bends of the road"
            raise WorldError(field="ego", expected=expected, received=self.ego.described)
        return Rules(
            road=road,
            physics_hz=physics_hz,
            ads_hz=ads_hz,
            duration=duration,
            clearance=self.clearance,
            headway=self.headway,
            limits=self.limits,
            ego=self.ego,
            hang_limit=self.hang_limit,
            obstacles=obstacles,
        )


def _reference_driver(name: str, known: Mapping[str, Callable[[], ReferenceDriver]] = REFERENCES) -> ReferenceDriver:
    if name not in known:
        raise WorldError(f"reference driver: expected one of {', '.join(known)}, received {name!r}")
    return known[name]()
