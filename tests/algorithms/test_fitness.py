"""Fitness: higher is worse for the ego, bounded by default, and never misled by NaN, invalid runs or ramming NPCs."""

import math
import pickle
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pytest_pafot import criticality
from pytest_pafot.algorithms.fitness import (
    FitnessError,
    Steered,
    before_impact,
    default_fitness,
    paper,
    resolve,
    risks,
)
from pytest_pafot.attribution.responsibility import Attribution
from pytest_pafot.model.trace import SPEED, Outcome
from pytest_pafot.oracle.run import Run
from tests.helpers.tables import table
from tests.helpers.traces import (
    blamed_on,
    collision_at,
    random_states,
    scenario_of,
    trace_of,
    vehicle,
)

seeds = st.integers(0, 2**32 - 1)
without_collision = st.sampled_from(
    [Outcome.COMPLETED, Outcome.OFF_ROAD, Outcome.ADS_ERROR, Outcome.HANG]
)


def following(*, outcome=Outcome.COMPLETED, **fields):
    """Return the ego at 20 m/s, 20 m behind an NPC at 10 m/s: TTC 2 s, SD 30 m, one tick."""
    return trace_of(vehicle(0, speed=20), vehicle(25, speed=10), outcome=outcome, **fields)


def harmless(**fields):
    return trace_of(vehicle(0, speed=20, ticks=90), vehicle(500, speed=30, ticks=90), **fields)


def near_miss():
    """Return a run in which the ego comes within 1 m of its leader, 12 m/s faster, and then the NPC is gone."""
    ego = vehicle(0, speed=22, ticks=90)
    leader = vehicle([500] * 30 + [ego[30, 0] + 6] + [500] * 60, speed=10)
    return trace_of(ego, leader)


def crash(*, outcome=Outcome.COLLISION, **fields):
    """Return a run in which the ego drives into a standing NPC after 6 s."""
    return trace_of(
        vehicle(0, speed=20, ticks=90), vehicle(124, ticks=90), outcome=outcome, **fields
    )


def rammed(**fields):
    """Return a run in which an NPC at 30 m/s rams the ego at 20 m/s from behind after 6 s, and nothing before."""
    return trace_of(
        vehicle(0, speed=20, ticks=90),
        vehicle(-64, speed=30, ticks=90),
        outcome=Outcome.COLLISION,
        **fields,
    )


def random_trace(seed, outcome):
    rng = np.random.default_rng(seed)
    states = random_states(rng, int(rng.integers(1, 30)), 3, spread=rng.choice([5.0, 50.0]))
    return trace_of(*states.transpose(1, 0, 2), outcome=outcome)


class TestWeighted:
    def test_is_the_mean_of_the_four_risks(self):
        ttc, gap, shortfall, time = 1 / (1 + 2 / 1.5), 1 / 21, 1 / 3, 0
        assert risks(following()) == pytest.approx((ttc, gap, shortfall, time))
        assert default_fitness(following()) == pytest.approx((ttc + gap + shortfall + time) / 4)

    def test_collision_adds_one_and_share_of_remaining_time(self):
        # Overlap: TTC risk 1, gap risk 1, shortfall 1; 6 s of the planned 60 s.
        assert default_fitness(crash()) == pytest.approx(1 + (1 + 1 + 1 + 0.9) / 4)

    @given(seeds, without_collision)
    def test_lies_between_zero_and_one_without_a_collision(self, seed, outcome):
        assert 0 <= default_fitness(random_trace(seed, outcome)) <= 1

    @given(seeds, without_collision)
    def test_any_collision_outranks_any_run_without(self, seed, outcome):
        assert default_fitness(random_trace(seed, outcome)) < default_fitness(rammed())

    def test_an_earlier_collision_is_worse(self):
        late = trace_of(
            vehicle(0, speed=20, ticks=180), vehicle(244, ticks=180), outcome=Outcome.COLLISION
        )
        assert default_fitness(late) < default_fitness(crash())

    def test_only_a_collision_before_the_end_of_the_plan_has_a_risk_by_its_time(self):
        assert risks(harmless(outcome=Outcome.ADS_ERROR))[3] == 0
        for genes, expected in ((2, 0.25), (1, 0.0)):
            run = crash(scenario=scenario_of(genes=genes, gene_seconds=4.0))
            assert risks(run)[3] == pytest.approx(expected)

    def test_closer_is_worse(self):
        runs = [trace_of(vehicle(0, speed=20), vehicle(x, speed=18)) for x in (80, 40, 20, 10, 6)]
        values = [default_fitness(run) for run in runs]
        assert values == sorted(values)
        assert len(set(values)) == 5


