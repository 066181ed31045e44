"""An episode of an environment with its own random traffic: its start and its result."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pytest_pafot.model.sight import Sight
from pytest_pafot.model.trace import AdsError, FloatArray, Lane, Outcome
from pytest_pafot.support.errors import WorldError
from pytest_pafot.support.references import described
from pytest_pafot.world.driving.ads import give_route
from pytest_pafot.world.driving.policy_driver import View, check_action_space, checked_action
from pytest_pafot.world.driving.seeing import ImperfectSensor, hidden_from_policy
from pytest_pafot.world.driving.vehicles import compiled_network, straight_road
from pytest_pafot.world.engines.gym_replay import StockVehicle
from pytest_pafot.world.guard.hang_guard import HangGuard
from pytest_pafot.world.gym_environment import EnvironmentGuard
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.lane_network import Network
from pytest_pafot.world.kernel.loop import PlannerDriver
from pytest_pafot.world.kernel.observation import COLUMNS, Observer, Sensor
from pytest_pafot.world.limits import PLANNER_HZ
from pytest_pafot.world.roads.straight import StraightRoad

POINT_STEP = 2.0
"""The distance between the points of a lane that is not straight [m]."""
LONGEST = 3600.0
"""The longest episode of an environment that does not specify a duration [s]."""

Step = tuple[Any, float, bool, bool, dict[str, Any]]
"""The result of ``env.step``: observation, reward, terminated, truncated, info."""

Kind = Literal["policy", "vehicle", "planner"]
"""The kinds of an ADS. A policy uses the environment's observations and actions. A vehicle is a vehicle class that
drives itself. A planner uses observations and actions in SI units."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRecording:
    """The recorded places of all vehicles in an episode.

    Attributes:
        states: x [m], y [m], heading [rad] and speed [m/s] of each vehicle, the ego first; shape [ticks + 1, vehicles,
            4]. NaN at ticks at which a vehicle was not on the road.
        sizes: length and width of each vehicle [m], shape [vehicles, 2].
        lanes: lanes of the road; lanes that are not straight have points.
        physics_hz: ticks per second.
    """

    states: FloatArray
    sizes: FloatArray
    lanes: tuple[Lane, ...]
    physics_hz: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Episode:
    """The result of an episode.

    Attributes:
        seed: seed of the episode.
        outcome: ``collision`` if highway-env flagged the ego as crashed, ``ads_error`` or ``hang`` if the ADS did not
            decide, else ``safe``.
        seconds: time driven until the crash, the error or the end of the episode [s].
        error: error of the ADS, if it did not decide, else None.
        steps: reason why the environment's own code moved its traffic; empty if compiled code did.
        recording: recording of the episode, if requested, else None.
    """

    seed: int
    outcome: Outcome
    seconds: float
    error: AdsError | None = None
    steps: str = ""
    recording: EpisodeRecording | None = None


