"""Shared parts of the programs here: options from their defaults, searches in processes, a property, table headings."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

from pytest_pafot import Run

ResultT = TypeVar("ResultT")


def options(about: str | None, **defaults: Any) -> argparse.Namespace:
    """Parse the command line.

    Args:
        about: The docstring of the program.
        defaults: The default of each option. A text or number sets the option's type, and False makes it a switch. From
            several names, some may be chosen; a list also allows other texts.
    """
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
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


def holds(run: Run) -> None:
    assert not run.collision


def seeds_of(given: argparse.Namespace) -> range:
    """Return the seeds of the options ``seeds`` and ``first_seed``."""
    return range(given.first_seed, given.first_seed + given.seeds)


def as_they_end(
    workers: int, function: Callable[..., ResultT], tasks: Iterable[tuple[Any, ...]]
) -> Iterator[ResultT]:
    """Yield the result of ``function(*task)`` for each task as soon as it ends; the tasks start in order."""
    pool = ProcessPoolExecutor(workers)
    try:
        for done in as_completed([pool.submit(function, *task) for task in tasks]):
            yield done.result()
    finally:  # On an error or Ctrl-C, do not wait for hours for tasks that have not begun.
        pool.shutdown(cancel_futures=True)


def print_head(*columns: str) -> None:
    """Print the head of a table."""
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}", flush=True)
