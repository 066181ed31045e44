"""Which of two engines steps a run in SI units: the kernel, or highway-env's own objects. The results are the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from pytest_pafot.errors import WorldError
from pytest_pafot.scenario import Scenario
from pytest_pafot.sight import Sight
from pytest_pafot.trace import Trace
from pytest_pafot.world.driving.hang_guard import HangGuard
from pytest_pafot.world.driving.idm_model import IdmModel, idm_model
from pytest_pafot.world.engines.kernel_engine import KernelRun, run_model, run_planner
from pytest_pafot.world.engines.lock_step import SteppedRun
from pytest_pafot.world.kernel.bodies import Body
from pytest_pafot.world.kernel.observation import Observation
from pytest_pafot.world.roads.network import NetworkRoad
from pytest_pafot.world.run_config import Rules


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
    """Run a scenario, which fits the world, on a straight road, with an ego of a vehicle class that drives itself."""
    if decisions:
        raise WorldError(
            f"decisions: expected none for {ads!r}, a vehicle class, which drives itself and returns no actions, "
            f"received {len(decisions)}; leave them out"
        )
    model = kernel_model(world, ads)
    if model is not None:
        return run_model(world.rules, scenario, model)
    if world.engine == "kernel":
        raise WorldError(
            f"engine: expected an ADS that the kernel can drive, a callable or IDMVehicle with other constants, "
            f'received {ads!r}, a vehicle class with code or options of its own; use engine="auto" or '
            f'engine="highway-env"'
        )
    return _by_objects(world, world.rules, scenario, ads)


def kernel_model(world: SiWorld, ads: Any) -> IdmModel | None:
    """The model by which the kernel drives a vehicle class; None where it cannot, or is not to."""
    return None if world.engine == "highway-env" else idm_model(ads)


def rollout_planner(
    world: SiWorld,
    rules: Rules,
    scenario: Scenario,
    ads: Callable[[Observation], Any],
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    """Run a scenario on the road of a world, by its rules or others, with a callable from an observation to an action.

    On a road that is not straight, the callable decides at every tick. Its car may have a body of its own.
    """
    road = rules.road
    if world.engine == "highway-env" or isinstance(road, NetworkRoad) or not road.starts_at_origin:
        return _by_objects(world, rules, scenario, ads, decisions, body)
    return run_planner(rules, scenario, ads, decisions, body)


def begin(world: SiWorld, scenario: Scenario, guard: HangGuard, sight: Sight | None) -> SteppedRun:
    """A run that is given its decisions in SI units, by an ADS that may have a sight."""
    if world.engine != "highway-env":
        return KernelRun(world.rules, scenario, guard, sight)
    from pytest_pafot.world.engines.object_engine import begin_planner  # noqa: PLC0415  (a second of imports)

    return begin_planner(world.network, world.rules, scenario, guard, sight)


def _by_objects(
    world: SiWorld,
    rules: Rules,
    scenario: Scenario,
    ads: Any,
    decisions: Sequence[Any] = (),
    body: Body | None = None,
) -> Trace:
    from pytest_pafot.world.engines.object_engine import run_on  # noqa: PLC0415  (a second of imports)

    return run_on(world.network, rules, scenario, ads, decisions, body)
