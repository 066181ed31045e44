"""Fitness: one number per run, which a search maximises. Higher is worse for the ego.

Source: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 3.3.
"""

from __future__ import annotations

import inspect
import math
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from numbers import Real
from types import MappingProxyType
from typing import Literal

import numpy as np

from pytest_pafot import criticality
from pytest_pafot.criticality.measures import MANOEUVRE_SECONDS
from pytest_pafot.criticality.signals import MEASURES
from pytest_pafot.model.trace import HEADING, SPEED, FloatArray, Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.references import referred_to
from pytest_pafot.support.text import suggest

Fitness = Callable[[Trace], float]  # from a trace to a number; higher is worse for the ego
# The fitness of invalid runs, in which NPCs touched, and the replacement for NaN. Such a run is never the best.
WORST_RANK = -math.inf


class FitnessError(ValueError):
    """An error about a fitness function that cannot be used or that failed for a run."""


# The time to contact at which the risk is one half [s], a usual limit for critical encounters (van der Horst 1990).
TAU = 1.5


def risks(trace: Trace) -> tuple[float, float, float, float]:
    """Return the four risks that the default fitness of a valid run combines, each from 0 to 1."""
    # The four measures of the paper, in forms that rise steadily towards a collision:
    # - METTC ignores when the NPC reaches the crossing point, and is infinite at nearly every tick on a straight road.
    #   The time until the boxes touch replaces it: 1 / (1 + TTC / tau).
    # - MD, the distance between the centres, is smallest for vehicles that drive harmlessly side by side. The gap
    #   between the boxes replaces it: 1 / (1 + gap / 1 m).
    # - SD is smallest if a leader pulls away. The shortfall of the safety distance replaces it. A crossing NPC is no
    #   leader, so its post-encroachment time counts instead: 1 / (1 + PET / 1 s).
    # - ET, the time to the collision, becomes 1 - ET / planned duration.
    # 0 if NPCs cross and the ADS fails at its first decision
    planned = criticality.planned_duration(trace)
    late = 0.0
    if planned:
        late = 1 - _time_to_collision(trace) / planned
    times = [each.post_encroachment_time for each in criticality.passages(trace) if each]
    encroachment = min([time for time in times if not math.isnan(time)], default=math.inf)
    return (
        1 / (1 + criticality.min_ttc(trace) / TAU),
        1 / (1 + criticality.min_gap(trace)),
        max(criticality.max_safety_shortfall(trace), 1 / (1 + encroachment)),
        late,
    )


def default_fitness(trace: Trace) -> float:
    """Return the default fitness: the mean of four :func:`risks`, plus 1 for a collision.

    It is from 0 to 1 without a collision and from 1 to 2 with one, so any collision outranks any near-miss.
    """
    if trace.outcome == Outcome.INVALID:
        return WORST_RANK
    contact, gap, shortfall, time = risks(trace)
    return _never_nan((contact + gap + shortfall + time) / 4 + (trace.outcome == Outcome.COLLISION))


def paper(trace: Trace) -> float:
    """Return the paper's linear combination of four measures, -(METTC + MD + SD + ET).

    Seconds and metres are added without weights, because the paper gives none.
    """
    if trace.outcome == Outcome.INVALID:
        return WORST_RANK
    # The paper has no bonus for a collision. The planned duration replaces an infinite METTC, and limits ET.
    # np.minimum propagates NaN, which min() would drop.
    planned = criticality.planned_duration(trace)
    mettc = float(np.minimum(criticality.mettc(trace), planned))
    distance = criticality.min_centre_distance(trace)
    safety = criticality.min_safety_distance(trace)
    return _never_nan(-(mettc + distance + safety + _time_to_collision(trace)))


SAMPLES_PER_SECOND = 4
FAR = 130.0  # the largest distance, which also replaces an unknown one [m]
# subtracted from the distance between centres; NPCs closer than this along the road are ignored [m]
CAR_LENGTH = 4.6
NEAR = 20.0  # NPCs farther away along the road are ignored [m]
BESIDE = 2.0  # NPCs farther away across the road are ignored [m]
TURNING = math.radians(1.0)  # angle to the road above which the ego counts as changing lanes [rad]


def braking_distance(speed: FloatArray) -> FloatArray:
    """Return braking distances [m] for an array of speeds [m/s], by AV-Fuzzer's fitted polynomial."""
    return np.maximum(0.0467 * speed**2 + 0.4116 * speed - 1.9913 + 0.5, 0.0)


