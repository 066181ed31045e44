"""The world in which a user's simulator moves the vehicles."""

from __future__ import annotations

import difflib
import inspect
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from numbers import Real
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, get_args

import numpy as np

from pytest_pafot.findings.finding import DRIVEN_ON, check_plain
from pytest_pafot.model.scenario import EGO_SPEED, PAPER_SPEED_LIMIT, Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.base_world import BaseWorld, EgoVehicle, FirstDecision
from pytest_pafot.world.driving.policy import AdsFactory, Policy, ads_and_sight
from pytest_pafot.world.engines.run import (
    ADS_HZ,
    PHYSICS_HZ,
    FixedObject,
    Rules,
    check_ticks,
    plain_data,
    planner_driver,
)
from pytest_pafot.world.engines.simulation import (
    Frame,
    Headings,
    NativeDriver,
    Reference,
    RepeatedBody,
    Simulation,
    Simulator,
    Simulators,
)
from pytest_pafot.world.guard.hang_guard import HangGuard, closing
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.loop import PlannerDriver
from pytest_pafot.world.limits import (
    CLEARANCE,
    HANG_LIMIT,
    HEADWAY,
    PLANNER_HZ,
    TOP_SPEED,
    NpcLimits,
    number_within,
    whole_within,
)
from pytest_pafot.world.roads.road import Road, StraightRoad, ego_start

if TYPE_CHECKING:
    from pytest_pafot.model.vehicle_type import VehicleName, VehicleType

    WorldArguments = TypedDict("WorldArguments", {  # noqa: UP013  (a class is longer)
        "ads_hz": float | None, "duration": float, "clearance": float, "headway": float, "limits": NpcLimits,
        "ego": VehicleType | VehicleName, "hang_limit": float,
    }, total=False)  # fmt: skip

# The lane width if a simulator sets none [m].
LANE_WIDTH = 4.0
MOST_LANES = 12
# The smallest length of a road [m].
LEAST_LENGTH = 100.0
# A straight road must be long enough for this time at top speed [s]. If it is too short for `duration`, runs end early.
LEAST_RUN = 20.0
# The length of road behind the ego's start if a simulator does not set `start_at` [m].
ROOM_BEHIND = 150.0


# Names that users may confuse with attributes of a simulator, and what to write instead.
OTHER_NAMES = {
    "at_front": 'reference = "front"',
    "from_north": 'headings = "y to x"',
    "physics_hz": "hz",
    "frequency": "hz",
    "time_step": "dt",
    "timestep": "dt",
    "simulation_frequency": "hz",
    "lane_count": "lanes",
    "max_speed": "speed_limit",
}


