"""AV-Fuzzer's fitness against a second implementation, written from the description in plain loops."""

import math

import numpy as np
import pytest

from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching.fitness import av_fuzzer, braking_distance, resolve
from tests.helpers.tables import table
from tests.helpers.traces import random_states, straight_lanes, trace_of, vehicle


def brake(speed):
    return max(0.0, 0.0467 * speed**2 + 0.4116 * speed - 1.4913)


def by_hand(trace):
    """Return the released formula, sample by sample and vehicle by vehicle; the road runs along x."""
    samples = {round(k * trace.physics_hz / 4) for k in range(int(trace.duration * 4 + 1e-9) + 1)}
    if trace.collision is not None:
        samples.add(trace.collision.tick)
    distances, rooms = [130.0], [130.0]
    for tick in samples:
        ex, ey, heading, ev = trace.ego[min(tick, trace.ticks), :4]
        for npc in trace.npcs[min(tick, trace.ticks)]:
            nx, ny, _, nv = npc[:4]
            d = math.dist((ex, ey), (nx, ny))
            distances.append(d)
            if abs(ny - ey) < 2 and ex + 4.6 < nx < ex + 20:
                rooms.append(d - 4.6 - brake(ev))
            yaw = abs(math.degrees(math.asin(math.sin(heading))))
            if abs(ny - ey) < 2 and ex - 20 < nx < ex - 4.6 and yaw > 1:
                rooms.append(d - 4.6 - brake(nv))
    return (130 - 0.5 * min(distances) - 0.5 * min(rooms)) / max(trace.npcs.shape[1] - 1, 1)


@table("seed", range(60))
def test_it_is_the_released_formula_on_any_trace(seed):
    rng = np.random.default_rng(seed)
    states = random_states(rng, rows=int(rng.integers(1, 40)), vehicles=int(rng.integers(2, 5)), spread=18.0)
    states[..., 2] = rng.uniform(-0.05, 0.05, states.shape[:2])
    states[..., 1] /= 4
    trace = trace_of(*np.moveaxis(states, 1, 0), outcome=Outcome.COLLISION if seed % 2 else Outcome.SAFE)
    assert av_fuzzer(trace) == pytest.approx(by_hand(trace), abs=1e-9)


@table("speed", [0.0, 3.0, 22.0, 30.0])
def test_braking_distance_is_polynomial_and_never_negative(speed):
    assert braking_distance(np.array([speed]))[0] == pytest.approx(brake(speed))
    assert braking_distance(np.zeros(1))[0] == 0.0


def test_a_turned_road_makes_no_difference():
    heading = 0.7
    cos, sin = math.cos(heading), math.sin(heading)

    def turned(x, y, **fields):
        return vehicle(x * cos - y * sin, x * sin + y * cos, heading=heading, lane=0, **fields)

    cars = [(0.0, 0.0, 20.0), (12.0, 1.0, 9.0), (-9.0, 0.5, 20.0)]
    straight = trace_of(*(vehicle(x, y, speed=speed) for x, y, speed in cars))
    other = trace_of(*(turned(x, y, speed=speed) for x, y, speed in cars), lanes=straight_lanes(heading=heading))
    assert av_fuzzer(other) == pytest.approx(av_fuzzer(straight))


def test_only_a_collision_counts_between_two_samples():
    passing = np.array([40.0, 40.0, 6.0, 40.0, 40.0])
    unseen = trace_of(vehicle(0.0, ticks=4), vehicle(passing), vehicle(500.0, 8.0))
    seen = trace_of(vehicle(0.0, ticks=2), vehicle(passing[:3]), vehicle(500.0, 8.0), outcome=Outcome.COLLISION)
    assert av_fuzzer(unseen) == pytest.approx(130 - 20 - 65)
    assert av_fuzzer(seen) > av_fuzzer(unseen)


def test_av_fuzzer_fitness_is_available_by_its_name():
    trace = trace_of(vehicle(0.0), vehicle(15.0), vehicle(500.0, 8.0))
    assert resolve("av-fuzzer")(trace) == av_fuzzer(trace)
    invalid = trace_of(vehicle(0.0), vehicle(15.0), vehicle(500.0, 8.0), outcome=Outcome.INVALID)
    assert resolve("av-fuzzer")(invalid) == -math.inf
