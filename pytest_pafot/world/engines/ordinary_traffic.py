"""Episodes of an unchanged environment: its own start, its own random traffic, and its own flag for crashes.

The start of an episode is the result of ``env.reset`` with its seed. Compiled code then drives the traffic if possible;
otherwise the environment takes its own steps. Both give the same outcome at the same tick, and the same positions up
to rounding, because numpy rounds some functions differently from the C library: less than 1e-9 m on straight roads, and
more where a vehicle crawls, because highway-env's steering is unstable at such speeds (8e-3 m in u-turn-v0).

If a user's environment changes the road or the vehicles on it between two steps, such as in ``_is_truncated``, the road
moves its vehicles itself from then on. Compiled code does not see changes that a vehicle class makes to other vehicles
while it acts.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import MethodType
from typing import Any

import numpy as np
from highway_env.vehicle.objects import Obstacle

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.support.references import described
from pytest_pafot.world.driving.ads import AdsFactory
from pytest_pafot.world.driving.compiled_vehicle import CompiledRoad, constants_of, obstacles_on, road_rules
from pytest_pafot.world.driving.idm_model import CONSTANTS, ORDINARY, idm_model, is_patched, shadowed, takes
from pytest_pafot.world.driving.object_driver import body_of
from pytest_pafot.world.driving.observations import observe_fast, observer
from pytest_pafot.world.driving.policy import Policy
from pytest_pafot.world.driving.policy_driver import View
from pytest_pafot.world.engines import policies
from pytest_pafot.world.engines.episode import Episode, EpisodeRecording, Kind, Start, Step
from pytest_pafot.world.guard.failure import UNFIT, closing, error_of
from pytest_pafot.world.guard.hang_guard import HangGuard, WorldHang
from pytest_pafot.world.gym_environment import NEUTRAL, GymEnvironment, has_known_step, vehicle_classes_kept
from pytest_pafot.world.gym_world import World
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.loop import PlannerDriver
from pytest_pafot.world.kernel.observation import COLUMNS
from pytest_pafot.world.kernel.traffic import OrdinaryTraffic
from pytest_pafot.world.limits import TOP_SPEED
from pytest_pafot.world.stock import ControlledVehicle, MDPVehicle, RegulatedRoad, Road, RoadNetwork, Vehicle, action

PACKAGES = ("highway_env", "gymnasium", "builtins", "abc", "typing", "pytest_pafot")
AT_THE_START = frozenset({
    "default_config", "_reset", "define_spaces", "_make_road", "_make_vehicles", "_create_road", "_create_vehicles",
})  # fmt: skip
"""The functions of environments that are called in a reset alone."""


def has_own_code(env: Any) -> bool:
    """Return whether an environment has functions, other than those for its start, that are not highway-env's."""
    own = [cls for cls in type(env).__mro__ if cls.__module__.partition(".")[0] not in PACKAGES]
    return bool(shadowed(env) - AT_THE_START) or any(set(vars(cls)) - ORDINARY - AT_THE_START for cls in own)