@dataclass(frozen=True, kw_only=True)
class SimulatorWorld(BaseWorld):
    """A world in which the user's simulator, a :class:`pytest_pafot.Simulator`, moves all vehicles.

    The ADS is a planner, as in :class:`pytest_pafot.Highway`: a callable from :class:`pytest_pafot.Observation` to
    ``(acceleration [m/s^2], steering [rad])`` or a :class:`pytest_pafot.LaneCommand`. If the simulator is ``native``,
    the ADS is a callable from the simulator's observations to its actions.

    Attributes:
        simulator: class of the simulator, or a function without parameters that creates one.
        ads_hz: decisions of the policy per second. The ticks per second must be a multiple of this value.
            The default is 5, or the next higher possible value.
        duration: longest duration [s] of a run.
        clearance, headway, limits, hang_limit, lasts, ego: as in :class:`pytest_pafot.Highway`. The time limit for the
            simulator's methods is ten times ``hang_limit``, but at least a minute.

    Raises:
        WorldError: if a value cannot be used. The simulator is created and checked when it is first used.
    """

    simulator: Callable[[], Simulator] = field(kw_only=False)
    ads_hz: float | None = None
    duration: float = 60.0
    clearance: float = CLEARANCE
    headway: float = HEADWAY
    limits: NpcLimits = field(default_factory=NpcLimits)
    ego: EgoVehicle = CAR  # type: ignore[assignment]
    hang_limit: float = HANG_LIMIT
    lasts: float | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if isinstance(self.simulator, Simulator) or not callable(self.simulator):
            name = type(self.simulator).__name__
            raise self._refused(
                "simulator",
                "a subclass of pafot.Simulator, or a function without parameters that creates a simulator",
                f"write pafot.SimulatorWorld({name}), or pass arguments with functools.partial({name}, ...)",
            )
        if self.ads_hz is not None:
            # The tick rate is known only after the simulator has been created, so the divisor is checked later.
            self._check_number("ads_hz", *ADS_HZ)
            object.__setattr__(self, "ads_hz", whole_if_possible(self.ads_hz))
        self._check_number("duration", 0.1, 3600.0)
        self._check_fields()

    @cached_property
    def simulators(self) -> Simulators:
        """The simulators that this world has created in this process. Each run borrows one until it ends."""
        return Simulators(self.simulator)

    @cached_property
    def _stated(self) -> _Stated:
        made = self.simulators.take()
        try:
            return _check_statements(made)
        finally:
            self.simulators.give(made)

    @property
    def physics_hz(self) -> float:
        """The simulator's ticks per second, as an int if the number is whole."""
        return self._stated.hz

    @property
    def tick(self) -> float:
        if isinstance(self.physics_hz, int):
            return 0.0
        return 1 / self.physics_hz

    @property
    def is_native(self) -> bool:
        """True if the policy receives the simulator's observations."""
        return self._stated.native

    @property
    def hides(self) -> bool:
        return not self.is_native or "hidden" in inspect.signature(self.maker.observe).parameters

    @property
    def maker(self) -> type[Simulator]:
        """The class of the simulator."""
        return self._stated.maker

    @property
    def moves_ego_only(self) -> bool:
        """True if the simulator moves only the ego, and puts NPCs into the states of their controls."""
        return self._stated.moves_ego_only

    @property
    def packages(self) -> tuple[str, ...]:
        """The packages that the simulator's class lists, or none if a function creates the simulator."""
        maker: Any = self.simulator
        if isinstance(maker, partial):
            maker = maker.func
        return getattr(maker, "packages", ())  # of the class, because creating a simulator may fail

    @property
    def speed_limit(self) -> float:
        return self.road.speed_limit

    @property
    def road(self) -> Road:
        """The straight road, or the ego's path along lanes of any shape."""
        return self._on_road.road

    @cached_property
    def _on_road(self) -> _OnRoad:
        stated = self._stated
        width = stated.lane_width
        limit = stated.speed_limit
        self.limits.top_speed(limit)
        ends = 2 * ego_start(self.headway, self.clearance)
        lines = self._lines
        if lines is None:
            # A straight road without an end is as long as a run needs, even a continued run.
            length = 100.0 + ends + TOP_SPEED * (self.duration + DRIVEN_ON)
            straight = StraightRoad.uniform(stated.count, length, width, limit)
            return _OnRoad(straight, Frame(stated), math.inf)
        from pytest_pafot.world.roads.survey import network_of, straight_along, survey  # noqa: PLC0415  (not in each world)

        # Parallel straight lines that are long enough for a run are also a straight road.
        found = straight_along(lines, width)
        if found is not None:
            origin, length = found
            longest = (length - ends) / TOP_SPEED
            if longest >= min(self.duration, LEAST_RUN):
                straight = StraightRoad.uniform(len(lines), length, width, limit)
                return _OnRoad(straight, Frame(stated, origin), longest)
        # On all other roads, the ego follows the lane in which it starts, as in an environment of highway-env.
        # The speed also determines how far the ego gets on a road with an end.
        speed = stated.start_speed
        if speed is None:
            speed = min(EGO_SPEED, limit)
        x, y, heading = _start_on(lines[stated.start_lane], stated.start_at)
        ego = SimpleNamespace(position=np.array([x, y]), heading=heading, speed=speed)
        network = network_of(lines, width, limit, stated.name)
        env = SimpleNamespace(road=SimpleNamespace(network=network), vehicle=ego)
        road = survey(env, stated.name, self.limits, self.duration * TOP_SPEED)
        longest = math.inf
        if speed > 0.0:
            longest = (road.end - road.start) / speed
        return _OnRoad(road, Frame(stated), longest, network)

    @property
    def _lines(self) -> list[Any] | None:
        # The centre lines of the lanes [m]; None for a straight road without an end.
        stated = self._stated
        if stated.lines is not None or stated.length is None:
            return stated.lines
        # A straight road of a limited length is treated like lanes with centre lines.
        across = [number * stated.lane_width for number in range(stated.count)]
        return [np.array([(0.0, each), (stated.length, each)]) for each in across]

    @cached_property
    def network(self) -> Any:
        network = self._on_road.network
        if network is None:
            return super().network
        from pytest_pafot.world.driving.vehicles import SearchedLanes  # noqa: PLC0415  (imports highway-env)

        return SearchedLanes(network)

    @cached_property
    def _rules(self) -> Rules:
        hz = self.physics_hz
        check_ticks(self.duration, hz)
        return self._rules_on(
            self.road,
            physics_hz=hz,
            ads_hz=whole_if_possible(hz / self._every),
            # On a short road, runs end where the road ends.
            duration=min(self.duration, self._on_road.longest),
            obstacles=self._obstacles,
        )

    @property
    def _every(self) -> int:
        # The number of ticks between two decisions.
        hz = self.physics_hz
        if self.ads_hz is None:
            # Decisions are as far apart as possible, with at least 5 per second. If the ticks per second are a whole
            # number, they are a multiple of the ticks between decisions.
            slowest = int(hz / PLANNER_HZ + 1e-9)
            if not isinstance(hz, int):
                return slowest
            return next(n for n in range(slowest, 0, -1) if hz % n == 0)
        # A decision must last a whole number of ticks. The tolerance allows for rounded rates.
        ticks = hz / self.ads_hz
        every = max(round(ticks), 1)
        if abs(ticks - every) > 1e-3 * every:
            lower = max(int(ticks), 1)
            near = {lower, lower + (self.ads_hz < hz)}
            raise WorldError(
                field="ads_hz",
                expected=f"a rate that divides {self._stated.name}'s {hz:.6g} ticks per second",
                received=f"{self.ads_hz:g}",
                fix=f"use {' or '.join(f'{hz / each:.6g}' for each in sorted(near))}",
            )
        return every

    @cached_property
    def _obstacles(self) -> tuple[FixedObject, ...]:
        # The position of an object is always its centre, regardless of the reference point for vehicles.
        stated = replace(self._stated, rear_axle_offset=None)
        frame = Frame(stated, self._on_road.frame.origin)
        found = []
        for x, y, heading, length, width in stated.obstacles:
            # With a length of 0, the point of reference is the centre.
            placed = frame.state((x, y, heading, 0.0), 0.0, 0.0)
            found.append((*placed[:3], length * frame.metres, width * frame.metres))
        return tuple(found)

    def check(self) -> None:
        """Create the simulator now, to check its attributes.

        Raises:
            WorldError: if an attribute cannot be used. The message names it.
        """
        _ = self.rules

    def first_decision(self, scenario: Scenario) -> FirstDecision | None:
        asked = super().first_decision(scenario)
        if asked is None or not self.is_native:
            return asked
        name = self.maker.__name__
        advice = f"{name}.observe returned this input, because native is True. For a planner, set it to False."
        return replace(asked, advice=advice)

    replays_in_gym = False

    is_resumable = True

    def rollout(
        self, scenario: Scenario, ads_factory: AdsFactory, *, decisions: Sequence[Any] = ()
    ) -> Trace:
        """Simulate a scenario with a new policy.

        Args:
            scenario: scenario to run.
            ads_factory: function that returns the policy. It is called once.
            decisions: first decisions of the run, in the form of ``Trace.actions``. The policy makes later decisions.

        Raises:
            ScenarioError: if the scenario does not fit this world.
            AdsFactoryError: if the factory returns an object that cannot drive in this world.
            BadAction: if one of the decisions is not a valid action.
            WorldError: if an attribute of the simulator cannot be used.
            Exception: any exception of the factory or the simulator. An exception in the policy ends the run with
                ``ads_error``.
        """
        self.check_fits(scenario)
        policy = Policy(ads_factory)
        policy.check_drives_in(self)
        # Both need highway-env.
        if policy.simulates or policy.drives_itself:
            raise self._no_planner(ads_factory)
        ads = policy.make()
        if ads.drives_itself:
            raise self._no_planner(ads.given)
        with closing(ads.given, self.hang_limit):
            given = ads.given
            if self.is_native:
                given = ads.policy
            return self._planned(self.rules, scenario, given, decisions, is_native=self.is_native)

    def _no_planner(self, given: Any) -> AdsFactoryError:
        takes = f"the return value of {self.maker.__name__}.observe into an action"
        if not self.is_native:
            takes = "a pafot.Observation into (acceleration, steering)"
        return AdsFactoryError(
            f"ads: expected a callable that turns {takes}, as pafot.SimulatorWorld requires, "
            f"received {given!r:.200}. Use pafot.Highway for a highway-env vehicle class, or "
            "pafot.World for a planner that simulates"
        )

    def _planned(
        self,
        rules: Rules,
        scenario: Scenario,
        ads: Callable[[Any], Any],
        decisions: Sequence[Any] = (),
        body: Body | None = None,
        *,
        is_native: bool = False,
    ) -> Trace:
        guard = HangGuard(rules.hang_limit)
        vehicles = self._vehicles(rules, scenario, body)
        every = self.rules.every
        if is_native:
            driver: PlannerDriver = NativeDriver(vehicles, ads, guard, decisions, every)
        else:
            # Only planners in SI units can have an imperfect perception.
            decides, sight = ads_and_sight(ads)
            driver = planner_driver(vehicles, decides, guard, sight, decisions)
        # A reference driver takes over from an ego that repeats the decisions of the policy, at the policy's rate.
        if isinstance(body, RepeatedBody):
            if self.is_native:
                body.repeats = NativeDriver(vehicles, ads, guard, body.actions, every)
            else:
                body.repeats = planner_driver(
                    vehicles, ads, guard, None, body.actions, rules=self.rules
                )
        try:
            with guard:
                # The simulator starts with these vehicles. Its states then replace the model's states in each tick.
                vehicles.loop.simulation = Simulation(
                    self.simulators, self._on_road.frame, vehicles, guard
                )
        # The guard may raise an error even after the simulation has started.
        except BaseException:
            vehicles.close()
            raise
        return vehicles.drive(driver, guard)

    def _repeated(self, trace: Trace, tick: int) -> Body:
        # The same decisions lead the simulator to the same states.
        length, width = trace.sizes[0].tolist()
        return RepeatedBody(length, width, trace.actions, tick)

    def to_dict(self) -> dict[str, Any]:
        """Return the world as data for a corpus file, with the simulator's ``to_dict()`` as ``simulator``."""
        # The lanes, the speed limit and the tick rate are for the reader, and show whether the simulator has changed.
        data: dict[str, Any] = {
            "lanes": self.road.lane_count,
            "speed_limit": self.road.speed_limit,
            "physics_hz": self.physics_hz,
            "ads_hz": self.ads_hz,
            "duration": self.duration,
            "clearance": self.clearance,
            "headway": self.headway,
            "limits": asdict(self.limits),
            "hang_limit": self.hang_limit,
            "simulator": self._stated.data,
        }
        if self.ego != CAR:
            data["ego"] = self.ego.plain()
        return data

    @classmethod
    def from_dict(cls, simulator: type[Simulator], data: Mapping[str, Any]) -> SimulatorWorld:
        """Create a world from the return value of :meth:`to_dict` and the simulator's class.

        Raises:
            Exception: any exception that the class raises for data that it does not accept.
        """
        given = dict(data)
        stated = {name: given.pop(name) for name in ("lanes", "speed_limit", "physics_hz")}
        # A file from an untrusted source may contain anything here.
        limits = given.pop("limits")
        if not isinstance(limits, dict):
            raise WorldError(
                field="world.data.limits", expected="a mapping", received=f"{limits!r:.200}"
            )
        made = partial(simulator, **given.pop("simulator"))
        world = cls(made, limits=NpcLimits(**limits), **given)
        now = world.to_dict()
        # A simulator that has changed since then would simulate other runs.
        for name, value in stated.items():
            if now[name] != value:
                raise WorldError(
                    field=f"world.data.{name}",
                    expected=f"{now[name]!r:.200}, as in the simulator",
                    received=f"{value!r:.200}",
                )
        return world