class TestPaper:
    def test_is_minus_the_sum_of_the_four_measures(self):
        # METTC: the lines cross 30 m ahead of the ego at 10 m/s. MD sqrt(30^2 + 20^2), SD 0, ET: all the 60 s.
        trace = trace_of(vehicle(0, speed=10), vehicle(30, -20, heading=math.pi / 2, speed=10))
        assert paper(trace) == pytest.approx(-(3 + math.hypot(30, 20) + 0 + 60))

    def test_caps_an_infinite_mettc_at_the_planned_duration(self):
        assert paper(following()) == pytest.approx(-(60 + 25 + 30 + 60))

    def test_takes_the_time_of_a_collision(self):
        # SD: the follower is 20 m/s faster; MD: 4 m at the last tick.
        assert paper(crash()) == pytest.approx(-(60 + 4 + 60 + 6))


@pytest.mark.parametrize("name", ["default", "paper"])
class TestEveryNamedFitness:
    def test_puts_an_invalid_run_last(self, name):
        assert resolve(name)(crash(outcome=Outcome.INVALID)) == -math.inf

    @pytest.mark.parametrize("column", [0, 1, 2, 3, 4])
    def test_puts_nan_last(self, name, column):
        ego = vehicle([0, 1], heading=0.1, speed=20)
        ego[1, column] = np.nan
        trace = trace_of(ego, vehicle([20, 21], speed=10, lane=0))
        assert resolve(name)(trace) == -math.inf

    @given(seed=seeds)
    def test_is_a_number_for_every_run(self, name, seed):
        assert math.isfinite(resolve(name)(random_trace(seed, Outcome.COMPLETED)))

    def test_can_be_sent_to_a_worker(self, name):
        fitness = pickle.loads(pickle.dumps(resolve(name)))
        assert fitness(following()) == resolve(name)(following())


def broken(trace):
    return 1 / 0


NO_NUMBERS = [None, "1", [1], np.array([1.0, 2.0]), 1j]
NO_FITNESSES = {
    "a misspelt name": "papr",
    "a measure without a worse side": "ego.lane",
    "a number": 3,
    "nothing": None,
    "a list": ["default"],
    "a function of two arguments": lambda trace, limit: 0.0,
}


class TestResolve:
    def test_default_is_the_weighted_one(self):
        for fitness in (resolve(), resolve("default")):
            assert fitness(following()) == default_fitness(following())

    @table("value", [3, 2.5, True, np.float32(0.5), np.bool_(True), np.int64(7), math.inf])
    def test_a_function_may_return_any_real_number(self, value):
        assert resolve(lambda trace: value)(following()) == float(value)

    def test_a_partial_and_a_measure_are_functions(self):
        assert resolve(partial(default_fitness))(following()) == default_fitness(following())
        assert resolve(criticality.hardest_brake)(following()) == 0

    def test_a_function_never_sees_an_invalid_run(self):
        assert (
            resolve(lambda trace: pytest.fail("called"))(crash(outcome=Outcome.INVALID))
            == -math.inf
        )

    def test_nan_of_a_function_is_last(self):
        assert resolve(lambda trace: math.nan)(following()) == -math.inf

    def test_function_that_raises_is_the_cause_of_the_error(self):
        with pytest.raises(FitnessError) as caught:
            resolve(broken)(following())
        assert isinstance(caught.value.__cause__, ZeroDivisionError)

    @table("value", NO_NUMBERS)
    def test_a_function_that_returns_no_number_is_refused(self, value):
        with pytest.raises(FitnessError):
            resolve(lambda trace: value)(following())

    @table("value", NO_FITNESSES.values())
    def test_anything_else_is_refused_before_any_run(self, value):
        with pytest.raises(FitnessError):
            resolve(value)


class TestMeasures:
    def test_measure_name_gives_fitness_by_worst_value(self):
        close, far = (trace_of(vehicle(0, speed=10), vehicle([x, 90])) for x in (20, 40))
        assert resolve("headway")(close) == pytest.approx(-1.5 / 2.5)
        assert resolve("headway")(far) == pytest.approx(-3.5 / 4.5)
        assert resolve("npcs.gap")(far) == pytest.approx(-35 / 36)

    def test_two_sided_measure_is_worse_far_from_zero(self):
        ego = vehicle(np.zeros(3), acceleration=np.array([0.0, -1.0, -1.0]))
        brakes = trace_of(ego, vehicle(50))
        assert resolve("ego.jerk")(brakes) == pytest.approx(15 / 16)

    def test_missing_values_rank_lowest_but_above_nan(self):
        alone = trace_of(vehicle(0, speed=10), vehicle(-20))
        unknown = trace_of(vehicle(0, speed=math.nan), vehicle(20))
        assert resolve("headway")(alone) == -1
        for run in (unknown, crash(outcome=Outcome.INVALID)):
            assert resolve("headway")(run) == -math.inf


def steered(fitness):
    """Return the fitness of traces in a search that blames the ego, which is responsible if it hits with its front."""

    def rank(trace):
        hits = trace.collision is not None and trace.collision.side == "front"
        return Steered(fitness)(blamed_on("ego" if hits else "npc", trace))

    return rank


REAR_END = collision_at(90, side="rear", ego_speed=20, npc_speed=30)
FITNESSES = {
    "default": "default",
    "paper": "paper",
    "quick": lambda trace: -trace.duration,
    "constant": lambda trace: 0.0,
    "huge": lambda trace: 1e300,
}


