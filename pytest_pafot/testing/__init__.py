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
from dataclasses import replace
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

# The durations of the experiments (in the last one, vehicles that have stopped drive on at `STAND`), and the longest
# random scenario [s]. The proportion of an experiment after which a lagging drivetrain obeys. The delay from which
# controls take effect late [s].
COAST, GAS, STAND, STOP, LONGEST, SETTLED, LATE = 1.5, 2.0, 6.0, 9.0, 20.0, 0.6, 0.1
# The accepted motion of a vehicle as a multiple of the requested motion: the lowest value, the lowest value without a
# note, and the highest value. A simulator may have drag, noise or another distance between axles.
# Above `WIDE`, a vehicle turns so much that its wheelbase probably differs from the model's.
DRIVEN, OBEYED, WIDE = (
    (0.97, 1.03),
    {"acceleration": (0.2, 0.8, 1.3), "steering": (0.2, 0.4, 2.45)},
    1.3,
)
# The largest change of speed without acceleration [m/s^2], of heading or direction without steering [rad], and angle
# between heading and motion in a turn: a proportion of the turn, and the effect of rear wheels [rad]. How far behind
# the centre of its box a vehicle turns, as a proportion of its length: at least and at most. The largest jump in a tick
# [m], speed of a stationary vehicle [m/s], and effect of other vehicles on the ego [m, m/s].
DRAG, STEADY, SLIP, CENTRE, JUMP, STANDS, AWAY = 0.8, 0.05, (0.3, 0.06), (0.12, 0.7), 0.5, 0.7, 0.5
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
    given: dict[str, Any] = {"vehicles": tuple(filter(world.can_drive, READY.values())), **space}
    within, rng = world.space({**drawn_space(world, given), **given}), rng_of(seed)
    done = [
        (each, _run_scenario(world, each, ads))
        for each in (sample(within, rng) for _ in range(runs))
    ]
    for scenario, trace in done[::-1]:  # in another order than before
        difference = first_difference(trace, _run_scenario(world, scenario, ads))
        _promise(
            not difference,
            "the same scenario gives the same run, to the last bit",
            f"another one: {difference}",
        )


def _run_scenario(world: BaseWorld, scenario: Scenario, ads: AdsFactory | None) -> Trace:
    drive, given = (world.rollout_reference, CAREFUL) if ads is None else (world.rollout, ads)
    with _without_error("a random scenario can be run"):
        trace: Trace = GENERATORS.run(drive, scenario, cast("Any", given))
    wrong = trace.users_error_text or (
        "" if trace.error is None else f"{trace.error.text}. Give a different ads="
    )
    _promise(
        not wrong, "random runs are valid, and the policy of the check drives in this world", wrong
    )
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