class _OnRoad(NamedTuple):
    """A road, the simulator's frame on it, the longest run [s], and highway-env's network if the road is curved."""

    road: Road
    frame: Frame
    longest: float
    network: Any = None


@dataclass(slots=True)
class _Stated:
    """The checked attributes of a simulator. All except its units and axes are in SI units and the axes of a run."""

    maker: type[Simulator]
    metres: float
    metres_per_second: float
    y_is_left: bool
    degrees: bool
    headings: str
    reference: Reference
    rear_axle_offset: float | None
    hz: float
    lane_width: float
    speed_limit: float
    length: float | None
    start_lane: int
    start_speed: float | None
    start_at: float | None
    moves_ego_only: bool
    native: bool
    obstacles: list[FixedObject]
    data: dict[str, Any]
    count: int = 0
    lines: list[Any] | None = None

    @property
    def name(self) -> str:
        return self.maker.__name__


def _check_statements(simulator: Any) -> _Stated:
    """Return the checked attributes of a simulator.

    Raises:
        WorldError: if a value cannot be used. The message names the attribute.
    """
    if not isinstance(simulator, Simulator):
        raise WorldError(
            field="simulator",
            expected="a callable that creates a pafot.Simulator",
            received=f"one that returned {simulator!r:.200}",
        )
    name = type(simulator).__name__
    # First of all, because a misspelt unit would make the values below look wrong.
    _check_names(type(simulator))
    # Units first, because the limits of other values depend on them.
    units = {
        "metres": number_within(f"{name}.metres", simulator.metres, 1e-3, 1e4),
        "metres_per_second": number_within(
            f"{name}.metres_per_second", simulator.metres_per_second, 1e-3, 1e3
        ),
    }

    def refused(field: str, expected: str, value: object, fix: str = "") -> WorldError:
        return WorldError(
            field=f"{name}.{field}", expected=expected, received=f"{value!r:.100}", fix=fix
        )

    def is_on(field: str) -> bool:
        value = getattr(simulator, field)
        if not isinstance(value, bool):
            raise refused(field, "True or False", value)
        return value

    def in_si(field: str, low: float, high: float, unit: str) -> float | None:
        value = getattr(simulator, field)
        if value is None:
            return None
        size = units[unit]
        why = f" if {name}.{unit} is {size:.6g}"
        return number_within(f"{name}.{field}", value, low / size, high / size, why) * size

    def several(field: str, of: str) -> Sequence[Any]:
        # The letters of a string would count as entries, so a string is not accepted.
        value = getattr(simulator, field)
        if isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.ndim):
            return list(value)
        raise refused(field, f"a list or tuple of {of}", value)

    for stated, known in (("headings", get_args(Headings)), ("reference", get_args(Reference))):
        value = getattr(simulator, stated)
        if value not in known:
            raise refused(stated, f"one of {', '.join(map(repr, known))}", value)
    # The offset is required for the rear axle, and has no effect with other points of reference.
    offset = simulator.rear_axle_offset
    reference = simulator.reference
    if offset is None and reference == "rear axle":
        expected = "the distance [m] from a vehicle's centre back to its rear axle, because reference = 'rear axle'"
        fix = "write, for example, rear_axle_offset = 1.4"
        raise refused("rear_axle_offset", expected, offset, fix)
    if offset is not None:
        if reference != "rear axle":
            expected = f"None, because reference = {reference!r}"
            fix = "remove it, or set reference = 'rear axle'"
            raise refused("rear_axle_offset", expected, offset, fix)
        offset = number_within(f"{name}.rear_axle_offset", offset, 0.1, 20.0, " metres")
    for each in several("packages", "package names"):
        if not isinstance(each, str):
            raise refused("packages", "package names, as strings", each)
    # The data of a file must be JSON-compatible.
    data = plain_data(f"{name}.to_dict()", simulator.to_dict())
    if not isinstance(data, dict):
        raise refused("to_dict()", "a dict with the arguments of the class", data)
    try:
        check_plain(f"{name}.to_dict()", data)
    except ValueError as error:
        raise WorldError(str(error)) from None
    # The method of the base class would only fail during a run.
    if is_on("native") and type(simulator).observe is Simulator.observe:
        raise WorldError(
            field=f"{name}.observe",
            expected="a method, because native is True",
            received="none",
            fix="write a method that returns the policy's input",
        )
    found = _Stated(
        maker=type(simulator),
        metres=units["metres"],
        metres_per_second=units["metres_per_second"],
        y_is_left=is_on("y_is_left"),
        degrees=is_on("degrees"),
        headings=simulator.headings,
        reference=reference,
        rear_axle_offset=offset,
        hz=_hz(simulator, name),
        lane_width=in_si("lane_width", 2.0, 10.0, "metres") or LANE_WIDTH,
        speed_limit=in_si("speed_limit", 5.0, TOP_SPEED, "metres_per_second") or PAPER_SPEED_LIMIT,
        length=in_si("length", LEAST_LENGTH, 1e6, "metres"),
        start_lane=whole_within(f"{name}.start_lane", simulator.start_lane, 0, MOST_LANES - 1),
        start_speed=in_si("start_speed", 0.0, TOP_SPEED, "metres_per_second"),
        start_at=in_si("start_at", 0.0, 1e6, "metres"),
        moves_ego_only=is_on("moves_ego_only"),
        native=is_on("native"),
        obstacles=[
            _obstacle(f"{name}.obstacles[{n}]", each)
            for n, each in enumerate(several("obstacles", "objects"))
        ],
        data=data,
    )
    # The number of lanes, or their centre lines.
    if isinstance(simulator.lanes, Real):
        found.count = whole_within(f"{name}.lanes", simulator.lanes, 1, MOST_LANES)
    else:
        frame = Frame(found)
        lines = several("lanes", "centre lines, or a number of lanes")
        found.lines = [_line(f"{name}.lanes[{n}]", line, frame) for n, line in enumerate(lines)]
        found.count = whole_within(f"len({name}.lanes)", len(lines), 1, MOST_LANES)
    whole_within(f"{name}.start_lane", found.start_lane, 0, found.count - 1)
    return found


