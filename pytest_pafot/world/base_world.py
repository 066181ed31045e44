"""The base class of all worlds, and the default world, a straight motorway."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self, cast

from pytest_pafot.attribution.responsibility import HARDEST
from pytest_pafot.attribution.takeovers import CAREFUL
from pytest_pafot.findings.finding import DRIVEN_ON
from pytest_pafot.model.crossings import Crossings
from pytest_pafot.model.instructions import (
    LARGEST_SLOT,
    SLOT_STEPS_PER_SECOND,
    Cell,
    CrossingInstruction,
    PositionInstruction,
    ScenarioError,
)
from pytest_pafot.model.scenario import PAPER_SPEED_LIMIT, Scenario, rng_of
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR, TIGHTEST, VehicleName, VehicleType
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import AdsFactoryError, DriverError, FieldError, WorldError
from pytest_pafot.support.text import one_line
from pytest_pafot.world.driving.policy import AdsFactory, Policy, ads_and_sight, idm_model
from pytest_pafot.world.engines.run import (
    ADS_HZ,
    PHYSICS_HZ,
    FixedObject,
    OwnEnds,
    Rules,
    VehiclesOfRun,
    built_as,
    check_divides,
    check_ticks,
    make_ego,
    planner_driver,
)
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.guard.hang_guard import HangGuard, closing
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.loop import ModelDriver
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.limits import (
    CLEARANCE,
    HANG_LIMIT,
    HEADWAY,
    TOP_SPEED,
    NpcLimits,
    number_within,
    whole_within,
)
from pytest_pafot.world.reference_drivers import REFERENCES, CarefulHuman, RecordedBody, Relief
from pytest_pafot.world.roads.road import Meeting, Road, StraightRoad, ego_start

if TYPE_CHECKING:
    from pytest_pafot.algorithms.space import SearchSpace


@dataclass(frozen=True, slots=True)
class FirstDecision:
    """A description of a policy's first observation and expected action, for error messages."""

    is_si: bool
    # A sentence about the observation and the action.
    text: str
    # Advice for a policy of another kind. If it is empty, the caller gives the advice.
    advice: str = ""


class RoadStart(NamedTuple):
    """The ego's required lane and speed [m/s] at the start, and the ticks per second."""

    lane: int
    speed: float
    physics_hz: float


# The smallest and largest accepted durations [s] of continued runs.
LASTS = (0.01, 86400.0)


class EgoVehicle(Protocol):
    """A field that accepts a vehicle type or its name, and returns the vehicle type."""

    def __get__(self, world: Any, of: Any = None, /) -> VehicleType: ...
    def __set__(self, world: Any, given: VehicleType | VehicleName, /) -> None: ...


