"""``python -m pytest_pafot export``: it writes the run of a finding to files for other tools."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pytest_pafot import Outcome, load
from pytest_pafot.commands.policy_reference import add_world_arguments, ads_factory, chosen_world
from pytest_pafot.export.exporter import FORMATS, ExportError, exporter
from pytest_pafot.support.files import write_whole, written_into
from pytest_pafot.support.process import postponed
from pytest_pafot.world.codec import WorldData


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the command."""
    parser.add_argument("finding", metavar="FILE|FINDING", help="run this saved scenario: its file, or its id")
    of_to = f"write this format: {', '.join(FORMATS)}"
    parser.add_argument("--to", required=True, metavar="FORMAT", help=of_to)
    of_ads = "let this policy drive the ego: a module of example_ads, module:factory, or module:factory:argument"
    parser.add_argument("--ads", metavar="ADS", help=of_ads)
    add_world_arguments(parser, "needed if that of the file is code, such as wrappers or your own", has_config=False)
    of_out = "write to this folder (default: the current one)"
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help=of_out)


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Drive the scenario of a finding, and write the run to files of the requested format; return the exit code."""
    export, saved = exporter(arguments.to), load(arguments.finding)
    if arguments.ads is None:
        expected = f"the policy that drives the ego in the test {saved.finding.test}, such as --ads module:factory"
        received = "none; a file contains the NPCs' instructions, not where the vehicles drove"
        raise ExportError(field="--ads", expected=expected, received=received)
    made = chosen_world(arguments.world, None, [arguments.ads])
    world: Any = saved.world if made is None else WorldData(saved.finding.world).named(made)
    driven = saved.replay(ads_factory(arguments.ads), world=world)
    error = driven.trace.error
    if error is not None and not driven.trace.actions and saved.expect.outcome not in (Outcome.ADS_ERROR, Outcome.HANG):
        expected = f"a policy that drives in {'the world of the file' if made is None else arguments.world}"
        fix = "give the policy of the test" + ("" if made is None else ", and its world, or no --world if that is data")
        raise ExportError(field="--ads", expected=expected, received=error.text, fix=fix)
    files = export(saved.finding, driven.trace)
    with postponed():  # one of several files is worth nothing alone, such as a scenario without its road
        for name, content in files.items():
            with written_into(arguments.out):
                write_whole(arguments.out / name, content)
            sys.stdout.write(f"{arguments.out / name}\n")
    # A failed check cannot be compared, because the test function is not called.
    if saved.expect.check is None and not saved.matches(driven):
        event = f"{saved.expect.outcome} at {saved.expect.time:.1f} s"
        world_too = "" if arguments.world is None else ", and --world its world"
        sys.stderr.write(
            f"export: {saved.id} was saved with {event}, but this run ended with {driven.outcome} after "
            f"{driven.duration:.1f} s. Is this the policy of its test{world_too}?\n"
        )
    return 0
