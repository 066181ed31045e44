"""What does a search with a slow ADS gain from several processes?

    python -m tests.benchmarks.workers [--workers 1 2] [--decision 0.005] [--kind computes waits] [--population 4 8]
        [--generations 5] [--gene-seconds 5] [--rounds 3]

Runs one search per number of workers and round, in turns, with an ADS that takes 5 ms for each decision: `computes`
needs a core for that time, `waits` does not, like a client of a planner on a different machine. The events of all
searches are compared. Prints what bare loops gain on this machine now, which limits what `computes` can gain, and a row
for each setting, in Markdown, with the median time and the speed-up over the first number of workers. With a population
of four, of which one passes on, two processes gain at most 1.5: three scenarios take two turns.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from pytest_pafot import Highway, Observation, Scenario
from pytest_pafot.execution.runner import runner_for
from pytest_pafot.execution.scenario_pool import Job
from pytest_pafot.searching import SearchSpace, resolve_algorithm, run_campaign
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import Event
from pytest_pafot.searching.fitness import resolve

HEADER = "| ADS | population | workers | runs | median [s] | speed-up | same events |\n|---|---|---|---|---|---|---|"
GENES = 2


class Driver:
    """Keep lane and speed, and take some time for each decision.

    Args:
        kind: What takes the time: `computes` or `waits`.
        seconds: The time for each decision [s].
    """

    def __init__(self, kind: str, seconds: float) -> None:
        self._kind = kind
        self._seconds = seconds

    def __call__(self, observation: Observation | None) -> tuple[float, float]:
        if self._kind == "waits":
            time.sleep(self._seconds)
            return 0.0, 0.0
        until = time.thread_time() + self._seconds
        while time.thread_time() < until:
            pass
        return 0.0, 0.0


def searched(ads: Callable[[], Any], workers: int, population: int, options: argparse.Namespace) -> list[Event]:
    """Return all events of one search."""
    world = Highway(duration=GENES * options.gene_seconds)
    fitness = resolve("default")
    with tempfile.TemporaryDirectory() as folder:
        job = Job(world=world, ads=ads, records=Path(folder), owner="benchmark")
        with job.crash_record() as record, runner_for(job, record, workers=workers) as runner:

            def evaluate(scenario: Scenario) -> Evaluation:
                trace = runner.run(scenario)
                return Evaluation.of(trace, fitness=fitness(trace), failing=trace.outcome == "collision")

            space = SearchSpace(genes=GENES, gene_seconds=options.gene_seconds)
            algorithm = resolve_algorithm("pafot").make(space, population=population)
            campaign = run_campaign(
                algorithm, evaluate, generations=options.generations, seed=1, foresee=runner.announce
            )
            return list(campaign)


def compare(kind: str, population: int, options: argparse.Namespace) -> None:
    """Print the rows for one ADS and population."""
    ads = partial(Driver, kind, options.decision)
    times: dict[int, list[float]] = {workers: [] for workers in options.workers}
    histories: dict[int, list[Event]] = {}
    for _ in range(options.rounds):
        for workers in options.workers:
            started = time.perf_counter()
            histories[workers] = searched(ads, workers, population, options)
            times[workers].append(time.perf_counter() - started)
    first = options.workers[0]
    for workers, seconds in times.items():
        speed_up = statistics.median(times[first]) / statistics.median(seconds)
        is_same = "yes" if histories[workers] == histories[first] else "NO"
        simulated = getattr(histories[workers][-1], "simulated", 0)
        print(
            f"| {kind} | {population} | {workers} | {simulated} | {statistics.median(seconds):.2f} "
            f"| {speed_up:.2f} | {is_same} |",
            flush=True,
        )


def capacity(processes: int) -> float:
    """Measure how much more loops compute at the same time than one after another, on this machine now."""
    busy = Driver("computes", 1.0)
    durations: list[float] = []
    for count in (1, processes, 1, processes):
        several = [multiprocessing.Process(target=busy, args=(None,)) for _ in range(count)]
        started = time.perf_counter()
        for each in several:
            each.start()
        for each in several:
            each.join()
        durations.append(time.perf_counter() - started)
    return processes * (durations[0] + durations[2]) / (durations[1] + durations[3])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    parser.add_argument("--decision", type=float, default=0.005)
    parser.add_argument("--kind", nargs="*", choices=["computes", "waits"], default=["computes", "waits"])
    parser.add_argument("--population", type=int, nargs="*", default=[4, 8])
    parser.add_argument("--generations", type=int, default=5)
    parser.add_argument("--gene-seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    searched(partial(Driver, "waits", 0.0), 1, 4, options)  # Loads highway-env before the measurement.
    for workers in options.workers[1:]:
        print(f"{workers} loops at once gain {capacity(workers):.2f}")
    print(HEADER)
    for kind in options.kind:
        for population in options.population:
            compare(kind, population, options)


if __name__ == "__main__":
    main()
