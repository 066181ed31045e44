"""The default world: a straight motorway for an ADS that works in SI units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from pytest_pafot.findings.finding import DRIVEN_ON
from pytest_pafot.model.scenario import PAPER_SPEED_LIMIT, Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.model.vehicle_type import CAR
from pytest_pafot.support.errors import AdsFactoryError, WorldError
from pytest_pafot.world.base_world import BuiltInWorld, EgoVehicle
from pytest_pafot.world.driving.policy import AdsFactory, Policy, idm_model
from pytest_pafot.world.engines.run import vehicle_run
from pytest_pafot.world.guard.hang_guard import closing
from pytest_pafot.world.limits import (
    ADS_HZ,
    CLEARANCE,
    HANG_LIMIT,
    HEADWAY,
    PHYSICS_HZ,
    TOP_SPEED,
    NpcLimits,
    check_divides,
    check_ticks,
    number_within,
    whole_within,
)
from pytest_pafot.world.roads.road import StraightRoad, ego_start
from pytest_pafot.world.run_config import Rules

LANE_WIDTH = 4.0
"""The lane width of highway-env [m]."""
LANE_COUNTS = (3, 6)
"""The smallest and the largest number of lanes."""


@dataclass(frozen=True, kw_only=True)
class Highway(BuiltInWorld):
    """A straight motorway of three to six lanes.

    The ADS is a callable from :class:`pytest_pafot.Observation` to ``(acceleration [m/s^2], steering [rad])`` or a
    :class:`pytest_pafot.Drive`. It may also be a highway-env vehicle class, which drives itself.

    Attributes:
        lanes: their number, 3 to 6.
        speed_limit: [m/s]; the default is the paper's 60 mph.
        physics_hz: simulation ticks per second.
        ads_hz: decisions of the ADS per second; a divisor of ``physics_hz``.
        duration: the longest duration of a run [s].
        clearance: the least gap between the ego and the cells ahead and behind [m]; NPCs may come nearer.
        headway: with which NPCs start ahead of the ego or behind it [s].
        limits: of NPCs.
        ego: [its vehicle](scenarios.md#the-egos-vehicle): a ``pafot.VehicleType``, or the name of a ready one.
        hang_limit: wall-clock time after which a decision of the ADS is interrupted [s].
        lasts: what :meth:`lasting` sets; not part of a saved world.

    Raises:
        WorldError: if a value cannot be used; the message states the possible values.
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
        for name, bounds in (("lanes", LANE_COUNTS), ("physics_hz", PHYSICS_HZ), ("ads_hz", ADS_HZ)):
            object.__setattr__(self, name, whole_within(name, getattr(self, name), *bounds))
        for name, low, high in (("speed_limit", 5.0, TOP_SPEED), ("duration", 1 / self.physics_hz, 3600.0)):
            object.__setattr__(self, name, number_within(name, getattr(self, name), low, high))
        self._check_fields()
        check_divides(("physics_hz", self.physics_hz), ("ads_hz", self.ads_hz))
        check_ticks(self.duration, self.physics_hz)
        self.limits.top_speed(self.speed_limit)

    @cached_property
    def road(self) -> StraightRoad:
        """The road, which is so long that no vehicle reaches its end, also in a run that is driven on."""
        length = 100.0 + 2 * ego_start(self.headway, self.clearance) + TOP_SPEED * (self.duration + DRIVEN_ON)
        return StraightRoad.uniform(self.lanes, length, LANE_WIDTH, self.speed_limit)

    def rollout(self, scenario: Scenario, ads_factory: AdsFactory, *, decisions: Sequence[Any] = ()) -> Trace:
        """Simulate a scenario with a fresh ADS.

        Args:
            scenario: the scenario to run; it is checked against this world.
            ads_factory: a callable that returns the ADS, called once; or a highway-env vehicle class, which drives
                itself.
            decisions: the first decisions of the run, in the form of ``Trace.actions``; the ADS is not called for
                them. Decisions beyond the end of the run are ignored.

        Raises:
            ScenarioError: if the scenario does not fit this world.
            AdsFactoryError: if the factory returns nothing that can drive here.
            BadAction: if one of the decisions is not a valid action.
            WorldError: if ``decisions`` are given together with a vehicle class, because it returns no decisions.
            Exception: any exception of the factory itself. An exception of the ADS ends the run as ``ads_error``.
        """
        self.check_fits(scenario)
        policy = Policy(ads_factory)
        policy.check_drives_in(self)
        if policy.simulates:
            raise AdsFactoryError(
                "ads: expected a factory without a parameter `env`, because pafot.Highway has no environment; "
                'use world=pafot.World("highway-v0") for planners that simulate inside one'
            )
        ads, rules = policy.make(), self.rules
        if ads.drives_itself:
            if decisions:
                raise WorldError(
                    f"decisions: expected none for {ads.given!r}, a vehicle class, which drives itself and returns no "
                    f"actions, received {len(decisions)}; leave them out"
                )
            return vehicle_run(rules, scenario, self.road, lambda: self.network, ads.given)
        with closing(ads.given, self.hang_limit):
            return self._planned(rules, scenario, ads.given, decisions)

    is_resumable = True
    """True, because :meth:`rollout` accepts ``decisions``."""

    def runs_in_kernel(self, ads: Any) -> bool:
        """Return whether ``ads`` is a vehicle class that the kernel can drive in this world."""
        return not self.ego.has_limits and idm_model(ads) is not None

    def rollout_in_gym(self, scenario: Scenario, ads_factory: AdsFactory) -> Trace:
        """Simulate a scenario as :meth:`rollout` does, but with ``env.step`` of highway-env's own highway-v0.

        Args:
            scenario: the scenario as driven, such as :attr:`pytest_pafot.Trace.executed`; it must fit this world.
            ads_factory: a callable that returns the ADS; it is called once.
        """
        from pytest_pafot.world.engines.gym_replay import replay_highway  # noqa: PLC0415  (imports highway-env)

        return replay_highway(self.rules, scenario, Policy(ads_factory))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for a corpus file; :func:`pytest_pafot.world.from_dict` reads it."""
        return {"kind": "highway", **self._to_dict()}

    @cached_property
    def _rules(self) -> Rules:
        return self._rules_on(self.road, physics_hz=self.physics_hz, ads_hz=self.ads_hz, duration=self.duration)
