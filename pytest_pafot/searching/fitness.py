"""Fitness: one number per run, higher is worse for the ego. The search maximises it.

Sources: Crespo-Rodriguez, Neelofar, Aleti, "PAFOT", AST 2024, section 3.3 names four measures (METTC, MD, SD, ET) and
combines them linearly, all minimised, without giving weights: that is ``"paper"``. The default measures the same four
things with bounded values, so that no measure dominates the others. ``"av-fuzzer"`` is the fitness of Li et al.,
"AV-FUZZER: Finding Safety Violations in Autonomous Driving Systems", ISSRE 2020, with the numbers of the released code.

Every function that :func:`resolve` returns gives minus infinity for an invalid run (two NPCs touched), and in place of
NaN, so such a run never becomes the best of a search.
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
from pytest_pafot.support.text import meant

Fitness = Callable[[Trace], float]  # from a trace to a number; higher is worse for the ego
WORST_RANK = -math.inf  # the fitness of invalid runs and NaN, which must never be preferred


class FitnessError(ValueError):
    """A fitness that cannot be used, or that failed on a run; the message states what was expected and what to do."""


TAU = 1.5
"""The time to contact of which the risk is one half [s]; usual between normal and critical (van der Horst 1990)."""


def risks(trace: Trace) -> tuple[float, float, float, float]:
    """Return the four risks of the default fitness, each from 0 to 1, of a run that is not invalid.

    They are 1 / (1 + TTC / tau), with the smallest time until ego and an NPC touch; 1 / (1 + gap / 1 m), with the
    smallest gap between the boxes; the larger of the largest shortfall of the safety distance and 1 / (1 + PET / 1 s),
    PET being the post-encroachment time of a crossing NPC; and 1 - ET / planned duration, ET being the time to the
    collision, or 0 without one.
    """
    planned = criticality.planned_duration(trace)  # 0 if NPCs cross and the ADS fails at its first decision
    times = (each.post_encroachment_time for each in criticality.passages(trace) if each is not None)
    encroachment = min((time for time in times if not math.isnan(time)), default=math.inf)
    return (
        1 / (1 + criticality.min_ttc(trace) / TAU),
        1 / (1 + criticality.min_gap(trace)),
        max(criticality.max_safety_shortfall(trace), 1 / (1 + encroachment)),
        1 - _time_to_collision(trace) / planned if planned else 0.0,
    )


def weighted(trace: Trace) -> float:
    """Return the default fitness: the mean of four :func:`risks`, each from 0 to 1, plus 1 for a collision.

    It is in [0, 1] without a collision and in [1, 2] with one: any collision outranks any near-miss. The measures are
    those of the paper, in forms that rise steadily towards a collision. The time until the boxes touch replaces METTC,
    which ignores when the NPC gets to the crossing point and is infinite at nearly every tick of a straight road. The
    gap between the boxes replaces MD, the distance between the centres, which is smallest when vehicles drive
    harmlessly alongside. The shortfall of the safety distance replaces SD, which is smallest if a leader pulls away. An
    NPC that crosses is no leader; for it the time between the two arrivals at the zone replaces the safety distance.
    """
    if trace.outcome == Outcome.INVALID:
        return WORST_RANK
    contact, gap, shortfall, time = risks(trace)
    return _never_nan((contact + gap + shortfall + time) / 4 + (trace.outcome == Outcome.COLLISION))


def paper(trace: Trace) -> float:
    """Return the paper's own four measures in its plain linear combination, -(METTC + MD + SD + ET).

    Seconds and metres are added as they are; the paper gives no weights. METTC is capped at the planned duration, which
    also replaces an infinite value. MD is between centres. SD is the smallest signed value of equation 5, follower
    minus leader. ET is the time to the collision, or the planned duration without one. The combination has no bonus for
    a collision, and none is added.
    """
    if trace.outcome == Outcome.INVALID:
        return WORST_RANK
    # np.minimum propagates NaN, min() would drop it.
    mettc = float(np.minimum(criticality.mettc(trace), criticality.planned_duration(trace)))
    distance, safety = criticality.min_centre_distance(trace), criticality.min_safety_distance(trace)
    return _never_nan(-(mettc + distance + safety + _time_to_collision(trace)))


SAMPLES_PER_SECOND = 4
FAR = 130.0  # replaces a distance that no sample gives, and all larger ones [m]
CAR_LENGTH = 4.6  # subtracted from the distance of centres; also the smallest distance along the road in both cases [m]
NEAR = 20.0  # the largest distance along the road in both cases [m]
BESIDE = 2.0  # ... and across it [m]
TURNING = math.radians(1.0)  # heading relative to the road above which the ego counts as changing lanes [rad]


def braking_distance(speed: FloatArray) -> FloatArray:
    """Return braking distances [m] for speeds [m/s] of any shape, by the polynomial that AV-Fuzzer's authors fitted."""
    return np.maximum(0.0467 * speed**2 + 0.4116 * speed - 1.9913 + 0.5, 0.0)


