"""Experiments on a user's simulator. They find the cause of a mistake where runs of a search only have its symptoms.

In an experiment the simulator moves the ego alone, with known controls, and the package's own model moves the others.
So the world itself translates units and axes, as in a search. If the ego does not move as it has to, the same is tried
with other statements or other controls. If one of them fits, it is the cause.

The tolerances are for other models of a vehicle: with a distance of its own between the axles, with a lag of some
0.3 s, with drag, with noise that follows from the seed, or calculated in another way or with single precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from pytest_pafot import Cell, PositionInstruction, Scenario, ScenarioError, Simulator, SimulatorWorld
from pytest_pafot.model.trace import HEADING, SPEED, FloatArray, X, Y
from pytest_pafot.model.vehicle_type import TRUCK
from pytest_pafot.testing.traces import Promises, wrapped
from pytest_pafot.world import WorldError

SECONDS, SETTLED = 1.5, 1.0
"""How long an experiment lasts, and the time after which a simulator with a lag does as it is asked [s]."""
DEAD = 0.1
"""The time after which a simulator with a lag does at least a small part of what it is asked [s]."""
FASTER, SLOWER, ASIDE = 2.0, -3.0, 1.5
"""The accelerations of the experiments along the road and across it [m/s^2]."""
SLOW = 10.0
"""The speed of an ego that turns, if it can have any [m/s]; at a high one, ticks are too long to see where it turns."""
STEADY, DRAG = (0.5, 0.05), 1.5
"""The largest changes of speed [m/s], and of heading or direction [rad], without acceleration and steering; and that of
the speed if the ego alone has the simulator's dynamics."""
DRIVEN, GAINED, TURNED = (0.97, 1.03), (0.85, 1.15), (0.4, 2.3)
"""What the simulator does, as a multiple of what it is asked to do: at least and at most."""
LEAST_ROWS = 4
"""The fewest rows of an experiment that show something."""
LEAST_TURN = 0.03
"""The least turn by the wheels that is compared [rad]."""
SLIP = 0.3, 0.06
"""The largest angle between heading and motion in a turn: a share of the turn, and what wheels at the rear do [rad]."""
PART = 0.2
"""The least of these if controls may take effect in part."""
CENTRE = 0.12, 0.7
"""How far behind the centre of its box a vehicle turns, as a share of its length: at least if places are those of its
front, and at most if they are those of its centre."""
INFLUENCE = 0.5
"""The largest change of the place [m] or the speed [m/s] of a vehicle by the controls of others."""
TURN = 0.02
"""The steering that NPCs get in addition [rad]."""
AT_ONCE = "step moves vehicles by the controls that it receives"
ADVICE = "or write moves_ego_only = True and put NPCs where their controls say"
AXES = {
    "y_is_left": (True, False),
    "degrees": (True, False),
    "at_front": (True, False),
    "headings": ("x to y", "y to x", "x to -y", "-x to y", "-x to -y", "y to -x", "-y to x", "-y to -x"),
}
"""What a simulator may state of its axes."""
VECTORS = {"x": (1.0, 0.0), "y": (0.0, 1.0), "-x": (-1.0, 0.0), "-y": (0.0, -1.0)}
"""The directions in :attr:`Simulator.headings`."""
UNITS = {
    "metres": {1.0: "1.0", 0.3048: "0.3048, as in feet"},
    "metres_per_second": {
        1.0: "1.0", 1 / 3.6: "1 / 3.6, as in km/h", 0.44704: "0.44704, as in mph", 0.3048: "0.3048, as in feet",
    },
}  # fmt: skip
"""The usual units of attributes in m and m/s, as messages show them."""


