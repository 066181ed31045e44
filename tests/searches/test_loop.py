"""The search loop with stand-ins for the simulation and the test function."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

import pytest_pafot as pafot
from example_ads import constant_speed
from pytest_pafot.algorithms import SearchSpace, sample
from pytest_pafot.algorithms.evaluation import Evaluated, Evaluation
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.runner import expectation
from pytest_pafot.findings.finding import signature_of_failure
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Lane, Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches.results import Result, State, common_death, result_of_death
from pytest_pafot.searches.run_table import row_of
from pytest_pafot.searches.scenarios import Bred
from pytest_pafot.searches.search import Watch, search
from pytest_pafot.searches.search_session import search_seed
from pytest_pafot.searches.store import OnlyCounted
from pytest_pafot.world.driving.policy import Policy
from tests.helpers.searches import Fresh
from tests.helpers.tables import table

SPACE = SearchSpace(npcs=1, genes=2, gene_seconds=5)
HARNESS = SimpleNamespace(
    node_id="test_it.py::test_it",
    world=pafot.Highway(),
    policy=Policy(constant_speed.make),
    versions={},
    request=SimpleNamespace(algorithm=SimpleNamespace(name="fresh")),
)


def quiet_trace(scenario, outcome=Outcome.COMPLETED):
    """Return a run in which nothing moves, so that signatures differ only by the failure."""
    return Trace(
        scenario=scenario,
        executed=scenario,
        outcome=outcome,
        states=np.zeros((2, 2, 7)) + np.arange(2)[None, :, None] * 50.0,
        sizes=np.full((2, 2), 2.0),
        lanes=(Lane(x=0.0, y=0.0, heading=0.0, length=1000.0, width=4.0, speed_limit=30.0),),
        physics_hz=15,
        ads_hz=5,
        arrivals=((0,),),
    )


def quiet_run(scenario):
    return Run(quiet_trace(scenario))


def lost(scenario, *, is_hang=False):
    """Raise like a run whose process does not come back."""
    raise ProcessLostError(scenario, pid=7, how="ended with exit code 9", is_hang=is_hang)


def failed(kind="AssertionError"):
    return Verdict(kind="failed", exception=AssertionError(), failure=Failure(kind=kind))


@dataclass
class Store:
    """Note what the search saves."""

    finds: list = field(default_factory=list)
    is_holding = False

    def add(self, result, generation):
        kind = result.evaluation.kind.failure
        if result.ended == "lost":
            kind = "hang" if result.evaluation.outcome is Outcome.HANG else "crash"
        self.finds.append((kind, generation))
        return OnlyCounted(f"id-{len(self.finds)}")


@dataclass
class Bench:
    """Make runs by a function; run ``n`` gets the ``n``-th verdict."""

    verdicts: Callable[[int], Verdict]
    simulate: Callable[[Scenario], Run]
    numbers: Iterator[int] = field(default_factory=count)
    has_reference: bool = False

    def results(self, scenarios, state, skips):
        for scenario in scenarios:
            if not skips(scenario):
                try:
                    result = self.result(scenario, state.known)
                except ProcessLostError as lost:
                    result = self.death(lost)
                yield result

    def result(self, scenario, known):
        run, verdict = self.simulate(scenario), self.verdicts(next(self.numbers))
        kind = signature_of_failure(run, verdict.failure) if verdict.failed else None
        evaluation = Evaluation.from_trace(
            run.trace, fitness=0.0, failing=verdict.failed, discarded=verdict.discarded, kind=kind
        )
        failed = SimpleNamespace(signature=kind) if kind is not None and kind not in known else None
        return Result(evaluation=evaluation, kind=verdict.kind, ended=run.outcome, failed=failed)

    def death(self, lost):
        """Return the result of a death. The reference fails every second scenario in which a process dies."""
        if self.has_reference and next(self.numbers) % 2 == 1:
            return common_death(lost.task)
        return result_of_death(lost, HARNESS, 1)


def searched(
    verdicts: Callable[[int], Verdict],
    *,
    generations=3,
    population=2,
    shown=(),
    fatal=(),
    run=quiet_run,
    has_reference=False,
    watch=None,
):
    """Return the state of a random search with these verdicts, and what it saved."""
    state, store = State(fatal=set(fatal)), Store()
    state.shown = dict(shown)
    bench = Bench(verdicts, run, has_reference=has_reference)
    scenarios = Bred(bench, Fresh(SPACE, population=population), generations=generations, seed=1)
    for _ in search(scenarios, state, bench, store, watch or Watch()):
        pass
    counts = state.counts
    assert (
        counts.kinds.total()
        == counts.outcomes.total()
        == counts.responsibilities.total()
        == state.runs
    )
    return state, store.finds


def passed(number):
    return Verdict(kind="passed")


class Reached(Watch):
    """A watch whose time is up after some runs."""

    def __init__(self, runs):
        self.runs = runs

    def reached(self, scenarios):
        return "time" if scenarios.sums.simulated >= self.runs else None


@table(
    ("runs", "simulated", "generations", "reason"),
    [
        (0, 1, 0, "time"),
        (1, 1, 0, "time"),
        (3, 3, 1, "time"),
        (4, 4, 2, "time"),
        (6, 6, 3, "generations"),
    ],
)
def test_limits_are_looked_at_between_runs_but_before_none_and_not_after_the_last(
    runs, simulated, generations, reason
):
    last = searched(passed, watch=Reached(runs))[0].finished
    assert (last.simulated, last.generations, last.reason) == (simulated, generations, reason)


def test_whoever_stops_it_still_gets_the_last_event():
    told = []
    found, _ = searched(passed, watch=Watch(lambda: told.append(0) or len(told) >= 3))
    assert (found.finished.reason, found.finished.evaluated) == ("stopped", 3)


def test_failures_with_one_signature_are_one_finding():
    found, finds = searched(lambda number: failed())
    assert finds == [("AssertionError", 0)]
    assert found.alike("id-1").runs == found.runs - 1


def test_each_signature_is_reported_once_with_its_generation():
    _, finds = searched(lambda number: failed("A" if number < 2 else "B"))
    assert finds == [("A", 0), ("B", 1)]


def test_failure_covered_by_saved_scenario_counts_as_known():
    run = Run(quiet_trace(sample(SPACE, np.random.default_rng(0))))
    signature = signature_of_failure(run, Failure(kind="AssertionError"))
    found, finds = searched(lambda number: failed(), shown={signature: "saved"})
    assert finds == []
    assert found.covered == {"saved": found.runs}


@table("kind", ["passed", "rejected", "skipped", "npc", "common", "invalid"])
def test_other_verdicts_are_counted_by_kind(kind):
    found, finds = searched(lambda number: Verdict(kind=kind))
    assert finds == []
    assert found.counts.kinds == {kind: found.runs}


def test_scenario_of_a_dead_process_is_not_run():
    scenarios = []
    everything, _ = searched(
        lambda number: Verdict(kind="passed"),
        run=lambda scenario: scenarios.append(scenario) or quiet_run(scenario),
    )
    found, _ = searched(lambda number: Verdict(kind="passed"), fatal=scenarios[:1])
    assert (
        found.runs
        == found.counts.health.simulated
        == found.counts.health.valid
        == everything.runs - 1
    )
    assert found.counts.health.reused == 1


def test_dying_processes_are_one_finding_with_count():
    found, finds = searched(lambda number: failed(), run=lost)
    assert finds == [("crash", 0)]
    assert found.alike("id-1").runs == 5
    assert found.counts.kinds == {"failed": 6}
    assert len(found.fatal) == found.counts.health.failing == 6
    assert found.finished.best is None, "a death must teach the search nothing"


def test_hanging_process_differs_from_a_dying_one():
    count = iter(range(10**6))
    _, finds = searched(
        lambda number: failed(), run=lambda scenario: lost(scenario, is_hang=next(count) > 2)
    )
    assert [kind for kind, *_ in finds] == ["crash", "hang"]


def test_process_crash_shared_with_reference_is_no_finding():
    found, finds = searched(lambda number: failed(), run=lost, has_reference=True)
    assert finds == [("crash", 0)]
    assert found.alike("id-1").runs == 2
    assert found.counts.kinds == {"failed": 3, "common": 3}
    assert found.runs == found.counts.health.simulated == found.counts.health.valid == 6
    assert (found.counts.health.failing, found.counts.health.vacuous) == (3, False)


def test_dying_processes_are_known_from_saved_scenario():
    lost_run = ProcessLostError(
        sample(SPACE, np.random.default_rng(0)), pid=7, how="was ended by SIGSEGV"
    )
    signature = expectation(lost_run).signature
    found, finds = searched(lambda number: failed(), run=lost, shown={signature: "saved"})
    assert finds == []
    assert found.covered == {"saved": 6}
    evaluation = result_of_death(lost_run, HARNESS, 1).evaluation
    row = row_of(
        Evaluated(generation=0, local_generation=0, index=0, evaluation=evaluation, reused=False)
    )
    assert [row[name] for name in ("failing", "verdict", "outcome")] == [
        True,
        "failed",
        "ads_error",
    ]
    assert row["kind"] == signature.slug


def test_a_failure_that_nothing_shows_ends_the_search_with_an_error(monkeypatch):
    result = Bench.result
    monkeypatch.setattr(Bench, "result", lambda *given: replace(result(*given), failed=None))
    with pytest.raises(
        RuntimeError, match=r"a failure has no finding: .*\. Please report this bug"
    ):
        searched(lambda number: failed())


def test_search_seed_depends_on_base_seed_and_node():
    assert (
        search_seed(1, "test_it.py::test_a") == search_seed(1, "test_it.py::test_a") == 1662527925
    )
    assert search_seed(1, "test_it.py::test_a") != search_seed(2, "test_it.py::test_a")
    assert search_seed(1, "test_it.py::test_a") != search_seed(1, "test_it.py::test_b")
