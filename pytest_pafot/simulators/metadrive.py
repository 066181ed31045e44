"""Worlds in MetaDrive, and MetaDrive's own policies (``pip install "pytest-pafot[metadrive]"``).

MetaDrive's physics moves the ego. The package moves the NPCs and places MetaDrive vehicles at their positions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from sys import version_info
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np

from pytest_pafot.model.vehicle_type import VehicleType
from pytest_pafot.support.errors import WorldError, install, refused_policy
from pytest_pafot.world.engines.simulation import Simulator
from pytest_pafot.world.limits import whole_within
from pytest_pafot.world.simulator_world import MOST_LANES, SimulatorWorld

if TYPE_CHECKING:
    from pytest_pafot.world.simulator_world import WorldArguments

VEHICLE = VehicleType(name="metadrive", length=4.515, width=1.852)
# The distance between the vehicle's axles [m].
WHEELBASE = 2.469
# The duration of a substep of the physics [s], and their number in a tick.
SUBSTEP, SUBSTEPS = 0.02, 5
# MetaDrive's sensors that need no images.
DETECTORS = ("lidar", "side_detector", "lane_line_detector")

# The inputs that a native policy of MetaDrive can receive.
Observed = Literal["lidar", "vehicle"]


def metadrive(
    map: str = "SSSSSSSSSSSSSSSS",  # noqa: A002  (MetaDrive's own name)
    lanes: int = 4,
    *,
    observation: Observed | None = None,
    sensors: Mapping[str, Mapping[str, int]] | None = None,
    speed_limit: float = 20.0,
    start_lane: int = 0,
    start_speed: float | None = None,
    start_at: float | None = None,
    **world: Unpack[WorldArguments],
) -> SimulatorWorld:
    """Return a world in which MetaDrive's physics moves the ego. It requires ``pytest-pafot[metadrive]``.

    Args:
        map: string with one letter per block of the road: ``"S"`` for a straight block, ``"C"`` for a curve. A block is
            40 to 80 m long. A run ends at the end of the road.
        lanes: number of lanes. Each is 3.5 m wide.
        observation: input of the policy: None for a planner; ``"lidar"`` for the array of MetaDrive's
            ``LidarStateObservation``, 275 numbers by default; ``"vehicle"`` for its ``BaseVehicle``. In the last two
            cases, the policy returns steering and pedal from -1 to 1, as in ``env.step``.
        sensors: changes to the sensor settings of the lidar observation, ``{"lidar": {"num_others": 4}}`` by default:
            ``num_lasers`` and ``distance`` [m] of ``"lidar"``, ``"side_detector"`` and ``"lane_line_detector"``, and
            ``num_others`` of ``"lidar"``.
        speed_limit: speed limit [m/s]. MetaDrive's vehicle can reach 22.2 m/s.
        start_lane, start_speed, start_at: the ego's lane (from 0 at the left), speed [m/s] and position [m] along the
            lane at the start, for a road that has a curve or is too short for ``duration``.
        world: other arguments of :class:`pytest_pafot.SimulatorWorld`. By default, ``ads_hz`` is 10 and ``duration`` is
            15 s.

    Raises:
        WorldError: at the first use, if an argument cannot be used or MetaDrive 0.4.3 is not installed.
    """
    own: dict[str, Any] = {
        "map": map,
        "lanes": lanes,
        "observation": observation,
        "sensors": sensors,
        "speed_limit": speed_limit,
        "start_lane": start_lane,
        "start_speed": start_speed,
        "start_at": start_at,
    }
    if "ego" in world:
        received = f"{world['ego']!r:.100}"
        raise WorldError("ego", "MetaDrive's own vehicle", received, "omit ego=")
    given: Any = {"ads_hz": 10, "duration": 15.0, "ego": VEHICLE, **world}
    return SimulatorWorld(partial(MetaDrive, **own), **given)


@dataclass(eq=False, repr=False, kw_only=True)
class MetaDrive(Simulator):
    """MetaDrive as a simulator, with the arguments of :func:`metadrive`."""

    hz, lane_width = 10, 3.5
    y_is_left = moves_ego_only = one_at_a_time = True
    packages = ("metadrive-simulator", "panda3d")

    map: str
    lanes: Any
    observation: Observed | None = None
    sensors: Mapping[str, Mapping[str, int]] | None = None
    speed_limit: float = 20.0
    start_lane: int = 0
    start_speed: float | None = None
    start_at: float | None = None

    def __post_init__(self) -> None:
        self._data = {**vars(self)}
        if version_info >= (3, 12) or find_spec("metadrive") is None:
            received = "no MetaDrive"
            if version_info >= (3, 12):
                received = f"Python {version_info[0]}.{version_info[1]}"
            raise WorldError(
                "pafot.metadrive",
                "MetaDrive 0.4.3 on Python 3.11",
                received,
                f"run `{install('metadrive')}` with Python 3.11",
            )
        if not isinstance(self.map, str) or not self.map or set(self.map) - {"S", "C"}:
            expected = 'a string of the letters "S" (straight) and "C" (curve), such as "SSSCSS"'
            raise WorldError("map", expected, f"{self.map!r:.100}")
        if self.observation not in (None, "lidar", "vehicle"):
            expected = 'None (for a planner), "lidar" or "vehicle"'
            raise WorldError("observation", expected, f"{self.observation!r:.100}")
        self._count = whole_within("lanes", self.lanes, 1, MOST_LANES)
        self._sensors = _check_sensors(self.sensors)
        self.native = self.observation is not None
        self._env: Any = None
        self._ego: Any = None
        self._npcs: list[Any] = []
        self._put_at: list[tuple[float, ...]] = []
        self._length = VEHICLE.length
        self.lanes = self._opened().lines()

    def to_dict(self) -> dict[str, Any]:
        return self._data

    def _opened(self) -> Any:
        # If another world has used the engine in the meantime, the environment must be made again.
        if self._env is None or not self._env.is_open:
            from pytest_pafot.simulators.metadrive_engine import Env  # noqa: PLC0415  (imports MetaDrive, in 1.5 s)

            self._env = Env(self.map, self._count, self._sensors)
        return self._env

    def start(self, vehicles: Sequence[Any], seed: int) -> None:
        env = self._opened()
        start = vehicles[0]
        self._length = start.length
        self._ego = env.begin((start.x, start.y), start.heading, start.speed)
        self._npcs = [
            env.add_other(each.length, each.width, each[:2], each.heading) for each in vehicles[1:]
        ]
        self._put(vehicles[1:])
        self._ego.after_step()

    def _put(self, wanted: Sequence[Any]) -> None:
        self._put_at = [(each.x, each.y, each.heading, each.speed) for each in wanted]
        for npc, (x, y, heading, speed) in zip(self._npcs, self._put_at, strict=True):
            npc.set_position((x, y))
            npc.set_heading_theta(heading)
            npc.set_velocity((math.cos(heading), math.sin(heading)), speed)
            if self.observation == "vehicle":
                # finds its lane, which MetaDrive's IDM reads
                npc.navigation.update_localization(npc)

    def step(self, controls: Sequence[Any]) -> None:
        # Put the NPCs at their positions at the end of the tick.
        self._put(controls[1:])
        engine = self._env.engine
        pedals = controls[0].action
        if pedals is None:
            pedals = self._pedals(controls[0])
        engine.before_step({"default_agent": pedals})
        engine.step(SUBSTEPS)
        engine.after_step()

    def _pedals(self, control: Any) -> tuple[float, float]:
        # Steering and pedal, from -1 to 1, for an acceleration and a steering angle of the package's model.
        vehicle = self._ego
        wheels = math.atan(math.tan(control.steering) * WHEELBASE / self._length)
        # The forces of the engine and the impulses of brakes act on each of four wheels.
        force = control.acceleration * vehicle.MASS / 4.0
        if control.acceleration > 0.0:
            pedal = force / vehicle.config["max_engine_force"]
        else:
            pedal = force / vehicle.config["max_brake_force"] * SUBSTEP
        # a pedal of 0 brakes by 0.36 m/s^2
        return wheels / math.radians(vehicle.max_steering), pedal or 1e-6

    def observe(self) -> Any:
        if self.observation == "vehicle":
            return self._ego
        return self._env.observations["default_agent"].observe(self._ego)

    def check_action(self, action: Any) -> tuple[float, ...]:
        try:
            checked = np.asarray(action, dtype=float)
        except (TypeError, ValueError):
            checked = np.empty(0)
        if checked.shape != (2,) or not np.isfinite(checked).all():
            raise ValueError(
                f"expected steering and pedal, two numbers from -1 to 1, received {action!r:.100}"
            )
        return tuple(checked.tolist())

    def states(self) -> list[tuple[float, ...]]:
        ego = self._ego
        state = (*map(float, ego.position), float(ego.heading_theta), float(ego.speed))
        return [state, *self._put_at]

    def close(self) -> None:
        if self._env is not None and self._env.is_open:
            self._env.close()
        self._env = None


def _check_sensors(sensors: Any) -> dict[str, dict[str, int]]:
    checked: dict[str, dict[str, int]] = {"lidar": {"num_others": 4}}
    if not sensors:
        return checked
    items = [("sensors", sensors)]  # rejected below, unless it is a mapping
    if isinstance(sensors, Mapping):
        items = [*sensors.items()]
    for name, given in items:
        most = {"num_lasers": 1000, "distance": 1000}
        if name == "lidar":
            most["num_others"] = 8
        if name not in DETECTORS or not isinstance(given, Mapping) or set(given) - set(most):
            names = ", ".join(DETECTORS)
            expected = f"only num_lasers and distance for {names}, and num_others for lidar"
            raise WorldError("sensors", expected, f"{sensors!r:.100}")
        values = checked.setdefault(name, {})
        for key, value in given.items():
            values[key] = whole_within(f"sensors.{name}.{key}", value, 0, most[key])
    return checked


class Expert:
    """MetaDrive's PPO expert for the lidar observation, with the actions of ``numpy_expert.expert``."""

    def __init__(self) -> None:
        self._layers = _weights()

    def __call__(self, seen: Any) -> tuple[float, ...]:
        x = np.array(seen)
        x[[10, 15]] = 1 - x[[10, 15]]  # it was trained with other axes
        (first, one), (second, two), (last, out) = self._layers
        x = np.tanh(x @ first + one)
        x = np.tanh(x @ second + two)
        x = x @ last + out
        return tuple(x[:2].tolist())