def av_fuzzer(trace: Trace) -> float:
    """Return AV-Fuzzer's fitness, which increases as the distances to NPCs and the room to brake decrease.

    Source: Li et al., "AV-FUZZER", ISSRE 2020, with the constants of the released code.
    """
    # The fitness is (130 - min d / 2 - min delta / 2) / (NPCs - 1), with minima over all NPCs and samples. d is the
    # distance between the centres [m]. delta is d - 4.6 m, minus the braking distance of the vehicle behind.
    count = int(trace.duration * SAMPLES_PER_SECOND + 1e-9) + 1
    samples = [round(sample * trace.physics_hz / SAMPLES_PER_SECOND) for sample in range(count)]
    # The released code continues to sample after an impact, so the tick of the collision is a sample as well.
    if trace.collision is not None:
        samples.append(trace.collision.tick)
    ticks = sorted({min(tick, trace.ticks) for tick in samples})
    frame = criticality.RoadFrame(trace)
    ahead = frame.ahead[:, ticks]
    right = frame.right[:, ticks]
    cos, sin = trace.road.direction
    heading = trace.ego[:, HEADING]
    turned = np.sin(heading) * cos[0] - np.cos(heading) * sin[0]
    turns = np.abs(turned)[ticks] > math.sin(TURNING)
    centres = criticality.centre_distance(trace)[ticks].T
    distance = np.where(frame.is_on_way[:, ticks], np.hypot(ahead, right), centres)
    beside = np.abs(right) < BESIDE
    # An NPC behind counts only while the ego changes lanes, which its heading shows.
    in_front = beside & (ahead > CAR_LENGTH) & (ahead < NEAR)
    cut_off = beside & (ahead < -CAR_LENGTH) & (ahead > -NEAR) & turns
    room = distance - CAR_LENGTH
    speeds = trace.states[ticks, :, SPEED].T
    front = np.where(in_front, room - braking_distance(speeds[0]), FAR)
    rear = np.where(cut_off, room - braking_distance(speeds[1:]), FAR)
    least_distance = min(float(distance.min()), FAR)
    least_room = float(np.minimum(front, rear).min())
    # With a single NPC, the released code fails. Here, the divisor is then 1.
    divisor = max(len(trace.scenario.npcs) - 1, 1)
    return (FAR - 0.5 * least_distance - 0.5 * least_room) / divisor


# The names that `fitness=` accepts.
FitnessName = Literal[
    "default", "paper", "av-fuzzer", "ego.speed", "ego.acceleration", "ego.jerk", "ego.lateral_acceleration", "headway",
    "npcs.gap", "npcs.ttc", "npcs.time_advantage",
]  # fmt: skip

FITNESSES: Mapping[str, Fitness] = MappingProxyType(
    {
        "default": default_fitness,
        "paper": paper,
        "av-fuzzer": av_fuzzer,
        **{measure.name: measure for measure in MEASURES if measure.worse != "neither"},
    }
)
"""The fitness functions by the names that ``fitness=`` accepts. A measure's name means its worst value in the run."""


def resolve(fitness: str | Fitness = "default") -> Fitness:
    """Return the fitness function that ``fitness`` specifies.

    The function raises a :class:`FitnessError` if it fails for a run.

    Args:
        fitness: a name, a measure, a function from a Trace to a number (higher is worse for the ego), or
            ``module:function``.

    Raises:
        FitnessError: for anything else.
    """
    return _Checked(_function(fitness))


def is_built_in(fitness: str | Fitness) -> bool:
    """Return whether ``fitness`` is the name of a built-in fitness."""
    return isinstance(fitness, str) and fitness in FITNESSES


@dataclass(frozen=True, slots=True)
class Steered:
    """A function that computes the fitness of a run, which a search maximises.

    If ``is_for_ego`` is True, the search looks for collisions for which the ego is responsible.
    """

    fitness: Fitness
    is_for_ego: bool = True

    def __call__(self, run: Run) -> float:
        """Return the fitness: 2 to 4 for a collision that counts, otherwise -1 to 1 or minus infinity."""
        trace = run.trace
        if not self.is_for_ego:
            return self.fitness(trace)
        # f / (1 + |f|) increases with the fitness f, so f decides the order within each of the two ranges.
        if trace.outcome != Outcome.COLLISION:
            return _bounded(self.fitness(trace))
        if run.responsibility in ("ego", "both"):
            return 3.0 + _bounded(self.fitness(trace))
        # An NPC gains nothing by ramming the ego, but an earlier near-miss of the ego still counts.
        return _bounded(self.fitness(before_impact(trace)))


