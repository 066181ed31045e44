"""NPCs that the director does not move, each of which is the ego of its driver, and the kinds that others register."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from pytest_pafot.model.instructions import (
    KINDS,
    SHIFTS,
    Free,
    Instruction,
    LaneInstruction,
    Manoeuvre,
    PositionInstruction,
    Recorded,
    ScenarioError,
    check_returns,
    kind_of,
    required_keys,
)
from pytest_pafot.model.instructions.free import NAME
from pytest_pafot.model.scenario import MAX_SEED, Scenario
from pytest_pafot.model.trace import AdsError, FloatArray
from pytest_pafot.model.vehicle_type import CAR, VehicleType
from pytest_pafot.support.errors import AdsFactoryError
from pytest_pafot.world.driving.idm_model import idm_model
from pytest_pafot.world.driving.policy import Ads, Policy
from pytest_pafot.world.guard.chance import OwnDraws
from pytest_pafot.world.guard.failure import closing
from pytest_pafot.world.guard.hang_guard import HangGuard, code_of_driver
from pytest_pafot.world.kernel.action import without_reversing
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.director import DRIVES, Start
from pytest_pafot.world.kernel.idm import GoalVehicle
from pytest_pafot.world.kernel.loop import EgoDriver, ModelDriver, PlannerDriver
from pytest_pafot.world.kernel.network_vehicle import StaticObstacle
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.kernel.places import Places, seated
from pytest_pafot.world.kernel.road_rules import EgosRoadRules
from pytest_pafot.world.run_config import Rules

IDM: Mapping[str, float] = MappingProxyType(
    {
        "LENGTH": CAR.length,
        "WIDTH": CAR.width,
        "ACC_MAX": 6.0,
        "COMFORT_ACC_MAX": 3.0,
        "COMFORT_ACC_MIN": -5.0,
        "DISTANCE_WANTED": 10.0,
        "TIME_WANTED": 1.5,
        "DELTA": 4.0,
        "POLITENESS": 0.0,
        "LANE_CHANGE_MIN_ACC_GAIN": 0.2,
        "LANE_CHANGE_MAX_BRAKING_IMPOSED": 2.0,
        "LANE_CHANGE_DELAY": 1.0,
        "KP_HEADING": 1 / 0.2,
        "KP_LATERAL": 1 / 0.6,
        "MAX_STEERING_ANGLE": math.pi / 3,
        "KP_A": 1 / 0.6,
    }
)
"""The constants of highway-env's ``IDMVehicle``, which would take a second to import. A test compares them."""

SEED_STEP = 0x9E3779B97F4A7C15
"""The distance between the seeds of two drivers, which has no pattern in binary: 2**64 divided by the golden ratio."""


class SeatedDriver(PlannerDriver):
    """The driver of an NPC that is a planner, for which the record has the NPC first, then the ego and all others.

    Args:
        record: the record of the run, shape [ticks + 1, vehicles, columns].
        own: the same with the NPC first, which is copied before each decision.
        npc: the index of the NPC.
        planner: the arguments of :class:`PlannerDriver`.
    """

    def __init__(self, record: FloatArray, own: FloatArray, npc: int, *planner: Any, **common: Any) -> None:
        super().__init__(*planner, **common)
        self._record, self._own, self._npc = record, own, npc
        self._seats = seated(range(record.shape[1]), npc + 1)
        self._copied = 0

    def decide(self, tick: int) -> AdsError | None:
        """Observe from the NPC's place, call the planner under guard, and check and apply its action."""
        self._own[self._copied : tick + 1] = self._record[self._copied : tick + 1, self._seats]
        self._copied = tick + 1
        with code_of_driver(self._npc):
            return super().decide(tick)


class TrafficDriver(ModelDriver):
    """The driver of a free NPC by IDM and MOBIL, which does not reverse as highway-env's does behind a vehicle.

    Args:
        npc: the NPC.
        ego: the ego, of which it sees place and speed: what the ego wants to drive is known to nobody.
        others: the other NPCs and the objects on the road.
        rules: the rules of the road that it obeys; None if there are none.
        dt: physics tick [s].
        kind: what vehicle it is, if that limits what it does; else None.
    """

    def __init__(
        self,
        npc: GoalVehicle,
        ego: Body,
        others: list[Any],
        rules: EgosRoadRules | None,
        dt: float,
        kind: VehicleType | None,
    ) -> None:
        self._ego, self._seen = ego, Body(ego.length, ego.width)
        super().__init__(npc, [self._seen, *others])
        self._yielding = rules
        self._dt = dt
        self._kind = kind

    def actuate(self) -> None:
        """Apply the vehicle's own model, but brake to a standstill at most; then apply the rules of the road."""
        ego = self._ego
        self._seen.place(ego.x, ego.y, ego.heading, ego.speed)
        super().actuate()
        npc = self.ego
        if self._kind is not None:
            npc.acceleration, npc.steering = self._kind.limited(npc.acceleration, npc.steering, npc.speed)
        npc.acceleration = without_reversing(npc.acceleration, npc.speed, self._dt)
        if self._yielding is not None:  # as highway-env's road does, while all are where they were
            self._yielding.apply_to_ego()


