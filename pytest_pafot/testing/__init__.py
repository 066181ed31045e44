"""A check of a user's simulator, to be called in the user's tests.

In each experiment, the simulator moves vehicles with known controls, and the package's own model predicts their motion.
If the two disagree, the experiments are repeated with other units, axes and controls. If everything agrees once a
declaration is changed, that declaration was wrong.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from numbers import Real
from types import SimpleNamespace
from typing import Any, NamedTuple, Unpack, cast, get_args

import numpy as np

from pytest_pafot.algorithms.space import sample
from pytest_pafot.attribution.takeovers import CAREFUL
from pytest_pafot.model.scenario import Scenario, rng_of
from pytest_pafot.model.trace import FloatArray, Trace, first_difference
from pytest_pafot.model.trace import vehicle_name as named
from pytest_pafot.model.vehicle_type import READY
from pytest_pafot.searches.request import SpaceArguments, drawn_space
from pytest_pafot.world import Control, Simulator, SimulatorWorld, Vehicle
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.codec import checked_world
from pytest_pafot.world.driving.policy import AdsFactory
from pytest_pafot.world.engines.simulation import HEADINGS, STARTS, Frame, Reference
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.kernel.lanes import Body

# The durations of the experiments [s]. In the last one, vehicles that have stopped drive on at `STAND`.
COAST = 1.5
GAS = 2.0
STAND = 6.0
STOP = 9.0
# The longest random scenario [s].
LONGEST = 20.0
# The proportion of an experiment after which a lagging drivetrain obeys.
SETTLED = 0.6
# The delay from which controls take effect late [s].
LATE = 0.1
# The accepted distance of a vehicle as a multiple of the distance by its speed.
DRIVEN = (0.97, 1.03)
# The accepted change of speed and of heading as a multiple of the requested change: the lowest value, the lowest value
# without a note, and the highest value. A simulator may have drag, noise or another distance between axles.
OBEYED = {"acceleration": (0.2, 0.8, 1.3), "steering": (0.2, 0.4, 2.45)}
# Above this multiple, a vehicle turns so much that its wheelbase probably differs from the model's.
WIDE = 1.3
# The largest change of speed without acceleration [m/s^2], and of heading or direction without steering [rad].
DRAG = 0.8
STEADY = 0.05
# The largest angle between heading and motion in a turn: a proportion of the turn, and the effect of rear wheels [rad].
SLIP = (0.3, 0.06)
# How far behind the centre of its box a vehicle turns, as a proportion of its length: at least and at most.
CENTRE = (0.12, 0.7)
# The largest jump in a tick [m], speed of a stationary vehicle [m/s], and effect of other vehicles on the ego [m, m/s].
JUMP = 0.5
STANDS = 0.7
AWAY = 0.5
# Usual units of speed [m/s] and of length [m].
UNITS = {"km/h": 1 / 3.6, "mph": 0.44704, "feet": 0.3048}
# All possible declarations of a simulator about its axes.
AXES = {
    "degrees": (True, False),
    "y_is_left": (True, False),
    "headings": HEADINGS,
    "reference": get_args(Reference),
}


def check_world(
    world: BaseWorld,
    *,
    seed: int = 0,
    runs: int = 8,
    ads: AdsFactory | None = None,
    **space: Unpack[SpaceArguments],
) -> None:
    """Check that a simulator behaves as a search expects, and that repeated runs are identical to the last bit.

    In any world other than a :class:`pytest_pafot.SimulatorWorld`, the check only runs random scenarios, twice each.

    Args:
        world: world to check, such as ``pafot.SimulatorWorld(MySimulator)``.
        seed: seed of the scenarios and of the simulator.
        runs: number of random scenarios.
        ads: factory of the policy for the random scenarios. The default is a reference driver.
        space: properties of the scenarios, such as ``npcs`` and ``ego_lane``, as in :func:`pytest_pafot.search`.

    Raises:
        AssertionError: if the simulator is wrong. The message names the attribute to change, if one is the cause.
        WorldError: if the world is not an instance of a class of this package, or cannot be used.

    Warns:
        RuntimeWarning: if controls take effect late or only partly, which is allowed.
    """
    checked_world(world)
    # First the experiments, only with a user's simulator. Its random runs are short: longer ones would show no more.
    if isinstance(world, SimulatorWorld):
        for note in _Bench(world, seed).check():
            warnings.warn(f"check_world: {note}", RuntimeWarning, stacklevel=2)
        world = replace(world, duration=min(world.duration, LONGEST))
    # Then random scenarios, with vehicles of all types that can follow the road.
    vehicles = tuple(filter(world.can_drive, READY.values()))
    given: dict[str, Any] = {"vehicles": vehicles, **space}
    within = world.space(drawn_space(world, given) | given)
    rng = rng_of(seed)
    done = []
    for _ in range(runs):
        scenario = sample(within, rng)
        done.append((scenario, _run_scenario(world, scenario, ads)))
    for scenario, trace in reversed(done):  # in another order than before
        difference = first_difference(trace, _run_scenario(world, scenario, ads))
        _promise(
            not difference,
            "the same scenario gives the same run, to the last bit",
            f"another one: {difference}",
        )


def _run_scenario(world: BaseWorld, scenario: Scenario, ads: AdsFactory | None) -> Trace:
    with _without_error("a random scenario can be run"):
        if ads is None:
            trace: Trace = GENERATORS.run(world.rollout_reference, scenario, cast("Any", CAREFUL))
        else:
            trace = GENERATORS.run(world.rollout, scenario, ads)
    wrong = trace.users_error_text
    if not wrong and trace.error is not None:
        wrong = f"{trace.error.text}. Give a different ads="
    promise = "random runs are valid, and the policy of the check drives in this world"
    _promise(not wrong, promise, wrong)
    return trace


def _promise(is_kept: Any, promise: str, received: object) -> None:
    if not is_kept:
        raise AssertionError(f"expected that {promise}, received {received}")


@contextmanager
def _without_error(promise: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        raise AssertionError(
            f"expected that {promise}, received {type(error).__name__}: {error}"
        ) from error


# Each promise is a tuple: whether it was kept, the expected result and the actual result.
Promises = Iterator[tuple[Any, str, str]]


class _Run(NamedTuple):
    """One experiment in SI units.

    ``states`` and ``model`` contain (x, y, heading, speed) as arrays of shape [ticks + 1, vehicles, 4]. ``model``
    contains the requested start, followed by the predictions of the package's own model.
    """

    states: FloatArray
    model: FloatArray
    dt: float
    lengths: list[float]
    given: list[Vehicle]
    sent: list[list[Control]]

    def name(self, number: int) -> str:
        # The kind or the lane may be the reason for an error.
        return f"{named(number)} ({self.given[number].kind}, lane {self.given[number].lane})"

    def steps(self, number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        # For each tick: the distance, the distance by the stated speeds [m], and the direction of motion minus the
        # heading [rad].
        rows = self.states[:, number]
        moved = np.diff(rows[:, :2], axis=0)
        # A vehicle moves in the direction of its heading halfway through the tick.
        middle = (rows[1:] + rows[:-1]) / 2
        course = np.arctan2(moved[:, 1], moved[:, 0]) - middle[:, 2]
        return (
            np.hypot(*moved.T),
            np.abs(middle[:, 3]) * self.dt,
            (course + np.pi) % (2 * np.pi) - np.pi,
        )


@dataclass
class _Bench:
    """The experiments with a world's simulator. The declarations in ``other`` replace the simulator's."""

    world: SimulatorWorld
    seed: int

    def __post_init__(self) -> None:
        self.top = self.world.speed_limit
        self.real = self.world.simulators.take()
        # Its attributes before the first run, because a method may use a name such as `length` for something else.
        stated = {name: getattr(self.real, name) for name in Simulator.__annotations__}
        self.said: Any = SimpleNamespace(**stated)
        self.notes: dict[str, str] = {}
        self.facts: dict[str, float] = {}
        self.lanes: int = self.said.lanes
        self.is_plain = isinstance(self.lanes, Real)
        if self.is_plain:
            self.mid = self.lanes // 2
        else:
            self.lanes = len(self.said.lanes)
            self.mid = self.said.start_lane

    def check(self) -> list[str]:
        # The first broken promise is an error, with its cause if another declaration explains everything.
        try:
            for is_kept, promise, received in self.promises():
                if not is_kept and ";" not in received:
                    _promise(False, promise, received + self.cause())
                _promise(is_kept, promise, received)
            self.check_repetition()
            return list(self.notes.values())
        finally:
            self.world.simulators.give(self.real, is_sound=False)

    def spots(self, speed: float) -> list[Any]:
        # The ego and six NPCs of all kinds in all lanes, far from each other. Each has a lane, a position along the
        # lane from the ego's [m], a speed [m/s] and a kind.
        kinds = [each for each in READY.values() if self.world.can_drive(each)]
        spots = [(self.mid, 0.0, speed, self.world.ego)]
        for n, ahead in enumerate((40.0, -40.0, 80.0, -80.0, 120.0, -120.0)):
            # NPCs take the lanes in turn, starting next to the ego's lane.
            lane = (self.mid + 1 + n) % self.lanes
            spots.append((lane, ahead, speed, kinds[n % len(kinds)]))
        return spots

    def crowd(self) -> list[Any]:
        # The ego is close to a slower NPC and ahead of a faster one. The other NPCs pass it.
        steady = min(16.0, 0.6 * self.top)
        closing = min(9.0, 0.3 * self.top)
        others = [n for n in range(self.lanes) if n != self.mid]
        behind = -8.0
        if not others:
            others = [self.mid]
            behind = 80.0
        kinds = [kind for *_, kind in self.spots(0.0)]
        spots: list[Any] = []
        for side, kind in zip((0, 1, -1), kinds, strict=False):
            # Without control, the first two NPCs come as close as 1.5 m to the ego, and would change its motion if the
            # simulator reacted to other vehicles.
            apart = (self.world.ego.length + kind.length) / 2 + 1.5 + COAST * closing
            spots.append((self.mid, side * apart, steady - side * closing, kind))
        for n, kind in enumerate(kinds[3:], 3):
            ahead = behind + 45.0 * (n // len(others))
            spots.append((others[n % len(others)], ahead, 0.9 * self.top, kind))
        return spots

    def tell(self, method: str, given: Sequence[Any], *more: Any) -> FloatArray:
        # Call a method, and return the states of the simulator after it, in shape [vehicles, 4].
        copy = list(given)
        with _without_error(f"{method} and states accept vehicles of all types"):
            getattr(self.real, method)(copy, *more)
            rows: FloatArray = np.array(self.real.states(), dtype=np.float64)
        _promise(copy == list(given), f"{method} does not change the list that it receives", copy)
        shape = (len(given), 4)
        _promise(
            rows.shape == shape and np.isfinite(rows).all(),
            f"states() returns finite numbers of shape {shape}, one row for each vehicle",
            f"{rows.tolist()!r:.200}",
        )
        return rows

    def drive(
        self, spots: Sequence[Any], seconds: float, control: Callable[..., Any], **other: Any
    ) -> _Run:
        # `control` returns acceleration and steering by number, time and vehicle.
        # `frame` converts as if the simulator had made the other declarations.
        stated = {**vars(self.said), **other}
        axle = 0.0
        if stated["reference"] == "rear axle":
            axle = self.said.rear_axle_offset or 1.4
        frame = Frame(SimpleNamespace(**{**stated, "rear_axle_offset": axle}))
        dt = other.get("dt", 1 / stated["hz"])
        gas = other.get("acceleration", 1.0) / frame.speed
        wheel = other.get("steering", 1.0) * frame.turn / frame.angle
        # The vehicles at their starts.
        bodies: list[Body] = []
        given: list[Vehicle] = []
        for lane, ahead, speed, kind in spots:
            start, has_room = self.place(frame, lane, ahead)
            if has_room or not bodies:  # a short road has room for the ego at least
                body = Body(kind.length, kind.width)
                body.place(*start, speed)
                bodies.append(body)
                sizes = body.length / frame.metres, body.width / frame.metres
                given.append(Vehicle(*frame.stated(body), *sizes, lane, kind.name))
        read = self.tell("start", given, self.seed)
        # In each tick, the model starts from the state that the simulator returned, so that errors do not add up.
        rows, model, sent = [], [], []
        for tick in range(round(seconds / dt) + 1):
            if tick:
                for number, body in enumerate(bodies):
                    body.acceleration, body.steering = control(number, tick * dt - dt, body)
                    body.step(dt)
                controls = [
                    Control(gas * each.acceleration, wheel * each.steering, *frame.stated(each))
                    for each in bodies
                ]
                sent.append(controls)
                read = self.tell("step", controls)
            model.append([(each.x, each.y, each.heading, each.speed) for each in bodies])
            states = []
            for row, body in zip(read.tolist(), bodies, strict=True):
                state = frame.state(row, body.length, body.heading)
                states.append(state)
                body.place(*state)
            rows.append(states)
        lengths = [body.length for body in bodies]
        return _Run(np.array(rows), np.array(model), dt, lengths, given, sent)

    def place(
        self, frame: Frame, lane: int, ahead: float
    ) -> tuple[tuple[float, float, float], bool]:
        # Returns x, y and heading in a run, and whether the road has this position.
        real = self.said
        if self.is_plain:
            # Make the centre line of a straight lane, as on other roads.
            across = frame.side * lane * (real.lane_width or 4.0 / frame.metres)
            points = [(0.0, across), (real.length or 1e6, across)]
        else:
            points = real.lanes[lane]
        line = np.array([frame.point(x, y) for x, y in points])
        steps = np.diff(line, axis=0)
        ends = np.cumsum(np.hypot(*steps.T))
        # As in a run, start at the stated position, or with enough road behind the ego.
        start = min(150.0, ends[-1] / 3)
        if real.start_at:
            start = real.start_at * frame.metres
        along = ahead + start
        at = min(int(np.searchsorted(ends, along)), len(steps) - 1)
        dx, dy = steps[at]
        beyond = along - ends[at]
        x, y = line[at + 1] + steps[at] * beyond / np.hypot(dx, dy)
        has_room = 10.0 < along < ends[-1] - 60.0
        return (float(x), float(y), math.atan2(dy, dx)), has_room

    def promises(self, **other: Any) -> Promises:
        self.notes = {}
        fast = max(self.top - 4.0, self.top / 2)
        slow = min(10.0, self.top / 2)

        # Every vehicle gets a different acceleration or steering angle, to detect controls that move another vehicle.
        # Half of the vehicles brake, or turn to the other side, depending on `side`.
        def gas(number: int, *_: Any, side: int) -> tuple[float, float]:
            if (-1) ** number == side:
                return 2.0 - 0.1 * number, 0.0
            return (0.06 * number - 1.0) * min(3.0, 0.4 * fast), 0.0

        def turn(number: int, _: float, body: Any, side: int) -> tuple[float, float]:
            slip = math.asin(min(0.75 * body.length / slow**2, 0.09))  # 1.5 m/s^2 across the road
            wheels = math.atan(2 * math.tan(slip))
            return 0.0, side * (-1) ** number * (1 - 0.06 * number) * wheels

        def stop(_: int, time: float, body: Any) -> tuple[float, float]:
            wanted = 6.0 if time >= STAND else 0.0
            return max(min(wanted - body.speed, 2.0), -4.0), 0.0

        def coast(*_: Any) -> tuple[float, float]:
            return 0.0, 0.0

        # Experiment 1: without controls, near other vehicles and alone.
        crowd = self.crowd()
        run = self.drive(crowd, COAST, coast, **other)
        alone = self.drive(crowd[:1], COAST, coast, **other)
        yield from self.moves(run, is_steady=True)
        ends = np.array([alone.states[-1, 0], run.states[-1, 0]])
        far = np.abs(ends[1] - ends[0])
        yield (
            far[[0, 1, 3]].max() <= AWAY,
            "the ego moves in the same way alone and near other vehicles",
            " and ".join(f"x = {x:.1f} m, y = {y:.1f} m, {v:.1f} m/s" for x, y, _, v in ends),
        )
        # Experiments 2 to 5: accelerate and brake, and turn to both sides.
        for name, control, speed, seconds in (
            ("acceleration", gas, fast, GAS),
            ("steering", turn, slow, COAST),
        ):
            for side in (1, -1):
                run = self.drive(self.spots(speed), seconds, partial(control, side=side), **other)
                yield from self.moves(run)
                yield from self.obeys(run, name)
        yield from self.turns(run, other.get("reference", self.said.reference))
        # Experiment 6: stop, wait, and drive on.
        spots = self.spots(min(8.0, self.top))
        run = self.drive(spots, STOP, stop, **other)
        for number, speeds in enumerate(run.states[..., 3].T):
            stood = speeds[round(STAND / run.dt)]
            last = speeds[-1]
            yield (
                abs(stood) <= STANDS and last > 1.5,
                "a vehicle stops, waits and drives on as requested",
                f"{stood:.1f} m/s after {STAND:g} s and {last:.1f} m/s after {STOP:g} s for {run.name(number)}",
            )

    def moves(self, run: _Run, *, is_steady: bool = False) -> Promises:
        # Promises that vehicles start in the requested states, and move along their headings at their stated speeds.
        # The start.
        most = [largest for _, largest in STARTS]
        off = np.abs(run.states[0] - run.model[0]) > most
        first = int(off.any(axis=1).argmax())
        asked = ", ".join(f"{each:.2f}" for each in run.model[0, first])
        received = ", ".join(f"{each:.2f}" for each in run.states[0, first])
        if off.any():
            received += self.misplaced(run)
        yield (
            not off.any(),
            f"after start, states() has x, y, heading, speed = {asked} for {run.name(first)} [m, rad, m/s]",
            received,
        )
        for number, rows in enumerate(run.states.transpose(1, 0, 2)):
            who = run.name(number)
            driven, by_speed, course = run.steps(number)
            # The distance. If its ratio to the speed is wrong in every tick, the unit is wrong. If it differs in one
            # tick, the vehicle has jumped.
            ratio = float(driven.sum() / max(by_speed.sum(), 1e-3))
            self.facts.setdefault("driven", ratio)
            jump = np.abs(driven - by_speed * ratio)
            at = jump.argmax()
            received = f"{driven[at]:.1f} m at {rows[at, 3]:.1f} m/s for {who} in a tick"
            is_late = driven[0] < 0.2 * driven[-1]
            if is_late:
                received = f"the states before it: the first step does not move {who}"
            yield (
                jump[at] <= JUMP and not is_late,
                "states() returns states after the step, without jumps",
                received,
            )
            yield (
                DRIVEN[0] <= ratio <= DRIVEN[1],
                "the distance of a vehicle fits its speed, given dt (or hz), metres_per_second and metres",
                f"{ratio:.3g} times the distance for {who}",
            )
            # The direction. A vehicle with turned wheels slips, so it may differ from the heading in a turn.
            *_, turned, gained = (rows[-1] - rows[0]).tolist()
            away = float(course[-1])
            slip = STEADY if is_steady else SLIP[0] * abs(turned) + SLIP[1]
            yield (
                abs(away) <= slip,
                "a vehicle moves in the direction of its heading, given headings, y_is_left and degrees",
                f"{math.degrees(away):.0f} degrees off for {who}, whose heading turned by {turned:.2f} rad",
            )
            if is_steady:
                yield (
                    abs(gained) <= DRAG * COAST and abs(turned) <= STEADY,
                    "without acceleration and steering, a vehicle keeps its speed and heading, even near another one",
                    f"{gained:+.1f} m/s and {turned:+.2f} rad for {who} in {COAST:g} s",
                )

    def obeys(self, run: _Run, name: str) -> Promises:
        # Promises that vehicles obey their controls, and notes where they do so late, in part, or too much.
        is_gas = name == "acceleration"
        column = 3 if is_gas else 2
        least, whole, most = OBEYED[name]
        # The change in each tick, of the simulator and of the model.
        done = np.diff(run.states, axis=0)[..., column]
        asked = (run.model[1:] - run.states[:-1])[..., column]
        # A lagging drivetrain needs time, so only the last part counts.
        since = int(SETTLED * len(asked))
        total = done[since:].sum(axis=0)
        # [vehicle, whose control]
        parts = total[:, None] / asked[since:].sum(axis=0)
        for number, part in enumerate(np.diag(parts).tolist()):
            self.facts.setdefault(name, part)
            is_kept = least <= part <= most
            received = f"{part:.2f} times that for {run.name(number)}"
            # The control of which vehicle explains the change, and is the unit a usual one?
            units = [unit for unit, share in UNITS.items() if abs(part / share - 1) < 0.03]
            movers = [n for n, other in enumerate(parts[number]) if abs(other - 1) < 0.03]
            if is_gas and units:
                received += f", as in {units[0]} per second"
            if not is_kept and movers:
                received += f"; the control of {named(movers[0])} moves it"
            yield (
                is_kept and not (is_gas and units),
                f"control.{name} of a vehicle changes its {STARTS[column][0]} as in a bicycle model",
                received,
            )
            # Late or partial effects are allowed, with a note.
            each_tick = part * asked[:, number].mean()
            ticks = float(done[:, number].sum() / each_tick)
            late = run.dt * (len(done) - ticks)
            found = []
            if part < whole:
                found.append(f"in part, {part:.2f} times")
            if late > min(LATE, 0.8 * run.dt):
                found.append(f"{late:.2f} s late")
            if found:
                told = f"control.{name} of {named(number)} takes effect {' and '.join(found)}"
                told += ". A lagging drivetrain is allowed"
                if not self.said.moves_ego_only:
                    told += ". Set moves_ego_only = True if NPCs obey immediately"
                self.notes.setdefault(name, told)
            if not is_gas and part > WIDE:
                told = f"control.steering turns {named(number)} {part:.2f} times as much as in a bicycle model"
                fix = (
                    f"If its wheelbase is not its length, use atan({1 / part:.2f} * tan(steering))"
                )
                self.notes.setdefault("axles", f"{told}. {fix}")

    def turns(self, run: _Run, reference: str) -> Promises:
        # Promises that vehicles turn about a point near their rear axles. The longer of two vehicles must turn less.
        asked = (run.model[1:] - run.states[:-1])[..., 2]
        turned = run.states[-1, :, 2] - run.states[0, :, 2]
        parts = turned / asked.sum(axis=0)
        shares = dict(zip(run.lengths, parts.tolist(), strict=True))
        short = min(shares)
        long = max(shares)
        yield (
            long < 1.8 * short or shares[long] / shares[short] < 0.85 * long / short,
            "a vehicle turns according to its length",
            f"the same turn with {short:g} and {long:g} m",
        )
        for number, length in enumerate(run.lengths):
            driven, _, course = run.steps(number)
            # a step may use the heading before or after it
            spare = run.states[-1, number, 3] * run.dt / 2 / length
            # The slip gives the distance between the point that the vehicle turns about and the centre of its box.
            slip = (driven * np.sin(course)).sum()
            behind = float(slip / turned[number] / length)
            is_ahead = behind + spare < CENTRE[0]
            yield (
                behind - spare <= CENTRE[1] and not (is_ahead and reference == "front"),
                "a vehicle turns about its rear axle, given the stated reference",
                f"{behind * length:.1f} m behind the centre of {run.name(number)}, with {reference!r}",
            )
            if is_ahead and reference == "centre":
                note = 'vehicles turn about their positions. Should reference be "rear axle"?'
                self.notes["axles"] = note

    def misplaced(self, run: _Run) -> str:
        # Describe a usual difference at the start. Return an empty string for any other difference.
        asked = run.model[0]
        got = run.states[0]
        # Another order of the vehicles.
        apart = asked[:, None, :2] - got[None, :, :2]
        far = np.hypot(*apart.T)  # [states, asked]
        order = {*far.argmin(axis=1).tolist()}
        nearest = far.min(axis=1).max()
        if len(order) == len(far) and nearest < 0.3 < far.diagonal().max():
            return "; states() returns the vehicles in another order than start received them (the ego first)"
        # Another point of reference: all are shifted along their headings.
        heading = asked[:, 2]
        forwards = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        ahead = ((got - asked)[:, :2] * forwards).sum(axis=1)
        halves = np.array(run.lengths) / 2
        is_half = np.abs(np.abs(ahead) - halves).max() < 0.1
        is_one = np.ptp(ahead) < 0.1 and 0.2 < abs(ahead[0]) < 6.0
        if is_half or is_one:
            side = "ahead of" if ahead[0] > 0 else "behind"
            shift = f"{abs(ahead[0]):.2f} m {side} the requested positions"
            return f"; states() returns vehicles {shift}. Both use the point of reference, {self.said.reference!r}"
        # Mirrored or scaled lanes.
        across = asked[:, 1]
        lanes = got[:, 1]
        most = across.max()
        if np.abs(lanes - (most - across)).max() < 0.1:
            return "; its lanes are counted from the right, but lane 0 is the leftmost"
        share = float(lanes[across.argmax()] / (most or 1.0))
        is_scaled = np.abs(lanes - share * across).max() < 0.1 < most
        if self.is_plain and round(share, 2) != 1 and is_scaled:
            return f"; its lanes are {share:.4g} times as wide as lane_width"
        return ""

    def cause(self) -> str:
        # Return the simplest other declaration that explains everything, or an empty string if there is none.
        real = self.said
        facts = dict(self.facts)
        # First try other axes, with the fewest changes first.
        causes: list[dict[str, Any]] = []
        for values in product(*AXES.values()):
            axes = dict(zip(AXES, values, strict=True))
            other = {k: value for k, value in axes.items() if value != getattr(real, k)}
            causes.append(other)
        causes = sorted(filter(None, causes), key=len)
        # Then try other units, which follow from the measured ratio. Usual units come first.
        driven = facts.get("driven", 1.0)
        if not DRIVEN[0] <= driven <= DRIVEN[1] and driven > 1e-3:
            if real.dt is None:
                causes.append({"hz": real.hz / driven})
            else:
                causes.append({"dt": driven / real.hz})
            units = [
                ("metres_per_second", real.metres_per_second * driven),
                ("metres", real.metres / driven),
            ]
            causes += [{name: value} for name, value in sorted(units, key=_oddness)]
        # Last, try controls in other units or with the other sign.
        causes.append({"steering": -1.0})
        for name in OBEYED:
            if abs(facts.get(name, 0)) > 1e-3:
                causes.append({name: 1 / facts[name]})
        # A cause explains everything if all experiments succeed with it.
        for cause in causes:
            with suppress(AssertionError):
                if all(is_kept for is_kept, *_ in self.promises(**cause)):
                    stated = []
                    for name, value in cause.items():
                        shown = round(value, 6) if isinstance(value, float) else value
                        stated.append(f"{name} = {shown!r}")
                    unit = " times that in control" if cause.keys() & OBEYED.keys() else ""
                    return f". Use {', '.join(stated)}{unit}"
        return ""

    def check_repetition(self) -> None:
        # Equal starts must give equal runs, regardless of earlier runs, and also in a new simulator.
        def weave(number: int, time: float, _: Any) -> tuple[float, float]:
            gas = (-1) ** number * (1 - time)
            return gas, 0.02 * math.sin(time + number)

        run = self.drive(self.spots(0.8 * self.top), GAS, weave)
        first = self.again(run)
        self.again(run, 2, self.seed + 1)
        promise = "the same start with the same seed gives the same run, to the last bit"
        cause = "Reset everything in start, and draw random numbers from a generator that start creates from seed"
        where = f"in a simulator that was used before. {cause}"
        _check_same(first, self.again(run), run.dt, promise, where)
        if not self.said.one_at_a_time:
            # A second simulator that runs in between must have no effect.
            beside = self.world.simulators.take()
            again = self.again(run, beside=beside)
            self.world.simulators.give(beside)
            share = "two simulators in a process share nothing, unless the class states one_at_a_time = True"
            _check_same(first, again, run.dt, share, "while another one runs")
        # Closing must work, and a new simulator must behave in the same way.
        with warnings.catch_warnings(record=True, action="always") as told:
            self.world.simulators.give(self.real, is_sound=False)  # closes it
        self.real = self.world.simulators.take()
        received = told[0].message if told else None
        _promise(not told, "close() returns in time and without an exception", received)
        _check_same(first, self.again(run), run.dt, promise, f"in another simulator. {cause}")

    def again(
        self, run: _Run, vehicles: int | None = None, seed: int | None = None, beside: Any = None
    ) -> FloatArray:
        # The states with the vehicles and controls of a run, in the simulator's own units.
        if seed is None:
            seed = self.seed
        rows = [self.tell("start", run.given[:vehicles], seed)]
        if beside is not None:
            beside.start(run.given[::-1], self.seed + 1)
            beside.step(run.sent[0][::-1])
        rows += [self.tell("step", controls[:vehicles]) for controls in run.sent]
        return np.array(rows)


def _oddness(unit: tuple[str, float]) -> float:
    # The smallest relative difference from a usual unit.
    _, value = unit
    differences = [abs(value / usual - 1) for usual in (1.0, *UNITS.values())]
    return round(min(differences), 2)


def _check_same(first: FloatArray, again: FloatArray, dt: float, promise: str, where: str) -> None:
    if first.tobytes() != again.tobytes():
        tick, number, column = np.argwhere(first != again)[0].tolist()
        change = abs(first - again)[tick, number, column]
        received = f"{STARTS[column][0]} of {named(number)} differs by {change:.3g}"
        _promise(False, promise, f"a different run: {received} after {tick * dt:.3g} s {where}")
