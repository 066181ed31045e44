"""Commands beside pytest, such as ``python -m pytest_pafot search``."""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import suppress


def main(arguments: list[str] | None = None) -> int:
    """Run a command, from the arguments of the command line without the program's name; its exit code."""
    from pytest_pafot.commands import bisect_command as bisecting  # noqa: PLC0415
    from pytest_pafot.commands import search_command as searching  # noqa: PLC0415
    from pytest_pafot.comparison import command as comparison  # noqa: PLC0415
    from pytest_pafot.corpus import corpus_command as corpus  # noqa: PLC0415
    from pytest_pafot.episodes import progress_command as progressing  # noqa: PLC0415
    from pytest_pafot.episodes import rate_command as rating  # noqa: PLC0415
    from pytest_pafot.export import export_command as exporting  # noqa: PLC0415

    given = sys.argv[1:] if arguments is None else arguments
    about = "Commands of pytest-pafot beside pytest."
    parser = argparse.ArgumentParser(prog="python -m pytest_pafot", description=about)
    commands = parser.add_subparsers(required=True, metavar="COMMAND", dest="command")
    search = commands.add_parser(
        "search",
        help="search for traffic in which a policy crashes, without a test",
        description="Search for traffic in which a policy crashes. Findings are saved, explained and shown on a page, "
        "as those of a test are; --write-test makes it one.",
    )
    searching.add_arguments(search)
    search.set_defaults(run=searching.run)
    bisect = commands.add_parser(
        "bisect",
        help="find the commit of a policy since which a saved scenario fails",
        description="Replay a saved scenario with the policy of earlier commits, in a copy of the repository, and tell "
        "in which it fails first, what that changed, and from when on it decides otherwise. All files but those of the "
        "policy stay as they are now. Nothing is changed here.",
    )
    bisecting.add_arguments(bisect)
    bisect.set_defaults(run=bisecting.run)
    progress = commands.add_parser(
        "progress",
        help="tell whether the new version of a policy is better than the old one",
        description="Put two versions of a policy through the same random scenarios, ordinary traffic and saved "
        "scenarios, search for what each fails alone, and say in a sentence which is better, and how sure that is.",
    )
    progressing.add_arguments(progress)
    progress.set_defaults(run=progressing.run)
    compare = commands.add_parser(
        "compare",
        help="compare search algorithms on a policy",
        description="Run several search algorithms on a policy, several times each, and write results, statistics, "
        "figures and a report. It can be interrupted at any time; the same command goes on where it was.",
    )
    comparison.add_arguments(compare)
    compare.set_defaults(run=comparison.run)
    rate = commands.add_parser(
        "rate",
        help="count how often a policy crashes by itself",
        description="Drive seeded episodes in the environment's own traffic, which no search has chosen, and count the "
        "crashes of one policy, or of two on the same seeds. With --out it can be interrupted at any time; the same "
        "command goes on where it was.",
    )
    rating.add_arguments(rate)
    rate.set_defaults(run=rating.run)
    export = commands.add_parser(
        "export",
        help="write the run of a finding as files for other tools",
        description="Drive the scenario of a saved finding once more, and write where everybody drove, with the road.",
    )
    exporting.add_arguments(export)
    export.set_defaults(run=exporting.run)
    of_corpus = commands.add_parser(
        "corpus",
        help="list, count and join saved scenarios",
        description="Tell which saved scenarios lie in folders, and which say the same, without running them.",
    )
    corpus.add_arguments(of_corpus)
    of_corpus.set_defaults(run=corpus.run)
    # argparse would give what follows to the positional arguments before it.
    own = given.index("--") if given[:1] == ["search"] and "--" in given else len(given)
    arguments_given = parser.parse_args(given[:own], argparse.Namespace(pytest=given[own + 1 :]))
    try:
        code: int = arguments_given.run(arguments_given, ["python", "-m", "pytest_pafot", *given])
        sys.stdout.flush()
    except KeyboardInterrupt:  # compare and rate say what is kept
        sys.stderr.write(f"\n{arguments_given.command}: interrupted\n")
        return 130
    except OSError as error:
        if error.filename is not None:  # not of the standard output, which has no name
            raise
        return _without_output(arguments_given.command, error)
    return code


def _without_output(command: str, error: OSError) -> int:
    """Say that the standard output cannot be written; the exit code."""
    from pytest_pafot.support.files import way_out  # noqa: PLC0415

    with suppress(OSError, ValueError), open(os.devnull, "wb") as nowhere:  # noqa: PTH123  (a name, no path)
        os.dup2(nowhere.fileno(), sys.stdout.fileno())  # Python writes what is left of it when it ends.
    if isinstance(error, BrokenPipeError):  # `| head` has read enough, which is no fault
        return 128 + 13
    expected, fix = "a standard output that can be written", way_out(error, "or send it to another place")
    sys.stderr.write(f"{command}: expected {expected}, received {error.strerror}; {fix}\n")
    return 2


if __name__ == "__main__":
    sys.exit(main())