class OwnMover(Protocol):
    """A mover, which moves one NPC in the place of the director, for one run.

    Attributes:
        body: the NPC at its start, in world coordinates.
    """

    body: Body

    def driver(self, places: Places, record: Any, guard: HangGuard) -> EgoDriver:
        """Return the driver of the NPC, which is its ego; ``guard`` is that of the decisions of the run."""

    def close(self) -> None:
        """End what the driver has begun, after the run."""


class FreeNpc:
    """A free NPC of one run, or one whose instruction has a driver of its own: a method ``planner`` that makes an ADS.

    Args:
        rules, scenario: the world's rules, and a scenario that fits them.
        npc: its index.
        start: its start.
        stock_road: returns the road as a road of highway-env.
    """

    def __init__(self, rules: Rules, scenario: Scenario, npc: int, start: Start, stock_road: Callable[[], Any]) -> None:
        self._rules = rules
        self._stock_road = stock_road
        self._scenario = scenario
        self._npc = npc
        told: Any = scenario.npcs[npc][0]
        self._planner = getattr(told, "planner", None)
        self._name: str = told.driver if self._planner is None else told.name
        self._speed: float = told.speed
        self._seed = (scenario.seed + (npc + 1) * SEED_STEP) % (MAX_SEED + 1)
        self._draws = OwnDraws(self._seed)
        self._ads: Ads | None = None
        self._objects: list[Body] = []
        self._yields: Callable[[Places], EgosRoadRules | None] = lambda seat: None
        self.body = self._body(start)

    def _body(self, start: Start) -> Body:
        rules, constants, changes_lanes = self._rules, IDM, self._name == "mobil"
        kind = self._scenario.vehicle_of(self._npc)
        if self._planner is not None or self._name not in ("idm", "mobil"):
            self._ads = self._made()
            if not self._ads.drives_itself:
                body = Body(kind.length, kind.width)
                body.place(*start[1])
                return body
            model = idm_model(self._ads.given)
            if model is None:
                raise self._refused(
                    "a planner in SI units, or highway-env's IDMVehicle with other constants",
                    f"{self._name!r}: {self._ads.given!r:.100}, a vehicle class with code of its own",
                    "its code would need highway-env's own road, which has no place for a second ego",
                )
            constants, changes_lanes = model.constants, model.changes_lanes
        # The model measures gaps from centre to centre, so a vehicle that is longer than a car keeps more, and all do
        # if the ego is.
        longer = max(kind.length - CAR.length, 0.0) + max(rules.ego.length - CAR.length, 0.0) / 2
        wanted = constants["DISTANCE_WANTED"] + longer
        constants = {**constants, "LENGTH": kind.length, "WIDTH": kind.width, "DISTANCE_WANTED": wanted}
        vehicle = rules.road.traffic_vehicle(
            constants,
            start,
            changes_lanes=changes_lanes,
            by_network=lambda sections: self._on_network(constants, start, changes_lanes, sections),
        )
        if vehicle is None:
            raise self._refused(
                "a planner, on a road with lanes of other classes than highway-env's own",
                repr(self._name),
                "name a planner in drivers=, or give the NPC a Manoeuvre",
            )
        vehicle.want(min(self._speed, kind.top_speed))  # also where a bend makes it start more slowly
        return vehicle

    def _on_network(
        self, constants: Mapping[str, float], start: Start, changes_lanes: bool, sections: Sequence[tuple[str, str]]
    ) -> GoalVehicle | None:
        """Return a vehicle on highway-env's network, on which it sees fixed objects, and may have to yield."""
        from pytest_pafot.world.driving.compiled_vehicle import egos_rules, traffic_vehicle  # noqa: PLC0415
        from pytest_pafot.world.driving.vehicles import compiled_network  # noqa: PLC0415  (both import highway-env)

        road = self._stock_road()
        lanes = compiled_network(road.network)
        if lanes is None:
            return None
        vehicle = traffic_vehicle(road, lanes, constants, start[1], changes_lanes, sections)
        self._objects = [_standing(*each) for each in self._rules.obstacles]
        self._yields = lambda seat: egos_rules(road, vehicle, seat, self._rules, lanes)
        return vehicle

    def _made(self) -> Ads:
        """Return a new ADS."""
        given = self._planner or self._rules.drivers.get(self._name)
        if given is None:
            raise self._refused(
                "a run that knows the policy under test, which acts in SI units or is a vehicle class",
                repr(self._name),
                "write driver='idm' or 'mobil', or name who drives by world.with_drivers({'policy': MyPlanner}): in "
                "pafot.World with planner_hz= a planner, without it a vehicle class",
            )
        policy = Policy(given)
        if policy.simulates:
            raise self._refused(
                "a driver that decides from its observations",
                f"{self._name!r}, which needs the environment itself (env)",
                "write driver='idm' or 'mobil'",
            )
        try:
            with code_of_driver(self._npc), self._draws:
                return policy.make()
        except AdsFactoryError as error:
            place = f"drivers[{self._name!r}]" if self._planner is None else self._place
            raise AdsFactoryError(f"{place}: {str(error).removeprefix('ads: ')}") from error

    @property
    def _place(self) -> str:
        return f"npcs[{self._npc}][0].{'driver' if self._planner is None else 'planner'}"

    def _refused(self, expected: str, received: str, fix: str) -> ScenarioError:
        return ScenarioError(field=self._place, expected=expected, received=received, fix=fix)

    def driver(self, places: Places, record: Any, guard: HangGuard) -> EgoDriver:
        """Return the driver of the NPC; its decisions are under the same guard as the ego's."""
        rules, road, ads = self._rules, self._rules.road, self._ads
        seat, vehicle = places.seat(self._npc + 1), self._scenario.vehicle_of(self._npc)
        kind, dt = vehicle if vehicle.has_limits else None, 1 / rules.physics_hz
        if isinstance(self.body, GoalVehicle):
            others = [*places.vehicles[1:], *self._objects]
            return TrafficDriver(self.body, places.vehicles[0], others, self._yields(seat), dt, kind)
        assert ads is not None  # noqa: S101  (all other bodies are GoalVehicles)
        rates = rules.physics_hz, rules.physics_hz // (rules.drivers_hz or rules.ads_hz)
        seeded = replace(self._scenario, seed=self._seed)
        rows = np.frombuffer(record).reshape(-1, len(places.vehicles), COLUMNS)
        own = np.empty_like(rows)
        sensor = road.sensor(seat, own.reshape(-1), seeded, rates, ads.sight, rules.ego, self._npc + 1)
        common: dict[str, Any] = {"lanes": road.lane_count, "lane_width": road.lane_width}
        common |= {"every": rates[1], "dt": dt, "kind": kind}
        decides = _drawing(ads.decides, self._draws)
        planner = decides, guard, (), self.body, seat.bodies[0], sensor
        return SeatedDriver(rows, own, self._npc, *planner, **common)

    def close(self) -> None:
        """Close the ADS."""
        if self._ads is not None:
            with code_of_driver(self._npc), closing(self._ads.given, self._rules.hang_limit):
                pass