@cache
def _weights() -> tuple[tuple[Any, Any], ...]:
    # MetaDrive's own function decompresses the weights for each decision.
    found = find_spec("metadrive")
    assert found is not None, "its world has been made"  # noqa: S101
    file = Path(str(found.origin)).parent / "examples" / "ppo_expert" / "expert_weights.npz"
    with np.load(file) as arrays:
        layers = ("fc_1", "fc_2", "fc_out")
        return tuple(
            (arrays[f"default_policy/{each}/kernel"], arrays[f"default_policy/{each}/bias"])
            for each in layers
        )


class Idm:
    """MetaDrive's IDM policy, which drives at up to 30 km/h and changes lanes."""

    def __init__(self) -> None:
        self._policy: Any = None

    def __call__(self, vehicle: Any) -> Any:
        if self._policy is None:
            from pytest_pafot.simulators.metadrive_engine import IDMPolicy  # noqa: PLC0415  (as above)

            self._policy = IDMPolicy(vehicle, 0)
        return self._policy.act()


@dataclass(frozen=True)
class OwnPolicy:
    """A factory of a MetaDrive policy, with the observation that the policy needs."""

    make: Callable[[], Callable[[Any], Any]]
    observation: Observed

    def __call__(self) -> Callable[[Any], Any]:
        return self.make()

    def check_world(self, world: Any) -> None:
        stated = {}
        received = f"{world!r:.200}"
        if isinstance(world, SimulatorWorld) and world.maker is MetaDrive:
            stated = world.to_dict()["simulator"]
            received = f"pafot.metadrive with {stated}"
        if (stated.get("observation"), stated.get("sensors")) != (self.observation, None):
            needed = f"pafot.metadrive(observation={self.observation!r})"
            raise refused_policy(
                f"the world {needed} for this policy of MetaDrive",
                received,
                f"write `world={needed}`",
            )


expert = OwnPolicy(Expert, "lidar")
"""MetaDrive's PPO expert, for ``pafot.metadrive(observation="lidar")``."""
idm = OwnPolicy(Idm, "vehicle")
"""MetaDrive's IDM policy, for ``pafot.metadrive(observation="vehicle")``."""
