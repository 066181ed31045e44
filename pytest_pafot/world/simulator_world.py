"""The world that drives scenarios in a simulator of the user's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np

from pytest_pafot.findings.finding import DRIVEN_ON
from pytest_pafot.model.instructions import BUILT_IN_DRIVERS, ScenarioError, checked_driver
from pytest_pafot.model.scenario import EGO_SPEED, PAPER_SPEED_LIMIT, Scenario
from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.base_world import RoadStart
from pytest_pafot.world.built_in import BuiltInWorld
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.engines.egos import planner_driver, planner_run
from pytest_pafot.world.engines.npc_drivers import BySimulator
from pytest_pafot.world.engines.run import SteppedRun
from pytest_pafot.world.engines.simulation import Frame, RepeatedBody, Simulation, Simulator, Simulators
from pytest_pafot.world.guard.failure import closing
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.limits import CLEARANCE, HANG_LIMIT, HEADWAY, TOP_SPEED, NpcLimits
from pytest_pafot.world.roads.road import Road
from pytest_pafot.world.roads.straight import StraightRoad, ego_start
from pytest_pafot.world.run_config import Rules
from pytest_pafot.world.validation import (
    ADS_HZ,
    PHYSICS_HZ,
    check_divides,
    check_ticks,
    number_within,
    plain_data,
    whole_within,
)

LANE_WIDTH = 4.0
"""The width of lanes if a simulator states none [m]."""
MOST_LANES = 12
"""The largest number of lanes."""
LEAST_LENGTH = 100.0
"""The least length of a road [m]."""
ROOM_BEHIND = 150.0
"""The length of a road behind the ego's start if a simulator does not say where it starts [m]."""


