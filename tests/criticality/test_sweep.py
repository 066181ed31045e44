"""The compiled pass over a run gives the same as numpy's whole arrays, to the last bit."""

import functools
import importlib.util
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import Highway
from pytest_pafot.algorithms import SearchSpace, sample
from pytest_pafot.criticality import gap, min_ttc, sweep, ttc
from pytest_pafot.criticality.measures import MANOEUVRE_SECONDS, safety_shortfall
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, X, Y
from tests.helpers.tables import table
from tests.helpers.traces import random_states, straight_lanes, trace_of, vehicle

seeds = st.integers(0, 2**32)


def interpreted():
    """Return the module of the pass from its source, even if there is a compiled one next to it."""
    path = Path(sweep.__file__).with_name("sweep.py")
    spec = importlib.util.spec_from_file_location("interpreted", path)
    copy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(copy)
    return copy


SWEEPS = {"as installed": sweep, "interpreted": interpreted()}


def swept(module, trace):
    """Return the extremes by one pass, or None if it leaves the run to the arrays."""
    heading = trace.lanes[0].heading
    road = math.cos(heading), math.sin(heading)
    return module.extremes(trace.states, trace.sizes, road, MANOEUVRE_SECONDS)


def by_arrays(trace):
    shortfall = safety_shortfall(trace).max(initial=0.0)
    return ttc(trace).min(initial=math.inf), gap(trace).min(initial=math.inf), shortfall


def drawn(seed, *, spread=25.0):
    """Return a run whose vehicles are anywhere at any tick, on a road of any heading."""
    rng = np.random.default_rng(seed)
    rows, vehicles = int(rng.integers(1, 40)), int(rng.integers(2, 6))
    sizes = rng.uniform(1, 6, (vehicles, 2))
    states = random_states(rng, rows, vehicles, spread=spread)
    states[..., HEADING] *= rng.choice([0.0, 0.01, 1.0], size=(rows, vehicles))
    lanes = straight_lanes(heading=rng.choice([0.0, 0.7]))
    return trace_of(*np.moveaxis(states, 1, 0), sizes=sizes, lanes=lanes)


def meeting(seed):
    """Return a run with a contact 3 s away at first; then two random vehicles drive at each other, or nearly."""
    rng = np.random.default_rng(seed)
    angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(15, 80)
    noise, speed = rng.normal(0, 0.1, 2), rng.uniform(3, 20, 2)
    ego = math.remainder(angle + noise[0], math.tau)
    npc = math.remainder(angle + math.pi + noise[1], math.tau)
    x, y = distance * math.cos(angle), distance * math.sin(angle)
    return trace_of(
        vehicle(0, heading=[0, ego], speed=[30, speed[0]], lane=1),
        vehicle([80, x], [0, y], heading=[0, npc], speed=[5, speed[1]], lane=2),
    )


def driven(seed):
    """Return the run of a random scenario with an ego that keeps its speed and weaves a little."""
    rng = np.random.default_rng(seed)
    scenario = sample(SearchSpace(npcs=int(rng.integers(1, 6)), genes=3), rng)
    return Highway().rollout(scenario, lambda: lambda seen: (0.0, 0.002 * math.cos(seen.time)))


@functools.cache
def runs():
    """Return runs of the world, with an ego that keeps its speed and weaves a little."""
    return [driven(seed) for seed in range(20)]


@pytest.mark.parametrize("module", SWEEPS.values(), ids=SWEEPS)
class TestSweep:
    @given(seed=seeds, spread=st.sampled_from([5.0, 25.0, 500.0]))
    def test_sweep_finds_same_extremes_in_any_states(self, module, seed, spread):
        trace = drawn(seed, spread=spread)
        assert swept(module, trace) in (by_arrays(trace), None)

    def test_sweep_finds_contacts_of_vehicles_from_any_direction(self, module):
        traces = [meeting(seed) for seed in range(100)]
        expected = [by_arrays(trace) for trace in traces]
        assert [swept(module, trace) for trace in traces] == expected
        assert sum(ttc < 2.9 for ttc, *_ in expected) > 33

    def test_finds_the_extremes_of_the_arrays_in_runs(self, module):
        found = [(swept(module, trace), by_arrays(trace)) for trace in runs()]
        assert [swept for swept, arrays in found if swept not in (arrays, None)] == []
        assert sum(swept is not None for swept, _ in found) >= 15, "most runs need no arrays"

    @pytest.mark.parametrize("of", [0, 2])
    def test_sweep_leaves_invalid_states_to_the_arrays(self, module, of):
        columns = (X, Y, HEADING, SPEED, ACCELERATION, LANE)
        values, swept_anyway = (math.nan, math.inf, -math.inf, 2e6), []
        for column, value in itertools.product(columns, values):
            states = drawn(4).states.copy()[:, :3]
            states[-1, of, column] = value
            trace = trace_of(*np.moveaxis(states, 1, 0))
            if swept(module, trace) is not None:
                swept_anyway.append((column, value))
        assert swept_anyway == []

    def test_sweep_leaves_runs_without_collision_course_to_arrays(self, module):
        trace = trace_of(vehicle(0, 0, speed=20, ticks=30), vehicle(50, 4, speed=25, ticks=30))
        assert swept(module, trace) is None
        assert by_arrays(trace)[0] == math.inf


SEVEN, SIX = (4, 2, 7), (4, 2, 6)


@table(("states", "sizes"), [(SEVEN, (1, 2)), (SEVEN, (2, 3)), (SEVEN, (2,)), (SIX, (2, 2))])
def test_arrays_that_do_not_belong_together_are_refused(states, sizes):
    with pytest.raises(ValueError, match=r"^states, sizes:"):
        sweep.extremes(np.zeros(states), np.ones(sizes), (1.0, 0.0), 3.0)


def test_roads_that_turn_are_left_to_the_arrays():
    lanes = (*straight_lanes(2), *straight_lanes(2, heading=0.3))
    trace = trace_of(vehicle(0, speed=20, ticks=9), vehicle(30, speed=10, ticks=9), lanes=lanes)
    assert min_ttc(trace) == ttc(trace).min() == 25 / 10 - 0.6


def test_without_a_compiled_pass_the_arrays_answer():
    assert interpreted().is_in_use() is False
