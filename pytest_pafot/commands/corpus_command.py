"""``python -m pytest_pafot corpus``: list the saved scenarios in folders, for people or programs.

It changes files only with ``join --write``, which leaves one file of each kind of failure in a folder, with
``prune --write``, which removes the files of tests that are gone, with ``nearby --write``, which puts a neighbour that
fails in place of a scenario that passes, and with ``accept``, which writes one line of each.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from pytest_pafot.corpus.layout import files_in, folders_below, link_below
from pytest_pafot.corpus.reader import content_of, parsed
from pytest_pafot.corpus.saved import Saved, named_file, of_one_kind, read_saved_file, refusal
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import size_of, sort_key
from pytest_pafot.support.errors import CorpusError, flag
from pytest_pafot.support.files import way_out, write_whole
from pytest_pafot.support.text import ascii_text, day_of, plural, quiet_json, visible

XFAIL_LINE = re.compile(rb"^(# )?xfail:.*$", re.MULTILINE)
"""The line ``xfail:`` in a file, which accepts the file's failure, or the comment in its place."""

NO_FOLDER = 2
"""The exit code if a path is not a folder, which is also the exit code for wrong arguments."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    kinds = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    of_folders = "searched for saved scenarios, with all folders below (default: here)"
    for name, about in (("list", "print a line for each saved scenario"), ("stats", "count saved scenarios by kind")):
        each = kinds.add_parser(name, help=about, description=about.capitalize())
        each.add_argument("--json", action="store_true", help="print JSON, for programs")
        each.add_argument("folders", nargs="*", type=Path, default=[Path()], metavar="FOLDER", help=of_folders)
    about = "keep one of the files in a folder that were saved for the same kind of failure; nothing is run"
    joining = kinds.add_parser("join", help=about, description=about.capitalize())
    joining.add_argument("--write", action="store_true", help="remove the other files; without it, only list them")
    joining.add_argument("folders", nargs="*", type=Path, default=[Path()], metavar="FOLDER", help=of_folders)
    about = "remove saved scenarios whose test is gone; pytest collects the tests for that, and runs none"
    pruning = kinds.add_parser("prune", help=about, description=about.capitalize())
    pruning.add_argument("--write", action="store_true", help="remove the files; without it, only list them")
    pruning.add_argument("arguments", nargs="*", metavar="ARG", help="an argument of pytest; options come after --")
    pruning.set_defaults(folders=[Path()])
    about = "replay saved scenarios, and list neighbours that fail although a saved scenario passes"
    nearing = kinds.add_parser("nearby", help=about, description=about.capitalize())
    nearing.add_argument("--write", action="store_true", help="put each of them in place of its saved scenario")
    nearing.add_argument("arguments", nargs="*", metavar="ARG", help="an argument of pytest; options come after --")
    nearing.set_defaults(folders=[Path()])
    about = "accept the failures of saved scenarios, so that they are expected to fail, for good or up to a day"
    accepting = kinds.add_parser("accept", help=about, description=about.capitalize())
    accepting.add_argument("ids", nargs="+", metavar="ID", help="saved scenarios: their files, or their ids")
    accepting.add_argument("--reason", required=True, metavar="TEXT", help="why, such as the number of an issue")
    accepting.add_argument(
        "--until", type=_day, metavar="YYYY-MM-DD", help="the last day, from today on (default: for good)"
    )
    accepting.set_defaults(folders=[Path()])


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """List the saved scenarios in folders, or change them as the module says; return the exit code.

    The exit code is 1 if a file cannot be read or written, or if files cannot be joined.
    """
    if arguments.what in ("prune", "nearby"):
        return subprocess.run(session_of(arguments), check=False).returncode  # noqa: S603
    for folder in arguments.folders:
        if not folder.is_dir():
            sys.stderr.write(f"corpus: expected a folder, received {visible(str(folder))}; give a folder that exists\n")
            return NO_FOLDER
        link = None if folder.is_absolute() else link_below(Path.cwd(), Path.cwd() / folder)
        if arguments.what in ("join", "accept") and link is not None:
            sys.stderr.write(f"corpus: {visible(refusal(link))}\n")
            return NO_FOLDER
    below = {below.resolve(): below for folder in arguments.folders for below in folders_below(folder)}
    if arguments.what == "join":
        joined = [_join(folder, write=arguments.write) for folder in sorted(below.values())]
        told = [ascii_text(line) for lines, _ in joined for line in lines] or ["nothing to join"]
        sys.stdout.write("".join(f"{line}\n" for line in told))
        return int(any(failed for _, failed in joined))
    files = [file for folder in sorted(below.values()) for file in files_in(folder)]  # each once
    if arguments.what == "accept":
        return max(_accept(name, arguments) for name in arguments.ids)
    rows = [_row(read_saved_file(file)) for file in files]
    shown: Any = rows if arguments.what == "list" else _counts(rows)
    lines = [quiet_json(json.dumps(shown, indent=2))] if arguments.json else _lines(shown)
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return int(any("error" in row for row in rows))


def session_of(arguments: argparse.Namespace) -> list[str]:
    """Return the session of pytest for what needs the tests: to collect them, or to replay their saved scenarios."""
    if arguments.what == "prune":
        plugin, how, write = "pruning", ["--collect-only", "-qq"], "--remove-orphans"
    else:
        plugin, how, write = "nearing", [flag("generations", 0), "-q", "--tb=no", "-rN"], "--put-neighbours"
    plugins = ["-p", "pafot", "-p", f"pytest_pafot.plugin.{plugin}"]
    return [sys.executable, "-m", "pytest", *plugins, *how, *([write] if arguments.write else []), *arguments.arguments]


def _join(folder: Path, *, write: bool) -> tuple[list[str], bool]:
    """List the files in a folder that fail in the same way as another file; with ``write``, remove them.

    Of files that fail in the same way, the simplest by the order of shrinking stays. A file whose failure is accepted
    is preferred: so no acceptance is lost, and none passes to a scenario for which it was not written. A flaky file
    stays only if there is no other. Files that name different tests are not joined.

    Returns:
        The lines to print, and True if the user must correct something in the folder by hand.
    """
    files = [read_saved_file(path) for path in files_in(folder) if not path.is_symlink()]
    lines = [f"left as it is: {saved.error}" for saved in files if saved.finding is None]
    failed = bool(lines)
    for group in of_one_kind(files):
        findings = {saved.path: saved.finding for saved in group if saved.finding is not None}
        accepted = {(finding.xfail, finding.xfail_until) for finding in findings.values() if finding.xfail is not None}
        if len(accepted) > 1:
            names = ", ".join(path.name for path in findings)
            lines.append(
                f"{folder}: {names}: left as they are: expected the same reason and day in their lines `xfail:`, "
                f"received {len(accepted)} different ones; write the same line in these files, and join again"
            )
            failed = True
            continue
        kept, *others = sorted(findings, key=lambda path: _order(findings[path]))
        for path in others:
            problem = ""
            if write:
                try:
                    path.unlink(missing_ok=True)  # Another command may have removed it already.
                except OSError as error:
                    problem = f"{error.strerror or error}; {way_out(error, 'then join again')}"
            failed = failed or bool(problem)
            verb = "not removed" if problem else "removed" if write else "would remove"
            is_firmer = findings[path].flaky is not None and findings[kept].flaky is None
            why = "not flaky" if is_firmer else "as simple or simpler"
            why = "accepted" if findings[kept].xfail is not None else why
            lines.append(f"{verb}: {path}: {problem or f'{kept.name} shows the same failure and is {why}'}")
    return lines, failed


def _order(finding: Finding) -> tuple[bool, bool, tuple[int, ...], str]:
    return finding.xfail is None, finding.flaky is not None, sort_key(finding.scenario), finding.id


def _day(text: str) -> date:
    day = day_of(text)
    if day is None:
        raise argparse.ArgumentTypeError(f"expected a day such as 2027-01-31, received {text!r:.50}")
    if day < date.today():
        raise argparse.ArgumentTypeError(f"expected today or a later day, received {text}, which is over")
    return day


def _accept(name: str, arguments: argparse.Namespace) -> int:
    """Write the line that accepts the failure of a file, and change nothing else in it; return the exit code."""
    try:
        path = named_file(name)
        content = content_of(path)
        finding = replace(parsed(path, content), xfail=arguments.reason, xfail_until=arguments.until)
        line = text_of(finding).rstrip().rpartition("\n")[2].encode()
        is_there = XFAIL_LINE.search(content) is not None
        accepted = (
            XFAIL_LINE.sub(lambda _: line, content, count=1) if is_there else content.rstrip() + b"\n" + line + b"\n"
        )
        if parsed(path, accepted) != finding:
            raise ValueError(f"{path}: expected one line `xfail:`, received more; write `{line.decode()}` by hand")
        write_whole(path, accepted)
    except OSError as error:
        fix = way_out(error, "then accept it again")
        sys.stderr.write(
            f"corpus: {visible(name)}: expected a file that can be written, received {error.strerror or error}; {fix}\n"
        )
        return 1
    except (CorpusError, ValueError) as error:
        sys.stderr.write(f"corpus: {visible(str(error))}\n")
        return 1
    sys.stdout.write(f"{ascii_text(f'{path}: {_accepted(finding.xfail, arguments.until)}')}\n")
    return 0


def _accepted(reason: str | None, until: object) -> str:
    return f"accepted {'for good' if until is None else f'until {until}'}: {reason}"


def _row(saved: Saved) -> dict[str, Any]:
    """Return a saved scenario as plain data: its path and its finding, or why the file cannot be read."""
    finding, file = saved.finding, saved.path.as_posix()
    if finding is None:
        return {"file": file, "id": saved.id, "error": saved.error}
    expect = finding.expect
    return {
        "file": file,
        "id": finding.id,
        "test": finding.test,
        "kind": finding.signature.slug,
        "event": expect.event,
        "failure": expect.failure,
        "assertion": expect.assertion,
        "outcome": str(expect.outcome),
        "time": expect.time,
        "responsibility": expect.responsibility,
        "preventable_by": list(expect.preventable_by),
        "size": size_of(finding.scenario, finding.longest_run),
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
    """Yield the lines of a list of saved scenarios, or of counts of them, for people to read."""
    if isinstance(told, list):
        for row in told:
            marks = f", flaky: {row['flaky']}" if row.get("flaky") else ""
            marks += f", {_accepted(row['xfail'], row['xfail_until'])}" if row.get("xfail") else ""
            rest = row.get("error") or f"{row['event']}; {row['size']}{marks}"
            yield ascii_text(f"{row['file']}: {rest}")
        return
    parts = [f"{told[name]} {name}" for name in ("broken", "flaky", "xfail") if told[name]]
    yield ", ".join([plural(told["files"], "saved scenario"), *parts])
    for name in ("test", "kind", "outcome", "responsibility"):
        for value, count in told[name].items():
            yield ascii_text(f"{name:14} {count:4}  {value}")
