"""``python -m pytest_pafot map``: the map of a scenario of the catalogue or of a saved finding."""

from __future__ import annotations

import argparse
import math
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from pytest_pafot.extending import (
    SUFFIX,
    add_world_arguments,
    ads_factory,
    check_function,
    chosen_world,
)
from pytest_pafot.extras.sweeps.drawing import page, png
from pytest_pafot.extras.sweeps.entries import ENTRIES, Entry, chosen, entry_of
from pytest_pafot.extras.sweeps.maps import WIDTH, Sweep, short, sweep
from pytest_pafot.extras.sweeps.numbers import over_of
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import check_writable, way_out, write_if_free, write_whole
from pytest_pafot.support.references import PLANNER
from pytest_pafot.support.text import visible, wrapped_to

FAILED = 1
"""The exit code if there is what ``--fail-on`` names."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_what = "a name of the catalogue, such as r157/cut-in, or the file of a finding; without it, list the catalogue"
    parser.add_argument("what", metavar="SCENARIO", nargs="?", help=of_what)
    parser.add_argument("--ads", metavar="ADS", help="the policy: module:factory, or module:factory:argument")
    of_over = "a number and its first and last value and their count; once or twice"
    parser.add_argument("--over", metavar="NAME=FIRST:LAST:COUNT", action="append", default=[], help=of_over)
    parser.add_argument("--set", metavar="NAME=VALUE", action="append", default=[], help="another number of an entry")
    add_world_arguments(parser, "default: a highway in SI units, or that of the finding")
    of_check = "a function of a run, which asserts what must hold (default: no collision, never off the road)"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    parser.add_argument("--against", metavar="FILE", help="a saved map to compare with")
    of_fail = "preventable: exit with 1 if a point fails that a reference driver avoids, or by an error of the ADS, or "
    of_fail += "if no point came up as asked; worse: if one was avoided in the map of --against, and is no more"
    parser.add_argument("--fail-on", choices=("preventable", "worse"), help=of_fail)
    parser.add_argument("--csv", metavar="FILE", help="save the map; --against reads it")
    parser.add_argument("--html", metavar="FILE", help="write a page on which each point plays its run")
    parser.add_argument("--png", metavar="FILE", help="write a picture")
    parser.epilog = f"{parser.epilog} The exit code is 1 with --fail-on, 2 for wrong arguments, else 0."


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Print the map, and write its files. Return the exit code."""
    if arguments.what is None:
        sys.stdout.write(catalogue_text(ENTRIES, shutil.get_terminal_size().columns))
        return 0
    if not arguments.over and arguments.ads is None and not arguments.what.endswith(SUFFIX):
        sys.stdout.write(catalogue_text(chosen((arguments.what,)), shutil.get_terminal_size().columns))
        return 0
    if arguments.ads is None or not arguments.over:
        raise RequestError(
            "expected --ads with a policy and --over with a number, such as --over gap=0:60:7, received "
            f"{'no --ads' if arguments.ads is None else 'no --over'}; `map` without arguments lists the catalogue"
        )
    if arguments.fail_on == "worse" and arguments.against is None:
        raise RequestError("--fail-on worse: expected --against with a saved map, received none; save one with --csv")
    kinds = ((arguments.csv, Sweep.csv), (arguments.html, page), (arguments.png, png))
    outputs = {path: content for path, content in kinds if path is not None}
    if len(outputs) < sum(path is not None for path, _ in kinds):
        raise RequestError("expected a file of its own for each of --csv, --html and --png, received one twice")
    for path in outputs if arguments.against is not None else ():
        if _is_same_file(path, arguments.against):
            raise RequestError(
                f"--against: expected a file that this map does not overwrite, received {visible(path)} for both; the "
                "next map would be compared with this one, and pass although it is as bad"
            )
    for path in outputs:
        _written(path, check_writable)  # before anything is driven
    is_watched = sys.stderr is not None and sys.stderr.isatty()
    values = _set(arguments.set)
    if values and arguments.what.endswith(SUFFIX):
        raise RequestError("--set: expected a scenario of the catalogue, received a file; --over changes its numbers")
    if values:  # before a name can be that of an argument
        entry_of(arguments.what).check(values)
    made = sweep(
        arguments.what,
        ads_factory(arguments.ads),
        over=over_of(arguments.over),
        world=chosen_world(
            arguments.world,
            arguments.config,
            [arguments.ads],
            is_planner=arguments.ads.endswith(PLANNER),
        ),
        holds=None if arguments.check is None else check_function(arguments.check),
        against=arguments.against,
        on_point=_tell if is_watched else None,
        on_stop=lambda saved: _kept(arguments.csv, saved),
        **values,
    )
    if is_watched:
        sys.stderr.write("\r\033[K")
    width = shutil.get_terminal_size().columns
    try:
        for path, content in outputs.items():  # before a closed output can end the command
            _written(path, partial(write_whole, content=content(made)))
    finally:
        sys.stdout.write(f"{made.explain(width)}\n")
    sys.stdout.write("".join(f"wrote {visible(path)}\n" for path in outputs))
    is_empty = made.not_as_asked == len(made.points)  # which says nothing, and so must not pass
    failed = {"preventable": made.preventable + made.errors or is_empty, "worse": made.worse}.get(arguments.fail_on)
    return FAILED if failed else 0


def _tell(count: int) -> None:
    sys.stderr.write(f"\rmap: {count} points\033[K")
    sys.stderr.flush()


def _set(texts: Sequence[str]) -> dict[str, float]:
    values: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if not math.isfinite(number) or name in values:
            raise RequestError(f"--set: expected different NAME=VALUE, such as gap=20, received {text!r}")
        values[name] = number
    return values


def _is_same_file(path: str, other: str) -> bool:
    """Return whether two paths lead to the same file, also through links, and if the file does not exist yet."""
    if os.path.exists(path) and os.path.exists(other):  # noqa: PTH110  (an odd path is an error below, not here)
        return os.path.samefile(path, other)  # noqa: PTH121
    return os.path.realpath(path) == os.path.realpath(other)


def _written(path: str, write: Callable[[Path], object]) -> None:
    """Write a file of the user, or check that it can be written.

    Raises:
        RequestError: if it cannot.
    """
    if not path:
        raise RequestError("expected the name of a file, received an empty one")
    try:
        write(Path(path))
    except OSError as error:
        fix = way_out(error, "or choose another file")
        raise RequestError(
            f"{visible(path)}: expected a file that can be written, received {error.strerror or error}; {fix}"
        ) from None


def _kept(path: str | None, saved: str) -> str:
    """Save the points of an interrupted map, unless there is a file of an earlier one. Return what was done."""
    with suppress(OSError):
        if path is not None and write_if_free(Path(path), saved.encode()):
            return f"wrote the points driven so far to {visible(path)}"
    return "nothing was written, because there is a file already" if path is not None else "nothing was written"


def catalogue_text(entries: Sequence[Entry], width: int = WIDTH) -> str:
    """Return entries with their sources and parameters, as the command prints them, wrapped to a width."""
    lines = []
    for entry in entries:
        lines += [entry.name, *wrapped_to(f"  {entry.about}", width), *wrapped_to(f"  after {entry.source}", width)]
        for name, each in entry.parameters.items():
            number = f"{short(each.default)} {each.unit}".rstrip()
            lines += wrapped_to(f"    {name:<15} {number:<12} {each.span:<18} {each.about}", width)
        lines.append("")
    return "\n".join(lines)