def why_not(start: Start) -> str:
    """Return the reason why compiled code cannot drive the traffic of an episode; empty if it can."""
    env, road, ego, inner, cls = start.env, start.env.road, start.env.vehicle, start.outer, type(start.env)
    while isinstance(inner, NEUTRAL):
        inner = inner.env
    if inner is not env:
        return f"the environment is wrapped in {type(inner).__name__}"
    if not has_known_step(cls):
        return f"{cls.__name__} has its own steps"
    if type(road) not in (Road, RegulatedRoad) or type(road.network) is not RoadNetwork:
        return f"the road is a {type(road).__name__} with a {type(road.network).__name__}"
    if is_patched(type(road)) or shadowed(road):
        return "the road has its own steps"
    if any(map(shadowed, road.network.lanes_list())):
        return "the road has lanes with functions of their own"
    if start.compiled_lanes is None:
        has_limits = all(lane.speed_limit is not None for lane in road.network.lanes_list())
        return f"the road has lanes {'of a class of its own' if has_limits else 'without a speed limit'}"
    if start.kind == "planner" and start.more_than_lanes:
        return f"a planner drives on a road with {start.more_than_lanes}"
    if unknown := _unknown(road.vehicles, road.objects, ego):
        return unknown
    if start.kind == "vehicle" and not isinstance(ego, ControlledVehicle) and hasattr(ego, "target_speed"):
        return f"{type(ego).__name__} has a target speed and no target lane"
    if start.kind == "policy" and type(env.action_type).__module__ != action.__name__:
        return f"the actions are of the class {type(env.action_type).__name__}"
    has_range = getattr(env.action_type, "speed_range", None) is not None  # actions limit the ego's speed to it
    if start.kind == "policy" and (type(ego) not in (MDPVehicle, Vehicle) or has_range):
        return f"the actions drive a {type(ego).__name__} with its own limits"
    decides_itself = start.kind == "planner" or (start.kind == "vehicle" and idm_model(type(ego)) is None)
    if decides_itself and type(road) is RegulatedRoad:
        return f"the road makes vehicles yield, also a {type(ego).__name__}"
    return "the ego is not the first vehicle on its road" if decides_itself and road.vehicles[0] is not ego else ""


def _shown(start: Start) -> dict[int, Any]:
    """Return what compiled code relies on of an environment's lanes, vehicles and objects, each by its identity."""
    road, ego = start.env.road, start.env.vehicle
    found: dict[int, Any] = {id(lane): lane.speed_limit for lane in road.network.lanes_list()}
    for each in (*road.vehicles, *road.objects):
        names = ["heading", "speed", "crashed", "lane_index", "solid", "collidable", "check_collisions", "timer"]
        names += ["route", "MAX_SPEED", "MIN_SPEED", "enable_lane_change", "is_yielding", *CONSTANTS]
        if each is not ego or start.kind != "policy":  # whose action sets the goal, which compiled code takes
            names += ["target_lane_index", "target_speed"]
        held = [getattr(each, name, None) for name in names]
        found[id(each)] = (tuple(map(float, each.position)), each.impact is None, shadowed(each), held)
    return found


def _unknown(vehicles: list[Any], objects: list[Any], ego: Any = None) -> str:
    """Return the reason why compiled code does not know something on a road; empty if it knows everything."""
    for each, is_vehicle in (*((each, True) for each in vehicles), *((each, False) for each in objects)):
        name = type(each).__name__
        if not is_vehicle and (type(each) is not Obstacle or not each.check_collisions):
            return f"there is a {name} on the road"
        if is_vehicle and each is not ego and idm_model(type(each)) is None:
            return f"the traffic has a {name}, not only IDM and MOBIL"
        if "__eq__" in {name for cls in type(each).__mro__[:-1] for name in vars(cls)}:
            return f"a {name} says itself which vehicles are equal to it"
        if is_vehicle and each is not ego and not takes(constants_of(each)):
            return f"a {name} has constants with which IDM and MOBIL have no answer"
        if is_vehicle and (each.MIN_SPEED, each.MAX_SPEED) != (-TOP_SPEED, TOP_SPEED):
            return f"a {name} has its own speed limits"
        if not (each.solid and each.collidable):
            return f"nothing crashes with a {name}"
        if shadowed(each):
            return f"a {name} has its own steps"
    return ""