@pytest.mark.parametrize("fitness", FITNESSES.values(), ids=FITNESSES)
class TestSteered:
    def rank(self, fitness):
        return steered(resolve(fitness))

    def test_collision_by_the_ego_outranks_every_other_run(self, fitness):
        rank = self.rank(fitness)
        others = [rammed(collision=REAR_END), harmless(), near_miss(), following()]
        assert rank(crash()) >= 2
        assert max(map(rank, others)) <= 1

    def test_rammed_run_counts_until_three_seconds_before_impact(self, fitness):
        rank, run = self.rank(fitness), rammed(collision=REAR_END)
        assert rank(run) == rank(trace_of(run.ego[:46], run.npcs[:46, 0]))

    @given(seed=seeds)
    def test_keeps_the_order_among_runs_without_collision(self, fitness, seed):
        runs = [random_trace(seed + i, Outcome.COMPLETED) for i in range(3)]
        plain, rank = resolve(fitness), self.rank(fitness)
        assert sorted(runs, key=lambda run: (plain(run), id(run))) == sorted(
            runs, key=lambda run: (rank(run), id(run))
        )

    def test_invalid_runs_stay_last(self, fitness):
        assert self.rank(fitness)(crash(outcome=Outcome.INVALID)) == -math.inf

    def test_the_rule_is_asked_about_collisions_only(self, fitness, monkeypatch):
        asked, blamed = [], Attribution(responsibility="ego", tick=None, time=None)
        monkeypatch.setattr(
            Run, "attribution", property(lambda run: asked.append(run.outcome) or blamed)
        )
        for trace in (harmless(), near_miss(), crash()):
            Steered(resolve(fitness))(Run(trace))
        assert asked == [Outcome.COLLISION]

    def test_blame_on_any_vehicle_leaves_the_fitness_as_it_is(self, fitness):
        plain, rank = resolve(fitness), Steered(resolve(fitness), is_for_ego=False)
        for trace in (harmless(), crash(), rammed(collision=REAR_END)):
            assert rank(Run(trace)) == plain(trace)


class TestSteeredDefault:
    rank = staticmethod(steered(resolve()))

    def test_being_rammed_ranks_below_a_near_miss(self):
        assert self.rank(rammed(collision=REAR_END)) < self.rank(near_miss())

    def test_near_miss_before_being_rammed_retains_its_rank(self):
        miss = near_miss()
        rammer = vehicle(-64, speed=30, ticks=90)
        both = trace_of(
            miss.ego, miss.npcs[:, 0], rammer, outcome=Outcome.COLLISION, collision=REAR_END
        )
        alone = trace_of(
            vehicle(0, speed=22, ticks=90), rammer, outcome=Outcome.COLLISION, collision=REAR_END
        )
        assert self.rank(alone) < self.rank(miss) <= self.rank(both)

    def test_a_fitness_that_is_minus_infinity_stays_so(self):
        assert steered(lambda trace: -math.inf)(crash()) == -math.inf

    def test_a_fitness_that_is_infinite_keeps_its_shelf(self):
        assert steered(lambda trace: math.inf)(crash()) == 4
        assert steered(lambda trace: math.inf)(harmless()) == 1


class TestBeforeImpact:
    def test_run_ends_three_seconds_before_the_collision(self):
        run = crash(
            actions=tuple(range(30)),
            arrivals=((10, 60), (None, 44)),
            scenario=scenario_of(2, gene_seconds=2.0),
        )
        cut = before_impact(run)
        assert (cut.outcome, cut.collision, cut.duration) == (Outcome.COMPLETED, None, 3.0)
        np.testing.assert_array_equal(cut.states, run.states[:46])
        assert cut.actions == tuple(range(15))
        assert cut.arrivals == ((10, None), (None, 44))

    def test_genes_that_had_not_started_leave_no_arrivals(self):
        cut = before_impact(crash(arrivals=((10, 70),), scenario=scenario_of(gene_seconds=4.0)))
        assert cut.arrivals == ((10,),)

    def test_keeps_at_least_the_start(self):
        run = trace_of(
            vehicle(0, speed=20, ticks=15), vehicle(24, ticks=15), outcome=Outcome.COLLISION
        )
        assert before_impact(run).ticks == 0

    @pytest.mark.parametrize(("tick", "outcome"), [(20, Outcome.OFF_ROAD), (80, Outcome.COMPLETED)])
    def test_remembers_leaving_the_road_if_that_came_before(self, tick, outcome):
        cut = before_impact(crash(off_road_tick=tick))
        assert cut.outcome == outcome
        assert cut.off_road_tick == (tick if outcome == Outcome.OFF_ROAD else None)

    def test_leaves_a_run_without_collision_and_the_original_alone(self):
        harmless_run, run = harmless(), crash()
        assert before_impact(harmless_run) is harmless_run
        before_impact(run)
        assert run.ticks == 90
        assert run.states[-1, 0, SPEED] == 20
