"""Which of the two engines steps a run: the kernel, or highway-env's own objects. The results are the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Trace
from pytest_pafot.world.driving.ads import EgoDriver, Planner, SelfDriving, is_vehicle_class
from pytest_pafot.world.driving.guard import HangGuard
from pytest_pafot.world.driving.idm_model import idm_model
from pytest_pafot.world.engines.kernel_engine import SteppedRun, run_model, run_planner
from pytest_pafot.world.engines.lock_step import Stepped
from pytest_pafot.world.errors import WorldError
from pytest_pafot.world.highway import Highway
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.run_config import Rules


def simulate(world: Highway, rules: Rules, scenario: Scenario, ads: Any, decisions: Sequence[Any] = ()) -> Trace:
    """Run a scenario on a Highway.

    Args:
        world: the Highway.
        rules: its rules, or others.
        scenario: checked against the world.
        ads: fresh: a callable from an observation to an action, or a vehicle class.
        decisions: the first ones of the run, which a callable is not asked for.

    Raises:
        WorldError: when the world insists on the kernel, and that cannot drive this ego; and for decisions in the place
            of a vehicle class.
    """
    if not is_vehicle_class(ads):
        return planned(world, rules, scenario, ads, decisions)
    if decisions:
        raise WorldError(
            f"decisions: expected none for {ads!r}, a vehicle class, which drives itself and returns no actions, "
            f"received {len(decisions)}; leave them out"
        )
    model = None if world.engine == "highway-env" else idm_model(ads)
    if model is not None:
        return run_model(rules, scenario, model)
    if world.engine == "kernel":
        raise WorldError(
            f"engine: expected an ADS that the kernel can drive, a callable or IDMVehicle with other constants, "
            f'received {ads!r}, a vehicle class with code or options of its own; use engine="auto" or '
            f'engine="highway-env"'
        )
    return _by_highway_env(rules, world.network, scenario, ads)


def planned(
    world: Any, rules: Rules, scenario: Scenario, ads: Callable[[Observation], Any], decisions: Sequence[Any] = ()
) -> Trace:
    """Run a scenario on the road of any world, with a callable from an observation to an action in SI units."""
    insists = isinstance(world, Highway) and world.engine == "highway-env"
    if insists or not rules.straight.starts_at_origin:
        return _by_highway_env(rules, world.network, scenario, ads, decisions)
    return run_planner(rules, scenario, ads, decisions)


def stepped(world: Highway, scenario: Scenario, guard: HangGuard) -> Stepped:
    """Begin a run on a Highway that is given its decisions in SI units."""
    if world.engine != "highway-env":
        return SteppedRun(world.rules, scenario, guard)
    from pytest_pafot.world.engines import object_engine as engine  # noqa: PLC0415

    road = _road(world.network, scenario)
    return engine.SteppedRun(world.rules, scenario, road, partial(_planner, world.rules, scenario, road, None), guard)


def _by_highway_env(rules: Rules, network: Any, scenario: Scenario, ads: Any, decisions: Sequence[Any] = ()) -> Trace:
    from pytest_pafot.world.engines.object_engine import run  # noqa: PLC0415

    road = _road(network, scenario)

    def make_ego(start: tuple[float, float, float]) -> EgoDriver:
        if is_vehicle_class(ads):
            return SelfDriving(ads, road, start, scenario.ego_speed)
        return _planner(rules, scenario, road, ads, start)

    return run(rules, scenario, road, make_ego, decisions)


def _road(network: Any, scenario: Scenario) -> Any:
    import numpy as np  # noqa: PLC0415
    from highway_env.road.road import Road  # noqa: PLC0415  (a second of imports, paid by the first run)

    return Road(network, np_random=np.random.default_rng(scenario.seed))


def _planner(rules: Rules, scenario: Scenario, road: Any, ads: Any, start: tuple[float, float, float]) -> Planner:
    from pytest_pafot.world.driving.vehicles import Car  # noqa: PLC0415

    x, y, heading = start
    ego = Car(road, (x, y), heading, scenario.ego_speed)
    return Planner(ads, road, rules.road, ego, rules.physics_hz, rules.physics_hz // rules.ads_hz)


def planned_on_network(world: Any, rules: Rules, scenario: Scenario, ads: Callable[[Observation], Any]) -> Trace:
    """The same on a road that is not straight."""
    import numpy as np  # noqa: PLC0415
    from highway_env.road.road import Road  # noqa: PLC0415

    from pytest_pafot.world.driving.road_planner import RoadPlanner  # noqa: PLC0415
    from pytest_pafot.world.driving.vehicles import Car  # noqa: PLC0415
    from pytest_pafot.world.engines.object_engine import run  # noqa: PLC0415

    network, far = rules.way, rules.start_distance(scenario)
    road = Road(world.network, np_random=np.random.default_rng(scenario.seed))
    starts = [rules.ego_start + row * far for row in (-1, 0, 1)]

    def make_ego(start: tuple[float, float, float]) -> EgoDriver:
        x, y, heading = start
        ego = Car(road, (x, y), heading, scenario.ego_speed)
        return RoadPlanner(ads, road, network, ego, rules.physics_hz, starts)

    return run(rules, scenario, road, make_ego)
