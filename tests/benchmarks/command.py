"""What the programs of this folder share: options by their defaults, searches in processes, heads of tables."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, TypeVar

from numpy.random import Generator

from pytest_pafot.searching import DistinctSearch
from pytest_pafot.searching.algorithms.distinct import DistinctState
from pytest_pafot.searching.evaluation import Evaluation

KeyT = TypeVar("KeyT")
ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class BeforeSearch(DistinctSearch):
    """The default search before it told runs apart by what the ego had to do, and drew random ones all the time."""

    name: ClassVar[str] = "before"

    fresh: float = field(default=0.0, kw_only=True)

    def learn(self, state: DistinctState, evaluations: Sequence[Evaluation], rng: Generator) -> DistinctState:
        """As the search does of runs that made the ego do nothing."""
        return DistinctSearch.learn(self, state, [replace(each, demand=(0, 0, False)) for each in evaluations], rng)


SCENARIOS_BEFORE: Mapping[str, Any] = {"traffic": "paper", "npcs": 4, "gene_seconds": 10.0}
"""Arguments of ``pafot.explore`` for scenarios as they were before NPCs were attentive and sizes were drawn."""
BEFORE: Mapping[str, Any] = {"algorithm": BeforeSearch, **SCENARIOS_BEFORE}
"""For the default search as it was then."""


def options(about: str | None, **defaults: Any) -> argparse.Namespace:
    """What the command line says.

    Args:
        about: the docstring of the program.
        defaults: of each option. A text or a number is one of its kind, and False a switch. Of several names some may
            be chosen; of a list, other texts may be given as well.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        flag = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, (str, int, float)):
            parser.add_argument(flag, type=type(default), default=default)
        else:
            known = None if isinstance(default, list) else list(default)
            parser.add_argument(flag, nargs="+", choices=known, default=list(default))
    return parser.parse_args()


def seeds_of(given: argparse.Namespace) -> range:
    """Of the options ``seeds`` and ``first_seed``."""
    return range(given.first_seed, given.first_seed + given.seeds)


def in_processes(
    workers: int, function: Callable[..., ResultT], keys: Iterable[KeyT], seeds: Iterable[int], *more: Any
) -> Iterator[tuple[KeyT, list[ResultT]]]:
    """Each key with what ``function(key, seed, *more)`` returns for each seed, as soon as that is there."""
    with ProcessPoolExecutor(workers) as pool:
        jobs = {key: [pool.submit(function, key, seed, *more) for seed in seeds] for key in keys}
        for key, futures in jobs.items():
            yield key, [future.result() for future in futures]


def as_they_end(workers: int, function: Callable[..., ResultT], tasks: Iterable[tuple[Any, ...]]) -> Iterator[ResultT]:
    """Yield what ``function(*task)`` returns for each of the tasks, which begin in their order, as soon as it ends."""
    pool = ProcessPoolExecutor(workers)
    try:
        for done in as_completed([pool.submit(function, *task) for task in tasks]):
            yield done.result()
    finally:  # An error or Ctrl-C does not wait for hours of tasks that have not begun.
        pool.shutdown(cancel_futures=True)


def print_head(*columns: str) -> None:
    """The head of a table."""
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", flush=True)