class BySimulator:
    """A free NPC that a driver of the user's simulator drives: nothing is decided here, and the simulator moves it.

    Args:
        kind: what vehicle it is.
        start: its start.
    """

    def __init__(self, kind: VehicleType, start: Start) -> None:
        self.body = Body(kind.length, kind.width)
        self.body.place(*start[1])

    def driver(self, places: Places, record: Any, guard: HangGuard) -> EgoDriver:
        """Return a driver that does nothing."""
        return EgoDriver(self.body, 1)

    def close(self) -> None:
        """Do nothing."""


MOVERS: dict[type[Instruction], Callable[[Rules, Scenario, int, Start, Callable[[], Any]], OwnMover]] = {
    Free: FreeNpc,
}
"""What moves the NPC of each kind of instruction that ``drives_itself``, made for each run."""

WAYS: Mapping[str, tuple[type[Instruction], frozenset[str]]] = MappingProxyType(
    {
        "grid": (PositionInstruction, frozenset({"cell", "on_grid", "target", "aimed"})),
        "lanes": (LaneInstruction, frozenset({"lane", "column", "target", "aimed"})),
        "steps": (Manoeuvre, frozenset({"beside", "ahead", "steps"})),
        "track": (Recorded, frozenset({"beside", "ahead", "steps", "at", "is_as_recorded", "follows_track", "track"})),
        "itself": (Free, frozenset({"beside", "ahead", "drives_itself"})),
    }
)
"""The names of the ways to drive, see :data:`~pytest_pafot.world.kernel.director.DRIVES`, each with the kind of this
package that drives so, and what is read of an instruction in addition to its speed; a flag among it must be true."""


