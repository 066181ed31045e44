"""The result of a session in a few lines of Markdown, for the page of a CI job.

Texts from users, files and exceptions appear as they are: nothing in them becomes markup, a mention or a link.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from pytest_pafot.findings.severity import Severity, worsening, worst_first
from pytest_pafot.report.session_record import ERROR, NEW, FindingRecord, SessionRecord
from pytest_pafot.support.text import plural, visible

MAX_LISTED = 20
"""The largest number of entries that a list in the summary names. Any more are only counted."""

MAX_TEXT = 300
"""The largest number of characters of a user's text. A longer text is cut."""

ACCEPTED = "accepted"
"""The group of failures that are accepted with ``xfail``."""

_GROUPS: Mapping[str, str] = MappingProxyType(
    {
        NEW: "New",
        "introduced": "Introduced by the change",
        ERROR: "Could not be read or run",
        "still failing": "Known, still failing",
        "drifted": "Drifted: the run differs from the file, so this is no fix",
        "flaky": "Flaky",
        "common": "Known, and also failing in the reference",
        ACCEPTED: "Accepted for now",
        "fixed": "Fixed",
        "fixed before": "Fixed before",
    }
)
"""The title of each group of findings, by status, with the most urgent group first."""

_MARKUP = re.compile(r"([\\`*_\[\]|~#!]|^[-+=](?=[-+=]*(?: |$)))")
_ORDERED = re.compile(r"^(\d+)(?=[.)](?: |$))")
_LINK = re.compile(r"(?i)(:)(?=//)|(?<=www)(\.)")
_ENTITIES = MappingProxyType({"&": "&amp;", "<": "&lt;", ">": "&gt;", "$": "<span>$</span>"})
_REFERENCE = re.compile(r"(?i)@|#(?=\w)|\bgh-(?=\d)|:(?=[\w+-]+:)")
"""Text that GitHub turns into a mention, an issue or an emoji, even escaped, unless a zero-width space follows it."""


def markdown(record: SessionRecord) -> str:
    """Return the summary of a session; empty if nothing in the session concerned this plugin."""
    return "" if record.is_empty else "\n".join(_lines(record)) + "\n"


def _lines(record: SessionRecord) -> Iterator[str]:
    groups: dict[str, list[FindingRecord]] = {name: [] for name in _GROUPS}
    for finding in record.findings:
        groups[ACCEPTED if finding.result == "xfailed" else finding.status].append(finding)
    counts = [f"{len(group)} {name}" for name, group in groups.items() if group]
    yield f"### pafot: {', '.join([*([] if groups[NEW] else ['nothing new']), *counts])}"
    yield ""
    yield from _search_lines(record)
    for name, group in groups.items():
        if group:
            yield from ("", f"**{_GROUPS[name]}**", "")
            for finding in sorted(group, key=_rank)[:MAX_LISTED]:
                yield from _finding_lines(finding)
            yield from ([f"- ... and {len(group) - MAX_LISTED} more"] if len(group) > MAX_LISTED else [])
    failed = [each for each in record.searches if each.result in ("failed", "error")]
    faulty = [each for each in failed if not (each.finds or each.unsaved)]  # their new findings did not make them fail
    yield from _listed("Searches that failed", [f"{code(each.node_id)}: {plain(each.message)}" for each in faulty])
    yield from _listed("Merged", [plain(" ".join(each.splitlines())) for each in record.merged])
    yield from _listed("Compared", [plain(each) for each in record.compared])
    lost = [f"{code(each.folder)}: {plain(each.expected)}; {plain(each.way_out)}" for each in record.orphans]
    yield from _listed("Saved scenarios whose test is gone", lost)
    yield from _listed("Warnings", [plain(each) for each in record.warnings])
    yield from _listed("Problems", [plain(each) for each in record.problems])


def _search_lines(record: SessionRecord) -> Iterator[str]:
    """Yield a line with the number of searches and runs, and with the options that repeat them."""
    ran = [search for search in record.searches if search.began]
    if not ran:
        idle = "No search ran." if record.compared else "No search was requested."
        yield "No search ran to its end." if record.searches else idle
        return
    options = " or ".join(code(options) for options in dict.fromkeys(search.options for search in ran))
    count = "1 search" if len(ran) == 1 else f"{len(ran)} searches"
    yield f"{count}, {plural(sum(search.runs for search in ran), 'run')}; repeat with {options}."
    against = ", ".join(code(name) for name in dict.fromkeys(search.against for search in ran) if name)
    if against:
        yield f"A run counts as a failure only if {against} passes it."


def _rank(finding: FindingRecord) -> tuple[Any, ...]:
    """Return the key that sorts findings of one group: the worst first, then those with the most runs."""
    severity = None if finding.severity is None else Severity.of_data(finding.severity)
    return *worst_first(finding.responsible, severity), -finding.runs, finding.node_id


def _finding_lines(finding: FindingRecord) -> Iterator[str]:
    """Yield two lines on a finding: its test and its description, then the command that replays it."""
    told = [plain(finding.headline or finding.detail)]
    if finding.severity is not None:
        severity = Severity.of_data(finding.severity)
        before = None if finding.severity_before is None else Severity.of_data(finding.severity_before)
        worse = "" if before is None else worsening(severity, before)
        told.append(f"worse: {plain(worse)}" if worse else plain(severity.further))
    told += [f"flaky: {plain(finding.flaky)}"] if finding.flaky else []
    told += [plain(finding.unshrunk)] if finding.unshrunk else []
    if finding.xfail is not None and finding.result == "xfailed":
        until = finding.xfail["until"]
        told.append(f"accepted{f' until {until}' if until else ''}: {plain(finding.xfail['reason'] or '')}")
    yield f"- {': '.join(filter(None, [code(finding.test or finding.node_id), '; '.join(filter(None, told))]))}"
    missing = f"not saved: {plain(finding.detail)}; " if finding.file is None else ""
    yield f"  <br>{missing}{code(finding.replay)}"


def _listed(title: str, entries: Sequence[str]) -> Iterator[str]:
    if entries:
        yield from ("", f"**{title}**", "", *(f"- {entry}" for entry in entries[:MAX_LISTED]))
        yield from ([f"- ... and {len(entries) - MAX_LISTED} more"] if len(entries) > MAX_LISTED else [])


def plain(text: str) -> str:
    """Escape a text on one line so that nothing in it is markup, a link or HTML."""
    line = _LINK.sub(r"\\\1\2", _ORDERED.sub(r"\1\\", _MARKUP.sub(r"\\\1", _one_line(text))))
    line = "".join(_ENTITIES.get(character, character) for character in line)
    return _REFERENCE.sub(r"\g<0>&#8203;", line)


def code(text: str) -> str:
    """Return a text as Markdown code, between fences of more backticks than the text has in a row."""
    line = _one_line(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", line)), default=0))
    pad = " " if line.startswith(("`", " ")) or line.endswith(("`", " ")) else ""
    return f"{fence}{pad}{line or ' '}{pad}{fence}"


def _one_line(text: str) -> str:
    line = " ".join(visible(text).split())
    return line if len(line) <= MAX_TEXT else f"{line[:MAX_TEXT]}..."