@dataclass(frozen=True, kw_only=True)
class SimulatorWorld(BuiltInWorld):
    """A world in which a simulator of the user's moves all vehicles; see :class:`pytest_pafot.Simulator`.

    The ADS is a planner, as in :class:`pytest_pafot.Highway`: a callable from :class:`pytest_pafot.Observation` to
    ``(acceleration [m/s^2], steering [rad])`` or a :class:`pytest_pafot.Drive`.

    Attributes:
        simulator: the class of the simulator, or a function without parameters that makes one.
        ads_hz: decisions of the ADS per second; a divisor of the simulator's ``hz``. None for 5, or for the next larger
            divisor.
        duration: the longest duration of a run [s].
        clearance, headway, limits, hang_limit, lasts, npc_drivers, ego: as in :class:`pytest_pafot.Highway`. A method
            of the simulator may take ten times ``hang_limit``, and a minute in any case.

    Raises:
        WorldError: if a value cannot be used. The simulator itself is made and checked at the first use.
    """

    simulator: Callable[[], Simulator] = field(kw_only=False)
    ads_hz: int | None = None
    duration: float = 60.0
    clearance: float = CLEARANCE
    headway: float = HEADWAY
    limits: NpcLimits = field(default_factory=NpcLimits)
    ego: VehicleType = CAR
    hang_limit: float = HANG_LIMIT
    lasts: float | None = field(default=None, compare=False)
    npc_drivers: Mapping[str, AdsFactory] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        if isinstance(self.simulator, Simulator) or not callable(self.simulator):
            expected = "the class of a pafot.Simulator, or a function without parameters that makes one"
            name = type(self.simulator).__name__
            fix = f"write pafot.SimulatorWorld({name}), or functools.partial({name}, ...) with its arguments"
            raise WorldError(field="simulator", expected=expected, received=f"{self.simulator!r:.200}", fix=fix)
        if self.ads_hz is not None:
            object.__setattr__(self, "ads_hz", whole_within("ads_hz", self.ads_hz, *ADS_HZ))
        object.__setattr__(self, "duration", number_within("duration", self.duration, 0.1, 3600.0))
        self._check_fields()

    @cached_property
    def _simulators(self) -> Simulators:
        return Simulators(self.simulator)

    @cached_property
    def _stated(self) -> SimpleNamespace:
        """What the simulator states, checked, in SI units and the axes of a run."""
        simulators = self._simulators
        made = simulators.take()
        try:
            stated = _stated(made)
        finally:
            simulators.give(made)
        return stated

    @property
    def physics_hz(self) -> int:
        """The simulator's ticks per second."""
        hz: int = self._stated.hz
        return hz

    @property
    def name(self) -> str:
        """The name of the simulator's class."""
        name: str = self._stated.name
        return name

    @property
    def speed_limit(self) -> float:
        """The speed limit [m/s]."""
        return self.road.speed_limit

    @property
    def start(self) -> tuple[int, float] | None:
        """The lane and speed [m/s] with which the ego must start; None on a straight road, which allows any."""
        return self.road.prescribed

    @property
    def road_start(self) -> RoadStart | None:
        """The lane and speed of :attr:`start`, with the ticks per second; None on a straight road."""
        return None if self.start is None else RoadStart(*self.start, physics_hz=self.physics_hz)

    @cached_property
    def road(self) -> Road:
        """The road: straight, or the ego's way along lanes of any shape."""
        return self._on_road[0]

    @cached_property
    def _on_road(self) -> tuple[Road, Frame]:
        """The road, and the axes of the simulator on it."""
        stated = self._stated
        lines, width, limit = stated.lines, stated.lane_width, stated.speed_limit
        self.limits.top_speed(limit)
        if lines is None:
            endless = 100.0 + 2 * ego_start(self.headway, self.clearance) + TOP_SPEED * (self.duration + DRIVEN_ON)
            length = stated.length or endless
            return StraightRoad.uniform(stated.count, length, width, limit), Frame(stated)
        from pytest_pafot.world.roads.lines import straight_along  # noqa: PLC0415  (only for lanes with points)

        if (found := straight_along(lines, width)) is not None:
            origin, length = found
            return StraightRoad.uniform(len(lines), length, width, limit), Frame(stated, origin)
        from pytest_pafot.world.roads.survey import survey  # noqa: PLC0415  (only for bent roads)

        lane, at = stated.start_lane, stated.start_at
        line = lines[lane]
        lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
        if at is None:
            at = min(ROOM_BEHIND, float(lengths[-1]) / 4)
        x, y = (float(np.interp(at, lengths, line[:, axis])) for axis in (0, 1))
        ahead = np.array([np.interp(at + 0.5, lengths, line[:, axis]) for axis in (0, 1)])
        heading = math.atan2(ahead[1] - y, ahead[0] - x)
        speed = min(EGO_SPEED, limit) if stated.start_speed is None else stated.start_speed
        ego = SimpleNamespace(position=np.array([x, y]), heading=heading, speed=speed)
        env = SimpleNamespace(road=SimpleNamespace(network=self.network), vehicle=ego)
        return survey(env, stated.name, self.limits, self.duration * TOP_SPEED), Frame(stated)

    @cached_property
    def network(self) -> Any:
        """The road as a road network of highway-env."""
        from pytest_pafot.world.driving.vehicles import SearchedLanes, straight_network  # noqa: PLC0415  (highway-env)

        stated = self._stated
        if stated.lines is not None:
            from pytest_pafot.world.roads.lines import network_of, straight_along  # noqa: PLC0415

            if straight_along(stated.lines, stated.lane_width) is None:
                return SearchedLanes(network_of(stated.lines, stated.lane_width, stated.speed_limit))
        lane = self.road.lanes[0]
        return SearchedLanes(straight_network(self.road.lane_count, lane.length, lane.width, self.speed_limit))

    @property
    def stock_road(self) -> Any:
        """The road as a road of highway-env without vehicles."""
        from pytest_pafot.world.stock import Road  # noqa: PLC0415  (imports highway-env)

        return Road(self.network)

    @cached_property
    def _rules(self) -> Rules:
        road, duration, hz = self.road, self.duration, self.physics_hz
        ads_hz = self.ads_hz or next(each for each in range(5, hz + 1) if hz % each == 0)
        check_divides((f"{self.name}.hz", hz), ("ads_hz", ads_hz))
        check_ticks(duration, hz)
        if isinstance(road, StraightRoad):
            room = (road.length - 2 * ego_start(self.headway, self.clearance)) / TOP_SPEED
            if room < 1.0:
                least = 2 * ego_start(self.headway, self.clearance) + TOP_SPEED
                received = f"{road.length:g} m"
                raise WorldError(
                    field=f"{self.name}.lanes", expected=f"a road of {least:g} m or more", received=received
                )
            duration = min(duration, math.floor(room * hz) / hz)
        elif (speed := road.prescribed[1] if road.prescribed else 0.0) > 0:
            duration = min(duration, (getattr(road, "end") - road.ego_start(0.0, 0.0)) / speed)  # noqa: B009
        rules = self._rules_on(road, physics_hz=hz, ads_hz=ads_hz, duration=duration, obstacles=self._obstacles)
        return replace(rules, drivers=dict.fromkeys(self._stated.drivers, BySimulator))

    @cached_property
    def _obstacles(self) -> tuple[tuple[float, float, float, float, float], ...]:
        """The fixed objects: x [m], y [m], heading [rad], length and width [m]."""
        frame, found = self._on_road[1], []
        for x, y, heading, length, width in self._stated.obstacles:
            placed = frame.state((x, y, heading, 0.0), 0.0, 0.0)
            found.append((*placed[:3], length * frame.metres, width * frame.metres))
        return tuple(found)

    @property
    def rules(self) -> Rules:
        """The settings that all runs have in common, with the drivers of the simulator's own."""
        rules = super().rules
        return replace(rules, drivers={**self._rules.drivers, **self.npc_drivers})

    def check(self) -> None:
        """Make the simulator now, to check what it states.

        Raises:
            WorldError: if it cannot be used; the message names the field.
        """
        _ = self.rules

    def check_fits(self, scenario: Scenario) -> None:
        """Check a scenario against this world.

        Raises:
            ScenarioError: if the scenario does not fit; the error names the field.
            WorldError: if the simulator cannot be used.
        """
        super().check_fits(scenario)
        for npc, chain in enumerate(scenario.npcs):
            if chain[0].follows_track and not self._stated.follows_recordings:
                raise ScenarioError(
                    field=f"npcs[{npc}][0]",
                    expected=f"no recorded NPC in {self.name}, which does not follow recordings",
                    received=chain[0].goal,
                    fix="let step put vehicles with control.recorded where the control says, and set "
                    "follows_recordings = True",
                )

    @property
    def replays_in_gym(self) -> bool:
        """False, because a simulator is no environment."""
        return False

    @property
    def is_resumable(self) -> bool:
        """True, because :meth:`rollout` accepts ``decisions``."""
        return True

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, *, decisions: Sequence[Any] = ()) -> Trace:
        """Simulate a scenario with a fresh ADS.

        Args:
            scenario: the scenario to run; it is checked against this world.
            ads_factory: a callable that returns the ADS, called once.
            decisions: the first decisions of the run, in the form of ``Trace.actions``; the ADS is not called for
                them. Decisions beyond the end of the run are ignored.

        Raises:
            ScenarioError: if the scenario does not fit this world.
            AdsFactoryError: if the factory returns nothing that can drive here.
            BadAction: if one of the decisions is not a valid action.
            WorldError: if the simulator states what cannot be.
            Exception: any exception of the factory or the simulator itself. An exception of the ADS ends the run as
                ``ads_error``.
        """
        self.check_fits(scenario)
        policy = Policy(ads_factory)
        policy.check_drives_in(self)
        if policy.simulates or policy.drives_itself:
            raise self._no_planner(ads_factory)
        ads, rules = policy.make(), self.driven_in((scenario,), ads_factory).rules
        if ads.drives_itself:
            raise self._no_planner(ads.given)
        with closing(ads.given, self.hang_limit):
            return self._planned(rules, scenario, ads.given, decisions)

    def _no_planner(self, given: Any) -> AdsFactoryError:
        return AdsFactoryError(
            f"ads: expected a planner, a callable from a pafot.Observation to (acceleration, steering), in a simulator "
            f"of your own, received {given!r:.200}; a vehicle class of highway-env drives in pafot.Highway, and a "
            "planner that simulates in pafot.World"
        )

    def _planned(
        self,
        rules: Rules,
        scenario: Scenario,
        ads: Callable[[Any], Any],
        decisions: Sequence[Any] = (),
        body: Body | None = None,
    ) -> Trace:
        guard = HangGuard(rules.hang_limit)
        run = planner_run(rules, scenario, lambda: self.stock_road, ads, guard, decisions=decisions, body=body)
        if isinstance(body, RepeatedBody):
            own = replace(rules, ads_hz=rules.drivers_hz or rules.ads_hz)
            body.repeats = planner_driver(run.vehicles, None, guard, None, rules=own)
        with guard:
            self._simulate(run, scenario, guard)
        return run.finish()

    def _begin(self, scenario: Scenario, guard: HangGuard, sight: Sight | None) -> SteppedRun:
        run = planner_run(self.rules, scenario, lambda: self.stock_road, None, guard, sight=sight)
        self._simulate(run, scenario, guard)
        return run

    def _simulate(self, run: SteppedRun, scenario: Scenario, guard: HangGuard) -> None:
        """Let the simulator move the vehicles of a run that begins."""
        frame, vehicles = self._on_road[1], run.vehicles
        try:
            vehicles.loop.simulation = Simulation(self._simulators, frame, vehicles, scenario.seed, guard)
        except BaseException:
            vehicles.close()
            raise

    def _repeated(self, trace: Trace, tick: int) -> Body:
        """Return an ego that repeats its decisions up to a tick, which leads the simulator to the same states."""
        return RepeatedBody(*trace.sizes[0], trace.actions, tick)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for a corpus file, which holds no code: a replay needs the world that its test names."""
        stated, road = self._stated, self.road
        limits = asdict(self.limits)
        own = {"lanes": road.lane_count, "speed_limit": road.speed_limit, "physics_hz": stated.hz}
        own |= {"ads_hz": self._rules.ads_hz, "duration": self.duration}
        own |= {name: getattr(self, name) for name in ("clearance", "headway")}
        data = {"kind": "simulator", "class": stated.name, **own, "limits": limits, "hang_limit": self.hang_limit}
        if stated.data:
            data["data"] = stated.data
        return data if self.ego == CAR else {**data, "ego": self.ego.plain()}


def _stated(simulator: Simulator) -> SimpleNamespace:
    """Return what a simulator states, checked, in SI units and the axes of a run.

    Raises:
        WorldError: for a value that cannot be used; the message names the field.
    """
    name = type(simulator).__name__
    if not isinstance(simulator, Simulator):
        expected = "that it makes a pafot.Simulator"
        raise WorldError(field="simulator", expected=expected, received=f"{simulator!r:.200}")
    at = lambda field: f"{name}.{field}"  # noqa: E731
    metres = number_within(at("metres"), simulator.metres, 1e-3, 1e4)
    unit = number_within(at("metres_per_second"), simulator.metres_per_second, 1e-3, 1e3)

    def in_si(field: str, default: float | None, low: float, high: float, of: float) -> float | None:
        value = getattr(simulator, field)
        if value is None:
            return default
        return number_within(f"{at(field)} [SI]", number_within(at(field), value, -1e9, 1e9) * of, low, high)

    found = SimpleNamespace(
        name=name,
        hz=whole_within(at("hz"), simulator.hz, *PHYSICS_HZ),
        metres=metres,
        metres_per_second=unit,
        lane_width=in_si("lane_width", LANE_WIDTH, 2.0, 10.0, metres),
        speed_limit=in_si("speed_limit", PAPER_SPEED_LIMIT, 5.0, TOP_SPEED, unit),
        length=in_si("length", None, LEAST_LENGTH, 1e6, metres),
        start_speed=in_si("start_speed", None, 0.0, TOP_SPEED, unit),
        start_at=in_si("start_at", None, 0.0, 1e6, metres),
        start_lane=0,
        follows_recordings=bool(simulator.follows_recordings),
        drivers=tuple(map(checked_driver, simulator.drivers)),
        lines=None,
        count=0,
        data=plain_data(at("to_dict()"), simulator.to_dict()),
    )
    for flag in ("y_is_left", "degrees", "from_north", "at_front"):
        if not isinstance(value := getattr(simulator, flag), bool):
            raise WorldError(field=at(flag), expected="True or False", received=f"{value!r:.100}")
        setattr(found, flag, value)
    if own := [each for each in found.drivers if each in BUILT_IN_DRIVERS]:
        expected = f"other names than {', '.join(BUILT_IN_DRIVERS)}, which the package has"
        raise WorldError(field=at("drivers"), expected=expected, received=own[0])
    if isinstance(simulator.lanes, int):
        found.count = whole_within(at("lanes"), simulator.lanes, 1, MOST_LANES)
    else:
        frame = Frame(found)
        found.lines = [_line(at(f"lanes[{number}]"), line, frame) for number, line in enumerate(simulator.lanes)]
        found.count = whole_within(f"len({at('lanes')})", len(found.lines), 1, MOST_LANES)
    found.start_lane = whole_within(at("start_lane"), simulator.start_lane, 0, found.count - 1)
    found.obstacles = [_obstacle(at(f"obstacles[{number}]"), each) for number, each in enumerate(simulator.obstacles)]
    return found


def _line(place: str, given: Any, frame: Frame) -> Any:
    """Return the points of a lane in the axes of a run [m]."""
    try:
        points = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        points = np.empty(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.isfinite(points).all():
        expected = "x and y of two points or more, in the direction of driving"
        raise WorldError(field=place, expected=expected, received=f"{given!r:.200}")
    line = np.array([frame.point(x, y) for x, y in points.tolist()])
    steps = np.hypot(*np.diff(line, axis=0).T)
    if steps.min() < 1e-3:
        number = int(steps.argmin())
        expected = "points at least a millimetre from each other"
        raise WorldError(field=f"{place}[{number + 1}]", expected=expected, received="the point before it")
    return line


def _obstacle(place: str, given: Any) -> tuple[float, ...]:
    values = tuple(given) if isinstance(given, (tuple, list)) else ()
    if len(values) != 5 or not all(isinstance(each, (int, float)) and math.isfinite(each) for each in values):
        expected = "x, y, heading, length and width of a fixed object"
        raise WorldError(field=place, expected=expected, received=f"{given!r:.200}")
    return tuple(map(float, values))