class Steps:
    """An episode in which the environment takes its own steps; it works for any environment and any ADS.

    Attributes:
        tick: current tick of the episode.
        has_crashed: whether the ego was flagged as crashed. After a crash or an error nothing moves any more, although
            the environment's step goes on to its end.
        error: error of the ADS, if it did not decide, else None.
        reason: reason why the road moves its vehicles itself; empty if compiled code does.
    """

    def __init__(self, start: Start, reason: str, body: Body | None = None) -> None:
        self.tick = 0
        self.has_crashed = False
        self.error: AdsError | None = None
        self.reason = reason
        self._start = start
        self._frames: list[dict[Any, tuple[float, ...]]] | None = None
        self._road_itself = start.env.road
        self._act_itself, self._step_itself = self._road_itself.act, self._road_itself.step
        self._methods = {"act": self._instead("act", self._act), "step": self._instead("step", self._tick)}
        self._ego: Any = Body(start.env.vehicle.LENGTH, start.env.vehicle.WIDTH) if body is None else body
        self._record = start.record() if start.kind == "planner" else None
        self._recorded = start.vehicles
        self._driver = None if self._record is None else start.driver(self._ego, self._record)

    def run(self, seed: int, *, is_recorded: bool) -> Episode:
        """Take steps until the episode is over, and return its result."""
        start, seen, is_over = self._start, self._start.seen, False
        outer, ask = (start.outer, start.action) if start.kind == "policy" else (start.env, lambda *_: None)
        self._frames = [] if is_recorded else None
        self._note()
        while not (is_over or self.has_crashed or self.error or self.tick >= start.ticks):
            before = self.tick
            try:
                action = ask(seen, before)
            except UNFIT as error:
                self.error = error_of(error, before, start.guard)
                break
            try:
                seen, _, is_terminated, is_truncated, _ = self._stepped(outer, action)
            except WorldHang as error:
                self.error = error_of(error, before, start.guard)
                break
            except Exception as error:
                raise start.unfit(error) from error
            is_over = bool(is_terminated or is_truncated)
            if self.tick == before and self.error is None:
                expected, at = "their step to step the environment", f"{before / start.physics_hz:.1f} s of an episode"
                raise WorldError(f"wrappers: expected {expected}, received a step that did not, at {at}")
        return start.ended(seed, self.tick, self.error, steps=self.reason, recording=self._recording())

    def _stepped(self, env: Any, action: Any) -> Any:
        """Return the result of ``env.step``, while ``act`` and ``step`` of the road note or do the episode's ticks."""
        attributes = vars(self._road_itself)
        own = {name: attributes[name] for name in ("act", "step") if name in attributes}
        attributes.update(self._methods)
        try:
            with self._start.around.call():
                return env.step(action)
        finally:
            del attributes["act"], attributes["step"]
            attributes.update(own)

    def _instead(self, name: str, call: Callable[..., None]) -> MethodType:
        """Return a method for the episode's road. A copy of the road, in which an ADS simulates, moves by itself."""
        itself = self._road_itself

        def method(road: Any, *arguments: float) -> None:
            if road is not itself:
                getattr(type(road), name)(road, *arguments)
            elif not (self.has_crashed or self.error):
                call(*arguments)

        return MethodType(method, itself)

    def _act(self) -> None:
        """Let all vehicles decide; the environment has interpreted the action of a policy."""
        if self._driver is not None and self._record is not None:
            self._plan(self._driver, self._record)
        self._guarded(self._act_itself)

    def _step(self, dt: float) -> None:
        """Move all vehicles."""
        self._guarded(self._step_itself, dt)
        self._guarded(body_of, self._start.env.vehicle)  # it raises BadAction for NaN

    def _tick(self, dt: float) -> None:
        """Do a tick, and count it unless the ADS raised an error."""
        self._step(dt)
        if self.error is None:
            self.tick += 1
            self.has_crashed = bool(self._start.env.vehicle.crashed)
            self._note()

    def _guarded(self, call: Callable[..., object], *arguments: Any) -> None:
        """Call code that may be the ADS's, under guard if it is; nothing after an error."""
        if self._start.kind != "vehicle":
            call(*arguments)
        elif self.error is None:
            try:
                self._start.guarded(call, *arguments)
            except UNFIT as error:
                self.error = error_of(error, self.tick, self._start.guard)

    def _plan(self, driver: PlannerDriver, record: array[float]) -> None:
        """Let a planner decide on the vehicles that were there at the start, and set the controls of its ego."""
        straight, ego, count = self._start.straight, self._start.env.vehicle, len(self._recorded)
        for row, each in enumerate(self._recorded):
            at = (self.tick * count + row) * COLUMNS
            pose = straight.project(float(each.position[0]), float(each.position[1]), float(each.heading))
            held = each.action["acceleration"], each.action["steering"]
            record[at : at + 6] = array("d", (*pose, each.speed, *held))
        x, y = map(float, ego.position)
        self._ego.place(*straight.project(x, y, ego.heading), ego.speed)
        if self.tick % driver.every == 0:
            with self._start.around.paused():
                self.error = driver.decide(self.tick)
        driver.actuate()
        ego.control(self._ego.acceleration, self._ego.steering)

    def _note(self) -> None:
        if self._frames is not None:
            poses = {each: (*each.position, each.heading, each.speed) for each in self._start.vehicles}
            self._frames.append(poses)

    def _recording(self) -> EpisodeRecording | None:
        """Return the recording of the ticks so far; None if there is none."""
        if self._frames is None:
            return None
        frames = self._frames
        vehicles, gone = list(dict.fromkeys(each for frame in frames for each in frame)), (math.nan,) * 4
        return EpisodeRecording(
            states=np.array([[frame.get(each, gone) for each in vehicles] for frame in frames], dtype=float),
            sizes=np.array([[each.LENGTH, each.WIDTH] for each in vehicles]),
            lanes=self._start.lanes,
            physics_hz=self._start.physics_hz,
        )


