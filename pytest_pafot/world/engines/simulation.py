"""Runs in which a user's simulator moves the vehicles.

In each tick, the package's own model first moves all vehicles. The simulator then receives the controls and the
resulting states, and returns states that replace them.
"""

from __future__ import annotations

import atexit
import copy
import math
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from multiprocessing import parent_process
from multiprocessing.util import Finalize
from os import getpid
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np

from pytest_pafot.model.trace import AdsError, vehicle_name
from pytest_pafot.support.errors import BadAction, WorldError
from pytest_pafot.world.driving.policy import Unseeing, check_by
from pytest_pafot.world.engines.run import Implausible, Plausibility, State, VehiclesOfRun
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard, call_close, patience_with_world
from pytest_pafot.world.kernel.lanes import Body
from pytest_pafot.world.kernel.loop import EgoDriver, PlannerDriver
from pytest_pafot.world.kernel.observation import Sensor

# The time that `close` of a simulator may take [s].
CLOSING = 10.0
# The largest differences between a vehicle's first state and the requested state [m, m, rad, m/s].
STARTS = (("x", 0.05), ("y", 0.05), ("heading", 0.01), ("speed", 0.05))
# In its first tick, a vehicle at a speed of at least `MOVES` [m/s] must move in the direction of its heading, as far as
# its speed implies. The tolerance is this proportion of the distance, plus this change in speed [m/s^2].
STRAYS = 0.15
FASTEST_CHANGE = 10.0
MOVES = 5.0
# One run only shows that something is wrong. This function finds the wrong attribute by experiments.
CAUSE = "To find the cause, call pytest_pafot.testing.check_world(world)"
Headings = Literal[
    "x to y", "x to -y", "y to -x", "y to x", "-x to -y", "-x to y", "-y to x", "-y to -x",
]  # fmt: skip
# The axis of heading 0 in quarter turns, and 1 if headings increase from x to y.
HEADINGS = dict(zip(get_args(Headings), product(range(4), (1, -1)), strict=True))
Reference = Literal["centre", "front", "rear axle"]
# Like `STARTS`, for NPCs that the simulator puts into the states of their controls.
PUT = (("x", 0.02), ("y", 0.02), ("heading", 0.01), ("speed", 0.5))


class Vehicle(NamedTuple):
    """A vehicle at the start of a run, in the units and axes of the simulator.

    Attributes:
        x, y, heading, speed: position, heading and speed.
        length, width: size.
        lane: lane, counted from 0 at the left.
        kind: name of the vehicle's type, such as ``"car"`` or ``"truck"``.
    """

    x: float
    y: float
    heading: float
    speed: float
    length: float
    width: float
    lane: int
    kind: str


class Control(NamedTuple):
    """The control of a vehicle in a tick, in the units and axes of the simulator.

    Attributes:
        acceleration: requested acceleration, in the simulator's unit of speed per second.
        steering: angle of the front wheels. A positive angle increases the heading.
        x, y, heading, speed: state at the end of the tick according to the package's kinematic bicycle model.
        action: action of the ego's policy, if the simulator is ``native``. ``acceleration`` and ``steering`` are then
            0. None for NPCs, and while one of the package's drivers replaces the policy.
    """

    acceleration: float
    steering: float
    x: float
    y: float
    heading: float
    speed: float
    action: Any = None


class _Hz:
    # The default: 1 / `dt`, or 15 ticks per second if `dt` is None.
    def __get__(self, simulator: Any, of: Any = None) -> float:
        if simulator is None:
            simulator = of
        dt: float | None = simulator.dt
        if dt is None:
            return 15
        return 1 / dt


