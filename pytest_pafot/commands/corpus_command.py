"""``python -m pytest_pafot corpus``: list the saved scenarios in folders, for people or programs.

It changes files only with ``join --write``, which leaves one file of each kind of failure in a folder, or adds the
files of other corpora, with ``prune --write``, which removes the files of tests that are gone, with ``shrink``, which
puts a simpler scenario into a file, and with ``accept``, which writes one line of each.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

from pytest_pafot.commands.corpus_table import (
    COLUMNS,
    condition,
    data_of,
    holds,
    labels_in,
    rows_of,
    text_of_table,
)
from pytest_pafot.commands.history import added_in, place_of
from pytest_pafot.commands.inventory import Inventory
from pytest_pafot.commands.results import Session
from pytest_pafot.corpus.layout import files_below, files_in, folders_below, link_below, unlisted_below
from pytest_pafot.corpus.reader import content_of, load, located, parsed
from pytest_pafot.corpus.saved import Saved, named_file, of_one_kind, refusal, saved_in
from pytest_pafot.corpus.writer import CorpusWriteError, free_path, text_of
from pytest_pafot.corpus.writer import write as write_finding
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import sort_key
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.support.errors import CorpusError, RequestError, WorldError, command, day_argument, flag
from pytest_pafot.support.files import way_out, write_whole
from pytest_pafot.support.text import ascii_text, plural, quiet_json, visible

XFAIL_LINE = re.compile(rb"^(# )?xfail:.*$", re.MULTILINE)
"""The line ``xfail:`` in a file, which accepts the file's failure, or the comment in its place."""

NO_FOLDER = 2
"""The exit code if a path is not a folder, which is also the exit code for wrong arguments."""