def av_fuzzer(trace: Trace) -> float:
    """Return AV-Fuzzer's fitness: how little room the braking distance leaves; higher is worse for the ego.

    It is (130 - min d / 2 - min delta / 2) / (NPCs - 1).

    d is the distance of the centres [m], and delta is d - 4.6 m minus a braking distance. This is the ego's if the NPC
    is 4.6 to 20 m ahead. It is the NPC's if the NPC is 4.6 to 20 m behind while the ego's heading is more than one
    degree off the road. If neither holds, or the NPC is 2 m or more to the side, delta is 130 m. The minima are over
    all NPCs and four samples per second. The released code continues to sample after an impact, so the tick of the
    collision is sampled as well. With a single NPC the released code fails; then the divisor is 1.
    """
    count = int(trace.duration * SAMPLES_PER_SECOND + 1e-9) + 1
    samples = [round(sample * trace.physics_hz / SAMPLES_PER_SECOND) for sample in range(count)]
    hit = [] if trace.collision is None else [trace.collision.tick]
    ticks = sorted({min(tick, trace.ticks) for tick in (*samples, *hit)})
    frame = criticality.RoadFrame(trace)
    ahead, right = frame.ahead[:, ticks], frame.right[:, ticks]
    cos, sin = criticality.Encounters(trace).road
    heading = trace.ego[:, HEADING]
    turns = np.abs(np.sin(heading) * cos[0] - np.cos(heading) * sin[0])[ticks] > math.sin(TURNING)
    distance = np.where(frame.is_on_way[:, ticks], np.hypot(ahead, right), criticality.centre_distance(trace)[ticks].T)
    beside = np.abs(right) < BESIDE
    in_front = beside & (ahead > CAR_LENGTH) & (ahead < NEAR)
    cut_off = beside & (ahead < -CAR_LENGTH) & (ahead > -NEAR) & turns
    room = distance - CAR_LENGTH
    front = np.where(in_front, room - braking_distance(trace.ego[ticks, SPEED]), FAR)
    rear = np.where(cut_off, room - braking_distance(trace.npcs[ticks, :, SPEED].T), FAR)
    least_distance = min(float(distance.min()), FAR)
    least_room = float(np.minimum(front, rear).min())
    return (FAR - 0.5 * least_distance - 0.5 * least_room) / max(len(trace.scenario.npcs) - 1, 1)


FitnessName = Literal[
    "default", "paper", "av-fuzzer", "ego.speed", "ego.acceleration", "ego.jerk", "ego.lateral_acceleration", "headway",
    "npcs.gap", "npcs.ttc", "npcs.time_advantage",
]  # fmt: skip
"""A name that ``fitness=`` accepts."""

FITNESSES: Mapping[str, Fitness] = MappingProxyType(
    {
        "default": weighted,
        "paper": paper,
        "av-fuzzer": av_fuzzer,
        **{measure.name: measure for measure in MEASURES if measure.worse != "neither"},
    }
)
"""The functions by the names that ``fitness=`` accepts; the name of a measure stands for its worst value in the run."""


def resolve(fitness: str | Fitness = "default") -> Fitness:
    """Return the fitness of a trace. If a user's function fails, it raises a :class:`FitnessError`.

    Args:
        fitness: ``"default"``, ``"paper"``, ``"av-fuzzer"``, a measure or its name, a function from a Trace to a number
            (higher is worse for the ego), or ``module:function``.

    Raises:
        FitnessError: for anything else.
    """
    return _Checked(_function(fitness))


def is_built_in(fitness: str | Fitness) -> bool:
    """Return whether a fitness comes with the plugin: it is a name, and not a user's function."""
    return isinstance(fitness, str) and fitness in FITNESSES