class Simulator(ABC):
    """The base class of a user's simulator, for :class:`pytest_pafot.SimulatorWorld`.

    One object simulates many runs, one after the other. Each run starts with a call of :meth:`start`. All values are in
    the units and axes that the class attributes declare.

    Attributes:
        dt: duration of a tick [s], from 0.001 to 0.2. None if you set ``hz``.
        hz: ticks per second, from 5 to 1000. The default is 15, or 1 / ``dt``.
        lanes: number of parallel straight lanes. The x axis is the centre line of lane 0, the leftmost lane. For lanes
            of other shapes, a list of the centre lines from the left, each with at least two points (x, y) in the
            direction of driving.
        lane_width: width of a lane, by default 4 m.
        speed_limit: speed limit, by default 26.8 m/s.
        length: length of the road if ``lanes`` is a number. None if the road is endless.
        start_lane, start_speed, start_at: the ego's initial lane, speed and position along the lane on a curved road.
            The default speed is 22 m/s, or the speed limit if that is lower. The default position is the first one with
            enough road behind the ego.
        obstacles: fixed objects, each given by the x and y of its centre, its heading, length and width.
        y_is_left: True if y is positive to the left of a vehicle that drives along x.
        headings: axis with heading 0, and axis with a heading of a quarter turn, for example ``"x to y"`` or ``"x to
            -y"``. Compass headings are ``"y to x"`` if x points to the east and y to the north.
        degrees: True if angles are in degrees.
        reference: point of a vehicle at x and y: the ``"centre"`` of its box, or the middle of its ``"front"`` or
            ``"rear axle"``.
        rear_axle_offset: distance from the centre of the box back to the rear axle, always in metres.
        metres: the simulator's unit of length, expressed in metres.
        metres_per_second: the simulator's unit of speed, expressed in m/s; ``1 / 3.6`` for km/h.
        moves_ego_only: True if :meth:`step` puts all NPCs into the states of their controls.
        packages: names of the installed packages whose versions affect runs. Saved files record these versions.
        one_at_a_time: True if a process can have only one simulator of this class, for example because the engine is
            global. A process then never has two open runs.
        native: True if the policy receives the return value of :meth:`observe` and returns an action for :meth:`step`.
    """

    dt: float | None = None
    hz: float = _Hz()  # type: ignore[assignment]
    lanes: int | Sequence[Any] = 4
    lane_width: float | None = None
    speed_limit: float | None = None
    length: float | None = None
    start_lane: int = 0
    start_speed: float | None = None
    start_at: float | None = None
    obstacles: Sequence[tuple[float, float, float, float, float]] = ()
    y_is_left: ClassVar[bool] = False
    headings: ClassVar[Headings] = "x to y"
    degrees: ClassVar[bool] = False
    reference: ClassVar[Reference] = "centre"
    rear_axle_offset: float | None = None
    metres: ClassVar[float] = 1.0
    metres_per_second: ClassVar[float] = 1.0
    moves_ego_only: bool = False
    packages: ClassVar[tuple[str, ...]] = ()
    one_at_a_time: ClassVar[bool] = False
    native: bool = False

    @abstractmethod
    def start(self, vehicles: Sequence[Vehicle], seed: int) -> None:
        """Start a run with these vehicles. The ego comes first. All randomness must depend on ``seed`` alone."""

    @abstractmethod
    def step(self, controls: Sequence[Control]) -> None:
        """Advance all vehicles by one tick. ``controls`` contains one control per vehicle, with the ego's first."""

    @abstractmethod
    def states(self) -> Any:
        """Return x, y, heading and speed of each vehicle in an array of shape [vehicles, 4], with the ego first."""

    def observe(self) -> Any:
        """Return the input for the next decision of a ``native`` simulator's policy.

        The method can have a parameter ``hidden``, the index of an NPC or None. The method must then hide this NPC from
        the policy. Reports use this to find out whether an action depends on a vehicle.
        """
        raise NotImplementedError

    def check_action(self, action: Any) -> Any:
        """Check an action of a ``native`` simulator's policy, and return it for :meth:`step` and the trace.

        Raises:
            ValueError: if the action is invalid. The run then ends with an error of the policy. By default, only None
                is rejected.
        """
        if action is None:
            raise ValueError(
                f"expected an action for {type(self).__name__}.step, received None; is a `return` missing?"
            )
        return action

    def close(self) -> None:  # noqa: B027  (most simulators hold nothing)
        """Release resources such as a process.

        The method is called once, at the end of the session or process, or after a failure of the simulator.
        """

    def to_dict(self) -> dict[str, Any]:
        """Return the arguments that recreate this simulator, as data for a file."""
        return {}