BAD_SESSION, NO_TESTS = 4, 5
"""The exit codes of pytest for wrong arguments, and for a session without an item."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    kinds = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    parser.set_defaults(folders=[Path()])  # of the kinds that take none

    def kind(name: str, about: str) -> argparse.ArgumentParser:
        return kinds.add_parser(name, help=about, description=about.capitalize())

    of_folders = "searched for saved scenarios, with all folders below (default: here)"
    results: dict[str, Any] = {"nargs": "+", "action": "extend", "type": Path, "default": [], "metavar": "FILE"}
    about = "print a table of the saved scenarios, the worst first; pytest collects their tests, and runs none"
    listing = kind("list", about)
    of_where = "list only rows that have the text in the column, or with `COLUMN=` nothing; all conditions must hold; "
    of_where += f"columns: {', '.join(COLUMNS)}"
    listing.add_argument("--where", action="append", type=condition, default=[], metavar="COLUMN=TEXT", help=of_where)
    of_states = f"results of a session, from {flag('json')}; the last file that has a scenario tells its state"
    listing.add_argument("--results", help=of_states, **results)
    of_no_tests = "read only the files, without asking whether their tests are gone"
    listing.add_argument("--no-tests", action="store_true", help=of_no_tests)
    of_today = "the day with which last days of accepted failures are compared (default: today)"
    listing.add_argument("--today", type=day_argument, metavar="YYYY-MM-DD", help=of_today)
    listing.add_argument("--json", action="store_true", help="print JSON, for programs")
    counting = kind("stats", "count saved scenarios by kind")
    for each in (listing, counting):
        each.add_argument("folders", nargs="*", type=Path, default=[Path()], metavar="FOLDER", help=of_folders)
    about = "keep one of the files in a folder that were saved for the same kind of failure; nothing is run"
    joining = kind("join", about)
    joining.add_argument("--write", action="store_true", help="change the files; without it, only list the changes")
    chosen = joining.add_mutually_exclusive_group()
    of_from = "add the saved scenarios of another corpus to FOLDER instead, and remove none; may be given several times"
    chosen.add_argument("--from", action="append", type=Path, default=[], dest="sources", metavar="DIR", help=of_from)
    of_failing = f"results of a session here, from {flag('json')}: join only files that still fail in the last one"
    chosen.add_argument("--results", help=of_failing, **results)
    joining.add_argument("folders", nargs="*", type=Path, default=[Path()], metavar="FOLDER", help=of_folders)
    about = "remove saved scenarios whose test is gone; pytest collects the tests for that, and runs none"
    pruning = kind("prune", about)
    pruning.add_argument("--write", action="store_true", help="remove the files; without it, only list them")
    about = "shrink a saved scenario further than the time of its search allowed, and rewrite its file"
    shrinking = kind("shrink", about)
    shrinking.add_argument("file", metavar="FILE", help="the saved scenario: its file, or its id")
    for each in (pruning, shrinking):
        each.add_argument("arguments", nargs="*", metavar="ARG", help="an argument of pytest; options come after --")
    about = "accept the failures of saved scenarios, so that they are expected to fail, for good or up to a day"
    accepting = kind("accept", about)
    accepting.add_argument("ids", nargs="+", metavar="ID", help="saved scenarios: their files, or their ids")
    accepting.add_argument("--reason", required=True, metavar="TEXT", help="why, such as the number of an issue")
    of_until = "the last day, from today on (default: for good)"
    accepting.add_argument("--until", type=_last_day, metavar="YYYY-MM-DD", help=of_until)
    of_flaky = "let them pass as well, up to the last day, which has to be given"
    accepting.add_argument("--flaky", action="store_true", help=of_flaky)


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """List the saved scenarios in folders, or change them as the module says; return the exit code.

    The exit code is 1 if a file cannot be read or written, or if files cannot be joined.
    """
    if arguments.what == "accept" and arguments.flaky and arguments.until is None:
        raise RequestError("expected a last day with --flaky, received none; add --until=YYYY-MM-DD")
    if arguments.what == "shrink":
        return _shrink(arguments)
    if arguments.what == "prune":
        return subprocess.run(session_of(arguments), check=False).returncode  # noqa: S603
    sources = arguments.sources if arguments.what == "join" else []
    if sources and len(arguments.folders) > 1:
        raise RequestError("expected one FOLDER with --from, received several; join into one after the other")
    for folder in (*arguments.folders, *sources):
        if not folder.is_dir():
            sys.stderr.write(f"corpus: expected a folder, received {visible(str(folder))}; give a folder that exists\n")
            return NO_FOLDER
        link = None if folder.is_absolute() else link_below(Path.cwd(), Path.cwd() / folder)
        if arguments.what in ("join", "accept") and link is not None:
            sys.stderr.write(f"corpus: {visible(refusal(link))}\n")
            return NO_FOLDER
    unlisted = {
        place: why for folder in (*arguments.folders, *sources) for place, why in unlisted_below(folder).items()
    }
    for place, why in unlisted.items():
        sys.stderr.write(f"corpus: {visible(str(place))}: {why}\n")
    below = {below.resolve(): below for folder in arguments.folders for below in folders_below(folder)}
    if arguments.what == "join":
        failing = _failing(arguments.results)
        joined = (
            [_add(sources, arguments.folders[0], write=arguments.write)]
            if sources
            else [_join(folder, failing, write=arguments.write) for folder in sorted(below.values())]
        )
        told = [ascii_text(line) for lines, _ in joined for line in lines] or ["nothing to join"]
        sys.stdout.write("".join(f"{line}\n" for line in told))
        return int(any(failed for _, failed in joined) or bool(unlisted))
    files = [file for folder in sorted(below.values()) for file in files_in(folder)]  # each once
    if arguments.what == "accept":
        return max(_accept(name, arguments) for name in arguments.ids)
    if arguments.what == "list":
        return max(_list(files, arguments), int(bool(unlisted)))
    rows = [data_of(Saved.read(file)) for file in files]
    sys.stdout.write("".join(f"{line}\n" for line in _lines(rows)))
    return int(any("error" in row for row in rows) or bool(unlisted))


def _list(files: Sequence[Path], arguments: argparse.Namespace) -> int:
    """Print the table of saved scenarios; return the exit code, 1 if a file cannot be read."""
    labels = labels_in(arguments.results)
    with ThreadPoolExecutor(max_workers=1) as pool:  # pytest collects while the files are read here.
        collecting = None if arguments.no_tests or not files else pool.submit(Inventory.collected)
        saved = [Saved.read(file) for file in files]
        added = added_in({file.parent for file in files}, arguments.folders)
        inventory = Inventory(root=Path()) if collecting is None else _inventory(collecting)
    rows = rows_of(saved, inventory=inventory, added=added, labels=labels, today=arguments.today or date.today())
    chosen = [row for row in rows if holds(row, arguments.where)]
    if arguments.json:
        sys.stdout.write(quiet_json(json.dumps([row.data for row in chosen], indent=2)) + "\n")
    else:
        sys.stdout.write(text_of_table(chosen, shutil.get_terminal_size().columns))
    return int(any(each.finding is None for each in saved))


def _inventory(collecting: Future[Inventory]) -> Inventory:
    """Return the tests that pytest collects here; if it cannot, say so in a line, and go on without them."""
    try:
        found = collecting.result()  # An interrupt comes here, and not in the thread that collects.
    except RequestError as error:
        found = Inventory(root=Path(), problem=str(error))
    lines = found.problem.splitlines()
    errors = [line for line in lines if line.startswith("ERROR")]
    if lines:
        why = (errors or lines)[-1]
        sys.stderr.write(f"corpus: some tests are not known: {visible(why)}; --no-tests is quicker\n")
    return found


def session_of(arguments: argparse.Namespace) -> list[str]:
    """Return the session of pytest for what needs the tests: to collect them, or to replay their saved scenarios."""
    if arguments.what == "shrink":
        plugin, how, write = "shrinking", ["--no-header", "--tb=short", "-rN", "--runxfail", "--shrink-saved"], ""
    else:
        plugin, how, write = "pruning", ["--collect-only", "-qq"], "--remove-orphans"
    plugins = ["-p", "pafot", "-p", f"pytest_pafot.plugin.{plugin}"]
    given = [write] if getattr(arguments, "write", False) else []
    return [sys.executable, "-m", "pytest", *plugins, *how, *given, *arguments.arguments]


def _shrink(arguments: argparse.Namespace) -> int:
    """Let a session of pytest shrink a saved scenario; return the exit code, 2 for a file that cannot be shrunk."""
    try:
        path = named_file(arguments.file)
        is_link = path.is_symlink() or (not path.is_absolute() and link_below(Path.cwd(), Path.cwd() / path))
        if is_link:
            raise CorpusError(path, "a file", "a link, which may lead to files of other people", "give the file itself")
        finding = load(path)
        if why := _why_not_shrunk(finding):
            fix = f"`{command('pytest', path)}` replays it"
            raise CorpusError(path, "a finding that can be shrunk", why, fix)
    except CorpusError as error:
        sys.stderr.write(f"corpus: {visible(str(error))}\n")
        return NO_FOLDER
    arguments.arguments = [str(path), *arguments.arguments]
    code = subprocess.run(session_of(arguments), check=False).returncode  # noqa: S603
    if code == NO_TESTS:
        gone = CorpusError(path, "the file of a test", "one whose test is gone", "`corpus prune` removes such files")
        sys.stderr.write(f"corpus: {visible(str(gone))}\n")
    return NO_FOLDER if code in (BAD_SESSION, NO_TESTS) else code


def _why_not_shrunk(finding: Finding) -> str:
    """Return why the finding of a file cannot be shrunk, because its runs may differ; empty if it can."""
    if finding.flaky is not None:
        return "a flaky one, whose scenario does not give the same run each time"
    if finding.expect.is_crash:
        return "one in which a process died"
    return "one that depends on wall-clock time" if finding.expect.outcome == "hang" else ""


def _add(sources: Sequence[Path], folder: Path, *, write: bool) -> tuple[list[str], bool]:
    """List the saved scenarios below other folders that a folder lacks at the same place; with ``write``, add them.

    It is unknown which of them fail here, so all are added, whatever the order of the other folders, and no file here
    changes.

    Returns:
        The lines to print, and True if a finding of the other folders does not come here.
    """
    lines, failed = [], False
    found: dict[tuple[Path, str], tuple[Path, Finding]] = {}  # by the folder here, and the text
    for source in sources:
        places = folders_below(source)
        if not places and not any(source.rglob("pafot.json")):  # a machine that found nothing has results
            why = "it has neither saved scenarios nor results, pafot.json; see whether its machine has searched"
            lines.append(f"nothing added: {source}: {why}")
        for place in places:
            here = folder / place.relative_to(source)
            if link := link_below(folder, here):
                lines.append(f"not added: {place}: {refusal(link)}")
                failed = True
                continue
            for saved in saved_in(place):
                if saved.finding is None:
                    lines.append(f"not added: {saved.error}")
                    failed = True
                else:
                    found.setdefault((here, text_of(saved.finding)), (saved.path, saved.finding))
    for file, why in _lost(sources, folder):
        lines.append(f"not added: {file}: {why}")
        failed = True
    own = {here: {text_of(saved.finding) for saved in saved_in(here) if saved.finding} for here, _ in found}
    order = sorted(found, key=lambda each: (each[0], _order(found[each][1]), each[1]))
    for here, text in order:
        path, finding = found[here, text]
        if text in own[here]:
            continue
        # An own file may pass here, so it covers only its own scenario, not that from which it was shrunk.
        target, named = free_path(here, finding, passed=files_in(here))
        if os.path.lexists(target):
            if finding.xfail is not None and finding.acceptance != load(target).acceptance:
                fix = f"write the same line `xfail:` in both, or none in {path}"
                why = f"expected the acceptance of {target}, received {finding.accepted}; {fix}"
                lines.append(f"not added: {path}: {why}")
                failed = True
            continue
        if write:
            try:
                write_finding(target, named)
            except CorpusWriteError as error:
                lines.append(f"not added: {path}: {error}")
                failed = True
                continue
        lines.append(f"{'added' if write else 'would add'}: {target}: from {path}")
    return lines, failed


def _lost(sources: Sequence[Path], folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the new findings that results in other folders name as saved, if their file is neither there nor here."""
    known = {file.parts[-3:] for root in (*sources, folder) for file in files_below(root)}
    for results in sorted(file for source in sources for file in source.rglob("pafot.json")):
        try:
            findings = Session.read(results).findings
        except RequestError:  # something else of this name
            continue
        for file in [each["file"] for each in findings if each.get("status") == "new" and each.get("file")]:
            if Path(file).parts[-3:] not in known:
                yield file, f"{results} names it as a new finding; bring the corpus of its machine along"