class CompiledSteps(Steps):
    """An episode among highway-env's IDM and MOBIL vehicles, all of which compiled code moves.

    The environment still creates the start and the observations, interprets actions, and decides when the episode is
    over. Before each of these, its vehicles are moved to the places that the compiled code has computed. If it adds
    something to the road that compiled code does not know, the road moves its vehicles itself from then on.
    :func:`why_not` must have returned an empty text for the start.
    """

    def __init__(self, start: Start) -> None:
        env = start.env
        assert start.compiled_lanes is not None  # noqa: S101  (see why_not)
        self._road = CompiledRoad(env.road, start.compiled_lanes)
        self._bodies = {each: self._road.vehicle(each) for each in env.road.vehicles}
        self._objects = list(env.road.objects)
        super().__init__(start, "", self._bodies[env.vehicle])
        self._traffic = OrdinaryTraffic(
            list(self._bodies.values()),
            obstacles_on(env.road),
            1 / start.physics_hz,
            self._record,
            road_rules(env.road, start.compiled_lanes, start.physics_hz),
        )
        self._is_watched = has_own_code(env)
        self._left: dict[int, Any] | None = None  # the road as the last step left it
        if start.kind == "policy":
            env.observation_type.observe = observer(env)

    def step(self, action: Any) -> Step:
        """Take one step with an action, and return the values of ``env.step``; the episode ends at a crash's tick."""
        start = self._start
        seen, reward, is_terminated, is_truncated, info = self._stepped(start.env, action)
        is_over = is_truncated or self.tick + start.every > start.ticks or (self.has_crashed and not is_terminated)
        return seen, float(reward), bool(is_terminated), bool(is_over), info

    def _act(self) -> None:
        """Let the ego decide, unless its model does; the environment has interpreted the action of a policy."""
        start, ego, road = self._start, self._start.env.vehicle, self._road_itself
        if self._left is not None and not self.reason and self.tick % start.every == 0:
            now = _shown(start)
            if any(now.get(each, held) != held for each, held in self._left.items()):
                self._leave("the environment changes its vehicles or their road")
        if start.kind == "policy" and not self.reason and self.tick % start.every == 0:
            self._road.take(ego, self._ego)
        if not self.reason and (road.vehicles != list(self._bodies) or road.objects != self._objects):
            self._follow_changes()
        if self.reason:
            super()._act()
        elif self._driver is not None:
            if self.tick % self._driver.every == 0:
                self.error = self._driver.decide(self.tick)
            self._driver.actuate()
        elif start.kind != "policy" and not self._ego.drives_itself:
            self._show()
            self._guarded(self._move_ego)

    def _move_ego(self) -> None:
        """Let the ego act and step by its own code; the compiled one will be where it has gone."""
        ego = self._start.env.vehicle
        ego.act()
        self._road.take(ego, self._ego)
        ego.step(1 / self._start.physics_hz)
        body_of(ego)  # it raises BadAction for NaN
        self._ego.lead(*self._road.state(ego))

    def _step(self, dt: float) -> None:
        if self.reason:
            super()._step(dt)
            return
        self._traffic.step()
        if self._start.kind == "vehicle" and not self._ego.drives_itself:  # its own step may have set these too
            self._guarded(self._road.take, self._start.env.vehicle, self._ego)
        is_last = (self.tick + 1) % self._start.every == 0
        if self._ego.crashed or self._frames is not None or is_last:
            self._show()
        if is_last and self._is_watched:
            self._left = _shown(self._start)

    def _follow_changes(self) -> None:
        """Drive the vehicles that the environment has added after its last step too, or let the road move them all."""
        road, bodies = self._road_itself, self._bodies
        is_strange = road.objects != self._objects or self._driver is not None  # a planner's record has a fixed size
        changed = "the environment changes what is on its road" if is_strange else ""
        reason = _unknown([each for each in road.vehicles if each not in bodies], []) or changed
        if reason:
            self._show()
            self._leave(reason)
            return
        self._bodies = {each: bodies[each] if each in bodies else self._road.vehicle(each) for each in road.vehicles}
        self._traffic.vehicles = list(self._bodies.values())

    def _leave(self, reason: str) -> None:
        """Let the road move its vehicles itself from now on; they are where compiled code has moved them."""
        self.reason = reason
        for vehicle, body in self._bodies.items():
            if body.is_pushed and vehicle.impact is None:
                vehicle.impact = np.array([body.push_x, body.push_y])
        if isinstance(self._road_itself, RegulatedRoad):
            self._road_itself.steps += self.tick  # it has not counted the ticks of compiled code

    def _show(self) -> None:
        """Move the environment's vehicles to the places of the compiled ones."""
        for vehicle, body in self._bodies.items():
            self._road.show(vehicle, body)