def _hz(simulator: Simulator, name: str) -> float:
    low, high = PHYSICS_HZ
    dt = simulator.dt
    if dt is not None:
        dt = number_within(f"{name}.dt", dt, 1 / high, 1 / low, " seconds")
    hz = number_within(f"{name}.hz", simulator.hz, low, high)
    if dt is not None and abs(hz * dt - 1.0) > 1e-5:
        raise WorldError(
            field=f"{name}.dt",
            expected=f"1 / hz = {1 / hz:.6g} s",
            received=f"{dt:g} s",
            fix="set either dt or hz, or rename dt to _dt if it is your own attribute",
        )
    return whole_if_possible(hz)


def _check_names(cls: type[Simulator]) -> None:
    """Reject an unused attribute with a name that looks like a misspelling."""
    classes = [
        each
        for each in cls.__mro__[:-1]
        if each is not Simulator and each.__module__ in sys.modules
    ]
    for each in classes:
        if not issubclass(each, Simulator):
            continue  # attributes of other classes, such as a mixin, may have any name
        for name, value in vars(each).items():
            is_own = not name.startswith("_") and not hasattr(Simulator, name)
            if not is_own or not isinstance(value, (int, float, str, list, tuple)):
                continue
            near = difflib.get_close_matches(name, Simulator.__annotations__, n=1, cutoff=0.8)
            meant = OTHER_NAMES.get(name, "".join(near))
            # An attribute that the user's code reads somewhere is no mistake.
            if meant and _uses(name, classes) == 1:
                raise WorldError(
                    field=f"{cls.__name__}.{name}",
                    expected="an attribute of pafot.Simulator",
                    received="an attribute without effect",
                    fix=f"write {meant}, or rename it to _{name} if it is your own attribute",
                )