def _failing(results: Sequence[Path]) -> set[Path] | None:
    """Return the files that still fail in the last results that name them; None without any results."""
    if not results:
        return None
    labels = {file: label for entries in labels_in(results).values() for file, label in entries}
    return {place_of(Path(file)) for file, label in labels.items() if label == "still failing"}


def _join(folder: Path, failing: set[Path] | None, *, write: bool) -> tuple[list[str], bool]:
    """List the files in a folder that fail in the same way as another file; with ``write``, remove them.

    Of files that fail in the same way, the simplest by the order of shrinking stays. A file whose failure is accepted
    is preferred: so no acceptance is lost, and none passes to a scenario for which it was not written. A flaky file
    stays only if there is no other. Files that name different tests are not joined; nor are files that no session would
    run, and those that are not among the ``failing`` ones, if these are known.

    Returns:
        The lines to print, and True if the user must correct something in the folder by hand.
    """
    paths = [path for path in files_in(folder) if failing is None or place_of(path) in failing]
    files = [Saved.read(path) for path in paths if not path.is_symlink()]
    lines = [f"left as it is: {saved.error}" for saved in files if saved.finding is None]
    failed = bool(lines)
    for group in of_one_kind(files):
        findings = {saved.path: saved.finding for saved in group if saved.finding is not None}
        for path, finding in tuple(findings.items()):
            if why := _why_not_run(path, finding):
                lines.append(f"left as it is: {why}")
                failed = True
                del findings[path]
        if len(findings) < 2:
            continue
        accepted = {finding.acceptance for finding in findings.values() if finding.xfail is not None}
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