@contextmanager
def _unrewarded(env: Any) -> Iterator[None]:
    """Leave out the reward and the information of an environment's steps, which take time and nothing reads."""
    env._reward, env._info = lambda *_: 0.0, lambda *_: {}
    try:
        yield
    finally:
        del env._reward, env._info  # it is used again


class ScenarioSteps:
    """A run of one scenario that advances by calls of ``step``.

    The world's environment must have one of highway-env's own ``step``, and the scenario must fit the world.
    """

    def __init__(self, world: World, scenario: Scenario) -> None:
        self._run = policies.begin(world.environment, world.rules, scenario, HangGuard(world.rules.hang_limit), None)
        self._env = self._run.driver.env
        self._goes_on = world.ends == "duration"
        self._env.action_space.seed(scenario.seed)

    @property
    def trace(self) -> Trace | None:
        """The trace of the run; None until the run or the episode is over."""
        return self._run.trace

    def reset(self) -> tuple[Any, dict[str, Any]]:
        """Return the first observation and info, as the environment's ``reset`` does."""
        seen = self._run.observe()
        return seen, self._env._info(seen, self._env.action_space.sample())

    def step(self, action: Any) -> Step:
        """Drive with an action of the action space; return the same values as the environment's ``step``.

        The run ends at the tick of first contact. The ego is then marked as crashed for the reward, because highway-env
        does not check for contact in a scenario. A run that ends for a different reason is truncated, unless the
        environment reports that it is terminated.
        """
        run, env = self._run, self._env
        run.take(action, 0.0)
        trace = run.trace
        if trace is not None and trace.error is not None:
            raise RuntimeError(f"{trace.error.kind}: {trace.error.message}\n{trace.error.traceback}")
        if trace is not None and run.vehicles.has_failed:
            raise RuntimeError(trace.ended)
        seen = run.observe()
        env.vehicle.crashed = trace is not None and trace.collision is not None
        reward, ends = float(env._reward(action)), run.ends
        if ends is not None and ends.asked == run.vehicles.loop.tick:  # a method may count its calls
            is_terminated = ends.ended.endswith("_is_terminated")
        else:
            is_terminated = not (trace is None and self._goes_on) and bool(env._is_terminated())
        if is_terminated and trace is None:  # it ends the episode before the run is over, such as behind a merge
            run.trace = trace = run.vehicles.trace(run.driver)
        return seen, reward, is_terminated, trace is not None and not is_terminated, env._info(seen, action)