def before_impact(trace: Trace) -> Trace:
    """Return a run cut off 3 s before its collision, as a run without a collision.

    At least the first tick remains. A run without a collision is returned unchanged.
    """
    if trace.collision is None:
        return trace
    last = max(trace.collision.tick - math.ceil(MANOEUVRE_SECONDS * trace.physics_hz), 0)
    outcome = Outcome.COMPLETED
    off_road_tick = trace.off_road_tick
    if off_road_tick is not None and off_road_tick <= last:
        outcome = Outcome.OFF_ROAD
    else:
        off_road_tick = None
    ticks_per_gene = trace.scenario.gene_seconds * trace.physics_hz
    arrivals = []
    for genes in trace.arrivals:
        started = [tick for gene, tick in enumerate(genes) if gene * ticks_per_gene <= last]
        arrivals.append(tuple(None if tick is None or tick > last else tick for tick in started))
    return replace(
        trace,
        outcome=outcome,
        collision=None,
        actions=trace.actions[: bisect_left(trace.decision_ticks, last)],
        decided=trace.decided[: bisect_left(trace.decided, last)],
        arrivals=tuple(arrivals),
        off_road_tick=off_road_tick,
        **trace.rows_until(last),
    )


@dataclass(frozen=True, slots=True)
class _Checked:
    """A fitness function whose result is checked in each run and is never NaN."""

    function: Fitness  # a field and not a variable of a closure, so that workers can receive it

    def __call__(self, trace: Trace) -> float:
        if trace.outcome == Outcome.INVALID:
            return WORST_RANK
        try:
            value = self.function(trace)
        except Exception as error:
            raise FitnessError(
                f"fitness: expected {_name(self.function)} to return a number for every run, but for {trace!r} it "
                f"raised {type(error).__name__}: {error}. Runs can end at any tick and with any outcome."
            ) from error
        if not isinstance(value, (Real, np.bool_)):
            raise FitnessError(
                f"fitness: expected {_name(self.function)} to return a number, but it returned {value!r} for {trace!r}."
                " Return a float that increases as the run gets worse for the ego."
            )
        return _never_nan(float(value))


def _function(fitness: object) -> Fitness:
    if isinstance(fitness, str) and fitness in FITNESSES:
        return FITNESSES[fitness]
    names = ", ".join(map(repr, FITNESSES))
    if isinstance(fitness, str) and ":" in fitness:
        try:
            return _function(referred_to(fitness))
        except ValueError as error:
            raise FitnessError(f"fitness: {error}") from error
    if not callable(fitness):
        hint = suggest(fitness, FITNESSES) if isinstance(fitness, str) else ""
        raise FitnessError(
            f"fitness: expected {names} or a function of a Trace, but received {fitness!r}{hint}"
        )
    try:
        signature = inspect.signature(fitness)
    # some builtins have no signature, so the first call shows whether the function fits
    except ValueError:
        return fitness
    try:
        signature.bind(None)
    except TypeError as error:
        raise FitnessError(
            f"fitness: expected a function that can be called with one Trace, but received {_name(fitness)}{signature} "
            f"({error}). Make the trace the first parameter, and give the other parameters defaults."
        ) from error
    return fitness


def _name(function: object) -> str:
    return getattr(function, "__name__", None) or repr(function)


def _time_to_collision(trace: Trace) -> float:
    """Return ET [s]: the time to the collision or, without one, the planned duration."""
    planned = criticality.planned_duration(trace)
    if trace.outcome == Outcome.COLLISION:
        return min(trace.duration, planned)
    return planned


def _never_nan(value: float) -> float:
    if math.isnan(value):
        return WORST_RANK
    return value


def _bounded(value: float) -> float:
    """Return f / (1 + |f|), between -1 and 1. NaN and minus infinity give minus infinity."""
    value = _never_nan(value)
    if value == math.inf:
        return 1.0
    if value == WORST_RANK:
        return WORST_RANK
    return value / (1 + abs(value))
