"""A world with the road, observations, actions and rates of a registered environment derived from highway-env."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import TYPE_CHECKING, Any, Literal, get_args

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.base_world import BaseWorld, EgoVehicle
from pytest_pafot.world.driving.policy import AdsFactory, Policy
from pytest_pafot.world.engines.run import (
    ADS_HZ,
    OTHER_KIND,
    PHYSICS_HZ,
    OwnEnds,
    Rules,
    VehiclesOfRun,
    check_divides,
    check_ticks,
    plain_data,
)
from pytest_pafot.world.guard.hang_guard import HangGuard, closing
from pytest_pafot.world.limits import (
    CLEARANCE,
    HANG_LIMIT,
    HEADWAY,
    TOP_SPEED,
    NpcLimits,
    number_within,
    whole_within,
)
from pytest_pafot.world.roads.road import Meeting, Road

if TYPE_CHECKING:
    from pytest_pafot.world.gym_environment import GymEnvironment

Ends = Literal["environment", "duration"]
ENDS: tuple[Ends, ...] = get_args(Ends)

# The duration [s] of a run in the paper. It limits the default on curved roads, and is the default if an environment
# specifies no duration.
LONGEST_RUN = 60.0


@dataclass(frozen=True)
class World(BaseWorld):
    """A world on the road of a registered gymnasium environment that is derived from highway-env's ``AbstractEnv``.

    The policy receives the observations of the environment and returns actions. The policy's factory can have a
    parameter ``env``, for a planner that simulates inside the environment. The policy can also be a highway-env vehicle
    class, which drives itself. If ``planner_hz`` is set, the policy is a planner in SI units, as
    in :class:`pytest_pafot.Highway`. The NPCs replace the environment's random traffic.

    Attributes:
        env_id: id of the registered environment, such as ``"highway-v0"``.
        config: options of the environment, as in ``gymnasium.make(env_id, config=config)``.
        duration: longest duration [s] of a run. The default is the ``duration`` of the environment, but at most 60 s on
            a curved road.
        clearance, headway, limits, hang_limit: as in :class:`pytest_pafot.Highway`.
        wrappers: functions that wrap an environment and return the result, with the innermost wrapper first. Required
            if the environment is registered with wrappers.
        planner_hz: decisions of a planner per second, a divisor of the ``simulation_frequency``. None for a policy that
            uses the environment's observations and actions.
        lasts, ego: as in :class:`pytest_pafot.Highway`.
        ends: ``"environment"`` if the environment can end a run early, or ``"duration"`` if it cannot.

    Raises:
        WorldError: if an argument cannot be used. The environment itself is created by :meth:`check`, or at its first
            use.
    """

    env_id: str
    config: dict[str, Any] | None = field(default=None, hash=False)
    duration: float | None = None
    clearance: float = CLEARANCE
    headway: float = HEADWAY
    limits: NpcLimits = field(default_factory=NpcLimits)
    hang_limit: float = HANG_LIMIT
    wrappers: Sequence[Callable[[Any], Any]] | None = None
    planner_hz: int | None = None
    lasts: float | None = field(default=None, compare=False)
    ego: EgoVehicle = CAR  # type: ignore[assignment]
    ends: Ends = "environment"

    def __post_init__(self) -> None:
        if not isinstance(self.env_id, str) or not self.env_id or ":" in self.env_id:
            fix = "first import the module that registers the environment"
            if not isinstance(self.env_id, str):
                fix += f", or write {OTHER_KIND}"
            raise WorldError(
                field="env_id",
                expected='the id of a registered environment, without a module name, such as "highway-v0"',
                received=repr(self.env_id),
                fix=fix,
            )
        if self.config is not None and not isinstance(self.config, dict):
            raise WorldError(
                field="config",
                expected="a dict of the environment's options",
                received=repr(self.config),
            )
        # A copy, so that later changes of the user's dict have no effect.
        object.__setattr__(self, "config", plain_data("config", self.config))
        self._check_fields()
        if self.duration is not None:
            self._check_number("duration", 0.1, 3600.0)
        if self.planner_hz is not None:
            self._check_whole("planner_hz", *ADS_HZ)
        if self.ends not in ENDS:
            raise self._refused("ends", " or ".join(map(repr, ENDS)))
        if self.wrappers is None:
            return
        if self.planner_hz is not None:
            raise self._refused(
                "wrappers",
                "no wrappers with planner_hz=, because a planner in SI units does not act through wrappers",
            )
        if not isinstance(self.wrappers, (list, tuple)):
            raise self._refused("wrappers", "a list of callables")
        for index, each in enumerate(self.wrappers):
            if not callable(each):
                field = f"wrappers[{index}]"
                raise WorldError(
                    field=field,
                    expected="a callable",
                    received=f"{each!r:.200}",
                )
        # A tuple, because worlds are compared and hashed.
        object.__setattr__(self, "wrappers", tuple(self.wrappers))

    def check(self) -> None:
        """Create the environment now, to check that it can be used.

        Raises:
            WorldError: if the environment cannot be used. The message states why.
        """
        rules = self.rules
        road = rules.road
        self.limits.top_speed(road.speed_limit)
        room = road.length - 2 * rules.ego_start
        if rules.duration * TOP_SPEED > room:  # a vehicle could reach the end of the road
            raise WorldError(
                field="duration",
                expected=f"at most {room / TOP_SPEED:g} s on a road of {road.length:g} m",
                received=f"{rules.duration:g}",
            )

    def check_fits(self, scenario: Scenario) -> None:
        self.check()
        super().check_fits(scenario)

    @property
    def road(self) -> Road:
        """The environment's road if it is straight, and otherwise the ego's path through it."""
        return self.rules.road

    @property
    def lanes(self) -> int:
        # On a curved road, the number of lanes along the ego's path.
        return self.road.lane_count

    @property
    def unused_roads(self) -> frozenset[Meeting]:
        environment = self.environment
        if not environment.is_stock and environment.steps_itself(drives_itself=False):
            return frozenset()  # the user's code may move vehicles on all roads
        return self.road.unused

    @property
    def speed_limit(self) -> float:
        # The limit of the fastest lane [m/s].
        return self.road.speed_limit

    @property
    def observation_space(self) -> Any:
        # The space of the outermost wrapper; None for a planner in SI units.
        if self.planner_hz is not None:
            return None
        return self.environment.outer.observation_space

    @property
    def action_space(self) -> Any:
        # The space of the outermost wrapper; None for a planner in SI units.
        if self.planner_hz is not None:
            return None
        return self.environment.outer.action_space

    @property
    def physics_hz(self) -> float:
        return self.rules.physics_hz

    @property
    def ads_hz(self) -> float:
        return self.rules.ads_hz

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario with a new policy.

        Args:
            scenario: scenario to run.
            ads_factory: function that returns the policy. It is called once, with ``env=`` if it has such a parameter.

        Raises:
            ScenarioError: if the scenario does not fit this world.
            AdsFactoryError: if the factory returns an object that cannot drive in this world.
            WorldError: if the environment cannot be used.
            Exception: any exception of the factory. An exception in the policy ends the run with ``ads_error``.
        """
        self.check_fits(scenario)
        policy = Policy(ads_factory)
        policy.check_drives_in(self)
        is_planner = self.planner_hz is not None
        environment = self.environment
        rules = self.rules
        if is_planner and policy.simulates:
            raise AdsFactoryError(
                "ads: expected a factory without the parameter `env`, because planner_hz= is for planners that receive "
                "a pafot.Observation. For planners that simulate inside the environment, omit planner_hz="
            )
        if (rules.ends_in_steps or not rules.road.is_straight) and not policy.simulates:
            # In some environments, policies need the environment's own steps, but vehicle classes do not.
            ads = policy.make()
            if ads.drives_itself:
                policy = Policy(ads.given)
            else:
                # The factory must be called only once for each run, and its result is known already.
                policy = Policy(wraps(ads_factory, updated=())(lambda: ads.given))
        drives_itself = is_planner or policy.drives_itself
        if not drives_itself:
            environment.check_keeps_no_ego()
        if not drives_itself or rules.ends:
            environment.traffic  # noqa: B018  (it raises an error if the NPCs cannot have its class)
        # An ego that acts through wrappers, or in an environment with its own `step`, needs complete episodes.
        has_wrappers = self.wrappers is not None and not drives_itself
        if has_wrappers or environment.episodes_itself(drives_itself=drives_itself):
            return self.rollout_in_gym(scenario, policy.factory)
        if is_planner:
            ads = policy.make()
            if not ads.drives_itself:
                with closing(ads.given, self.hang_limit):
                    return self._planned(rules, scenario, ads.given)
            policy = Policy(ads.given)
        from pytest_pafot.world.engines import policies  # noqa: PLC0415  (imports highway-env)

        return policies.rollout(environment, rules, scenario, policy, self._own_ends)

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario as :meth:`rollout` does, but entirely with ``env.step`` of the environment."""
        from pytest_pafot.world.engines.gym_replay import replay_environment  # noqa: PLC0415  (imports highway-env)

        is_planner = self.planner_hz is not None
        return replay_environment(
            self.environment, self.rules, scenario, Policy(ads_factory), is_planner=is_planner
        )

    def _own_ends(self, vehicles: VehiclesOfRun, guard: HangGuard) -> OwnEnds | None:
        from pytest_pafot.world.engines import gym_replay, policies  # noqa: PLC0415  (import highway-env)

        ends_beside: Callable[..., OwnEnds | None] = policies.ends_beside
        if vehicles.rules.ends_in_steps:
            ends_beside = gym_replay.episode_beside
        return ends_beside(self.environment, vehicles, guard)

    def options_without_effect(
        self, *, drives_itself: bool, simulates: bool = False
    ) -> dict[str, list[str]]:
        return self.environment.without_effect(
            is_planner=self.planner_hz is not None,
            drives_itself=drives_itself,
            simulates=simulates,
            ends=self.ends == "environment",
        )

    @property
    def left_out(self) -> dict[str, tuple[str, ...]]:
        environment = self.environment
        is_episode = self.wrappers is not None or environment.episodes_itself(drives_itself=False)
        if is_episode or self.planner_hz is not None:
            return {}
        left_out = environment.left_out
        if self.ends == "duration":
            return left_out
        asked = environment.own_ends
        return {name: changed for name, changed in left_out.items() if name not in asked}

    def to_dict(self) -> dict[str, Any]:
        """Return the world as data for a corpus file.

        Raises:
            WorldError: if the environment cannot be used.
        """
        data = {"kind": "gym", **self._to_dict(wrappers=None)}
        data["config"] = self.environment.whole_config
        data["duration"] = self._wanted
        if not self.road.is_straight:
            data["duration"] = min(self._wanted, self._longest)
        if self.planner_hz is None:
            del data["planner_hz"]
        # Files state only an `ends` that makes a difference.
        if self.ends == "environment" or not (self.wrappers or self.environment.has_own_ends):
            del data["ends"]
        if self.wrappers is not None:
            data["wrappers"] = self.environment.wrapper_names
        return data

    @cached_property
    def environment(self) -> GymEnvironment:
        # Accessing it imports highway-env.
        from pytest_pafot.world.gym_environment import GymEnvironment  # noqa: PLC0415  (imports highway-env)

        return GymEnvironment(self.env_id, self.config, self.wrappers, self.hang_limit)

    def make(self) -> Any:
        """Create a new environment with all its wrappers, but without traffic."""
        return self.environment.make()

    @property
    def network(self) -> Any:
        return self.environment.network

    def stock_road(self, np_random: Any = None) -> Any:
        return self.environment.road(np_random)

    @cached_property
    def _rules(self) -> Rules:
        # The unwrapped environment has the configuration after a reset, which wrappers may change.
        environment = self.environment
        env = environment.unwrapped
        config = env.config
        ticks_name = "config.simulation_frequency"
        physics_hz = whole_within(ticks_name, config["simulation_frequency"], *PHYSICS_HZ)
        name, value = "config.policy_frequency", config["policy_frequency"]
        if self.planner_hz is not None:
            name, value = "planner_hz", self.planner_hz
        ads_hz = whole_within(name, value, *ADS_HZ)
        check_divides(ticks_name, physics_hz, name, ads_hz)
        duration = self._wanted
        check_ticks(duration, physics_hz)
        road: Road | None = environment.straight_road
        if road is None:
            from pytest_pafot.world.roads.junction import with_junction  # noqa: PLC0415  (only for curved roads)
            from pytest_pafot.world.roads.survey import survey  # noqa: PLC0415  (only for curved roads)

            duration = min(duration, self._longest)
            surveyed = survey(env, self.env_id, self.limits, duration * TOP_SPEED)
            road = way = with_junction(env, surveyed, self.limits, self.ego)
            # the run ends when an ego at its initial speed would reach the end of the road
            if way.ego_speed > 0:
                duration = min(duration, (way.end - way.start) / way.ego_speed)
        made = self._rules_on(
            road,
            physics_hz=physics_hz,
            ads_hz=ads_hz,
            duration=duration,
            obstacles=environment.obstacles,
        )
        if self.ends == "duration":
            return made
        in_steps = self.planner_hz is None and environment.ends_in_steps
        made = replace(made, ends=environment.own_ends, ends_in_steps=in_steps)
        steps = environment.step_limit
        # If a `step` repeats actions, the number of its ticks is not known.
        if steps is None or environment.may_repeat_actions:
            return made
        # A step of the environment lasts several ticks.
        limit = steps * made.step_ticks
        made = replace(made, duration=min(duration, limit / physics_hz))
        # If no duration is set, as in two-way-v0, the limit is the intended duration, so no run ends early.
        has_duration = self.duration is not None or "duration" in config
        if has_duration and limit < duration * physics_hz:
            made = replace(made, step_limit=limit)
        return made

    @property
    def _wanted(self) -> float:
        # The duration [s] on a straight road: `duration` or, if it is None, the environment's own duration.
        config = self.environment.unwrapped.config
        name, value = "duration", self.duration
        if value is None:
            name, value = "config.duration", config.get("duration", LONGEST_RUN)
        return number_within(name, value, 1 / config["simulation_frequency"], 3600.0)

    @property
    def _longest(self) -> float:
        # The longest duration [s] on curved roads.
        own = self.environment.unwrapped.config.get("duration", LONGEST_RUN)
        longest = number_within("config.duration", own, 0.0, math.inf)
        if self.duration is None:
            longest = min(longest, LONGEST_RUN)
        return longest


def action_names(world: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a world's discrete meta-actions, ordered by number, or an empty tuple if there are none."""
    config = world.get("config")
    if not isinstance(config, Mapping) or world.get("planner_hz"):
        return ()
    given = config.get("action")
    if not isinstance(given, Mapping) or given.get("type") != "DiscreteMetaAction":
        return ()
    from pytest_pafot.world.stock import action  # noqa: PLC0415  (slow to import, and a report may have no such run)

    # The numbers of actions depend on which of the two groups exist.
    names = action.DiscreteMetaAction.ACTIONS_ALL
    if not given.get("longitudinal", True):
        names = action.DiscreteMetaAction.ACTIONS_LAT
    elif not given.get("lateral", True):
        names = action.DiscreteMetaAction.ACTIONS_LONGI
    return tuple(names[number] for number in range(len(names)))
