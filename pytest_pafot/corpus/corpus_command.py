"""``python -m pytest_pafot corpus``: which saved scenarios lie in folders, told to people or to programs."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pytest_pafot.corpus.layout import files_in, folders_below
from pytest_pafot.corpus.saved import Saved, read_saved_file
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.support.text import ascii_text, plural, quiet_json, visible

MARKS = ("flaky", "xfail", "xfail_until")
"""What a line tells of a file where it has it."""

NO_FOLDER = 2
"""Exit code where a folder is none, as for wrong arguments."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    kinds = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    for name, about in (("list", "a line for each saved scenario"), ("stats", "how many there are of each kind")):
        each = kinds.add_parser(name, help=about, description=about.capitalize())
        each.add_argument("--json", action="store_true", help="as JSON, for programs")
        of_folders = "in which, or below which, saved scenarios lie (default: here)"
        each.add_argument("folders", nargs="*", type=Path, default=[Path()], metavar="FOLDER", help=of_folders)


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """Tell what lies in the folders; the exit code, which is 1 where a file cannot be read."""
    for folder in arguments.folders:
        if not folder.is_dir():
            sys.stderr.write(f"corpus: expected a folder, received {visible(str(folder))}; give one that exists\n")
            return NO_FOLDER
    below = {below.resolve(): below for folder in arguments.folders for below in folders_below(folder)}
    files = [file for folder in sorted(below.values()) for file in files_in(folder)]  # each once, however it is reached
    rows = [_row(read_saved_file(file)) for file in files]
    told: Any = rows if arguments.what == "list" else _counts(rows)
    lines = [quiet_json(json.dumps(told, indent=2))] if arguments.json else _lines(told)
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return int(any("error" in row for row in rows))


def _row(saved: Saved) -> dict[str, Any]:
    """A file as plain data: what its finding is, or why it cannot be read."""
    finding, file = saved.finding, saved.path.as_posix()
    if finding is None:
        return {"file": file, "id": saved.id, "error": saved.error}
    expect = finding.expect
    return {
        "file": file,
        "id": finding.id,
        "test": finding.test,
        "kind": finding.signature.slug,
        "failure": expect.failure,
        "assertion": expect.assertion,
        "outcome": str(expect.outcome),
        "time": expect.time,
        "responsibility": expect.responsibility,
        "preventable_by": list(expect.preventable_by),
        "size": size_of(finding.scenario),
        "algorithm": finding.found.algorithm,
        "seed": finding.found.seed,
        "flaky": finding.flaky,
        "xfail": finding.xfail,
        "xfail_until": None if finding.xfail_until is None else finding.xfail_until.isoformat(),
    }


def _counts(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    def by(name: str) -> dict[str, int]:
        return dict(sorted(Counter(row[name] for row in rows if name in row).items()))

    return {
        "files": len(rows),
        "broken": sum("error" in row for row in rows),
        "flaky": sum(row.get("flaky") is not None for row in rows),
        "xfail": sum(row.get("xfail") is not None for row in rows),
        **{name: by(name) for name in ("test", "kind", "outcome", "responsibility")},
    }


def _lines(told: list[dict[str, Any]] | dict[str, Any]) -> Iterator[str]:
    """The same for people."""
    if isinstance(told, list):
        for row in told:
            marks = "".join(f", {name.replace('_', ' ')}: {row[name]}" for name in MARKS if row.get(name))
            rest = row.get("error") or f"{row['outcome']} at {row['time']:.1f} s, {row['size']}{marks}"
            yield ascii_text(f"{row['file']}: {rest}")
        return
    parts = [f"{told[name]} {name}" for name in ("broken", "flaky", "xfail") if told[name]]
    yield ", ".join([plural(told["files"], "saved scenario"), *parts])
    for name in ("test", "kind", "outcome", "responsibility"):
        for value, count in told[name].items():
            yield ascii_text(f"{name:14} {count:4}  {value}")
