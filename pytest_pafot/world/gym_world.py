"""A registered highway-env environment as a world: its road, observations, actions and frequencies, our NPCs."""

from __future__ import annotations

import copy
import difflib
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world import validation as checks
from pytest_pafot.world.errors import AdsFactoryError, WorldError
from pytest_pafot.world.limits import CLEARANCE, HANG_LIMIT, HEADWAY, NpcLimits
from pytest_pafot.world.referable import References
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.roads.straight import StraightRoad

if TYPE_CHECKING:
    from pytest_pafot.world.driving.ads import AdsFactory, EgoDriver
    from pytest_pafot.world.driving.guard import HangGuard
    from pytest_pafot.world.driving.policy import Policy
    from pytest_pafot.world.engines.lock_step import Stepped
    from pytest_pafot.world.run_config import Rules


LONGEST_RUN = 60.0
"""Where neither the option nor the environment says how long a run lasts, and on circuits [s]; the paper's."""

TRAFFIC = ("initial_vehicle_count", "other_vehicles", "spawn_probability")
"""What environments call their random traffic, besides ``vehicles_count``."""

LEAST_HZ = MappingProxyType({"simulation_frequency": 5, "policy_frequency": 1})

_REPLACED = (*TRAFFIC, "vehicles_count", "offscreen_rendering")
"""Options that are not as given while scenarios run; how to draw also depends on the machine."""


