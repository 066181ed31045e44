"""``python -m pytest_pafot corpus``: list saved scenarios, or accept their failures."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date
from pathlib import Path

from pytest_pafot.corpus.layout import files_in, folders_below, unlisted_below
from pytest_pafot.corpus.reader import Saved, content_of, named_file, parsed
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.support.errors import CorpusError, RequestError
from pytest_pafot.support.files import Since, added_in, way_out, write_whole
from pytest_pafot.support.text import ascii_text, day_of, visible, wrapped_to

# The line `xfail:` of a file, or the comment in its place.
XFAIL_LINE = re.compile(rb"^(# )?xfail:.*$", re.MULTILINE)

# The exit code if a path is not a folder, as for invalid arguments.
NO_FOLDER = 2

COLUMNS = ("id", "test", "since")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    kinds = parser.add_subparsers(required=True, metavar="WHAT", dest="what")
    about = "list each saved scenario with its failure, its test, and the commit that added it"
    listing = kinds.add_parser("list", help=about, description=about.capitalize())
    of_folders = "search this folder and all folders below it (default: the current folder)"
    listing.add_argument(
        "folders", nargs="*", type=Path, default=[Path()], metavar="FOLDER", help=of_folders
    )
    about = (
        "accept the failures of saved scenarios, which are then expected to fail until a given day"
    )
    accepting = kinds.add_parser("accept", help=about, description=about.capitalize())
    accepting.add_argument(
        "ids", nargs="+", metavar="ID", help="accept the failure of this scenario (a file or an id)"
    )
    accepting.add_argument(
        "--reason", required=True, metavar="TEXT", help="give a reason, such as an issue number"
    )
    of_until = "expect the failures until the end of this day, which must not be in the past"
    accepting.add_argument(
        "--until", required=True, type=_last_day, metavar="YYYY-MM-DD", help=of_until
    )


def run(arguments: argparse.Namespace, command: Sequence[str]) -> int:
    """List the saved scenarios in folders, or accept their failures, and return the exit code."""
    if arguments.what == "accept":
        return max(_accept(name, arguments.reason, arguments.until) for name in arguments.ids)
    for folder in arguments.folders:
        if not folder.is_dir():
            sys.stderr.write(
                f"corpus: expected an existing folder, received {visible(str(folder))}\n"
            )
            return NO_FOLDER
    unlisted: dict[Path, str] = {}
    below: dict[Path, Path] = {}  # each folder once
    for folder in arguments.folders:
        unlisted |= unlisted_below(folder)
        below |= {each.resolve(): each for each in folders_below(folder)}
    for place, why in unlisted.items():
        sys.stderr.write(f"corpus: {visible(str(place))}: {why}\n")
    saved = [Saved.read(file) for folder in sorted(below.values()) for file in files_in(folder)]
    lines = list(_lines(saved, added_in(arguments.folders), shutil.get_terminal_size().columns))
    if not saved:
        lines = ["no saved scenarios were found"]
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    return int(bool(unlisted) or any(each.finding is None for each in saved))


def _lines(saved: Iterable[Saved], added: Mapping[Path, Since], width: int) -> Iterator[str]:
    # A row for each saved scenario, and below it the failure, or the reason why the file cannot be read.
    rows, texts = [COLUMNS], [""]
    for each in saved:
        finding = each.finding
        test, about = "", each.error
        if finding is not None:
            test, about = finding.test.partition("::")[2], finding.expect.brief
            if finding.xfail is not None:
                about += f"; accepted: {finding.accepted}"
        # git stores a file that is a link as a link, so only the folder is resolved.
        folder = os.path.realpath(each.path.parent)
        since = added.get(Path(folder, each.path.name), ())
        rows.append((ascii_text(each.id), ascii_text(test), " ".join(since)))
        texts.append(ascii_text(about))
    widths = [max(map(len, cells)) for cells in zip(*rows, strict=True)]
    for row, text in zip(rows, texts, strict=True):
        cells = [f"{cell:{room}}" for cell, room in zip(row, widths, strict=True)]
        yield "  ".join(cells).rstrip()
        if text:
            yield from wrapped_to(f"    {text}", width)


def _last_day(text: str) -> date:
    day = day_of(text)
    if day is None:
        raise RequestError(f"expected a day such as 2027-01-31, received {text!r:.50}")
    if day < date.today():
        raise RequestError(f"expected today or a later day, received {text}, which is in the past")
    return day


def _accept(name: str, reason: str, until: date) -> int:
    # Only the line `xfail:` changes, so that the file keeps its comments and the order of its keys.
    try:
        path = named_file(name)
        content = content_of(path)
        finding = parsed(path, content).accepting(reason, until)
        line = text_of(finding).rstrip().rpartition("\n")[2].encode()
        accepted, count = XFAIL_LINE.subn(lambda _: line, content, count=1)
        if count == 0:
            accepted = content.rstrip() + b"\n" + line + b"\n"
        if parsed(path, accepted) != finding:
            raise ValueError(
                f"{path}: expected one line `xfail:`, received several. Write `{line.decode()}` by hand"
            )
        write_whole(path, accepted)
    except OSError as error:
        fix = way_out(error, "then run the command again")
        sys.stderr.write(
            f"corpus: {visible(name)}: expected a writable file, received {error.strerror or error}. {fix}\n"
        )
        return 1
    except (CorpusError, ValueError) as error:
        sys.stderr.write(f"corpus: {visible(str(error))}\n")
        return 1
    sys.stdout.write(f"{ascii_text(f'{path}: accepted until {until}: {reason}')}\n")
    return 0