class _Run(NamedTuple):
    """One experiment in SI units.

    ``states`` and ``model`` contain (x, y, heading, speed) as arrays of shape [ticks + 1, vehicles, 4]. ``model``
    contains the requested start, followed by the predictions of the package's own model.
    """

    states: FloatArray
    model: FloatArray
    dt: float
    bodies: list[Any]
    given: list[Vehicle]
    sent: list[list[Control]]

    def name(self, number: int) -> str:
        # The kind or the lane may be the reason for an error.
        return f"{named(number)} ({self.given[number].kind}, lane {self.given[number].lane})"

    def steps(self, number: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        # For each tick: the distance, the distance by the stated speeds [m], and the direction of motion minus the
        # heading [rad].
        rows = self.states[:, number]
        # A vehicle moves in the direction of its heading halfway through the tick.
        moved, heading = np.diff(rows[:, :2], axis=0), (rows[1:, 2] + rows[:-1, 2]) / 2
        course = (np.arctan2(moved[:, 1], moved[:, 0]) - heading + np.pi) % (2 * np.pi) - np.pi
        return np.hypot(*moved.T), np.abs(rows[1:, 3] + rows[:-1, 3]) / 2 * self.dt, course


class _Bench:
    """The experiments with a world's simulator. The declarations in ``other`` replace the simulator's.

    Each promise is a tuple: whether it was kept, the expected result and the actual result.
    """

    def __init__(self, world: SimulatorWorld, seed: int) -> None:
        self.world, self.seed, self.top, self.real = (
            world,
            seed,
            world.speed_limit,
            world.simulators.take(),
        )
        # Its attributes before the first run, because a method may use a name such as `length` for something else.
        self.said: Any = SimpleNamespace(
            **{name: getattr(self.real, name) for name in Simulator.__annotations__}
        )
        self.notes, self.facts, lanes = dict[str, str](), dict[str, float](), self.said.lanes
        self.is_plain = isinstance(lanes, Real)
        self.lanes: int = lanes if self.is_plain else len(lanes)
        self.mid: int = self.lanes // 2 if self.is_plain else self.said.start_lane

    def check(self) -> list[str]:
        # The first broken promise is an error, with its cause if another declaration explains everything.
        try:
            for is_kept, promise, received in self.promises():
                _promise(
                    is_kept,
                    promise,
                    received if is_kept or ";" in received else f"{received}{self.cause()}",
                )
            self.check_repetition()
            return list(self.notes.values())
        finally:
            self.world.simulators.give(self.real, is_sound=False)

    def spots(self, speed: float) -> list[Any]:
        # The ego and six NPCs of all kinds in all lanes, far from each other. Each has a lane, a position along the
        # lane from the ego's [m], a speed [m/s] and a kind.
        # NPCs take the lanes in turn, starting next to the ego's lane.
        kinds = [each for each in READY.values() if self.world.can_drive(each)]
        places = enumerate((40.0, -40.0, 80.0, -80.0, 120.0, -120.0))
        npcs = [
            ((self.mid + 1 + n) % self.lanes, ahead, speed, kinds[n % len(kinds)])
            for n, ahead in places
        ]
        return [(self.mid, 0.0, speed, self.world.ego), *npcs]

    def crowd(self) -> list[Any]:
        # The ego is close to a slower NPC and ahead of a faster one. The other NPCs pass it.
        steady, closing = min(16.0, 0.6 * self.top), min(9.0, 0.3 * self.top)
        others, spots = [n for n in range(self.lanes) if n != self.mid] or [self.mid], []
        for n, (*_, kind) in enumerate(self.spots(0.0)):
            # Without control, the first two NPCs come as close as 1.5 m to the ego, and would change its motion if the
            # simulator reacted to other vehicles.
            apart = (self.world.ego.length + kind.length) / 2 + 1.5 + COAST * closing
            beside = (80.0 if others == [self.mid] else -8.0) + 45.0 * (n // len(others))
            side = (0, 1, -1)[n] if n < 3 else 0
            near = self.mid, side * apart, steady - side * closing, kind
            spots.append(near if n < 3 else (others[n % len(others)], beside, 0.9 * self.top, kind))
        return spots

    def tell(self, method: str, given: Sequence[Any], *more: Any) -> FloatArray:
        # Call a method, and return the states of the simulator after it, in shape [vehicles, 4].
        with _without_error(f"{method} and states accept vehicles of all types"):
            getattr(self.real, method)(copy := list(given), *more)
            rows: FloatArray = np.array(self.real.states(), dtype=np.float64)
        _promise(copy == list(given), f"{method} does not change the list that it receives", copy)
        promise = (
            f"states() returns finite numbers of shape ({len(given)}, 4), one row for each vehicle"
        )
        _promise(
            rows.shape == (len(given), 4) and np.isfinite(rows).all(),
            promise,
            f"{rows.tolist()!r:.200}",
        )
        return rows

    def drive(
        self, spots: Sequence[Any], seconds: float, control: Callable[..., Any], **other: Any
    ) -> _Run:
        # `control` returns acceleration and steering by number, time and vehicle.
        # `frame` converts as if the simulator had made the other declarations.
        stated = {
            name: getattr(self.said, name) for name in (*AXES, "metres", "metres_per_second")
        } | other
        axle = (self.said.rear_axle_offset or 1.4) * (stated["reference"] == "rear axle")
        frame = Frame(SimpleNamespace(**stated, rear_axle_offset=axle))
        dt = other.get("dt", 1 / other.get("hz", self.said.hz))
        gas, wheel = (
            other.get("acceleration", 1.0) / frame.speed,
            other.get("steering", 1.0) * frame.turn / frame.angle,
        )
        # The vehicles at their starts.
        bodies, given = list[Any](), list[Vehicle]()
        for lane, ahead, speed, kind in spots:
            start, has_room = self.place(frame, lane, ahead)
            if has_room or not bodies:  # a short road has room for the ego at least
                bodies.append(body := Body(kind.length, kind.width))
                body.place(*start, speed)
                sizes = body.length / frame.metres, body.width / frame.metres
                given.append(Vehicle(*frame.stated(body), *sizes, lane, kind.name))
        # In each tick, the model starts from the state that the simulator returned, so that errors do not add up.
        rows, model, sent, read = [], [], [], self.tell("start", given, self.seed)
        for tick in range(round(seconds / dt) + 1):
            if tick:
                for number, body in enumerate(bodies):
                    body.acceleration, body.steering = control(number, tick * dt - dt, body)
                    body.step(dt)
                sent.append(
                    [
                        Control(gas * b.acceleration, wheel * b.steering, *frame.stated(b))
                        for b in bodies
                    ]
                )
                read = self.tell("step", sent[-1])
            model.append([(each.x, each.y, each.heading, each.speed) for each in bodies])
            rows.append(
                [
                    frame.state(row, b.length, b.heading)
                    for row, b in zip(read.tolist(), bodies, strict=True)
                ]
            )
            for body, state in zip(bodies, rows[-1], strict=True):
                body.place(*state)
        return _Run(np.array(rows), np.array(model), dt, bodies, given, sent)

    def place(
        self, frame: Frame, lane: int, ahead: float
    ) -> tuple[tuple[float, float, float], bool]:
        # Returns x, y and heading in a run, and whether the road has this position.
        real, lanes = self.said, self.said.lanes
        if self.is_plain:
            # Make centre lines for straight parallel lanes, as on other roads.
            width, end = (real.lane_width or 4.0 / frame.metres), (real.length or 1e6)
            lanes = [
                [(0.0, frame.side * n * width), (end, frame.side * n * width)] for n in range(lanes)
            ]
        line = np.array([frame.point(x, y) for x, y in lanes[lane]])
        ends = np.cumsum(np.hypot(*(steps := np.diff(line, axis=0)).T))
        # As in a run, start at the stated position, or with enough road behind the ego.
        along = ahead + (
            real.start_at * frame.metres if real.start_at else min(150.0, ends[-1] / 3)
        )
        at = min(int(np.searchsorted(ends, along)), len(steps) - 1)
        x, y = line[at + 1] + steps[at] * (along - ends[at]) / np.hypot(*steps[at])
        return (float(x), float(y), math.atan2(steps[at, 1], steps[at, 0])), 10.0 < along < ends[
            -1
        ] - 60.0

    def promises(self, **other: Any) -> Iterator[tuple[Any, str, str]]:
        self.notes, fast, slow = {}, max(self.top - 4.0, self.top / 2), min(10.0, self.top / 2)

        # Every vehicle gets a different acceleration or steering angle, to detect controls that move another vehicle.
        # Half of the vehicles brake, or turn to the other side, depending on `side`.
        def gas(number: int, *_: Any, side: int) -> tuple[float, float]:
            return 2.0 - 0.1 * number if (-1) ** number == side else (0.06 * number - 1.0) * min(
                3.0, 0.4 * fast
            ), 0.0

        def turn(number: int, _: float, body: Any, side: int) -> tuple[float, float]:
            slip = math.asin(min(0.75 * body.length / slow**2, 0.09))  # 1.5 m/s^2 across the road
            return 0.0, side * (-1) ** number * (1 - 0.06 * number) * math.atan(2 * math.tan(slip))

        def stop(_: int, time: float, body: Any) -> tuple[float, float]:
            return max(min(6.0 * (time >= STAND) - body.speed, 2.0), -4.0), 0.0

        # Experiment 1: without controls, near other vehicles and alone.
        crowd = self.crowd()
        run, alone = (
            self.drive(each, COAST, lambda *_: (0.0, 0.0), **other) for each in (crowd, crowd[:1])
        )
        yield from self.moves(run, is_steady=True)
        far, ends = (
            np.abs(run.states - alone.states)[-1, 0, [0, 1, 3]].max(),
            (alone.states[-1, 0], run.states[-1, 0]),
        )
        received = " and ".join(f"x = {x:.1f} m, y = {y:.1f} m, {v:.1f} m/s" for x, y, _, v in ends)
        yield far <= AWAY, "the ego moves in the same way alone and near other vehicles", received
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
        run = self.drive(self.spots(min(8.0, self.top)), STOP, stop, **other)
        for number, speeds in enumerate(run.states[..., 3].T):
            stood, last = speeds[round(STAND / run.dt)], speeds[-1]
            received = f"{stood:.1f} m/s after {STAND:g} s and {last:.1f} m/s after {STOP:g} s for {run.name(number)}"
            yield (
                abs(stood) <= STANDS and last > 1.5,
                "a vehicle stops, waits and drives on as requested",
                received,
            )

    def moves(self, run: _Run, *, is_steady: bool = False) -> Iterator[tuple[Any, str, str]]:
        # Promises that vehicles start in the requested states, and move along their headings at their stated speeds.
        # The start.
        off = np.abs(run.states[0] - run.model[0]) > [most for _, most in STARTS]
        first = int(off.any(axis=1).argmax())
        asked, got = (
            ", ".join(f"{each:.2f}" for each in rows[0, first]) for rows in (run.model, run.states)
        )
        promise = f"after start, states() has x, y, heading, speed = {asked} for {run.name(first)} [m, rad, m/s]"
        yield not off.any(), promise, f"{got}{self.misplaced(run) if off.any() else ''}"
        for number, rows in enumerate(run.states.transpose(1, 0, 2)):
            who, (driven, by_speed, course) = run.name(number), run.steps(number)
            # The distance. If its ratio to the speed is wrong in every tick, the unit is wrong. If it differs in one
            # tick, the vehicle has jumped.
            ratio = float(driven.sum() / max(by_speed.sum(), 1e-3))
            self.facts.setdefault("driven", ratio)
            jump, is_late = np.abs(driven - by_speed * ratio), driven[0] < 0.2 * driven[-1]
            jumped = f"{driven[jump.argmax()]:.1f} m at {rows[jump.argmax(), 3]:.1f} m/s for {who} in a tick"
            received = (
                f"the states before it: the first step does not move {who}" if is_late else jumped
            )
            yield (
                jump.max() <= JUMP and not is_late,
                "states() returns states after the step, without jumps",
                received,
            )
            promise = "the distance of a vehicle fits its speed, given dt (or hz), metres_per_second and metres"
            yield (
                DRIVEN[0] <= ratio <= DRIVEN[1],
                promise,
                f"{ratio:.3g} times the distance for {who}",
            )
            # The direction. A vehicle with turned wheels slips, so it may differ from the heading in a turn.
            turned, away, gained = (
                float(rows[-1, 2] - rows[0, 2]),
                float(course[-1]),
                float(rows[-1, 3] - rows[0, 3]),
            )
            promise = "a vehicle moves in the direction of its heading, given headings, y_is_left and degrees"
            received = f"{math.degrees(away):.0f} degrees off for {who}, whose heading turned by {turned:.2f} rad"
            yield (
                abs(away) <= (STEADY if is_steady else SLIP[0] * abs(turned) + SLIP[1]),
                promise,
                received,
            )
            is_kept = not is_steady or (abs(gained) <= DRAG * COAST and abs(turned) <= STEADY)
            promise = "without acceleration and steering, a vehicle keeps its speed and heading, even near another one"
            yield (
                is_kept,
                promise,
                f"{gained:+.1f} m/s and {turned:+.2f} rad for {who} in {COAST:g} s",
            )

    def obeys(self, run: _Run, name: str) -> Iterator[tuple[Any, str, str]]:
        # Promises that vehicles obey their controls, and notes where they do so late, in part, or too much.
        column, (least, whole, most) = 2 + (name == "acceleration"), OBEYED[name]
        done, asked = (
            np.diff(run.states[..., column], axis=0),
            (run.model[1:] - run.states[:-1])[..., column],
        )
        # The change in each tick, of the simulator and of the model. A lagging drivetrain needs time, so only the last
        # part counts.
        since, limit = int(SETTLED * len(asked)), min(LATE, 0.8 * run.dt)
        # [vehicle, whose control]
        parts = done[since:].sum(axis=0)[:, None] / asked[since:].sum(axis=0)
        # The control of which vehicle explains the change, and is the unit a usual one?
        for number, part in enumerate(np.diag(parts).tolist()):
            who, fits = run.name(number), least <= part <= most
            others = [
                f"; the control of {named(n)} moves it"
                for n, p in enumerate(parts[number])
                if abs(p - 1) < 0.03
            ]
            units = [
                f", as in {unit} per second"
                for unit, share in UNITS.items()
                if abs(part / share - 1) < 0.03
            ]
            self.facts.setdefault(name, part)
            promise = (
                f"control.{name} of a vehicle changes its {STARTS[column][0]} as in a bicycle model"
            )
            received = f"{part:.2f} times that for {who}{''.join(units[: column - 2] + others[: not fits])}"
            yield fits and not (units and column == 3), promise, received
            # Late or partial effects are allowed, with a note.
            late = run.dt * (
                len(done) - float(done[:, number].sum() / (part * asked[:, number].mean()))
            )
            if found := [f"in part, {part:.2f} times"] * (part < whole) + [f"{late:.2f} s late"] * (
                late > limit
            ):
                told = f"control.{name} of {named(number)} takes effect {' and '.join(found)}"
                advice = (
                    ""
                    if self.said.moves_ego_only
                    else ". Set moves_ego_only = True if NPCs obey immediately"
                )
                self.notes.setdefault(name, f"{told}. A lagging drivetrain is allowed{advice}")
            if column == 2 and part > WIDE:
                told = f"control.steering turns {named(number)} {part:.2f} times as much as in a bicycle model"
                fix = (
                    f"If its wheelbase is not its length, use atan({1 / part:.2f} * tan(steering))"
                )
                self.notes.setdefault("axles", f"{told}. {fix}")

    def turns(self, run: _Run, reference: str) -> Iterator[tuple[Any, str, str]]:
        # Promises that vehicles turn about a point near their rear axles. The longer of two vehicles must turn less.
        turned = run.states[-1, :, 2] - run.states[0, :, 2]
        parts = turned / (run.model[1:] - run.states[:-1])[..., 2].sum(axis=0)
        shares = dict(zip((body.length for body in run.bodies), parts.tolist(), strict=True))
        short, long = min(shares), max(shares)
        is_felt = long < 1.8 * short or shares[long] / shares[short] < 0.85 * long / short
        yield (
            is_felt,
            "a vehicle turns according to its length",
            f"the same turn with {short:g} and {long:g} m",
        )
        for number, length in enumerate(body.length for body in run.bodies):
            driven, _, course = run.steps(number)
            # The slip gives the distance between the point that the vehicle turns about and the centre of its box.
            # a step may use the heading before or after it
            spare = run.states[-1, number, 3] * run.dt / 2 / length
            behind = float((driven * np.sin(course)).sum() / turned[number] / length)
            is_ahead = behind + spare < CENTRE[0]
            promise = "a vehicle turns about its rear axle, given the stated reference"
            received = f"{behind * length:.1f} m behind the centre of {run.name(number)}, with {reference!r}"
            yield (
                behind - spare <= CENTRE[1] and not (is_ahead and reference == "front"),
                promise,
                received,
            )
            if is_ahead and reference == "centre":
                self.notes["axles"] = (
                    'vehicles turn about their positions. Should reference be "rear axle"?'
                )

    def misplaced(self, run: _Run) -> str:
        # Describe a usual difference at the start. Return an empty string for any other difference.
        asked, got, most = run.model[0], run.states[0], run.model[0, :, 1].max()
        # Another order of the vehicles.
        far = np.hypot(*(asked[:, None, :2] - got[None, :, :2]).T)  # [states, asked]
        order, nearest = far.argmin(axis=1).tolist(), far.min(axis=1).max()
        if len({*order}) == len(order) and nearest < 0.3 < far.diagonal().max():
            return "; states() returns the vehicles in another order than start received them (the ego first)"
        # Another point of reference: all are shifted along their headings.
        ahead = (
            (got - asked)[:, :2] * np.stack([np.cos(asked[:, 2]), np.sin(asked[:, 2])], axis=1)
        ).sum(axis=1)
        is_half = (
            np.abs(np.abs(ahead) - np.array([body.length for body in run.bodies]) / 2).max() < 0.1
        )
        if is_half or (np.ptp(ahead) < 0.1 and 0.2 < abs(ahead[0]) < 6.0):
            side = f"{abs(ahead[0]):.2f} m {'ahead of' if ahead[0] > 0 else 'behind'} the requested positions"
            return f"; states() returns vehicles {side}. Both use the point of reference, {self.said.reference!r}"
        # Mirrored or scaled lanes.
        if np.abs(got[:, 1] - (most - asked[:, 1])).max() < 0.1:
            return "; its lanes are counted from the right, but lane 0 is the leftmost"
        share = float(got[asked[:, 1].argmax(), 1] / (most or 1.0))
        wide = (
            self.is_plain
            and round(share, 2) != 1
            and np.abs(got[:, 1] - share * asked[:, 1]).max() < 0.1 < most
        )
        return f"; its lanes are {share:.4g} times as wide as lane_width" if wide else ""

    def cause(self) -> str:
        # Return the simplest other declaration that explains everything, or an empty string if there is none.
        real, facts, driven = self.said, dict(self.facts), self.facts.get("driven", 1.0)
        # First try other axes, with the fewest changes first.
        axes = (
            {k: v for k, v in zip(AXES, e, strict=True) if v != getattr(real, k)}
            for e in product(*AXES.values())
        )
        causes: list[dict[str, Any]] = sorted(filter(None, axes), key=len)
        # Then try other units, which follow from the measured ratio. Usual units come first.
        if not DRIVEN[0] <= driven <= DRIVEN[1] and driven > 1e-3:
            units = [
                ("metres_per_second", real.metres_per_second * driven),
                ("metres", real.metres / driven),
            ]
            units.sort(
                key=lambda unit: round(
                    min(abs(unit[1] / usual - 1) for usual in (1.0, *UNITS.values())), 2
                )
            )
            tick = {"hz": real.hz / driven} if real.dt is None else {"dt": driven / real.hz}
            causes += [tick, *({name: value} for name, value in units)]
        # Last, try controls in other units or with the other sign.
        causes += [
            {"steering": -1.0},
            *({name: 1 / facts[name]} for name in OBEYED if abs(facts.get(name, 0)) > 1e-3),
        ]
        # A cause explains everything if all experiments succeed with it.
        for each in causes:
            with suppress(AssertionError):
                if all(is_kept for is_kept, *_ in self.promises(**each)):
                    all_ = (
                        f"{k} = {round(v, 6) if isinstance(v, float) else repr(v)}"
                        for k, v in each.items()
                    )
                    return f". Use {', '.join(all_)}{' times that in control' if {*each} & {*OBEYED} else ''}"
        return ""

    def check_repetition(self) -> None:
        # Equal starts must give equal runs, regardless of earlier runs, and also in a new simulator.
        promise = "the same start with the same seed gives the same run, to the last bit"
        run = self.drive(
            self.spots(0.8 * self.top),
            GAS,
            lambda n, t, _: ((-1) ** n * (1 - t), 0.02 * math.sin(t + n)),
        )
        first, _, again = (self.again(run, *each) for each in ((), (2, self.seed + 1), ()))
        cause = "Reset everything in start, and draw random numbers from a generator that start creates from seed"
        _check_same(first, again, run.dt, promise, f"in a simulator that was used before. {cause}")
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
        _promise(
            not told, "close() returns in time and without an exception", told and told[0].message
        )
        _check_same(first, self.again(run), run.dt, promise, f"in another simulator. {cause}")

    def again(
        self, run: _Run, vehicles: int | None = None, seed: int | None = None, beside: Any = None
    ) -> FloatArray:
        # The states with the vehicles and controls of a run, in the simulator's own units.
        rows = [self.tell("start", run.given[:vehicles], self.seed if seed is None else seed)]
        if beside is not None:
            beside.start(run.given[::-1], self.seed + 1)
            beside.step(run.sent[0][::-1])
        return np.array([*rows, *(self.tell("step", each[:vehicles]) for each in run.sent)])


def _check_same(first: FloatArray, again: FloatArray, dt: float, promise: str, where: str) -> None:
    if first.tobytes() != again.tobytes():
        tick, number, column = np.argwhere(first != again)[0].tolist()
        received = f"{STARTS[column][0]} of {named(number)} differs by {abs(first - again)[tick, number, column]:.3g}"
        _promise(False, promise, f"a different run: {received} after {tick * dt:.3g} s {where}")
