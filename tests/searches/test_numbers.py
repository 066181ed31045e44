"""The numbers of a random search: which are out, early and back, whoever runs their scenarios."""

from collections import deque
from types import SimpleNamespace

import pytest

from pytest_pafot.algorithms import SearchSpace
from pytest_pafot.algorithms.catalogue import resolve_algorithm
from pytest_pafot.execution.pool import Done, Lost, ProcessLostError, RunItHere, Said
from pytest_pafot.execution.runner import Apart, CapturedOutput, Timed
from pytest_pafot.searches.results import Counts, Failed, Result, State, not_run
from pytest_pafot.searches.scenarios import Early, Numbers, NumberState

SPACE = SearchSpace(npcs=1, genes=2, gene_seconds=5)
BACK, OUT, EARLY, WAITING = (
    NumberState.BACK,
    NumberState.OUT,
    NumberState.EARLY,
    NumberState.WAITING,
)


class Processes(Apart):
    """Two processes whose messages the test gives, in chunks of two numbers."""

    run_seconds = in_use = 1.0

    def __init__(self):
        self.chunks, self.said, self.recovered = [], deque(), []

    def drive(self, chunk):
        self.chunks.append(chunk)
        return len(self.chunks) <= 2

    def messages(self, *, waits):
        assert self.said or not waits, "nobody would ever say anything"
        said = list(self.said)
        self.said.clear()
        return said

    def count(self, runs, seconds):
        pass

    def end(self):
        pass


def counted(runs=1):
    counts = Counts()
    counts.kinds["passed"] = runs
    return Said(Timed(counts, CapturedOutput(), 0.1))


@pytest.fixture
def search(monkeypatch):
    """Return the numbers of a search, its processes, and a function that takes the next step."""
    monkeypatch.setattr("pytest_pafot.searches.scenarios.chunk_size", lambda *given: 2)
    processes, state = Processes(), State(is_set_up=True)
    made = []

    def results(drawn, state, skips):
        for scenario in drawn:
            made.append(scenario)
            yield Result(evaluation=not_run(scenario), kind="passed", ended="completed")

    bench = SimpleNamespace(
        runner=processes,
        driver=SimpleNamespace(drawn=None),
        results=results,
        harness=SimpleNamespace(request=SimpleNamespace(settings=SimpleNamespace(workers=2))),
    )
    algorithm = resolve_algorithm("random").make(SPACE)
    numbers = Numbers(algorithm=algorithm, seed=1, runs=8, bench=bench)

    def step():
        done = numbers.next(state)
        if isinstance(done, Counts):
            numbers.count(done.runs)
        elif isinstance(done, Result):
            numbers.count(1)
        return done

    return SimpleNamespace(numbers=numbers, processes=processes, step=step, made=made)


def states(search, most=6):
    return [search.numbers.state_of(number) for number in range(most)]


def test_numbers_are_out_until_they_come_back_in_order(search):
    assert states(search) == [WAITING] * 6
    search.processes.said.append((search_chunk(search, 0), counted(2)))
    assert search.step().runs == 2
    assert states(search) == [BACK, BACK, OUT, OUT, WAITING, WAITING]


def search_chunk(search, index):
    """Return a chunk that the search will give or has given to a process."""
    while len(search.processes.chunks) <= index:
        search.numbers._give(State(is_set_up=True))
    return search.processes.chunks[index]


def test_a_failure_of_a_later_number_is_early_until_its_turn(search):
    first, second = search_chunk(search, 0), search_chunk(search, 1)
    failed = Failed(signature="it", finding=None, headline="", text="", trace=None)
    evaluation = not_run(search.numbers.algorithm.drawn(1, 2))
    failure = Result(evaluation=evaluation, kind="failed", ended="collision", failed=failed)
    search.processes.said.append((second, Said(Timed(failure, CapturedOutput(), 0.1))))
    early = search.step()
    assert early == Early(failure, 2)
    assert states(search) == [OUT, OUT, EARLY, OUT, WAITING, WAITING]
    search.processes.said += [(first, counted(2)), (first, Done(None))]
    assert search.step().runs == 2
    assert search.step() is failure
    assert states(search)[:4] == [BACK, BACK, BACK, OUT]


@pytest.mark.parametrize("is_lost", [True, False])
def test_the_rest_of_a_chunk_that_ends_early_runs_one_by_one(search, is_lost):
    """A process that died is recovered if no scenario of its chunk kills a second one."""
    first = search_chunk(search, 0)
    death = ProcessLostError(first, pid=7, how="died")
    answer = Lost(death) if is_lost else RunItHere(RuntimeError("no memory"))
    search.processes.said.append((first, answer))
    for _ in range(2):
        assert search.step().kind == "passed"
    assert search.made == [search.numbers.algorithm.drawn(1, number) for number in (0, 1)]
    assert search.processes.recovered == ([death] if is_lost else [])
    assert states(search)[:4] == [BACK, BACK, OUT, OUT]


def test_a_scenario_that_only_the_session_can_run_is_run_there(search):
    first = search_chunk(search, 0)
    only_here = Said(RunItHere(LookupError("a process died in this scenario before")))
    search.processes.said += [(first, only_here), (first, counted(1))]
    assert search.step().kind == "passed"
    assert len(search.made) == 1
    assert search.step().runs == 1
    assert states(search)[:4] == [BACK, BACK, OUT, OUT]