def _why_not_run(path: Path, finding: Finding) -> str:
    """Return why a session would refuse to run the scenario of a file, as far as that is known without its test."""
    # Worlds take longer to import than the other subcommands to run.
    from pytest_pafot.campaign.saved_scenario import SavedScenario  # noqa: PLC0415
    from pytest_pafot.world import codec  # noqa: PLC0415
    from pytest_pafot.world.highway import Highway  # noqa: PLC0415

    if codec.is_code(finding.world):
        return ""
    try:
        world = SavedScenario(path=path, finding=finding).world
        if isinstance(world, Highway):  # An environment may be registered only by its tests.
            world.check_fits(finding.scenario)
    except CorpusError as error:
        return str(error)
    except (ScenarioError, WorldError) as error:
        return str(located(path, "scenario", error))
    return ""


def _order(finding: Finding) -> tuple[bool, bool, tuple[int, ...], str]:
    return finding.xfail is None, finding.flaky is not None, sort_key(finding.scenario), finding.id


def _last_day(text: str) -> date:
    day = day_argument(text)
    if day < date.today():
        raise RequestError(f"expected today or a later day, received {text}, which is over")
    return day


def _accept(name: str, arguments: argparse.Namespace) -> int:
    """Write the line that accepts the failure of a file, and change nothing else in it; return the exit code."""
    try:
        path = named_file(name)
        content = content_of(path)
        finding = parsed(path, content).accepting((arguments.reason, arguments.until, arguments.flaky))
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
    sys.stdout.write(f"{ascii_text(f'{path}: accepted {_how_long(arguments)}: {finding.xfail}')}\n")
    return 0


def _how_long(arguments: argparse.Namespace) -> str:
    if arguments.until is None:
        return "for good"
    return f"{'as flaky ' if arguments.flaky else ''}until {arguments.until}"


def _lines(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines that count saved scenarios, for people to read."""
    counts = {
        "broken": sum("error" in row for row in rows),
        "flaky": sum(row.get("flaky") is not None for row in rows),
        "xfail": sum(row.get("xfail") is not None for row in rows),
    }
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    yield ", ".join([plural(len(rows), "saved scenario"), *parts])
    for name in ("test", "kind", "outcome", "responsibility"):
        for value, count in sorted(Counter(row[name] for row in rows if name in row).items()):
            yield ascii_text(f"{name:14} {count:4}  {value}")
