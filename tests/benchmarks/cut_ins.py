"""Who is responsible for collisions of which UN R157 and two models of drivers say whether they can be avoided?

    python -m tests.benchmarks.cut_ins [--collisions 1000]

The ego runs into a vehicle that cuts in, that a leader's lane change reveals, or that brakes ahead (R157, annex 4,
appendix 3), because it brakes not at all, too late or too weakly. Prints how many of these collisions R157 requires the
ego to avoid, how many the Fuzzy Safety Model and the careful driver avoid if they take over when the other vehicle
begins, and the verdicts. Then it prints the answers that disagree with a verdict, and what is special about the run.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from pytest_pafot import criticality
from pytest_pafot.attribution.responsibility import attribute_collision, decide_contested
from pytest_pafot.model.trace import HEADING, SPEED, FloatArray, Trace, X, Y
from pytest_pafot.world.kernel.observation import Observation, VehicleState
from pytest_pafot.world.reference_drivers import CarefulHuman
from tests.benchmarks.command import options, print_head
from tests.helpers.drives import HZ
from tests.helpers.situations import LEFT, OWN, RIGHT, driven, hit
from tests.helpers.traces import LENGTH, WIDTH, straight_lanes, trace_of, vehicle

BEGIN, FASTEST, HEADWAY = 2.0, 130 / 3.6, 2.0
"""When the other vehicle begins to cut in, to leave or to brake [s], the speed limit [m/s], and R157's headway [s]."""
INTRUSION, VISIBLE, WANDERING = 0.3, 0.72, 0.375
"""Of R157: how far a cut-in is over the line [m] and for how long it has been visible [s] when it counts, and how far
from the centre of its lane a vehicle does not yet seem to leave it [m]."""
Driver = Callable[[Observation], tuple[float, float]]
ROAD = {"lanes": straight_lanes(speed_limit=FASTEST)}
HARD, LEVEL, SUDDEN = "leader brakes with over 8 m/s^2", "ego drew level", "visible for < 0.72 s"
QUICK, FAST = "needs a response in < 1.4 s", "closing with > 12 m/s"


class Fuzzy:
    """The Fuzzy Safety Model (Mattas et al., Accident Analysis and Prevention 148, 2020) with the values of R157."""

    REACTION, COMFORTABLE, HARDEST, OTHERS, MARGIN, JERK = 0.75, 4.0, 6.0, 7.0, 2.0, 12.65
    # [m], our own: without it, the model touches what it stops for, because time passes in ticks
    ROUNDING = 0.5

    def __init__(self) -> None:
        self.waits, self.acceleration = self.REACTION, 0.0

    def __call__(self, seen: Observation) -> tuple[float, float]:
        wanted = max((self.braking(seen.ego, other) for other in seen.others), default=0.0)
        if wanted > 0 and self.waits > 0:
            self.waits, wanted = self.waits - 1 / HZ, 0.0
        self.acceleration = -min(wanted, self.JERK / HZ - self.acceleration)
        return self.acceleration, 0.0

    def braking(self, ego: VehicleState, other: VehicleState) -> float:
        """Return the braking for a vehicle that is in the way, or will be before the ego has passed it [m/s^2]."""
        gap, v, u = other.x - ego.x - LENGTH, ego.speed, other.speed * math.cos(other.heading)
        apart, nearing = (
            abs(other.y - ego.y) - WIDTH,
            other.speed * math.sin(other.heading) * np.sign(ego.y - other.y),
        )
        passing = (gap + 2 * LENGTH) / (v - u) + 0.1 if v > u else 0.0
        if other.x < ego.x or (apart > 0 and apart > nearing * passing):
            return 0.0
        room, later = (
            gap - self.ROUNDING,
            v - u + max(self.acceleration, -self.COMFORTABLE) * self.REACTION,
        )
        if later < 0:
            critical = float(v > u and room < (v - u) ** 2 / (2 * abs(self.acceleration)))
        else:
            critical = self.share(room - (v - u + later) / 2 * self.REACTION, later) * (v > u)
        if critical:
            return self.COMFORTABLE + critical * (self.HARDEST - self.COMFORTABLE)
        room = gap - self.MARGIN - v * self.REACTION + u**2 / (2 * self.OTHERS)
        return self.COMFORTABLE * self.share(room, v, self.MARGIN)

    def share(self, room: float, speed: float, margin: float = 0.0) -> float:
        """Return 0 if there is room to stop comfortably, 1 if there is none even to stop hard, or a number between."""
        safe, unsafe = speed**2 / (2 * self.COMFORTABLE) + margin, speed**2 / (2 * self.HARDEST)
        return min(max((safe - room) / max(safe - unsafe, 1e-9), 0.0), 1.0)