class _Watched(Simulator):
    """A user's simulator that moves the first vehicles only, with other statements or controls than its own.

    Args:
        real: the user's simulator.
        stated: other statements.

    Attributes:
        moved: the number of vehicles that it moves; the others move by the package's own model.
        scaled: which of its controls is multiplied, and by what.
        vehicles: the vehicles of the last run.
        controls: the controls of each of its ticks.
        ego: the states of its ego, in the simulator's own units.
    """

    def __init__(self, real: Simulator, **stated: Any) -> None:
        for name in Simulator.__annotations__:
            setattr(self, name, stated.get(name, getattr(real, name)))
        self._real = real
        self.moved, self.scaled = 0, ("steering", 1.0)
        self.vehicles: list[Any] = []
        self.controls: list[list[Any]] = []
        self.ego: list[Any] = []

    def start(self, vehicles: Sequence[Any], seed: int) -> None:
        """Begin a run of the user's simulator with its part of the vehicles."""
        self.vehicles, self.controls, self.ego = list(vehicles), [], []
        self._rest = _places(vehicles)[self.moved :]
        if self.moved:
            self._real.start(self.vehicles[: self.moved], seed)

    def step(self, controls: Sequence[Any]) -> None:
        """Move all vehicles by a tick."""
        self.controls.append(list(controls))
        self._rest = _places(controls)[self.moved :]
        if self.moved:
            name, factor = self.scaled
            self._real.step([each._replace(**{name: factor * getattr(each, name)}) for each in controls[: self.moved]])

    def states(self) -> Any:
        """Return the states of all vehicles."""
        states = [*(self._real.states() if self.moved else ()), *self._rest]
        self.ego.append(copy(states[0]))  # of arrays and lists that the next step changes
        return states

    def gains(self) -> tuple[FloatArray, FloatArray]:
        """Return how the ego's speed changed in each tick, and how the package's own model would change it."""
        return self._changes(3)

    def turns(self) -> tuple[FloatArray, FloatArray]:
        """Return the same of its heading [rad], in the direction of the simulator's headings."""
        unit = math.pi / 180 if self.degrees else 1.0
        turned, asked = (wrapped(each * unit) for each in self._changes(2))
        return turned, asked

    def _changes(self, column: int) -> tuple[FloatArray, FloatArray]:
        ego = np.array(self.ego, dtype=np.float64)[:, column]
        asked = np.array(_places([each[0] for each in self.controls])).reshape(-1, 4)[:, column]
        return np.diff(ego), asked[: len(ego) - 1] - ego[:-1]


def _places(vehicles: Sequence[Any]) -> list[tuple[float, ...]]:
    return [(each.x, each.y, each.heading, each.speed) for each in vehicles]


def experiments(world: SimulatorWorld, scenario: Scenario, seed: int) -> Promises:
    """Yield what a simulator promises, by experiments with it. A scenario of its world says where vehicles start."""
    real = world.simulator()
    try:
        bench = _Bench(world, scenario, real)
        yield from bench.start()
        yield from bench.repetition(seed)
        yield from bench.sizes(seed)
        yield from bench.motion()
        yield from bench.others(seed)
    finally:
        real.close()


