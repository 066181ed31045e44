"""Which of two engines steps a run in SI units: the kernel, or highway-env's own objects. The results are the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world.driving.ads import EgoDriver, Planner, SelfDriving, is_vehicle_class
from pytest_pafot.world.driving.guard import HangGuard
from pytest_pafot.world.driving.idm_model import idm_model
from pytest_pafot.world.engines.kernel_engine import KernelRun, run_model, run_planner
from pytest_pafot.world.engines.lock_step import SteppedRun
from pytest_pafot.world.errors import WorldError
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.run_config import Rules

if TYPE_CHECKING:
    from highway_env.road.road import Road

Start = tuple[float, float, float]
"""x [m], y [m], heading [rad]."""


class SiWorld(Protocol):
    """A world on whose road egos can drive in SI units."""

    @property
    def engine(self) -> str:
        """``"kernel"``, ``"highway-env"`` or ``"auto"``."""

    @property
    def rules(self) -> Rules:
        """Of its runs."""

    @property
    def network(self) -> Any:
        """The road as highway-env has it."""


def rollout_vehicle(world: SiWorld, scenario: Scenario, ads: Any, decisions: Sequence[Any] = ()) -> Trace:
    """Run a scenario, which fits the world, on a straight road, with an ego that drives itself.

    Args:
        world: that says which engine.
        scenario: to run.
        ads: a vehicle class.
        decisions: the first ones of the run; such an ego can be given none.

    Raises:
        WorldError: when the world insists on the kernel, and that cannot drive this ego; and for decisions in the place
            of a vehicle class.
    """
    if decisions:
        raise WorldError(
            f"decisions: expected none for {ads!r}, a vehicle class, which drives itself and returns no actions, "
            f"received {len(decisions)}; leave them out"
        )
    model = None if world.engine == "highway-env" else idm_model(ads)
    if model is not None:
        return run_model(world.rules, scenario, model)
    if world.engine == "kernel":
        raise WorldError(
            f"engine: expected an ADS that the kernel can drive, a callable or IDMVehicle with other constants, "
            f'received {ads!r}, a vehicle class with code or options of its own; use engine="auto" or '
            f'engine="highway-env"'
        )
    return _by_objects(world, world.rules, scenario, ads)


def rollout_planner(
    world: SiWorld,
    rules: Rules,
    scenario: Scenario,
    ads: Callable[[Observation], Any],
    decisions: Sequence[Any] = (),
) -> Trace:
    """Run a scenario on the road of a world, by its rules or others, with a callable from an observation to an action.

    On a road that is not straight, the callable decides at every tick.
    """
    road = rules.road
    if world.engine == "highway-env" or isinstance(road, NetworkRoad) or not road.starts_at_origin:
        return _by_objects(world, rules, scenario, ads, decisions)
    return run_planner(rules, scenario, ads, decisions)


def begin(world: SiWorld, scenario: Scenario, guard: HangGuard) -> SteppedRun:
    """A run that is given its decisions in SI units."""
    if world.engine != "highway-env":
        return KernelRun(world.rules, scenario, guard)
    from pytest_pafot.world.engines.object_engine import ObjectRun  # noqa: PLC0415  (a second of imports)

    road = _road(world, scenario)
    return ObjectRun(world.rules, scenario, road, partial(_planner, world.rules, scenario, road, None), guard)


def _by_objects(world: SiWorld, rules: Rules, scenario: Scenario, ads: Any, decisions: Sequence[Any] = ()) -> Trace:
    from pytest_pafot.world.engines.object_engine import run  # noqa: PLC0415

    road = _road(world, scenario)

    def make_ego(start: Start) -> EgoDriver:
        if is_vehicle_class(ads):
            return SelfDriving(ads, road, start, scenario.ego_speed)
        return _planner(rules, scenario, road, ads, start)

    return run(rules, scenario, road, make_ego, decisions)


def _road(world: SiWorld, scenario: Scenario) -> Road:
    from highway_env.road.road import Road  # noqa: PLC0415  (a second of imports, paid by the first run)

    return Road(world.network, np_random=np.random.default_rng(scenario.seed))


def _planner(rules: Rules, scenario: Scenario, road: Road, ads: Any, start: Start) -> Planner:
    from pytest_pafot.world.driving.road_planner import RoadPlanner  # noqa: PLC0415
    from pytest_pafot.world.driving.vehicles import Car  # noqa: PLC0415

    ego = Car(road, start[:2], start[2], scenario.ego_speed)
    if isinstance(rules.road, NetworkRoad):
        far = rules.start_distance(scenario)
        starts = [rules.ego_start + row * far for row in (-1, 0, 1)]
        return RoadPlanner(ads, road, rules.road, ego, rules.physics_hz, starts)
    return Planner(ads, road, rules.road, ego, rules.physics_hz, rules.physics_hz // rules.ads_hz)