class BaseWorld(ABC):
    """The base class of all worlds. Only this package may derive classes from it."""

    clearance: float
    headway: float
    limits: NpcLimits
    hang_limit: float
    lasts: float | None
    ego: VehicleType

    is_resumable: bool = False

    # True if `rollout_in_gym` can repeat a run with `env.step` of a gymnasium environment.
    replays_in_gym: bool = True

    @property
    @abstractmethod
    def speed_limit(self) -> float:
        """The highest target speed [m/s] of NPCs."""

    @abstractmethod
    def rollout(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario with a new policy. A decision that exceeds ``hang_limit`` ends the run."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return the world as JSON-compatible data."""

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        raise NotImplementedError

    @property
    def unused_roads(self) -> frozenset[Meeting]:
        """The kinds of conflict with the ego's path that cannot occur, because no NPCs use the roads involved."""
        return frozenset()

    @property
    def action_space(self) -> Any:
        return None

    @property
    def hides(self) -> bool:
        # True if a vehicle can be hidden from observations.
        return True

    @property
    def tick(self) -> float:
        # The duration of a tick [s], if a second has no whole number of ticks; otherwise 0.
        return 0.0

    @property
    def left_out(self) -> Mapping[str, tuple[str, ...]]:
        # The methods of the environment that runs of a policy skip, although they change its state, with these changes.
        return {}

    def options_without_effect(
        self, *, drives_itself: bool, simulates: bool = False
    ) -> dict[str, list[str]]:
        """Return the options of the environment that have no effect in a search, grouped by reason.

        ``simulates`` is true if the policy receives the environment.
        """
        return {}

    @property
    def packages(self) -> tuple[str, ...]:
        """The names of installed packages whose versions also affect runs."""
        return ()

    def runs_in_kernel(self, ads: Any) -> bool:
        """Return whether compiled code simulates every tick, so that a run of ``ads`` takes about a millisecond."""
        return False

    @property
    def observation_space(self) -> Any:
        return None

    @property
    def rules(self) -> Rules:
        # On a straight road, the run must end before an ego at top speed would reach the end of the road.
        rules, lasts = self._rules, self.lasts
        if lasts is None:
            return rules
        longest = (rules.road.length - rules.ego_start) / TOP_SPEED
        return replace(rules, lasts=min(lasts, longest))

    @property
    @abstractmethod
    def _rules(self) -> Rules:
        """The settings of runs, without the duration that :meth:`lasting` sets."""

    @cached_property
    def network(self) -> Any:
        # The road as a highway-env road network.
        from pytest_pafot.world.driving.vehicles import SearchedLanes, straight_network  # noqa: PLC0415  (highway-env)

        lane = self.road.lanes[0]
        return SearchedLanes(
            straight_network(self.road.lane_count, lane.length, lane.width, self.speed_limit)
        )

    def stock_road(self, np_random: Any = None) -> Any:
        # The road as a highway-env road without vehicles.
        from pytest_pafot.world.stock import Road  # noqa: PLC0415  (a second of imports)

        return Road(self.network, np_random=np_random)

    @property
    @abstractmethod
    def road(self) -> Road:
        """The road on which the ego drives."""

    @property
    def start(self) -> tuple[int, float] | None:
        """The ego's required lane and speed [m/s] at the start, or None on a straight road."""
        return self.road.prescribed

    @property
    def road_start(self) -> RoadStart | None:
        if self.start is None:
            return None
        return RoadStart(*self.start, physics_hz=self.rules.physics_hz)

    @property
    def straight_road(self) -> StraightRoad | None:
        road = self.road
        if isinstance(road, StraightRoad):
            return road
        return None

    def can_drive(self, vehicle: VehicleType) -> bool:
        """Return whether an NPC of this type can follow all bends of the ego's path."""
        return self.rules.road.can_drive(vehicle)

    @property
    def longest_run(self) -> float:
        """The longest duration [s] of a run. A run of a shorter scenario ends earlier."""
        rules = self.rules
        if rules.lasts is None:
            return rules.duration
        return rules.lasts

    @property
    def crossings(self) -> Crossings | None:
        """The paths that cross or join the ego's path, or None if there are none."""
        return self.rules.road.crossings

    def check_fits(self, scenario: Scenario) -> None:
        """Check that a scenario fits this world.

        Raises:
            ScenarioError: if it does not fit. The error names the field.
        """
        if not isinstance(scenario, Scenario):
            raise ScenarioError(
                field="scenario",
                expected="a Scenario",
                received=repr(scenario),
            )
        rules = self.rules
        road = rules.road
        lane = scenario.ego_lane
        if lane not in road.start_lanes:
            expected, fix = road.said_of_start_lanes
            raise ScenarioError(
                field="ego_lane",
                expected=expected,
                received=str(lane),
                fix=fix,
            )
        # NPCs that cross start on their own paths, so they need no cell.
        cells = rules.start_cells(scenario, rules.ego.length)
        on_grid = sum(not chain[0].crosses for chain in scenario.npcs)
        if on_grid > len(cells):
            kind = " that do not cross" if scenario.crossings else ""
            raise ScenarioError(
                field="npcs",
                expected=f"at most {len(cells)} NPCs{kind}, one for each cell around lane {lane}",
                received=str(on_grid),
            )
        _check_speeds(rules, scenario)
        near = rules.object_at_start(lane, scenario.ego_speed)
        if near is not None:
            rules.refuse_start(scenario, near)
        # A crossing NPC drives on its own path, which may have tighter bends than the ego's path.
        zones: list[str | None] = [None] * len(scenario.npcs)
        for npc, instruction in enumerate(scenario.crossings):
            if instruction is not None:
                _check_crossing(road.crossings, f"npcs[{npc}][0]", instruction)
                zones[npc] = instruction.zone
        for npc, vehicle in enumerate(scenario.vehicles):
            zone = zones[npc]
            if not road.can_drive(vehicle, zone):
                least = vehicle.length / (TIGHTEST * CAR.length)
                raise ScenarioError(
                    field=f"vehicles[{npc}]",
                    expected=f"a vehicle that can follow the bends of {zone or 'the road'}",
                    received=vehicle.described,
                    fix=f"it needs bend radii of at least {least:.1f} m. "
                    "Give the NPC a shorter vehicle or another path",
                )
        # Instructions change only between ticks. The tolerance allows for rounding.
        ticks = scenario.gene_seconds * rules.physics_hz
        whole = round(ticks)
        if abs(ticks - whole) > 1e-6 or whole < 1:
            nearest = round(max(whole, 1) / rules.physics_hz, 13)
            raise ScenarioError(
                field="gene_seconds",
                expected=f"a whole number of ticks of 1/{rules.physics_hz:.6g} s",
                received=f"{scenario.gene_seconds:g}",
                fix=f"the nearest valid duration is {nearest!r} s",
            )

    def lasting(self, seconds: float) -> Self:
        """Return a copy of this world in which runs last ``seconds``, even if the scenario or ``duration`` is shorter.

        NPCs with the longest chain continue their last instruction. Other NPCs keep their lane and speed.

        Raises:
            WorldError: if ``seconds`` is not a number from 0.01 to 86400.
        """
        # The copy shares the road and the environment, which are slow to create. So runs start from the same state.
        longer = copy.copy(self)
        object.__setattr__(longer, "lasts", number_within("lasting", seconds, *LASTS))
        return longer

    def rollout_reference(self, scenario: Scenario, name: str) -> Trace:
        """Simulate a scenario with a reference driver instead of the policy.

        Raises:
            WorldError: if there is no reference driver called ``name``.
        """
        return self._driven_by(lambda: (_reference_driver(name), None), scenario)

    def take_over(self, trace: Trace, tick: int, name: str) -> Trace:
        """Repeat a run up to a tick, and then let a reference driver take over the ego.

        Raises:
            WorldError: if the name is unknown, the tick is not in the run, or the tick rate is not this world's.
        """
        if not 0 <= tick <= trace.ticks:
            raise WorldError(
                field="tick",
                expected=f"a tick of the run, from 0 to {trace.ticks}",
                received=repr(tick),
            )
        # The recorded states can only be repeated at the same ticks.
        physics_hz = self.rules.physics_hz
        if trace.physics_hz != physics_hz:
            raise WorldError(
                field="trace",
                expected=f"a run with {physics_hz} ticks per second, as in this world",
                received=f"a run with {trace.physics_hz}",
            )
        # The ego repeats its states, so the NPCs repeat theirs. The driver starts to watch shortly before the tick.
        seconds = tick / physics_hz
        return self._driven_by(
            lambda: (Relief(_reference_driver(name), seconds), self._repeated(trace, tick)),
            trace.executed,
        )

    def _repeated(self, trace: Trace, tick: int) -> Body:
        # The states repeat to the last bit, regardless of the policy.
        return RecordedBody(trace, tick)

    def _driven_by(
        self,
        driver_of: Callable[[], tuple[Callable[[Observation], Any], Body | None]],
        scenario: Scenario,
    ) -> Trace:
        self.check_fits(scenario)
        rules = self.rules
        # A reference driver decides at every tick. `policy_hz` keeps the length of the environment's steps.
        every_tick = replace(rules, ads_hz=rules.physics_hz, policy_hz=rules.ads_hz)

        def driven(scenario: Scenario, factory: Callable[[], Any]) -> Trace:
            driver, body = factory()
            return self._planned(every_tick, scenario, driver, body=body)

        # Reference drivers draw no random numbers, but a user's code that ends runs may.
        if rules.ends or rules.ends_in_steps:
            trace: Trace = GENERATORS.run(driven, scenario, driver_of)
            return trace
        return driven(scenario, driver_of)

    def _planned(
        self,
        rules: Rules,
        scenario: Scenario,
        ads: Callable[[Observation], Any],
        decisions: Sequence[Any] = (),
        body: Body | None = None,
    ) -> Trace:
        """Run a planner in SI units.

        ``decisions`` replace the first calls of the planner. ``body`` is the ego's body, or None for a default one.
        """
        guard = HangGuard(rules.hang_limit)
        decides, sight = ads_and_sight(ads)
        vehicles = self._vehicles(rules, scenario, body)
        driver = planner_driver(vehicles, decides, guard, sight, decisions)
        return vehicles.drive(driver, guard, self._own_ends(vehicles, guard))

    def _vehicles(self, rules: Rules, scenario: Scenario, body: Body | None) -> VehiclesOfRun:
        ego = body or Body(rules.ego.length, rules.ego.width)
        ego.place(*rules.ego_position(scenario), rules.ego_speed(scenario))
        return VehiclesOfRun(rules, scenario, ego, self.stock_road)

    def _own_ends(self, vehicles: VehiclesOfRun, guard: HangGuard) -> OwnEnds | None:
        # The methods with which the environment of this world can end a run early, or None.
        return None

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        """Describe the first decision in a scenario, or return None if the run fails earlier."""
        seen: list[Any] = []
        # `append` returns None, so the run ends with an error that names the expected action.
        trace = self.rollout(scenario, lambda: seen.append)
        if not seen or trace.error is None:
            return None
        # Only the first half of the message; the second half states the None of this function.
        expected = trace.error.message.removeprefix("expected ").partition(", received")[0]
        observation = seen[0]
        is_si = isinstance(observation, Observation)
        shape = getattr(observation, "shape", None)
        if is_si:
            fields = "time, ego, others, lanes, lane_width, speed_limit"
            given = f"a pafot.Observation ({fields}, and .array of shape {observation.array.shape})"
        elif shape is None:
            given = f"a {type(observation).__name__}"
        else:
            given = f"an array of shape {tuple(shape)} and type {observation.dtype}"
        return FirstDecision(is_si, f"The ADS was given {given}, and must return {expected}.")

    def _check_number(self, name: str, low: float, high: float) -> None:
        # The class of a world is frozen, so it does not allow assignments.
        object.__setattr__(self, name, number_within(name, getattr(self, name), low, high))

    def _check_whole(self, name: str, low: int, high: int) -> None:
        object.__setattr__(self, name, whole_within(name, getattr(self, name), low, high))

    def _refused(self, name: str, expected: str, fix: str = "") -> WorldError:
        received = f"{getattr(self, name)!r:.200}"
        return WorldError(
            field=name,
            expected=expected,
            received=received,
            fix=fix,
        )

    def _check_fields(self) -> None:
        """Check the fields that all worlds have."""
        self._check_number("clearance", 0.0, 50.0)
        self._check_number("headway", 0.0, 10.0)
        self._check_number("hang_limit", 0.01, 86400.0)
        if self.lasts is not None:
            self._check_number("lasts", *LASTS)
        if not isinstance(self.limits, NpcLimits):
            raise WorldError(
                field="limits", expected="a pafot.NpcLimits object", received=repr(self.limits)
            )
        try:
            object.__setattr__(self, "ego", VehicleType.parse(self.ego))
        except FieldError as error:
            # The error names a field of the vehicle type, or "vehicle" for the whole value.
            raise WorldError(f"ego.{error}".replace("ego.vehicle:", "ego:")) from None
        if self.ego.braking < HARDEST:
            raise WorldError(
                field="ego",
                expected=f"a vehicle that can brake at {HARDEST:g} m/s^2, which the rules require of every driver",
                received=f"{self.ego.name!r}, which can brake at only {self.ego.braking:g} m/s^2",
            )

    def _to_dict(self, **without: Any) -> dict[str, Any]:
        # `asdict` copies all values, which fails for some user's objects, so they are removed first.
        data = asdict(cast("Any", replace)(self, **without))
        for name in ("lasts", "ego", *without):
            del data[name]
        if self.ego != CAR:
            data["ego"] = self.ego.plain()
        return data

    def _rules_on(
        self,
        road: Road,
        *,
        physics_hz: float,
        ads_hz: float,
        duration: float,
        obstacles: tuple[FixedObject, ...] = (),
    ) -> Rules:
        # The run of an ego that cannot follow the road would end wherever it first bends.
        if not road.can_drive(self.ego):
            raise WorldError(
                field="ego",
                expected="a vehicle that can follow the bends of the road",
                received=self.ego.described,
            )
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

    def space(self, given: Mapping[str, Any]) -> SearchSpace:
        """Return the search space for this world and the given fields, as created by ``space_on``."""
        from pytest_pafot.algorithms.space import space_on  # noqa: PLC0415  (slow to import, and many worlds need none)

        if self.tick:
            given = {**given, "tick": self.tick}
        return space_on(float(self.speed_limit), float(self.longest_run), given, self.road_start)

    @property
    def most_on_grid(self) -> int:
        # The largest number of NPCs in cells around the ego's required start, or 8 if no start is required.
        start = self.road_start
        if start is None:
            return len(Cell)
        for npcs in range(len(Cell), 0, -1):
            if self._has_cells(start, npcs):
                return npcs
        return 0

    def _has_cells(self, start: RoadStart, npcs: int) -> bool:
        # The number that fits depends only on the cells around the start, so any instructions will do.
        cells = list(Cell)[:npcs]
        chains = tuple((PositionInstruction(cell, 0.0),) for cell in cells)
        seconds = self.tick or 1.0
        try:
            self.check_fits(
                Scenario(
                    npcs=chains, ego_lane=start.lane, ego_speed=start.speed, gene_seconds=seconds
                )
            )
        except ScenarioError:
            return False
        return True

    def run_of(self, trace: Trace) -> Run:
        """Convert a trace of this world to the run that a test function receives."""
        return Run(trace, take_over=TakingOver(self))


def _check_speeds(rules: Rules, scenario: Scenario) -> None:
    limit = rules.road.speed_limit
    top = rules.limits.top_speed(limit)
    if scenario.ego_speed > top:
        # Rounded down, so that the stated speed is valid.
        reached = math.floor(100 * top) / 100
        raise ScenarioError(
            field="ego_speed",
            expected=f"at most {reached:.2f} m/s, the NPCs' top speed, because NPCs start at the ego's speed",
            received=f"{scenario.ego_speed:g}",
        )
    for npc, chain in enumerate(scenario.npcs):
        for gene, instruction in enumerate(chain):
            if instruction.speed > limit + 1e-9:
                raise ScenarioError(
                    field=f"npcs[{npc}][{gene}].speed",
                    expected=f"at most the speed limit of {limit:g} m/s",
                    received=f"{instruction.speed:g}",
                )


def _check_crossing(
    crossings: Crossings | None, place: str, instruction: CrossingInstruction
) -> None:
    zone = instruction.zone
    if crossings is None:
        raise ScenarioError(
            field=place,
            expected="no crossing NPC, because no other path crosses the ego's path on this road",
            received=f"zone {zone}",
            fix='use PositionInstruction(cell, speed), or a world with crossings, such as "intersection-v0"',
        )
    if zone not in crossings.ways:
        raise ScenarioError(
            field=f"{place}.zone",
            expected=f"one of {', '.join(zone.way for zone in crossings.zones)}",
            received=zone,
            fix="a path that starts with the ego's path, or does not meet it, has no zone",
        )
    if crossings.fits(instruction):
        return
    # The error states which slots are valid.
    most = round(LARGEST_SLOT * SLOT_STEPS_PER_SECOND)
    slots = [step / SLOT_STEPS_PER_SECOND for step in range(-most, most + 1)]
    slots = [slot for slot in slots if crossings.fits(replace(instruction, slot=slot))]
    fits = "a zone or speed other than"
    if slots:
        fits = f"a slot from {min(slots):g} to {max(slots):g} s at"
    speed = f"{instruction.speed:g} m/s"
    along = crossings.start(instruction)
    raise ScenarioError(
        field=f"{place}.slot",
        expected=f"{fits} {zone} and {speed}, so that the NPC starts on its path before the zone",
        received=f"{instruction.slot:g} s, with which the NPC would start {along:.0f} m along its path",
    )


def _reference_driver(name: str) -> CarefulHuman:
    if name not in REFERENCES:
        raise WorldError(f"reference driver: expected {' or '.join(REFERENCES)}, received {name!r}")
    return REFERENCES[name]()


@dataclass(frozen=True, slots=True)
class TakingOver:
    """A callable that repeats a run up to a tick and then lets the careful driver take over."""

    world: BaseWorld

    def __call__(self, trace: Trace, tick: int) -> Trace:
        try:
            return self.world.take_over(trace, tick, CAREFUL)
        except Exception as error:  # raised by a user's simulator
            world = type(self.world).__name__
            # The message of a user's exception can have several lines.
            raised = f"{type(error).__name__}: {one_line(str(error))}"
            text = f"take_over with the driver {CAREFUL!r} failed in the {world}: {raised}"
            raise DriverError(text) from error

    def lasting(self, seconds: float) -> TakingOver:
        return TakingOver(self.world.lasting(seconds))


# highway-env's lane width [m].
LANE_WIDTH = 4.0
# The smallest and largest number of lanes.
LANE_COUNTS = (3, 6)


@dataclass(frozen=True, kw_only=True)
class Highway(BaseWorld):
    """A straight motorway of three to six lanes.

    The ADS is a callable from :class:`pytest_pafot.Observation` to ``(acceleration [m/s^2], steering [rad])`` or a
    :class:`pytest_pafot.LaneCommand`. The ADS can also be a highway-env vehicle class, which drives itself.

    Attributes:
        lanes: number of lanes, from 3 to 6.
        speed_limit: speed limit [m/s], by default 60 mph, as in the paper.
        physics_hz: simulation ticks per second.
        ads_hz: decisions of the policy per second, a divisor of ``physics_hz``.
        duration: longest duration [s] of a run.
        clearance: smallest gap [m] between the ego and the cells ahead of and behind it. NPCs can come closer.
        headway: time gap [s], but at least ``clearance``, at which NPCs start ahead of or behind the ego.
        limits: limits of the NPCs.
        ego: the ego's [vehicle type](scenarios.md#vehicles), as a ``pafot.VehicleType`` or the name of a built-in type.
        hang_limit: wall-clock time [s] after which a decision of the policy is interrupted.
        lasts: duration [s] of all runs, if :meth:`lasting` has set it. It is not saved with the world.

    Raises:
        WorldError: if a value cannot be used. The message states the possible values.
    """

    lanes: int = 4
    speed_limit: float = PAPER_SPEED_LIMIT
    physics_hz: int = 15
    ads_hz: int = 5
    duration: float = 60.0
    clearance: float = CLEARANCE
    headway: float = HEADWAY
    limits: NpcLimits = field(default_factory=NpcLimits)
    ego: EgoVehicle = CAR  # type: ignore[assignment]
    hang_limit: float = HANG_LIMIT
    lasts: float | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        self._check_whole("lanes", *LANE_COUNTS)
        self._check_whole("physics_hz", *PHYSICS_HZ)
        self._check_whole("ads_hz", *ADS_HZ)
        self._check_number("speed_limit", 5.0, TOP_SPEED)
        self._check_number("duration", 1 / self.physics_hz, 3600.0)
        self._check_fields()
        check_divides("physics_hz", self.physics_hz, "ads_hz", self.ads_hz)
        check_ticks(self.duration, self.physics_hz)
        self.limits.top_speed(self.speed_limit)

    @cached_property
    def road(self) -> StraightRoad:
        # The road is so long that no vehicle reaches the end, even in a run that is continued.
        ends = 2 * ego_start(self.headway, self.clearance)
        length = 100.0 + ends + TOP_SPEED * (self.duration + DRIVEN_ON)
        return StraightRoad.uniform(self.lanes, length, LANE_WIDTH, self.speed_limit)

    def rollout(
        self, scenario: Scenario, ads_factory: AdsFactory, *, decisions: Sequence[Any] = ()
    ) -> Trace:
        """Simulate a scenario with a new policy.

        Args:
            scenario: scenario to run.
            ads_factory: function that returns the policy, or a highway-env vehicle class, which drives itself.
            decisions: first decisions of the run, in the form of ``Trace.actions``. The policy makes later decisions.

        Raises:
            ScenarioError: if the scenario does not fit this world.
            AdsFactoryError: if the factory returns an object that cannot drive in this world.
            BadAction: if one of the decisions is not a valid action.
            WorldError: if ``decisions`` are given for a vehicle class, which returns no decisions.
            Exception: any exception of the factory. An exception in the policy ends the run with ``ads_error``.
        """
        self.check_fits(scenario)
        policy = Policy(ads_factory)
        policy.check_drives_in(self)
        if policy.simulates:
            raise AdsFactoryError(
                "ads: expected a factory without the parameter `env`, because pafot.Highway has no environment. "
                'For planners that simulate inside an environment, use world=pafot.World("highway-v0")'
            )
        ads = policy.make()
        if ads.drives_itself:
            # A vehicle class has no decisions that could be replaced.
            if decisions:
                raise WorldError(
                    f"decisions: expected none for {ads.given!r}, because a vehicle class drives itself and returns no "
                    f"actions, received {len(decisions)}. Omit them"
                )
            return self._vehicle_run(scenario, ads.given)
        # A planner may hold resources, such as a process, until the end of its run.
        with closing(ads.given, self.hang_limit):
            return self._planned(self.rules, scenario, ads.given, decisions)

    def _vehicle_run(self, scenario: Scenario, given: Any) -> Trace:
        """Run a highway-env vehicle class."""
        rules = self.rules
        vehicle_class = built_as(rules.ego, given)
        guard = HangGuard(rules.hang_limit)
        model = idm_model(vehicle_class)
        if model is not None:  # the kernel drives it
            ego = GoalVehicle(model.constants, self.road.grid, self.road.speed_limit)
            start = rules.ego_position(scenario)
            ego.start(*start, rules.ego_speed(scenario), model.changes_lanes)
            vehicles = VehiclesOfRun(
                rules, scenario, ego, lambda: self.stock_road(rng_of(scenario.seed))
            )
            return vehicles.drive(ModelDriver(ego, vehicles.vehicles[1:]), guard)
        from pytest_pafot.world.driving.environment import ObjectDriver  # noqa: PLC0415  (a second of imports)

        road = self.stock_road(rng_of(scenario.seed))
        driver = ObjectDriver(make_ego(rules, scenario, vehicle_class, road), road, guard)
        vehicles = VehiclesOfRun(rules, scenario, driver.ego, lambda: road)
        driver.show(vehicles.places, self.road)
        return vehicles.drive(driver, guard)

    is_resumable = True

    def runs_in_kernel(self, ads: Any) -> bool:
        return not self.ego.has_limits and idm_model(ads) is not None

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario as :meth:`rollout` does, but with ``env.step`` of highway-env's highway-v0."""
        from pytest_pafot.world.engines.gym_replay import replay_highway  # noqa: PLC0415  (imports highway-env)

        return replay_highway(self.rules, scenario, Policy(ads_factory))

    def to_dict(self) -> dict[str, Any]:
        """Return the world as data for a corpus file, which :func:`pytest_pafot.world.from_dict` can read."""
        return {"kind": "highway", **self._to_dict()}

    @cached_property
    def _rules(self) -> Rules:
        return self._rules_on(
            self.road, physics_hz=self.physics_hz, ads_hz=self.ads_hz, duration=self.duration
        )