class SteppedWorld:
    """A world that its caller drives by calls of ``step``, in a scenario or in ordinary traffic."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._ordinary = world.environment.make(has_traffic=True)
        observe_fast(self._ordinary.unwrapped)
        self._guard = HangGuard(world.hang_limit)

    def scenario(self, scenario: Scenario) -> ScenarioSteps:
        """Return the run of a scenario that fits the world."""
        return ScenarioSteps(self._world, scenario)

    def traffic(self, seed: int) -> tuple[Any, Any, dict[str, Any]]:
        """Reset the environment, and return what drives its traffic by ``step``, with what the reset returns.

        Compiled code does, or else the environment itself.
        """
        seen, info = self._ordinary.reset(seed=seed)
        start = Start(outer=self._ordinary, seen=seen, ads=None, kind="policy", guard=self._guard)
        return self._ordinary if why_not(start) else CompiledSteps(start), seen, info


def drive_episode(
    world: World, factory: AdsFactory, seed: int, *, is_planner: bool = False, is_recorded: bool = False
) -> Episode:
    """Drive an episode of a world's own traffic with a new ADS; arguments as of :func:`drive`."""
    hang_limit = world.hang_limit
    return drive(
        world.environment, factory, seed, hang_limit=hang_limit, is_planner=is_planner, is_recorded=is_recorded
    )


def drive(
    environment: GymEnvironment,
    factory: AdsFactory,
    seed: int,
    *,
    hang_limit: float,
    is_planner: bool = False,
    may_compile: bool = True,
    is_recorded: bool = False,
) -> Episode:
    """Drive one episode with a new ADS.

    Args:
        environment: environment, which is reset with the seed.
        factory: factory of an ADS of any kind.
        seed: seed of the episode.
        hang_limit: time after which a decision of the ADS is interrupted and counts as a hang [s].
        is_planner: whether the ADS receives an :class:`pytest_pafot.Observation` and returns acceleration and steering.
        may_compile: whether compiled code may drive the traffic; otherwise the environment takes its own steps.
        is_recorded: whether to record the episode.

    Raises:
        AdsFactoryError: if the factory returns an object that cannot drive.
        WorldError: if the environment cannot be used, or its road is not straight and the ADS is a planner.
    """
    environment.unwrapped  # noqa: B018  (it imports the user's module, whose changes to classes are not undone)
    with vehicle_classes_kept(), HangGuard(hang_limit) as guard:
        outer = environment.with_traffic()
        observe_fast(outer.unwrapped)
        try:
            with environment.in_time():
                seen, _ = outer.reset(seed=seed)
        except WorldError:
            raise
        except Exception as error:
            expected = f"that {environment.env_id}, in its wrappers, can be reset with the seed {seed}"
            raise WorldError(field="world", expected=expected, received=described(error), fix="correct it") from error
        view, policy = None, Policy(factory)
        try:
            if policy.simulates:
                view = View(environment.make().unwrapped, outer.unwrapped)
            made = policy.make() if view is None else policy.make(env=view.env)
        except (AdsFactoryError, WorldError):
            raise
        except UNFIT as error:
            return Episode(seed=seed, outcome=Outcome.ADS_ERROR, seconds=0.0, error=error_of(error, 0, guard))
        with closing(made.given, hang_limit), ExitStack() as at_the_end:
            kind: Kind = "vehicle" if made.drives_itself else "planner" if is_planner else "policy"
            ads, sight = made.decides, made.sight
            start = Start(outer=outer, seen=seen, ads=ads, kind=kind, guard=guard, view=view, seed=seed, sight=sight)
            at_the_end.enter_context(start.around)
            reason = why_not(start) if may_compile else "that was requested"
            steps = Steps(start, reason) if reason else CompiledSteps(start)
            if kind != "policy":
                start.env.observation_type.observe = lambda: 0.0
            # A wrapper may read rewards, and a user's environment may end an episode by them.
            if not has_own_code(start.env) and (kind != "policy" or not reason):
                at_the_end.enter_context(_unrewarded(start.env))
            return steps.run(seed, is_recorded=is_recorded)