class Scene(NamedTuple):
    """An ego that keeps its speed [m/s] until ``BEGIN``, and the NPCs; it sees the first one from a time on [s]."""

    kind: str
    speed: float
    npcs: list[FloatArray]
    seen_from: float

    def ego(self, driver: Driver) -> FloatArray:
        """Return the states of the ego if a driver takes over at ``BEGIN``, who has watched before."""
        rows, x, speed, acceleration = [], 0.0, self.speed, 0.0
        seen = [npc[:, [X, Y, HEADING, SPEED]].tolist() for npc in reversed(self.npcs)]
        for tick in range(len(seen[0])):
            rows.append((x, speed, acceleration))
            states = [npc[tick] for npc in (seen if tick / HZ >= self.seen_from else seen[:-1])]
            others = [VehicleState(*state, round(state[1] / OWN)) for state in states]
            wish, _ = driver(
                Observation(
                    tick / HZ, VehicleState(x, OWN, 0.0, speed, 1), others, speed_limit=FASTEST
                )
            )
            acceleration = max(wish, -speed * HZ) if tick / HZ >= BEGIN else 0.0
            x, speed = x + speed / HZ, speed + acceleration / HZ
        along, speeds, accelerations = np.array(rows).T
        return vehicle(along, OWN, speed=speeds, acceleration=accelerations)

    def hits(self, ego: FloatArray) -> bool:
        return bool((criticality.gap(trace_of(ego, *self.npcs, **ROAD)) == 0).any())

    def requires(self, trace: Trace) -> tuple[bool | None, str]:
        """Return whether R157 requires the ego to avoid the collision, if it speaks of it, and what is special in it.

        It does behind a leader that brakes (5.2.5.1), here if the ego kept its headway, and at a cut-in with a time to
        collision of more than v / (2 * 6 m/s^2) + 0.35 s when it is over the line (5.2.5.2).
        """
        ego, npc, begin = trace.ego, trace.npcs[:, 0], round(BEGIN * HZ)
        gap, slower = (
            npc[:, X] - ego[:, X] - LENGTH,
            ego[:, SPEED] - npc[:, SPEED] * np.cos(npc[:, HEADING]),
        )
        if self.kind == "cut-in":
            over = np.abs(npc[:, Y] - OWN) <= (OWN + WIDTH) / 2 - INTRUSION
            at = int(np.argmax(over))
            v, spare = slower[at], gap[at] - slower[at] ** 2 / (2 * 6.0)
            is_seen, late = (
                at - begin >= VISIBLE * HZ,
                QUICK if spare <= v * 1.4 else FAST if v > 12 else "",
            )
            special = LEVEL if gap[-2] <= 0 else late if is_seen else SUDDEN
            return bool(over.any() and is_seen and v > 0 and spare > v * 0.35), special
        is_required = self.kind == "braking leader" and gap[begin] >= HEADWAY * self.speed
        return bool(is_required) or None, HARD if np.diff(npc[:, SPEED]).min() * HZ < -8.0 else ""


def drawn(number: int) -> tuple[Scene, Driver]:
    """Return the scene of a number, and the braking of its ego; the three kinds take turns."""
    rng, kind = (
        np.random.default_rng([157, number]),
        ("cut-in", "cut-out", "braking leader")[number % 3],
    )
    speed, seen_from, place = rng.uniform(20 / 3.6, FASTEST), 0.0, LENGTH
    other = rng.uniform(10 / 3.6, speed) if kind == "cut-in" else speed
    across = rng.uniform(0.3, min(3.0, 0.15 * other))
    if kind == "cut-in":
        place, side = (
            place + (speed - other) * (BEGIN + rng.uniform(0, 6)),
            (LEFT, RIGHT)[rng.integers(2)],
        )
        npcs = [driven(place, side, speed=other, shifts=[(BEGIN, OWN, OWN / across)])]
    elif kind == "cut-out":
        place, seen_from = place + HEADWAY * speed, BEGIN + WANDERING / across
        leader = driven(place, speed=speed, shifts=[(BEGIN, LEFT, OWN / across)])
        passed, slow = (
            BEGIN + (WIDTH + 0.5) / across + rng.uniform(0, 3),
            max(rng.uniform(-0.8, 0.8), 0.0) * speed,
        )
        npcs = [driven(place + LENGTH + (speed - slow) * passed, speed=slow), leader]
    else:
        place += rng.uniform(1, 3) * speed
        npcs = [driven(place, speed=speed, brakes=[(BEGIN, rng.uniform(1, 9.81), 0.0)])]
    braking, late = ((0.0, 0.0), (6.0, rng.uniform(1.5, 4)), (rng.uniform(0.5, 3), 1.0))[
        rng.integers(3)
    ]
    return Scene(kind, speed, npcs, seen_from), lambda seen: (
        -braking * (seen.time >= BEGIN + late),
        0.0,
    )


def collisions(count: int) -> Iterator[tuple[Scene, Trace]]:
    """Return the first scenes in which the ego runs into an NPC, with their runs."""
    egos = ((scene, scene.ego(driver)) for scene, driver in map(drawn, itertools.count()))
    found = ((scene, hit(ego, *scene.npcs, **ROAD)) for scene, ego in egos if scene.hits(ego))
    return itertools.islice((pair for pair in found if pair[1].collision.side != "rear"), count)


def responsible(scene: Scene, trace: Trace) -> str:
    """Return who is responsible, with the careful driver who takes over when it begins for one that takes over."""
    avoids = not scene.hits(scene.ego(CarefulHuman()))
    return decide_contested(attribute_collision(trace), float(avoids)).responsibility


def main() -> None:
    kinds: defaultdict[str, Counter[str]] = defaultdict(Counter)
    columns, odd = ("R157", "FSM", "careful", "ego", "both", "npc"), Counter[tuple[str, ...]]()
    for scene, trace in collisions(options(__doc__, collisions=1000).collisions):
        (required, special), verdict = scene.requires(trace), responsible(scene, trace)
        answers = (
            required,
            *(not scene.hits(scene.ego(driver())) for driver in (Fuzzy, CarefulHuman)),
        )
        kinds[scene.kind].update(
            itertools.compress(columns, [*answers, *(verdict == name for name in columns[3:])])
        )
        if {*answers} - {None} != {verdict in ("ego", "both")}:
            says = ["-" if answer is None else "yes" if answer else "no" for answer in answers]
            odd[scene.kind, verdict, *says, special] += 1
    print_head("", *columns)
    for kind, counts in kinds.items():
        print(f"| {kind} | {' | '.join(str(counts[column]) for column in columns)} |")
    print_head("", "verdict", *columns[:3], "special", "n")
    for row, count in sorted(odd.items()):
        print(f"| {' | '.join(row)} | {count} |")


if __name__ == "__main__":
    main()