class _Bench:
    """The experiments with a simulator.

    Args:
        world: its world.
        scenario: a scenario of it.
        real: the simulator.
    """

    def __init__(self, world: SimulatorWorld, scenario: Scenario, real: Simulator) -> None:
        self._world, self._scenario, self._real = world, scenario, real
        top = int(10 * world.speed_limit) / 10
        self._made: dict[tuple[Any, ...], tuple[SimulatorWorld, _Watched]] = {}
        self._fast, self._slow = max(top - FASTER * SECONDS, top / 2), min(SLOW, top)

    def _driven(
        self, speed: float, action: tuple[float, float], moved: int = 1, **changed: Any
    ) -> tuple[FloatArray, _Watched]:
        """Return the states of the ego with constant decisions in SI units, and the simulator as it was driven.

        The start has this speed [m/s], if it can have any.
        """
        world, watched = self._watched(**{key: value for key, value in changed.items() if key != "scaled"})
        watched.moved, watched.scaled = moved, changed.get("scaled", ("steering", 1.0))
        given = [action] * max(round(SECONDS * world.rules.ads_hz), 1)
        return world.rollout(self._alone(world, speed), _ends, decisions=given).ego, watched

    def _watched(self, **stated: Any) -> tuple[SimulatorWorld, _Watched]:
        """Return the world with a watched simulator, whose class has the user's name for messages, and it."""
        key = tuple(stated.items())
        if key not in self._made:
            if "metres_per_second" in stated:  # the road and its start are the same
                factor = self._real.metres_per_second / stated["metres_per_second"]
                speeds = {name: getattr(self._real, name) for name in ("speed_limit", "start_speed")}
                stated |= {name: factor * speed for name, speed in speeds.items() if speed is not None}
            watched = type(type(self._real).__name__, (_Watched,), {})(self._real, **stated)
            ads_hz = None if "hz" in stated else self._world.ads_hz
            self._made[key] = replace(self._world, simulator=lambda: watched, ads_hz=ads_hz), watched
        return self._made[key]

    def _alone(self, world: SimulatorWorld, speed: float) -> Scenario:
        """Return a scenario with one NPC, in any cell that there is."""
        for cell in (Cell.REAR, *Cell):
            asked = replace(self._scenario, npcs=((PositionInstruction(cell, 0.0),),), vehicles=())
            if world.road_start:
                asked = replace(asked, ego_lane=world.road_start.lane)
            else:
                asked = replace(asked, ego_speed=min(speed, int(10 * world.speed_limit) / 10))
            with suppress(ScenarioError):
                world.check_fits(asked)
                return asked
        return self._scenario

    def start(self) -> Promises:
        """Yield that vehicles start where they are asked to, with the cause if they do not."""
        try:
            self._driven(self._fast, (0.0, 0.0))
        except WorldError as error:
            promise = "vehicles start where they are asked to, and drive where they head"
            seen = f"{error.field}: expected {error.expected}, received {error.received}"
            yield False, promise, f"{seen}{self._astray()}"

    def _astray(self) -> str:
        """Return in words why the ego is not where it has to be at its start or after its first tick."""
        ego, rows, real = *self._alone_in_own_units(), self._real
        steps = np.diff(rows[:, :2], axis=0)
        driven, shift = np.hypot(*steps.T), rows[0, :2] - (ego.x, ego.y)
        if 0.45 < math.hypot(*shift) / ego.length < 0.55:
            side = "ahead of" if shift @ (rows[-1, :2] - rows[0, :2]) > 0 else "behind"
            return self._fits({"at_front": not real.at_front}) or (
                f"; states() has it half the length of the ego {side} where start put it, but both are places of "
                "the centre, or with at_front = True of the front"
            )
        if driven[0] < PART * driven[-1]:
            return "; the first step moves no vehicle: states() has to return the states after the last step"
        by_speed = float(np.abs(rows[1:, 3]).sum()) * real.metres_per_second / real.hz
        felt = {"driven": float(driven.sum()) * real.metres / by_speed} if by_speed > 1.0 else {}
        return self._cause(felt, rows) or (
            f"; start received x, y, heading and speed {_shown(ego[:4])} of it, and states() then has {_shown(rows[0])}"
        )

    def _alone_in_own_units(self) -> tuple[Any, FloatArray]:
        """Return the ego at its start, and its states as it drives straight ahead, as the simulator states them."""
        watched = self._driven(self._fast, (0.0, 0.0), moved=0)[1]
        ego = watched.vehicles[0]
        return ego, self._raw(self._real, [ego], [each[:1] for each in watched.controls], 0)[:, 0]

    def motion(self) -> Promises:
        """Yield that the ego moves as its controls and its state say, with the cause if it does not."""
        felt: dict[str, float] = {}
        try:
            wrong = [each for each in self._moves(felt) if not each[0]]
        except WorldError as error:
            wrong = [(False, "the ego drives where it heads in each experiment", str(error))]
        if wrong:
            _, promise, received = wrong[0]
            yield False, promise, received + self._cause(felt, self._alone_in_own_units()[1])

    def _moves(self, felt: dict[str, float], **changed: Any) -> Promises:
        """Yield how the ego moves in each experiment; ``felt`` receives multiples of what it was asked to do."""
        rows, watched = self._driven(self._fast, (0.0, 0.0), **changed)
        if len(rows) < LEAST_ROWS:  # the road bends too much to go straight ahead; other statements would be unproven
            yield not changed, "the ego stays on the road", f"{len(rows)} rows"
            return
        yield from self._straight_ahead(rows, watched, felt, **changed)
        for acceleration in (FASTER, max(SLOWER, -rows[0, SPEED] / 3)):
            yield from self._accelerates(acceleration, self._fast, felt, **changed)
        if not self._world.road_start:
            yield from self._accelerates(FASTER, 0.0, {}, **changed)
        for side in (1.0, -1.0):
            speed = max(float(rows[0, SPEED]), 1.0) if self._world.road_start else self._slow
            slip = math.asin(min(ASIDE * self._world.ego.length / 2 / speed**2, 0.15))
            yield from self._turns(side * math.atan(2 * math.tan(slip)), felt, **changed)

    def _straight_ahead(self, rows: FloatArray, watched: _Watched, felt: dict[str, float], **changed: Any) -> Promises:
        """Yield that an ego without acceleration and steering goes straight on, as fast and where its states say."""
        real, dt = self._real, 1 / changed.get("hz", self._real.hz)
        (driven, course, _), by_speed, seconds = _steps(rows), _by_speed(rows, dt), (len(rows) - 1) * dt
        if by_speed.sum() > dt:  # else it stands, and shows nothing of distances and directions
            promise = "states() has the states after the last step"
            yield not _late(driven, by_speed, dt), promise, "those before it: the first step moves no vehicle"
            felt["driven"] = ratio = float(driven.sum() / by_speed.sum())
            promise = "a vehicle drives as far as hz, metres_per_second and metres say of its speed"
            yield DRIVEN[0] <= ratio <= DRIVEN[1], promise, f"{ratio:.3g} times the distance"
            # Along a bend, a simulator in coordinates of the road may drive as far in each lane, and be right in one.
            for lane in (0, len(real.lanes) - 1) if not changed and not isinstance(real.lanes, int) else ():
                there = self._driven(self._fast, (0.0, 0.0), start_lane=lane)[0]
                far = float(_steps(there)[0].sum() / max(_by_speed(there, dt).sum(), dt))
                yield DRIVEN[0] <= far <= DRIVEN[1], promise, f"{far:.3g} times the distance in lane {lane}"
            away = float(np.median(course))
            promise = "a vehicle moves where its heading points, in the axes of y_is_left, headings and degrees"
            yield abs(away) <= STEADY[1], promise, f"{math.degrees(away):.0f} degrees beside it"
        promise, gain = "the speed is steady without acceleration", float(rows[-1, SPEED] - rows[0, SPEED])
        most = DRAG if self._world.moves_ego_only else STEADY[0]
        received = f"{rows[0, SPEED]:.2f} m/s, and {rows[-1, SPEED]:.2f} m/s {seconds:.1f} s later"
        yield abs(gain) <= most, promise, received
        turned, asked = (float(each.sum()) for each in watched.turns())
        promise = "the heading is steady without steering"
        received = f"a turn by {turned - asked:.2f} rad in {seconds:.1f} s"
        yield abs(turned - asked) <= STEADY[1] + (TURNED[1] - 1) * abs(asked), promise, received

    def _accelerates(self, acceleration: float, speed: float, felt: dict[str, float], **changed: Any) -> Promises:
        """Yield that the ego changes its speed [m/s] at once and as much as an acceleration [m/s^2] says."""
        is_free, dt = self._world.moves_ego_only, 1 / changed.get("hz", self._real.hz)
        rows, watched = self._driven(speed, (acceleration, 0.0), **changed)
        gains, wanted = watched.gains()
        ticks, since = _late(gains, wanted, dt), _since(gains, dt)
        yield is_free or not ticks, AT_ONCE, f"an acceleration that begins {_many(ticks)} late; {ADVICE}"
        felt["acceleration"] = ratio = _ratio(gains[since:], wanted[since:])
        promise = "the speed changes by control.acceleration, which is in the simulator's speeds per second"
        received = f"{ratio:.3g} times an acceleration of {acceleration:.3g} m/s^2, from {rows[0, SPEED]:.3g} m/s on"
        yield (PART if is_free else GAINED[0]) <= ratio <= GAINED[1], promise, received

    def _turns(self, steering: float, felt: dict[str, float], **changed: Any) -> Promises:
        """Yield that the ego turns at once and as its wheels [rad] say, about a place near its rear axle."""
        is_free, dt = self._world.moves_ego_only, 1 / changed.get("hz", self._real.hz)
        length, at_front = self._world.ego.length, changed.get("at_front", self._real.at_front)
        turning, watched = self._driven(self._slow, (0.0, steering), **changed)
        (turns, wanted), since = watched.turns(), _since(turning[1:], dt)
        if abs(wanted[since:].sum()) < LEAST_TURN:  # the road bends to the other side
            return
        driven, course, own = _steps(turning)
        away, whole = float(course[-1]), float(own.sum())
        promise = "a vehicle that turns moves where its heading points, in the axes of y_is_left and degrees"
        received = f"{away:.2f} rad beside it after a turn by {whole:.2f} rad"
        yield abs(away) <= SLIP[0] * abs(whole) + SLIP[1], promise, received
        ticks = _late(turns, wanted, dt)
        yield is_free or not ticks, AT_ONCE, f"a steering that begins {_many(ticks)} late; {ADVICE}"
        felt["steering"] = ratio = _ratio(turns[since:], wanted[since:])
        promise = f"control.steering to the {'right' if steering > 0 else 'left'} turns a vehicle as wheels do"
        received = f"{ratio:.3g} times the turn of a vehicle of its length"
        yield (PART if is_free else TURNED[0]) <= ratio <= TURNED[1], promise, received
        behind = _ratio((driven * np.sin(course))[since:], own[since:]) / length
        spare = float(turning[-1, SPEED]) * dt / 2 / length  # a step may have the heading before or after it
        is_there = behind + spare >= CENTRE[0] if at_front else behind - spare <= CENTRE[1]
        promise = "a vehicle turns about its rear, so that at_front says whether its place is that of its front"
        received = f"a turn about {behind * length:.1f} m behind the centre of its box"
        yield is_there, promise, f"{received} with at_front = {at_front}"

    def _cause(self, felt: dict[str, float], rows: FloatArray) -> str:
        """Return in words what is otherwise than stated, the simplest first; empty if nothing alone explains all.

        ``rows`` has the ego's states as it drives straight ahead, in the simulator's own units. They exclude most axes.
        """
        real, driven = self._real, felt.get("driven", 1.0)
        stated = {name: getattr(real, name) for name in AXES}
        given: list[dict[str, Any]] = [dict(zip(AXES, each, strict=True)) for each in product(*AXES.values())]
        other = [{name: value for name, value in each.items() if value != stated[name]} for each in given
                 if _heads(rows, each["headings"], each["degrees"])]  # fmt: skip
        causes: list[dict[str, Any]] = sorted(filter(None, other), key=len)
        if not DRIVEN[0] <= driven <= DRIVEN[1] and driven > 1e-3:
            causes.append({"hz": round(real.hz / driven)})
            units = [("metres_per_second", real.metres_per_second * driven), ("metres", real.metres / driven)]
            causes += [{name: value} for name, value in sorted(units, key=lambda unit: not _usual(*unit))]
        causes.append({"scaled": ("steering", -1.0)})
        names = [name for name in ("acceleration", "steering") if abs(felt.get(name, 0.0)) > 1e-3]
        causes += [{"scaled": (name, 1 / felt[name])} for name in names]
        return next(filter(None, map(self._fits, causes)), "")

    def _fits(self, cause: dict[str, Any]) -> str:
        """Return in words that the experiments go well with a cause taken out; nothing if they do not."""
        try:
            if not all(is_kept for is_kept, *_ in self._moves({}, **cause)):
                return ""
        except (WorldError, ScenarioError):  # the road is none then, or the start
            return ""
        if "scaled" not in cause:
            return "; all fits with " + ", ".join(f"{name} = {_unit(name, value)}" for name, value in cause.items())
        name, factor = cause["scaled"]
        if factor < 0:
            return f"; all fits with the opposite sign of control.{name}, which is positive where headings grow"
        unit = "speeds per second" if name == "acceleration" else "angles"
        return f"; all fits with {factor:.3g} times control.{name}, which is in the simulator's own {unit}"

    def _raw(self, real: Simulator, vehicles: Sequence[Any], controls: Sequence[Any], seed: int) -> FloatArray:
        """Return the states of vehicles in the simulator's own units, shape [ticks + 1, vehicles, 4]."""
        real.start(list(vehicles), seed)
        rows = [np.array(real.states(), dtype=np.float64)]
        for each in controls:
            real.step(list(each))
            rows.append(np.array(real.states(), dtype=np.float64))
        return np.array(rows)

    def repetition(self, seed: int) -> Promises:
        """Yield that equal starts give equal runs, in one simulator and in another."""
        watched, real = self._watched_all(), self._real
        run = partial(self._raw, vehicles=watched.vehicles, controls=watched.controls, seed=seed)
        first, _, again = run(real), run(real, seed=seed + 1), run(real)
        fresh, other = self._world.simulator(), self._world.simulator()
        try:
            is_random = not np.array_equal(run(fresh), run(other))
        finally:
            fresh.close()
            other.close()
        promise = "the same start with the same seed gives the same run, to the last bit"
        fix = "take each random number from a generator that start makes from seed"
        yield not is_random, promise, f"another one, in new simulators, too; {fix}"
        received = "another one in a simulator that has been used before; reset all in start, also random generators"
        yield np.array_equal(first, again), promise, received

    def _watched_all(self) -> _Watched:
        """Return a simulator with the vehicles and controls of a scenario, in which the ego brakes later."""
        world, watched = self._watched()
        watched.moved, watched.scaled = 0, ("steering", 1.0)
        half = max(round(SECONDS * world.rules.ads_hz), 1)
        world.rollout(self._scenario, _ends, decisions=[(1.0, 0.01)] * half + [(-4.0, -0.02)] * half)
        return watched

    def sizes(self, seed: int) -> Promises:
        """Yield that a vehicle turns by its length, and not by its width."""
        real = self._real
        _, turning = self._driven(self._slow, (0.0, 0.05), moved=0)
        ego, turn = turning.vehicles[0], [[each[0]] for each in turning.controls]
        straight = [[each._replace(acceleration=0.0, steering=0.0)] for (each,) in turn]
        plain, still, wide, long = (
            (self._raw(real, [vehicle], given, seed)[-1, 0, :2] - [vehicle.x, vehicle.y]) * real.metres
            for vehicle, given in (
                (ego, turn), (ego, straight), (ego._replace(width=2 * ego.width), turn),
                (ego._replace(length=2 * ego.length), turn),
            )
        )  # fmt: skip
        least = 0.05 * float(np.hypot(*(plain - still)))  # nothing in a simulator that puts vehicles at places
        promise = "the length of a vehicle decides how it turns, and not its width"
        is_wide = np.hypot(*(wide - plain)) > max(least, 1e-3)
        yield not is_wide, promise, "another turn of a wider vehicle; are they swapped?"
        is_long = least < 1e-3 or np.hypot(*(long - plain)) > least
        yield is_long or not self._world.can_drive(TRUCK), promise, "the same turn of one of twice the length"

    def others(self, seed: int) -> Promises:
        """Yield that each vehicle moves by its own controls."""
        watched, real = self._watched_all(), self._real
        vehicles, turn = watched.vehicles, TURN * (180 / math.pi if real.degrees else 1.0)
        straight = watched.controls[: len(watched.controls) // 2]
        controls = (
            straight
            + [  # of which NPCs may turn nowhere by themselves
                [each[0], *(one._replace(steering=one.steering + turn) for one in each[1:])]
                for each in watched.controls[len(straight) :]
            ]
        )
        together = self._raw(real, vehicles, controls, seed)
        units = np.array([real.metres, real.metres, real.metres_per_second])

        at_start = float(np.abs(together[0, :, :2] - np.array(_places(vehicles))[:, :2]).max()) * real.metres
        promise = "states() has the vehicles in the order in which start received them"
        yield at_start <= INFLUENCE, promise, f"{at_start:.1f} m from there at the start"

        def away(number: int, by: int, late: int = 0, **changed: float) -> float:
            """Return how far a vehicle is from where it is alone some ticks before, with the controls of one of them.

            A vehicle that is alone is the ego.
            """
            given = [[each[by]._replace(**changed)] for each in controls]
            alone = self._raw(real, [vehicles[number]], given, seed)[: len(together) - late, 0]
            return float(np.abs((together[late:, number] - alone)[:, [0, 1, 3]] * units).max())

        own = [0] if self._world.moves_ego_only else range(len(vehicles))
        for number in own:
            if away(number, number) > INFLUENCE:
                by = min(own, key=partial(away, number))
                tried = (
                    (away(number, by), f"that those of {_name(by)} move it"),
                    (away(number, number, late=1), "states that are a tick old, unlike those of the ego"),
                    (away(number, number, steering=0.0), "that its control.steering does not turn it"),
                    (away(number, number, acceleration=0.0), "that its control.acceleration does not move it"),
                )
                promise = f"the controls of {_name(number)} move it, and come in the order of the vehicles in start"
                yield False, promise, next((what for far, what in tried if far <= INFLUENCE), "that others do, too")


def _ends() -> Callable[[Any], Any]:
    """Return an ADS that ends the run after the given decisions."""

    def decide(_: Any) -> Any:
        raise ValueError

    return decide


def _heads(rows: FloatArray, headings: str, degrees: bool) -> bool:
    """Return whether an ego drives where its headings point, if they are such; also if it stands."""
    steps, angles = np.diff(rows[:, :2], axis=0), rows[:-1, 2] * (math.pi / 180 if degrees else 1.0)
    zero, quarter = (np.array(VECTORS[axis]) for axis in headings.split(" to "))
    ahead = steps[:, 0] * (np.cos(angles) * zero[0] + np.sin(angles) * quarter[0])
    ahead += steps[:, 1] * (np.cos(angles) * zero[1] + np.sin(angles) * quarter[1])
    return bool(np.median(ahead - np.hypot(*steps.T) * math.cos(2 * STEADY[1])) >= 0.0)


def _unit(name: str, value: Any) -> str:
    """Return a value of an attribute in words: a unit by its name if it is a usual one."""
    return (_usual(name, value) or f"{value:.6g}") if isinstance(value, float) else repr(value)


def _usual(name: str, value: float) -> str:
    """Return a usual unit of an attribute in words; empty if a value is none."""
    return next((shown for unit, shown in UNITS.get(name, {}).items() if abs(value / unit - 1) < 0.01), "")


def _shown(values: Sequence[float]) -> str:
    return ", ".join(f"{each:.6g}" for each in values)


def _late(done: FloatArray, asked: FloatArray, dt: float) -> int:
    """Return after how many ticks what is asked begins to be done.

    It is 0 with a lag, in which a part is done in the first ticks, however short they are.
    """
    shares = np.abs(done) / np.maximum(np.abs(asked), 1e-9)
    ticks = int((shares > 0.02).argmax())
    is_sudden = shares[min(ticks, len(shares) - 1)] > 0.6
    return ticks if is_sudden or ticks * dt > DEAD else 0


def _by_speed(rows: FloatArray, dt: float) -> FloatArray:
    """Return how far the ego drives in each tick by the speeds that it states [m]."""
    distances: FloatArray = np.abs(rows[1:, SPEED] + rows[:-1, SPEED]) / 2 * dt
    return distances


def _many(ticks: int) -> str:
    return "a tick" if ticks == 1 else f"{ticks} ticks"


def _steps(rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return for each tick how far a vehicle drives [m], the angle between motion and heading, and its turn [rad]."""
    steps, turns = np.diff(rows[:, [X, Y]], axis=0), np.diff(rows[:, HEADING])
    return np.hypot(*steps.T), wrapped(np.arctan2(steps[:, 1], steps[:, 0]) - rows[:-1, HEADING] - turns / 2), turns


def _ratio(done: FloatArray, asked: FloatArray) -> float:
    """Return how much of what was asked has been done; all if nothing was."""
    return float(done.sum() / asked.sum()) if abs(asked.sum()) > 1e-6 else 1.0


def _since(ticks: FloatArray, dt: float) -> int:
    """Return the tick from which a simulator with a lag does what it is asked to do."""
    return min(round(SETTLED / dt), len(ticks) // 2)


def _name(number: int) -> str:
    return f"NPC {number - 1}" if number else "the ego"