class Frame:
    """The units and axes of a simulator, and the origin of its straight road: x [m], y [m] and heading [rad]."""

    def __init__(
        self, simulator: Any, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        self.origin = origin
        self.side = 1.0
        if simulator.y_is_left:
            self.side = -1.0
        # Headings and steering angles change their sign with y.
        zero, sense = HEADINGS[simulator.headings]
        self.zero = self.side * zero * math.pi / 2
        self.turn = self.side * sense
        self.angle = 1.0
        if simulator.degrees:
            self.angle = math.pi / 180
        self.metres = float(simulator.metres)
        self.speed = float(simulator.metres_per_second)
        # The point of reference is a fraction of the length ahead of the centre, or a distance behind it.
        self._share = 0.0
        if simulator.reference == "front":
            self._share = 0.5
        self._behind = simulator.rear_axle_offset or 0.0
        self._x, self._y, self._heading = origin
        self._cos = math.cos(self._heading)
        self._sin = math.sin(self._heading)

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Convert a position in the simulator to a run's x [m] and y [m]."""
        dx = x * self.metres - self._x
        dy = self.side * y * self.metres - self._y
        return dx * self._cos + dy * self._sin, dy * self._cos - dx * self._sin

    def state(self, row: Sequence[float], length: float, near: float) -> State:
        """Convert a row of the simulator's states to a run's x [m], y [m], heading [rad] and speed [m/s]."""
        x, y = self.point(row[0], row[1])
        heading = self.turn * self.angle * row[2] + self.zero - self._heading
        # A simulator may limit headings to one turn, but in a run, they must not jump by a turn.
        heading -= 2.0 * math.pi * round((heading - near) / (2.0 * math.pi))
        ahead = self._share * length - self._behind
        if ahead:
            x -= ahead * math.cos(heading)
            y -= ahead * math.sin(heading)
        return x, y, heading, row[3] * self.speed

    def stated(self, body: Any) -> State:
        """Convert the state of a body to the units and axes of the simulator."""
        x = body.x
        y = body.y
        heading = body.heading
        # The steps of `state` are undone in reverse order.
        ahead = self._share * body.length - self._behind
        if ahead:
            x += ahead * math.cos(heading)
            y += ahead * math.sin(heading)
        x, y = x * self._cos - y * self._sin + self._x, y * self._cos + x * self._sin + self._y
        turned = self.turn * (heading + self._heading - self.zero) / self.angle
        if self.zero:
            turned %= 2.0 * math.pi / self.angle
        return x / self.metres, self.side * y / self.metres, turned, body.speed / self.speed


class RepeatedBody(Body):
    """The ego of a repeated run, which repeats recorded decisions up to a tick and then obeys its driver."""

    def __init__(self, length: float, width: float, actions: Sequence[Any], until: int) -> None:
        super().__init__(length, width)
        self.actions = actions
        self._until = until
        self._tick = 0
        self._steering = 0.0
        self.repeats: EgoDriver | None = None

    def step(self, dt: float) -> None:
        driver = self.repeats
        if driver is not None and self._tick < self._until:
            # of the last decision; the driver that takes over has changed it
            self.steering = self._steering
            if self._tick % driver.every == 0:
                driver.decide(self._tick)
            driver.actuate()
            self._steering = self.steering
        self._tick += 1
        super().step(dt)


class OwnUnits(tuple[Any, ...]):
    """A tuple that is a native action, rather than acceleration and steering in SI units."""

    __slots__ = ()


class Observed(Sensor):
    """The observations that a native policy receives."""

    seen: Any = None

    def observation(self, tick: int) -> Any:
        return self.seen


class NativeDriver(PlannerDriver):
    """The driver of an ego with a native policy, which receives a simulator's observations and returns its actions."""

    def __init__(
        self,
        vehicles: VehiclesOfRun,
        ads: Any,
        guard: HangGuard,
        decisions: Sequence[Any],
        every: int,
    ) -> None:
        self._loop = vehicles.loop
        self._checked_before = decisions
        self._observed = Observed()
        self._action: Any = None
        self._hidden: int | None = None
        if isinstance(ads, Unseeing):
            self._hidden = ads.npc
        check_by(ads, self._check_action)
        super().__init__(
            ads,
            guard,
            (),
            vehicles.vehicles[0],
            vehicles.places.bodies[0],
            self._observed,
            lanes=0,
            lane_width=0.0,
            every=every,
            dt=1 / vehicles.rules.physics_hz,
        )

    def decide(self, tick: int) -> AdsError | None:
        # An exception of the simulator is not an error of the policy.
        self._observed.seen = self._loop.simulation.observe(self._hidden)
        taken = len(self.actions)
        if taken >= len(self._checked_before):
            return super().decide(tick)
        self._take(self._checked_before[taken])
        return None

    def take(self, action: Any, seconds: float) -> None:
        """Check and apply an action, for which the policy took ``seconds``.

        Raises:
            BadAction: if the action is None, or if the simulator does not accept it.
        """
        self._take(self._check_action(action))
        self.slowest = max(self.slowest, seconds)

    def _take(self, checked: Any) -> None:
        self.actions.append(checked)
        self._action = copy.deepcopy(checked)  # step may write into it

    def _check_action(self, action: Any) -> Any:
        simulator = self._loop.simulation.simulator
        try:
            # rejects None, even if the user's method does not
            Simulator.check_action(simulator, action)
            checked = simulator.check_action(action)
        except ValueError as error:
            raise BadAction(str(error)) from error
        except Exception as error:
            method = f"{type(simulator).__name__}.check_action({action!r:.100})"
            raise BadAction(f"{method}: {type(error).__name__}: {error}") from error
        checked = copy.deepcopy(checked)  # the policy may use its array again
        if type(checked) is tuple:
            return OwnUnits(checked)
        return checked

    def actuate(self) -> None:
        simulation = self._loop.simulation
        if self._action is None:
            raise WorldError(
                field=f"{type(simulation.simulator).__name__}.check_action",
                expected="the method to return the action",
                received="None",
                fix="is a `return` missing?",
            )
        simulation.action = self._action
        # The package's own model drives straight ahead in this tick.
        self.ego.acceleration = self.ego.steering = 0.0


class Simulation:
    """One run in a simulator."""

    def __init__(
        self, simulators: Simulators, frame: Frame, vehicles: VehiclesOfRun, guard: HangGuard
    ) -> None:
        self._simulators = simulators
        self._frame = frame
        self._bodies: list[Any] = vehicles.vehicles
        self._guard = guard
        self._tick = 0
        self._hz = vehicles.rules.physics_hz
        self.simulator: Any = simulators.take()
        self.action: Any = None  # of a native policy, for the next tick
        self._is_sound = False  # set to True once its states are possible
        try:
            self._starts = self._vehicles(vehicles)
            with self._called("start"):
                self.simulator.start(self._starts, vehicles.scenario.seed)
            self._rows = self._read()
            states = self._in_run(self._rows)
            self._check(states, range(len(self._starts)), STARTS, "start")
        except BaseException:
            self.close()
            raise
        self._speeds = [body.speed for body in self._bodies]
        self._plausibility = vehicles.plausibility = Plausibility(states, 1.0 / self._hz)
        # The NPCs that the simulator puts into the states of their controls.
        self._put = range(0)
        if self.simulator.moves_ego_only:
            self._put = range(1, len(self._bodies))
        self._is_sound = True

    def _vehicles(self, vehicles: VehiclesOfRun) -> list[Vehicle]:
        metres = self._frame.metres
        kinds = [vehicles.rules.ego, *vehicles.scenario.all_vehicles]
        starts = []
        for body, place, kind in zip(self._bodies, vehicles.places.bodies, kinds, strict=True):
            size = body.length / metres, body.width / metres
            starts.append(Vehicle(*self._frame.stated(body), *size, place.lane, kind.name))
        return starts

    def move(self) -> None:
        """Simulate the tick in which the package's own model has just moved all vehicles.

        Raises:
            WorldError: if the first tick shows that the simulator mixes up units, axes or vehicles.
            Implausible: if a vehicle later moves in an impossible way.
        """
        frame = self._frame
        bodies = self._bodies
        controls = [
            Control(
                body.acceleration / frame.speed,
                frame.turn * body.steering / frame.angle,
                *frame.stated(body),
            )
            for body in bodies
        ]
        if self.action is not None:
            controls[0] = controls[0]._replace(action=self.action)
            self.action = None
        self._tick += 1
        self._is_sound = False
        with self._called("step"):
            self.simulator.step(controls)
        rows = self._read()
        states = self._in_run(rows)
        if self._tick == 1:
            self._check(states, self._put, PUT, "step")
            self._check_way(rows)
        self._plausibility.check(states, f"{type(self.simulator).__name__}.states")
        try:
            self._check(states, self._put, PUT, "step")
        except WorldError as error:
            raise Implausible(str(error)) from None
        # Put the vehicles where the simulator has moved them. NPCs in `_put` are there already.
        for number, (body, state) in enumerate(zip(bodies, states, strict=True)):
            if number in self._put:
                self._speeds[number] = body.speed
                continue
            if state[3] != body.speed:  # at the same speed, it has the requested acceleration
                body.acceleration = (state[3] - self._speeds[number]) * self._hz
            body.place(*state)
            self._speeds[number] = state[3]
        self._is_sound = True

    def observe(self, hidden: int | None = None) -> Any:
        arguments = {}
        if hidden is not None:  # otherwise, the method needs no such parameter
            arguments["hidden"] = hidden
        self._is_sound = False
        with self._called("observe"):
            seen = self.simulator.observe(**arguments)
        self._is_sound = True
        return seen

    def _read(self) -> list[list[float]]:
        with self._called("states"):
            given = self.simulator.states()
        count = len(self._bodies)
        try:
            rows = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            rows = np.empty(0)
        if rows.shape != (count, 4):
            received = f"{given!r:.200}"
            if rows.size:
                received = f"an array of shape {rows.shape}"
            raise self._refused(
                "states",
                f"an array of shape ({count}, 4) with x, y, heading and speed of each vehicle, the ego first",
                received,
            )
        if not np.isfinite(rows).all():
            number, column = np.argwhere(~np.isfinite(rows))[0].tolist()
            raise self._refused(
                "states",
                "finite numbers",
                f"{STARTS[column][0]} = {rows[number, column]} for {vehicle_name(number)}",
            )
        stated: list[list[float]] = rows.tolist()
        return stated

    def _in_run(self, rows: Any) -> list[State]:
        return [
            self._frame.state(row, body.length, body.heading)
            for row, body in zip(rows, self._bodies, strict=True)
        ]

    def _check(self, states: Any, numbers: Sequence[int], most: Any, method: str) -> None:
        for number in numbers:
            for (name, largest), value in zip(most, states[number], strict=True):
                wanted = getattr(self._bodies[number], name)
                if abs(value - wanted) <= largest:
                    continue
                unit = {"heading": "rad", "speed": "m/s"}.get(name, "m")
                axes = ""
                if name in ("y", "heading"):
                    axes = " (y points to the right)"
                fix = "put each vehicle into the requested state, and return the states in the order of the vehicles"
                if method == "start":
                    received = _shown(self._starts[number])
                    returned = _shown(self._rows[number])
                    fix += (
                        f". In this run, start received {received}, and states returned {returned}"
                    )
                raise WorldError(
                    field=f"{self._place('states')} after {method}",
                    expected=f"{name} = {wanted:.2f} {unit} for {vehicle_name(number)}{axes}",
                    received=f"{value:.2f} {unit}",
                    fix=f"{fix}. {CAUSE}",
                )

    def _check_way(self, rows: list[list[float]]) -> None:
        # In the first tick, vehicles must move in the direction of their headings, as far as their speeds imply.
        dt = 1.0 / self._hz
        starts = self._in_run(self._rows)
        ends = self._in_run(rows)
        for number, (start, end) in enumerate(zip(starts, ends, strict=True)):
            x, y, heading, speed = start
            way = (end[0] - x, end[1] - y)
            wanted = (speed * math.cos(heading) * dt, speed * math.sin(heading) * dt)
            # Turned wheels may turn the direction by the slip of the bicycle model.
            slips = abs(math.atan(math.tan(self._bodies[number].steering) / 2.0))
            most = (STRAYS + min(slips, 1.0)) * math.hypot(*wanted) + FASTEST_CHANGE * dt * dt
            if self._speeds[number] < MOVES or math.dist(way, wanted) <= most:
                continue
            turned = math.degrees(math.atan2(*way[::-1]) - math.atan2(*wanted[::-1]))
            off = abs((turned + 180.0) % 360.0 - 180.0)
            raise self._refused(
                "states",
                f"{vehicle_name(number)} to move {math.hypot(*wanted):.2f} m in the direction of its heading",
                f"a move of {math.hypot(*way):.2f} m, {off:.0f} degrees off that direction",
                f"are hz, the units and the axes correct? Does states() return the states after the step? {CAUSE}",
            )

    def _place(self, method: str) -> str:
        return f"{type(self.simulator).__name__}.{method}, tick {self._tick}"

    def _refused(self, method: str, expected: str, received: str, fix: str = "") -> WorldError:
        return WorldError(field=self._place(method), expected=expected, received=received, fix=fix)

    @contextmanager
    def _called(self, method: str) -> Iterator[None]:
        # Each call of a method has a time limit, and errors in it name the method.
        guard = self._guard
        limit = guard.limit
        most = guard.limit = patience_with_world(limit)
        try:
            try:
                guard.decision_starts()
                yield
            finally:
                guard.decision_ends()
                guard.limit = limit
            guard.raise_swallowed()
        except AdsHang:
            raise self._refused(
                method,
                f"a return within {most:g} s",
                "none",
                "increase the world's hang_limit",
            ) from None
        except Exception as error:
            error.add_note(f"raised by {self._place(method)}")
            raise

    def close(self) -> None:
        simulator, self.simulator = self.simulator, None
        if simulator is not None:
            self._simulators.give(simulator, is_sound=self._is_sound)


class Simulators:
    """The simulators that a world has created in this process. Each run borrows one, and later runs reuse it."""

    _all: ClassVar[weakref.WeakSet[Simulators]] = weakref.WeakSet()

    def __init__(self, make: Callable[[], Any]) -> None:
        is_first = all(each._process != getpid() for each in self._all)
        self._make = make
        self._process: int = getpid()
        self._free: list[Any] = []
        if is_first:
            atexit.register(self.close_all)
            # multiprocessing ends its processes without calling atexit functions
            if parent_process() is not None:
                Finalize(None, self.close_all, exitpriority=0)
        self._all.add(self)

    # in the callback of a weak reference, nothing could interrupt a close that hangs
    def __del__(self) -> None:
        if self._free:  # at the interpreter's end, all are closed, and _close is gone
            _close(self._process, self._free)

    def __reduce__(self) -> tuple[Any, ...]:
        # The simulators are omitted, because they belong to this process.
        return Simulators, (self._make,)

    def take(self) -> Any:
        # the other process still uses its simulators, so they are not closed
        if self._process != getpid():
            self.__init__(self._make)  # type: ignore[misc]
        if self._free:
            return self._free.pop()
        for each in tuple(self._all):  # close simulators of other worlds, whose runs are over
            alone = [one for one in each._free if one.one_at_a_time]
            each._free = [one for one in each._free if one not in alone]
            _close(each._process, alone)
        return self._make()

    def give(self, simulator: Any, *, is_sound: bool = True) -> None:
        """Take a simulator back after a run, or close it if it has failed."""
        if is_sound and self._process == getpid():
            self._free.append(simulator)
        else:
            _close(getpid(), [simulator])

    @classmethod
    def close_all(cls) -> None:
        """Close all unused simulators of this process. Later runs create new ones."""
        for each in tuple(cls._all):
            _close(each._process, each._free)


def _close(process: int, simulators: list[Any]) -> None:
    # A forked process must not close the simulators of its parent.
    while simulators and process == getpid():
        simulator = simulators.pop()
        call_close(simulator.close, f"{type(simulator).__name__}.close", CLOSING)


def _shown(values: Sequence[Any]) -> str:
    names = [name for name, _ in STARTS]
    return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, values, strict=False))