@dataclass(frozen=True, slots=True)
class Steered:
    """The fitness of a run, which a search maximises.

    With ``is_for_ego``, the search is for collisions that the ego is responsible for (``blame`` other than ``any``).
    Then two rules hold for every fitness of a trace:

    1. A collision for which the ego is responsible is in [2, 4], every other run in [-1, 1]; minus infinity does not
       change. Within each range, the given fitness f decides the order, because f / (1 + |f|) increases with f.
    2. A collision for which the ego is not responsible is measured as if the run had ended, without a collision, 3 s
       before the impact (the paper's time to manoeuvre). So an NPC gains nothing by ramming the ego, but an earlier
       near-miss of the ego is still measured.
    """

    fitness: Fitness
    is_for_ego: bool = True

    def __call__(self, run: Run) -> float:
        """Return the fitness of a run."""
        trace = run.trace
        if not self.is_for_ego:
            return self.fitness(trace)
        if trace.outcome != Outcome.COLLISION:
            return _bounded(self.fitness(trace))
        if run.responsibility in ("ego", "both"):
            return 3.0 + _bounded(self.fitness(trace))
        return _bounded(self.fitness(before_impact(trace)))


def before_impact(trace: Trace) -> Trace:
    """Return the part of a colliding run up to 3 s (a manoeuvre) before the impact, as a run without a collision.

    At least the first tick remains. A run without a collision is returned unchanged.
    """
    if trace.collision is None:
        return trace
    last = max(trace.collision.tick - math.ceil(MANOEUVRE_SECONDS * trace.physics_hz), 0)
    off_road = trace.off_road_tick is not None and trace.off_road_tick <= last
    ticks_per_gene = trace.scenario.gene_seconds * trace.physics_hz
    return replace(
        trace,
        outcome=Outcome.OFF_ROAD if off_road else Outcome.SAFE,
        collision=None,
        actions=trace.actions[: bisect_left(trace.decision_ticks, last)],
        decided=trace.decided[: bisect_left(trace.decided, last)],
        arrivals=tuple(
            tuple(
                tick if tick is not None and tick <= last else None
                for gene, tick in enumerate(genes)
                if gene * ticks_per_gene <= last
            )
            for genes in trace.arrivals
        ),
        off_road_tick=trace.off_road_tick if off_road else None,
        **trace.rows_until(last),
    )


@dataclass(frozen=True, slots=True)
class _Checked:
    """A fitness that is checked in each run and is never NaN; a value, not a closure, so it can be sent to workers."""

    function: Fitness

    def __call__(self, trace: Trace) -> float:
        if trace.outcome == Outcome.INVALID:
            return WORST_RANK
        try:
            value = self.function(trace)
        except Exception as error:
            raise FitnessError(
                f"fitness: expected {_name(self.function)} to return a number for every run, but for {trace!r} it "
                f"raised {type(error).__name__}: {error}; runs may end at any tick and in any outcome"
            ) from error
        if not isinstance(value, (Real, np.bool_)):
            raise FitnessError(
                f"fitness: expected {_name(self.function)} to return a number, received {value!r} for {trace!r}; "
                "return a float, higher = worse for the ego"
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
    if isinstance(fitness, str):
        hint = meant(fitness, FITNESSES)
        raise FitnessError(f"fitness: expected {names} or a function of a Trace, received {fitness!r}{hint}")
    if not callable(fitness):
        raise FitnessError(f"fitness: expected {names} or a function of a Trace, received {fitness!r}")
    try:
        signature = inspect.signature(fitness)
    except ValueError:  # builtins have no signature: the first call shows whether it fits
        return fitness
    try:
        signature.bind(None)
    except TypeError as error:
        raise FitnessError(
            f"fitness: expected a function that can be called with one Trace, received {_name(fitness)}{signature} "
            f"({error}); take the trace as the first parameter and give the others defaults"
        ) from error
    return fitness


def _name(function: object) -> str:
    return getattr(function, "__name__", None) or repr(function)


def _time_to_collision(trace: Trace) -> float:
    """Return ET [s]: the time to the collision, at most the planned duration; without a collision that duration."""
    planned = criticality.planned_duration(trace)
    return min(criticality.execution_time(trace), planned) if trace.outcome == Outcome.COLLISION else planned


def _never_nan(value: float) -> float:
    return WORST_RANK if math.isnan(value) else value


def _bounded(value: float) -> float:
    """Return f / (1 + |f|), which increases with f, from -1 to 1; NaN and minus infinity give minus infinity."""
    if math.isnan(value) or value == WORST_RANK:
        return WORST_RANK
    return 1.0 if value == math.inf else value / (1 + abs(value))