@dataclass(eq=False, kw_only=True)
class Start:
    """The start of an episode: an environment after its reset, with an ADS that will drive its ego.

    Attributes:
        outer: environment with its wrappers.
        seen: observation that the reset returned.
        ads: ADS that drives the ego.
        kind: kind of the ADS.
        guard: guard that interrupts the ADS's decisions if they take too long.
        view: copy of the environment that an ADS may simulate in; None if the ADS does not request it.
        seed: seed of the episode and of the errors of an imperfect sight.
        sight: sight of the ADS; None if it is perfect.
        around: guard that interrupts steps of the environment.
        physics_hz: ticks per second.
        ticks: largest number of ticks of the episode.
        every: ticks per step of the environment.
        road: straight road; None if the road is not straight.
    """

    outer: Any
    seen: Any
    ads: Any
    kind: Kind
    guard: HangGuard
    view: View | None = None
    seed: int = 0
    sight: Sight | None = None
    around: EnvironmentGuard = field(init=False)
    physics_hz: int = field(init=False)
    every: int = field(init=False)
    ticks: int = field(init=False)
    road: StraightRoad | None = field(init=False)

    def __post_init__(self) -> None:
        config = self.env.config
        self.around = EnvironmentGuard(self.guard.limit)
        self.physics_hz = int(config["simulation_frequency"])
        self.every = int(config["simulation_frequency"] // config["policy_frequency"])
        longest = min(float(config.get("duration", LONGEST)), LONGEST)
        self.ticks = math.ceil(longest * self.physics_hz) + self.every
        steps = getattr(self.outer.spec, "max_episode_steps", None)  # counted by a wrapper of gymnasium
        if steps is not None:
            self.ticks = min(self.ticks, steps * self.every)
        self.road = straight_road(self.env.road.network)
        if self.kind == "policy":
            check_action_space(self.outer.action_space)
            hidden_from_policy(self.env, self.sight)
            return
        if self.kind == "planner":
            _ = self.straight  # raises now if the road is not straight
        # A vehicle of the given class replaces the environment's own ego.
        env, old, vehicle_class = self.env, self.env.vehicle, self.ads if self.kind == "vehicle" else StockVehicle
        ego = vehicle_class(env.road, old.position, old.heading, old.speed)
        give_route(ego, getattr(old, "route", None))
        env.road.vehicles = [ego if each is old else each for each in env.road.vehicles]
        env.controlled_vehicles = [ego]
        try:
            env.define_spaces()
        except Exception as error:
            raise self.unfit(error) from error

    @cached_property
    def compiled_lanes(self) -> StraightRoad | Network | None:
        """The lanes for compiled code, which is fastest on a plain straight road; None if it does not know them."""
        return compiled_network(self.env.road.network) if self.road is None or self.more_than_lanes else self.road

    @cached_property
    def more_than_lanes(self) -> str:
        """The kinds of things that a straight road has besides lanes of one kind; empty if there are none."""
        road, lanes = self.env.road, self.env.road.network.lanes_list()
        if road.objects or any(getattr(each, "route", None) for each in road.vehicles):
            return "objects or routes"
        if any(lane.forbidden for lane in lanes):
            return "lanes closed to lane changes"
        return "several speed limits" if len({lane.speed_limit for lane in lanes}) > 1 else ""

    @property
    def straight(self) -> StraightRoad:
        """The straight road of the environment.

        Raises:
            WorldError: if the road is not straight, so that no planner can drive on it.
        """
        if self.road is None:
            raise WorldError(
                f"world: expected a straight road for a planner in SI units, received the road of "
                f"{type(self.env).__name__}; give a policy with the environment's own observations and actions, or a "
                "vehicle class"
            )
        return self.road

    def unfit(self, error: Exception) -> WorldError:
        """Return the error for an environment that raised an exception, as it may with an ego of a different class."""
        name, ego = type(self.env).__name__, type(self.env.vehicle).__name__
        return WorldError(
            f"world: expected an environment whose steps work with an ego of the class {ego}, received {name}, "
            f"which raised {described(error)}; rate a policy that returns the environment's own "
            "actions, or use a different environment"
        )

    @property
    def env(self) -> Any:
        """The environment without wrappers."""
        return self.outer.unwrapped

    @property
    def vehicles(self) -> list[Any]:
        """The vehicles of the environment, the ego first."""
        ego = self.env.vehicle
        return [ego, *(each for each in self.env.road.vehicles if each is not ego)]

    @property
    def lanes(self) -> tuple[Lane, ...]:
        """The lanes of the road, as in a recording."""
        if self.road is not None:
            return self.road.lanes
        return tuple(map(_bent, self.env.road.network.lanes_list()))

    def guarded(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Call the ADS's code under the time limit of a decision and return its result."""
        with self.around.paused():
            self.guard.decision_starts()
            try:
                result = call(*arguments)
            finally:
                self.guard.decision_ends()
            self.guard.raise_swallowed()
            return result

    def action(self, seen: Any, tick: int) -> Any:
        """Return the policy's action for an observation.

        Raises:
            BadAction: if the policy returns no valid action. Exceptions of the policy are raised unchanged.
        """
        if self.view is not None:
            self.view.show(tick)
        return checked_action(self.guarded(self.ads, seen), self.outer.action_space)

    def record(self) -> array[float]:
        """Return an empty array for the states of all vehicles at all ticks."""
        return array("d", bytes(8 * (self.ticks + 1) * len(self.vehicles) * COLUMNS))

    def driver(self, body: Body, record: array[float]) -> PlannerDriver:
        """Return the driver that makes a planner's observations from a record and applies its decisions to a body."""
        road = self.straight
        sizes = [(each.LENGTH, each.WIDTH) for each in self.vehicles]
        every = max(1, self.physics_hz // PLANNER_HZ)
        sensor: Sensor = Observer(record, sizes, road.grid, road.speed_limit, self.physics_hz, every)
        if self.sight is not None:
            sensor = ImperfectSensor(sensor, self.sight, self.seed, road.grid, self.physics_hz)
        common: dict[str, Any] = {"lanes": road.lane_count, "lane_width": road.lane_width, "every": every}
        return PlannerDriver(self.ads, self.guard, (), body, body, sensor, dt=1 / self.physics_hz, **common)

    def ended(
        self,
        seed: int,
        tick: int,
        error: AdsError | None,
        *,
        steps: str = "",
        recording: EpisodeRecording | None = None,
    ) -> Episode:
        """Return the result of an episode that ended at a tick; the ego crashed if the environment has flagged it."""
        outcome = Outcome.COLLISION if self.env.vehicle.crashed else Outcome.SAFE
        if error is not None:
            outcome = Outcome.HANG if error.interrupted else Outcome.ADS_ERROR
        seconds = tick / self.physics_hz
        return Episode(seed=seed, outcome=outcome, seconds=seconds, error=error, steps=steps, recording=recording)


def _bent(lane: Any) -> Lane:
    places = np.linspace(0.0, lane.length, max(2, math.ceil(lane.length / POINT_STEP)))
    points = [lane.position(float(place), 0) for place in places]
    return Lane(
        x=float(points[0][0]),
        y=float(points[0][1]),
        heading=float(lane.heading_at(0.0)),
        length=float(lane.length),
        width=float(lane.width_at(0.0)),
        speed_limit=float(lane.speed_limit or 0.0),
        points=tuple((float(x), float(y)) for x, y in points),
    )