@dataclass(frozen=True)
class World(References):
    """An environment that is registered with gymnasium and derives from highway-env's ``AbstractEnv``.

    Its ADS is a callable from the environment's own observation to its own action, or a highway-env vehicle class
    that drives itself, or comes from a factory with a parameter ``env`` for planners that simulate inside the
    environment. The environment's road is kept; its random traffic is replaced by the NPCs.

    Attributes:
        env_id: such as ``"highway-v0"``.
        config: the environment's configuration, as for ``gymnasium.make(env_id, config=config)``.
        duration: of a run, at most [s]; by default the environment's own ``duration``.
        clearance, headway, limits, hang_limit: as in :class:`pytest_pafot.Highway`.
        wrappers: callables that take an environment and return it wrapped, such as gymnasium's wrappers, put around
            what ``gymnasium.make`` gives, the first one innermost; runs then go through ``env.step`` of the whole. By
            default none, and an environment that is registered with wrappers is refused.

    Raises:
        WorldError: when the environment cannot be used; the message says why. The environment itself is made at
            the first use, or by :meth:`check`.
    """

    env_id: str
    config: dict[str, Any] | None = field(default=None, hash=False)
    duration: float | None = None
    clearance: float = CLEARANCE
    headway: float = HEADWAY
    limits: NpcLimits = field(default_factory=NpcLimits)
    hang_limit: float = HANG_LIMIT
    wrappers: Sequence[Callable[[Any], Any]] | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.env_id, str) or not self.env_id or ":" in self.env_id:
            raise WorldError(
                field="env_id",
                expected='the id of a registered environment without a module in front, such as "highway-v0"',
                received=repr(self.env_id),
                fix="import the module that registers it first",
            )
        if self.config is not None and not isinstance(self.config, dict):
            expected = "a dict of the environment's options"
            raise WorldError(field="config", expected=expected, received=repr(self.config))
        object.__setattr__(self, "config", checks.plain("config", self.config))
        for name, low, high in (("clearance", 0.0, 50.0), ("headway", 0.0, 10.0), ("hang_limit", 0.01, 86400.0)):
            object.__setattr__(self, name, checks.number(name, getattr(self, name), low, high))
        if self.duration is not None:
            object.__setattr__(self, "duration", checks.number("duration", self.duration, 0.1, 3600.0))
        if not isinstance(self.limits, NpcLimits):
            raise WorldError(field="limits", expected="pafot.NpcLimits(...)", received=repr(self.limits))
        if self.wrappers is not None:
            object.__setattr__(self, "wrappers", checks.callables("wrappers", self.wrappers))

    def check(self) -> None:
        """Make the environment now, to see whether it can be used.

        Raises:
            WorldError: when it cannot; the message says why.
        """
        road = self.road
        checks.top_speed(self.limits, road)
        if isinstance(road, StraightRoad):
            checks.road_is_long_enough(road, 2 * self.rules.ego_start, self.rules.duration)

    def check_fits(self, scenario: Scenario) -> None:
        """Check the environment, and a scenario against it.

        Raises:
            ScenarioError: naming the field that does not fit.
            WorldError: when the environment cannot be used.
        """
        self.check()
        checks.fits(scenario, self.rules)

    @property
    def road(self) -> StraightRoad | NetworkRoad:
        """The environment's road; where it is not straight, the ego's way through it."""
        return self.rules.road

    @property
    def lanes(self) -> int:
        """Number of lanes; on roads that are not straight, of those along the ego's way."""
        return self.road.lane_count

    @property
    def start(self) -> tuple[int, float] | None:
        """The ego's lane and speed [m/s] as the environment has them; None on a straight road, where any will do."""
        road = self.road
        return None if isinstance(road, StraightRoad) else (road.ego_lane, road.ego_speed)

    @property
    def speed_limit(self) -> float:
        """Of the fastest lane [m/s]."""
        return self.road.speed_limit

    @property
    def longest_run(self) -> float:
        """How long a run lasts that nothing ends early [s]."""
        return self.rules.duration

    @property
    def physics_hz(self) -> int:
        """The environment's ``simulation_frequency``."""
        return self.rules.physics_hz

    @property
    def ads_hz(self) -> int:
        """The environment's ``policy_frequency``."""
        return self.rules.ads_hz

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario with a fresh ADS.

        Args:
            scenario: to run; checked against this world.
            ads_factory: called once, gives the ADS; with ``env=`` if it has such a parameter.

        Raises:
            ScenarioError: when the scenario does not fit this world.
            AdsFactoryError: when the factory gives nothing that can drive here.
            WorldError: when the environment cannot be used.
            Exception: whatever the factory itself raises. What the ADS raises ends the run as ``ads_error``.
        """
        from pytest_pafot.world.driving.ads import SelfDriving, is_vehicle_class, made, wants_env  # noqa: PLC0415
        from pytest_pafot.world.driving.policy import Policy, View  # noqa: PLC0415
        from pytest_pafot.world.engines.object_engine import run  # noqa: PLC0415

        self.check_fits(scenario)
        if not isinstance(self.road, StraightRoad) and not wants_env(ads_factory):
            ads_factory = _once(made(ads_factory))
        if self.wrappers is not None or self._steps_itself(is_vehicle_class(ads_factory)):
            from pytest_pafot.world.engines.gym_replay import replay_in_gym  # noqa: PLC0415

            return replay_in_gym(self, scenario, ads_factory)
        env = self._env_of(scenario)

        def make_ego(start: tuple[float, float, float]) -> EgoDriver:
            if is_vehicle_class(ads_factory):
                return SelfDriving(ads_factory, env.road, start, scenario.ego_speed, self.route)
            _put_ego(env, start, scenario.ego_speed, self.route)
            if wants_env(ads_factory):
                view = View(self._make_env(), env)
                return Policy(made(ads_factory, env=view.env), env, self.physics_hz // self.ads_hz, view)
            ads = made(ads_factory)
            if is_vehicle_class(ads):
                return SelfDriving(ads, env.road, start, scenario.ego_speed, self.route)
            return Policy(ads, env, self.physics_hz // self.ads_hz)

        return run(self.rules, scenario, env.road, make_ego)

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario as :meth:`rollout` does, by ``env.step`` of the plain environment.

        Args:
            scenario: to run, as :attr:`pytest_pafot.Trace.executed` has it; it must fit this world.
            ads_factory: called once, gives the ADS.
        """
        from pytest_pafot.world.engines.gym_replay import replay_in_gym  # noqa: PLC0415

        return replay_in_gym(self, scenario, ads_factory)

    def rollout_batch(self, scenarios: Sequence[Scenario], ads_factory: AdsFactory) -> list[Trace]:
        """Simulate scenarios in lock step, where this world has that and the ADS has ``batch``; else one by one.

        Args:
            scenarios: to run; checked against this world.
            ads_factory: gives the ADS; see :mod:`pytest_pafot.world.engines.lock_step` on what an ADS with ``batch``
                promises.

        Raises:
            ScenarioError: when a scenario does not fit this world.
            AdsFactoryError: when the factory gives nothing that can drive here, or ``batch`` not one action for
                each observation.
            WorldError: when the environment cannot be used.
            Exception: whatever the factory itself raises. What the ADS raises ends its run as ``ads_error``.
        """
        from pytest_pafot.world.engines.lock_step import rollouts  # noqa: PLC0415

        for scenario in scenarios:
            self.check_fits(scenario)
        if not self.has_lock_step:
            return [self.rollout(scenario, ads_factory) for scenario in scenarios]
        return rollouts(scenarios, ads_factory, self._stepped, self.rollout, self.hang_limit)

    @property
    def has_lock_step(self) -> bool:
        """Whether runs can take place in lock step: not by the steps of a whole environment, nor on bends."""
        return isinstance(self.road, StraightRoad) and self.wrappers is None and not self._steps_itself(False)

    def _stepped(self, scenario: Scenario, guard: HangGuard) -> Stepped:
        """Begin a run that is given its actions."""
        from pytest_pafot.world.driving.policy import Policy  # noqa: PLC0415
        from pytest_pafot.world.engines.object_engine import SteppedRun  # noqa: PLC0415

        env = self._env_of(scenario)

        def make_ego(start: tuple[float, float, float]) -> Policy:
            _put_ego(env, start, scenario.ego_speed, self.route)
            return Policy(None, env, self.physics_hz // self.ads_hz)

        return SteppedRun(self.rules, scenario, env.road, make_ego, guard)

    def _env_of(self, scenario: Scenario) -> Any:
        """The environment of one run, without vehicles; runs may nest and share no state."""
        from highway_env.road.road import Road  # noqa: PLC0415  (a second of imports, paid by the first run)

        from pytest_pafot.world.driving.policy import moved  # noqa: PLC0415

        env = copy.copy(self._env)
        env.np_random = _generator(scenario.seed)
        env.time = env.steps = 0
        env.road = Road(
            self.network,
            np_random=env.np_random,
            neighbour_vehicles_connected_lanes=env.config.get("neighbour_vehicles_connected_lanes", False),
        )
        env.road.objects = moved(self._env.road.objects, env.road)
        return env

    @property
    def route(self) -> tuple[Any, ...] | None:
        """The ego's, as the environment has planned it for a vehicle that follows one; None without."""
        route = None if isinstance(self.road, StraightRoad) else getattr(self._env.vehicle, "route", None)
        return None if route is None else tuple(route)

    def _steps_itself(self, drives_itself: bool) -> bool:
        """Whether a run needs the environment's own steps: they are its own, or its road does more than move vehicles.

        An ego that drives itself takes no part in the steps of the environment, only in those of the road.
        """
        from highway_env.envs.common.abstract import AbstractEnv  # noqa: PLC0415
        from highway_env.road.road import Road  # noqa: PLC0415

        env = type(self._env)
        has_own_road = type(self._env.road).step is not Road.step or type(self._env.road).act is not Road.act
        has_own_step = env.step is not AbstractEnv.step or env._simulate is not AbstractEnv._simulate
        return has_own_road or (has_own_step and not drives_itself)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for a corpus file; :func:`pytest_pafot.world.from_dict` reads it.

        It is complete: the configuration with the environment's own defaults, and the duration that comes of it.
        Defaults that are no plain data are left out.

        Raises:
            WorldError: when the environment cannot be used.
        """
        is_straight = isinstance(self.road, StraightRoad)
        duration = self._wanted if is_straight else min(self._wanted, self._longest)
        data = {"kind": "gym", **asdict(replace(self, wrappers=None))}
        data |= {"config": self._whole_config(), "duration": duration}
        del data["wrappers"]
        return data if self.wrappers is None else {**data, "wrappers": self.wrapper_names}

    @property
    def wrapper_names(self) -> list[str]:
        """The classes of the wrappers, from the inside out, those of the registration included."""
        from pytest_pafot.world import wrappers as wrapping  # noqa: PLC0415

        return wrapping.names(self._outer)

    def _whole_config(self) -> dict[str, Any]:
        """The options of the environment with the values that it has, or would have with its random traffic."""
        env = self._env
        values = {**type(env).default_config(), **self._given_config()}
        values |= {name: env.config[name] for name in values if name in env.config and name not in _REPLACED}
        config: dict[str, Any] = {}
        for name, value in values.items():
            with suppress(WorldError):
                config[name] = checks.plain(f"config.{name}", value)
        return config

    def _given_config(self) -> dict[str, Any]:
        """Instead of the environment's defaults; that of the registration where there is no other, as in gymnasium."""
        import gymnasium  # noqa: PLC0415

        registered: dict[str, Any] = gymnasium.registry[self.env_id].kwargs.get("config") or {}
        return registered if self.config is None else self.config

    @cached_property
    def _env(self) -> Any:
        return self._outer.unwrapped

    @cached_property
    def _outer(self) -> Any:
        return self.make()

    def _make_env(self) -> Any:
        return self.make().unwrapped

    def make(self) -> Any:
        """A fresh environment without traffic in all its wrappers, as ``gymnasium.make`` gives it.

        Raises:
            WorldError: when the environment cannot be used.
        """
        import gymnasium  # noqa: PLC0415
        import highway_env  # noqa: F401, PLC0415  (registers its environments)
        from highway_env.envs.common.abstract import AbstractEnv  # noqa: PLC0415

        from pytest_pafot.world import wrappers as wrapping  # noqa: PLC0415

        if self.env_id not in gymnasium.registry:
            known = sorted(name for name in gymnasium.registry if name.startswith("highway"))
            near = difflib.get_close_matches(self.env_id, gymnasium.registry, n=1)
            raise WorldError(
                field="env_id",
                expected="a registered environment",
                received=repr(self.env_id),
                fix=f"highway-env's straight roads are {', '.join(known)}; an environment of your own must be "
                f"registered by an import before it is used{f'; did you mean {near[0]!r}?' if near else ''}",
            )
        creator = _creator(gymnasium.registry[self.env_id].entry_point)
        if isinstance(creator, type) and not issubclass(creator, AbstractEnv):
            raise WorldError(
                field="env_id",
                expected="an environment that derives from highway-env's AbstractEnv",
                received=f"{self.env_id!r} ({creator.__name__})",
            )
        self._check_sizes(creator)
        try:
            with vehicle_classes_kept():
                env = _made(self.env_id, creator, self._given_config())
        except Exception as error:
            raise WorldError(
                field="config",
                expected=f"a configuration that the environment {self.env_id} accepts",
                received=f"{self.config!r:.200}",
                fix=f"it raised {type(error).__name__}: {error!s:.200}",
            ) from error
        plain = env.unwrapped
        if not isinstance(plain, AbstractEnv):
            raise WorldError(
                field="env_id",
                expected="an environment that derives from highway-env's AbstractEnv",
                received=f"{self.env_id!r} ({type(plain).__name__})",
            )
        self._check_config(type(plain).default_config(), plain.config)
        self._check_kinds(plain)
        if self.wrappers is None:
            wrapping.check_bare(env, self.env_id)
        return wrapping.put_on(env, self.wrappers or ())

    def _check_sizes(self, creator: Any) -> None:
        """Refuse what would take the environment minutes to make; what options of your own mean is not known."""
        given = {name: value for name, value in (self.config or {}).items() if name not in _REPLACED}
        for name in ("simulation_frequency", "policy_frequency"):
            if name in given:
                checks.whole(f"config.{name}", given[name], LEAST_HZ[name], 1000)
        if not str(getattr(creator, "__module__", "")).startswith("highway_env."):
            given = {name: given[name] for name in ("observation", "action") if name in given}
        checks.sizes("config", given)

    def _check_config(self, known: dict[str, Any], config: dict[str, Any]) -> None:
        unknown = sorted(set(self.config or {}) - set(known))
        if unknown:
            near = difflib.get_close_matches(unknown[0], known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"it has {', '.join(sorted(known))}"
            expected = f"options of {self.env_id}"
            raise WorldError(field="config", expected=expected, received=", ".join(unknown), fix=hint)
        for name, value in (self.config or {}).items():
            if isinstance(value, str) and isinstance(known[name], (int, float)):  # it would fail once a run needs it
                expected = f"a number such as {known[name]!r}"
                raise WorldError(field=f"config.{name}", expected=expected, received=repr(value))
        if config.get("controlled_vehicles", 1) != 1:
            raise WorldError(
                field="config.controlled_vehicles",
                expected="1, the ego",
                received=repr(config["controlled_vehicles"]),
                fix="the other vehicles are the NPCs",
            )

    def _check_kinds(self, env: Any) -> None:
        """Refuse misspelt options of highway-env's own observations and actions; what others take is not known."""
        from highway_env.envs.common import action, observation  # noqa: PLC0415

        given, default = self.config or {}, type(env).default_config()
        for name, module in (("observation", observation), ("action", action)):
            kind = getattr(env, f"{name}_type", None)
            if name in given and type(kind).__module__ == module.__name__:
                checks.known_options(f"config.{name}", given[name], {*_options(module), *default.get(name, ())})

    @cached_property
    def network(self) -> Any:
        """The road as highway-env has it."""
        from pytest_pafot.world.driving.vehicles import ParallelLanes, SearchedLanes  # noqa: PLC0415

        if isinstance(self.road, StraightRoad):
            return ParallelLanes(self._plain_network)
        return SearchedLanes(self._plain_network)

    @cached_property
    def _plain_network(self) -> Any:
        return self._env.road.network

    @cached_property
    def rules(self) -> Rules:
        """What all runs have in common."""
        from pytest_pafot.world.driving.vehicles import straight_road  # noqa: PLC0415
        from pytest_pafot.world.run_config import Rules  # noqa: PLC0415

        config = self._env.config
        physics_hz, ads_hz = (
            checks.whole(f"config.{name}", config[name], least, 1000) for name, least in LEAST_HZ.items()
        )
        checks.divides(("config.simulation_frequency", physics_hz), ("config.policy_frequency", ads_hz))
        duration = self._wanted
        checks.ticks(duration, physics_hz)
        road: StraightRoad | NetworkRoad | None = straight_road(self._plain_network)
        if road is None:
            road, duration = self._way(duration)
        return Rules(
            road=road,
            physics_hz=physics_hz,
            ads_hz=ads_hz,
            duration=duration,
            clearance=self.clearance,
            headway=self.headway,
            limits=self.limits,
            hang_limit=self.hang_limit,
        )

    @property
    def _wanted(self) -> float:
        """How long a run on a straight road lasts [s]."""
        config, name = self._env.config, "config.duration" if self.duration is None else "duration"
        value = config.get("duration", LONGEST_RUN) if self.duration is None else self.duration
        return checks.number(name, value, 1 / config["simulation_frequency"], 3600.0)

    @property
    def _longest(self) -> float:
        """How long a run on any other road may last [s]."""
        own = checks.number("config.duration", self._env.config.get("duration", LONGEST_RUN), 0.0, math.inf)
        return min(own, LONGEST_RUN if self.duration is None else math.inf)

    def _way(self, wanted: float) -> tuple[NetworkRoad, float]:
        """The ego's way, and how long a run on it lasts [s].

        At most as wanted, as the environment's own episodes, and as the ego needs at its first speed to the end of the
        road.
        """
        from pytest_pafot.world.roads.survey import survey  # noqa: PLC0415

        most = min(wanted, self._longest)
        road = survey(self._env, self.env_id, self.limits, ahead=most * checks.TOP_SPEED)
        if road.ego_speed > 0:
            most = min(most, (road.end - road.start) / road.ego_speed)
        return road, most


def _once(ads: Any) -> AdsFactory:
    """A factory of what has been made already."""
    from pytest_pafot.world.driving.ads import is_vehicle_class  # noqa: PLC0415

    if is_vehicle_class(ads):
        made: AdsFactory = ads
        return made
    return lambda: ads


def _made(env_id: str, creator: Any, given: dict[str, Any]) -> Any:
    """An environment without traffic, in the wrappers that it is registered with.

    Where its road is not straight, it is as a reset with seed 0 leaves it: road and start may depend on chance.
    """
    import inspect  # noqa: PLC0415

    import gymnasium  # noqa: PLC0415

    from pytest_pafot.world.driving.vehicles import straight_road  # noqa: PLC0415

    known = creator.default_config() if hasattr(creator, "default_config") else {}
    config = _as_known(_with_tuples(given), known)
    config |= {"vehicles_count": 0, **{name: 0 for name in TRAFFIC if name in known}}
    parameters = inspect.signature(creator).parameters
    takes_config = "config" in parameters or any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    keywords: dict[str, Any] = {"config": config} if takes_config else {}
    with warnings.catch_warnings():  # whoever names merge-v0 has chosen it, and needs not be told in every run
        warnings.filterwarnings("ignore", message=".*is out of date", category=DeprecationWarning)
        env: Any = gymnasium.make(env_id, disable_env_checker=True, **keywords)
    plain: Any = env.unwrapped
    if not takes_config and hasattr(plain, "configure"):
        plain.configure(config)
    if getattr(plain, "road", None) is not None and straight_road(plain.road.network) is None:
        plain.reset(seed=0)
    return env


def _put_ego(env: Any, start: tuple[float, float, float], speed: float, route: tuple[Any, ...] | None) -> None:
    """The environment's own ego at a start, on a route."""
    from pytest_pafot.world.driving.ads import follow  # noqa: PLC0415

    x, y, heading = start
    ego = env.action_type.vehicle_class(env.road, [x, y], heading, speed)
    ego.check_collisions = False
    follow(ego, route)
    env.controlled_vehicles = [ego]
    env.road.vehicles = [ego]
    env.define_spaces()


def _options(module: Any) -> set[str]:
    """What any class of observations or actions of a module takes.

    Each of them takes the options of all others, too, and highway-env's own configurations make use of that.
    """
    import inspect  # noqa: PLC0415

    kinds = [each for each in vars(module).values() if inspect.isclass(each) and each.__module__ == module.__name__]
    taken = {name for kind in kinds for name in inspect.signature(kind).parameters}
    return (taken - {"env", "kwargs"}) | {"type", "flatten"}  # intersection-v0 has "flatten", which none takes


def _creator(entry_point: Any) -> Any:
    from gymnasium.envs.registration import load_env_creator  # noqa: PLC0415

    return load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point


@contextmanager
def vehicle_classes_kept() -> Iterator[None]:
    """Undo what an environment writes to highway-env's vehicle classes.

    intersection-v0 sets the IDM's distances on the class itself, for every other environment of the process; without
    this, an environment that was merely tried would change how an IDM ego drives from then on.
    """
    from highway_env.vehicle.kinematics import Vehicle  # noqa: PLC0415

    classes, queue = set(), [Vehicle]
    while queue:
        classes.add(queue[-1])
        queue.extend(queue.pop().__subclasses__())
    before = {cls: {name: value for name, value in vars(cls).items() if name.isupper()} for cls in classes}
    try:
        yield
    finally:
        for cls, constants in before.items():
            for name in [name for name in vars(cls) if name.isupper() and name not in constants]:
                delattr(cls, name)
            for name, value in constants.items():
                if vars(cls)[name] is not value:
                    setattr(cls, name, value)


def _as_known(config: dict[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """A copy with the environment's own value wherever plain data, which has no tuples or arrays, means that value."""

    def is_known(name: str, value: Any) -> bool:
        with suppress(WorldError):
            return name in known and repr(checks.plain(name, value)) == repr(checks.plain(name, known[name]))
        return False

    return {name: known[name] if is_known(name, value) else value for name, value in config.items()}


def _with_tuples(config: Any) -> Any:
    """A copy with a tuple where highway-env insists on one."""
    if isinstance(config, list):
        return [_with_tuples(item) for item in config]
    if not isinstance(config, dict):
        return config
    copied = {key: _with_tuples(item) for key, item in config.items()}
    if isinstance(copied.get("observation_shape"), list):
        copied["observation_shape"] = tuple(copied["observation_shape"])
    return copied


def _generator(seed: int) -> Any:
    import numpy as np  # noqa: PLC0415

    return np.random.default_rng(seed)


__all__ = ["AdsFactoryError", "World"]
