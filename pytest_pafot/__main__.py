"""Commands beside pytest: ``python -m pytest_pafot compare``."""

from __future__ import annotations

import argparse
import sys


def main(arguments: list[str] | None = None) -> int:
    """Run a command, from the arguments of the command line without the program's name; its exit code."""
    from pytest_pafot.comparison import command  # noqa: PLC0415

    given = sys.argv[1:] if arguments is None else arguments
    about = "Commands of pytest-pafot beside pytest."
    parser = argparse.ArgumentParser(prog="python -m pytest_pafot", description=about)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    compare = commands.add_parser(
        "compare",
        help="compare search algorithms on a policy",
        description="Run several search algorithms on a policy, several times each, and write results, statistics, "
        "figures and a report. It can be interrupted at any time; the same command goes on where it was.",
    )
    command.add_arguments(compare)
    return command.run(parser.parse_args(given), ["python", "-m", "pytest_pafot", *given])


if __name__ == "__main__":
    sys.exit(main())