def register(kind: Any, drives: str, mover: Callable[..., OwnMover] | None = None) -> None:
    """Let scenarios, files, searches and reports have instructions of a kind, as those of this package.

    Args:
        kind: the kind, a frozen dataclass. One that replaces a class of the same module and name, as in a notebook, is
            the kind from now on.
        drives: how its NPCs drive: ``"grid"``, ``"lanes"``, ``"steps"``, ``"track"`` or ``"itself"``.
        mover: what moves an NPC that drives by itself. If it is None, its method ``planner`` makes a planner for each
            run, which is asked as that of a free NPC: it sees the road from the NPC's place.

    Raises:
        ScenarioError: if the kind lacks something, or cannot be told from another one.
    """
    is_data = isinstance(kind, type) and issubclass(kind, Instruction) and is_dataclass(kind)
    if not is_data or not kind.__dataclass_params__.frozen:
        raise ScenarioError(field="kind", expected="a frozen dataclass of Instruction", received=f"{kind!r:.100}")
    ways = [way for way in WAYS if (way == "itself") == kind.drives_itself]
    if drives not in ways or (mover is not None and drives != "itself"):
        expected = f"one of {', '.join(ways)} for a kind with drives_itself = {kind.drives_itself}"
        raise ScenarioError(field="drives", expected=expected, received=repr(drives), fix="only itself has a mover")
    needed = {"name", "marks", "speed", *WAYS[drives][1]} | ({"planner"} if kind.drives_itself and not mover else set())
    there = {each.name for each in fields(kind)}
    lacking = {each for each in needed - there if getattr(kind, each, None) is getattr(Instruction, each, None)}
    if lacking := lacking | kind.__abstractmethods__:
        expected, received = f"{', '.join(sorted(needed))} and a goal", f"none of {', '.join(sorted(lacking))}"
        raise ScenarioError(field=kind.__name__, expected=expected, received=received)
    was = (kind.__module__, kind.__qualname__)
    others = [each for each in KINDS if (each.__module__, each.__qualname__) != was]
    if not NAME.fullmatch(kind.name) or kind.name in (*SHIFTS, *(getattr(each, "name", "") for each in others)):
        expected, fix = "a name that no other kind has", "it has up to 40 letters, digits, _ and -"
        raise ScenarioError(field=f"{kind.__name__}.name", expected=expected, received=repr(kind.name), fix=fix)
    for each in (*others, kind):
        if (read := kind_of(required_keys(each), (*others, kind))) is not each:
            expected, received = "keys of files that tell it from each other kind", f"{', '.join(sorted(kind.marks))}"
            fix = f"a {each.__name__} would be read as a {read.__name__}; list all keys that each file of the kind has"
            raise ScenarioError(field=f"{kind.__name__}.marks", expected=expected, received=received, fix=fix)
    check_returns(kind)
    KINDS[:] = [*others, kind]
    DRIVES[kind] = DRIVES[WAYS[drives][0]]
    if kind.drives_itself:
        MOVERS[kind] = mover or FreeNpc


def movers_of(
    rules: Rules, scenario: Scenario, starts: Sequence[Start], stock_road: Callable[[], Any]
) -> dict[int, OwnMover]:
    """Return what moves each NPC that the director does not move, by its index."""
    made: dict[int, OwnMover] = {}
    for npc, chain in enumerate(scenario.npcs):
        if not chain[0].drives_itself:
            continue
        if rules.drivers.get(getattr(chain[0], "driver", "")) is BySimulator:
            made[npc] = BySimulator(scenario.vehicle_of(npc), starts[npc])
        else:
            made[npc] = MOVERS[type(chain[0])](rules, scenario, npc, starts[npc], stock_road)
    return made


def _standing(x: float, y: float, heading: float, length: float, width: float) -> StaticObstacle:
    """Return a fixed object, behind which models of traffic brake."""
    body = StaticObstacle(length, width)
    body.place(x, y, heading, 0.0)
    return body


def _drawing(decides: Callable[[Any], Any], draws: OwnDraws) -> Callable[[Any], Any]:
    """Return an ADS that draws from generators of its own."""

    def decide(observation: Any) -> Any:
        with draws:
            return decides(observation)

    return decide