def _uses(name: str, classes: Sequence[type[Any]]) -> int:
    """Return how often a name occurs in the modules of classes, or 0 without their source code."""
    try:
        sources = {inspect.getsource(sys.modules[each.__module__]) for each in classes}
    except (OSError, TypeError):  # typed interactively, or compiled
        return 0
    return sum(len(re.findall(rf"\b{re.escape(name)}\b", source)) for source in sources)


def _start_on(line: Any, at: float | None) -> tuple[float, float, float]:
    """Return x [m], y [m] and heading [rad] on a centre line, at a position or with enough room behind it."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    lengths = np.concatenate(([0.0], np.cumsum(steps)))
    if at is None:
        at = min(ROOM_BEHIND, float(lengths[-1]) / 4)
    # A metre further along the line gives the heading.
    x, ahead_x = np.interp((at, at + 1), lengths, line[:, 0])
    y, ahead_y = np.interp((at, at + 1), lengths, line[:, 1])
    return x, y, math.atan2(ahead_y - y, ahead_x - x)


def _line(place: str, given: Any, frame: Frame) -> Any:
    try:
        points = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        # Reported below, like all other values that are not points.
        points = np.empty(0)
    is_line = points.ndim == 2 and points.shape[1] == 2 and len(points) >= 2
    if not is_line or not np.isfinite(points).all():
        raise WorldError(
            field=place,
            expected="at least two points (x, y), in the direction of travel",
            received=f"{given!r:.200}",
        )
    # From here on in metres and in the axes of a run.
    line = np.array([frame.point(x, y) for x, y in points.tolist()])
    steps = np.hypot(*np.diff(line, axis=0).T)
    if steps.min() < 1e-3:
        raise WorldError(
            field=f"{place}[{int(steps.argmin()) + 1}]",
            expected="a point that is at least 1 mm from the previous point",
            received="a closer point",
        )
    return line


def _obstacle(place: str, given: Any) -> FixedObject:
    values: list[float] = []
    if isinstance(given, (tuple, list)):
        values = [each for each in given if isinstance(each, (int, float)) and math.isfinite(each)]
    if len(values) != 5 or len(given) != 5:
        raise WorldError(
            field=place,
            expected="five numbers: the x, y, heading, length and width of a fixed object",
            received=f"{given!r:.200}",
        )
    x, y, heading, length, width = map(float, values)
    return x, y, heading, length, width


def whole_if_possible(rate: float) -> float:
    """Return a rate as an int if, apart from rounding errors, it is a whole number."""
    if abs(rate - round(rate)) < 1e-9 * rate:
        return round(rate)
    return rate
