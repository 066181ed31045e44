"""The result of a session for programs, as ``--pafot-json`` writes it.

The record contains no clock time and no duration, and nothing on processes, and its keys and entries are sorted. So the
same seed gives the same text, for any number of workers. Its day is what the option says.

The same result in a few lines of Markdown is for the page of a CI job.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict, fields
from functools import partial
from types import MappingProxyType
from typing import Any

from pytest_pafot.campaign.events import Search
from pytest_pafot.corpus.writer import named
from pytest_pafot.findings.finding import portable
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.findings.sighting import GROUPS, Observed, Seen, label
from pytest_pafot.findings.verdict import worsening
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.report.session import ADVICE, RESULTS, Session
from pytest_pafot.report.terminal import FAILING, further, told
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.text import capitalised, code, plain, plural, quiet_json

VERSION = 5
"""The version of the JSON layout. It grows if a key is removed or changes its meaning, not if a key is added."""

UNREAD = label(Observed(is_error=True))
"""The label of a saved scenario that could not be read or run, of which nothing else is known."""

NOT_WRITTEN = ("seconds", "process_notes")
"""The attributes of a search that only the terminal shows, because the same seed may give others."""


FINDING: Mapping[str, tuple[Any, Callable[[Seen], Any] | None]] = MappingProxyType({
    "node_id": ("", lambda seen: seen.node_id),
    "id": ("", lambda seen: seen.id),
    "test": ("", lambda seen: seen.finding.test),
    "status": (UNREAD, lambda seen: str(seen.label)),
    "result": ("", None),
    "file": (None, lambda seen: seen.path or None),
    "replay": ("", None),
    "scenario": (None, lambda seen: named(seen.finding.scenario)),
    "world": (None, lambda seen: dict(seen.finding.world)),
    "headline": ("", lambda seen: seen.headline),
    "sentences": ([], lambda seen: list(seen.observed.sentences)),
    "detail": ("", lambda seen: seen.detail),
    "signature": (None, lambda seen: seen.finding.signature.told),
    "kind": ("", lambda seen: seen.finding.signature.slug),
    "failure": ("", lambda seen: seen.finding.expect.failure),
    "assertion": ("", lambda seen: seen.finding.expect.assertion),
    "outcome": ("", lambda seen: str(seen.finding.expect.outcome)),
    "time": (None, lambda seen: seen.finding.expect.time),
    "responsible": ("none", lambda seen: seen.responsible),
    "takeover": (None, lambda seen: seen.finding.expect.takeover),
    "size": ("", lambda seen: size_of(seen.finding.scenario, seen.finding.longest_run)),
    "traffic": ("", lambda seen: STYLES[seen.finding.scenario.traffic].described),
    "runs": (0, lambda seen: 1 + seen.alike.runs if seen.observed.new else 0),
    "worst": (None, lambda seen: {name: asdict(seen.alike)[name] for name in ("number", "severity")}),
    "seed": (None, lambda seen: seen.finding.found.seed),
    "algorithm": ("", lambda seen: seen.finding.found.algorithm),
    "policy": (None, lambda seen: seen.finding.found.policy),
    "against": ("", lambda seen: seen.finding.expect.against),
    "rate": (None, lambda seen: seen.finding.rate and asdict(seen.finding.rate) | {
        "of": seen.finding.drawn, "now": seen.observed.rate and asdict(seen.observed.rate),
    }),
    "flaky": (None, lambda seen: seen.finding.flaky),
    "unshrunk": ("", lambda seen: seen.unshrunk),
    "moment": (None, lambda seen: seen.moment and asdict(seen.moment) | {
        "conditions": [{"about": whom, "evaluated": [*rows]} for whom, rows in seen.moment.conditions],
    }),
    "searched": (0, lambda seen: seen.observed.searched),
    "drawn": (0, lambda seen: seen.observed.drawn),
    "elsewhere": ("", lambda seen: seen.observed.elsewhere),
    "reference_passes": (None, lambda seen: seen.observed.reference_passes),
    "severity": (None, lambda seen: seen.severity and asdict(seen.severity)),
    "severity_before": (None, lambda seen: seen.observed.before and asdict(seen.observed.before)),
    "xfail": (None, lambda seen: seen.finding.xfail_until and {
        "reason": seen.finding.xfail, "until": seen.finding.xfail_until.isoformat(),
    }),
})  # fmt: skip
"""For each key of the entry of a finding its value if a file could not be read or run, and else the function that
returns its value; None for what only the session knows.
"""


def finding_entry(seen: Seen | None, **more: Any) -> dict[str, Any]:
    """Return the entry of a finding for programs; without one, of a file that could not be read or run.

    ``more`` are the values of further keys, or of those that the session changes.

    Keys:
        node_id: of the item that replays it, if new from the next session on.
        id: name of its file without the suffix.
        test: node id of its test.
        status: `new`; `no worse`, if new but not counted in a comparison with a reference; the label of its replay; or
            `error`, with which only ids, `test`, `result`, `file`, `replay` and `detail` are known.
        result: `passed`, `skipped`, `xfailed`, `failed` or `error`; empty if the item did not end.
        file: path relative to the rootdir; null if not saved.
        replay: the command that replays it.
        scenario: as in its file; null with `error`.
        world: as in its file; null likewise.
        headline: how the run ended; empty if it passes.
        sentences: the sentences of the verdict on a collision.
        detail: what differs from the file, why there is no file, or the error.
        signature: what makes two failures the same; null likewise.
        kind: short name of the signature, with which ids begin.
        failure, assertion, outcome, time: as in `expect` of its file.
        responsible: `ego`, `npc`, `both` or `none`.
        takeover: the latest takeover by a careful driver that avoids it, as in `expect` of its file, or null.
        size: size of the scenario in words.
        traffic: how the NPCs drive, in words; empty for the paper's.
        runs: number of runs that failed so; 0 for a saved scenario (see `known` of the search).
        worst: of the worst of these runs, its `number` in the search, from 0, and its `severity`, if it has one.
        seed, algorithm, policy: as in `found` of its file.
        against: the reference that passed then; empty without one.
        rate: of a policy that draws random numbers: `failing` of `runs`, each with another seed if `of` is `seeds`; of
            a replay also `now`, with `failing` and `runs`.
        flaky: what differed when it was run again, or null.
        unshrunk: that no time was left to confirm it, or to shrink it fully.
        moment: the last decision that could have avoided it: `time` [s], `npc`, and in words: `seen`, where the policy
            saw the NPC; `action`, its answer; `hidden`, the answer with the NPC hidden (empty for the same, null if
            unknown); `otherwise`, the smallest change of the NPC that changes it; `reference`, the reference's answer;
            `conditions`, for each vehicle that they are `about` (`NPC 1`, `no NPC, or unknown which`, or empty if
            nothing is known) those that it `evaluated`, first those that come out otherwise with that change. Or null.
        searched: number of runs of its test's search without such a failure, if `fixed`.
        drawn: number of these whose scenarios are random.
        elsewhere: id of the finding with the same failure, if its scenario passes and it is still failing elsewhere.
        reference_passes: whether the reference passes the scenario of a replay, or null.
        severity: `kind`, `collision` or `check`; `value`, the closing speed [m/s] or by how much the check is broken
            [`unit`]; `margin` and `name` of a check. Null if it passes or has no measure.
        severity_before: the same for the reference, if it fails as well, or null.
        xfail: `reason` and `until` of an accepted failure, or null.
    """
    values = (copy(nothing) if seen is None or of is None else of(seen) for nothing, of in FINDING.values())
    return dict(zip(FINDING, values, strict=True)) | more


def to_text(session: Session, *, root: str, day: str | None = None) -> str:
    """Write the record of a session as JSON with sorted keys; paths in texts are relative to the folder ``root``.

    Keys:
        exit: pytest's exit code; null while the session runs, or if it was killed.
        day: the value of `--pafot-today`, or null.
        versions: of the packages on which a run depends.
        searches, findings: in the order of node ids; `findings` are new or replayed.
        orphans: folders with saved scenarios that the session left out.
        warnings, problems: saved scenarios that are no longer accepted, and what went wrong outside the tests.
    """
    same = partial(portable, root=root)
    told = {node_id: {"result": session.results.get(node_id, "")} for node_id in (*session.searches, *session.seen)}
    reasons = {node_id: same(reason) for node_id, reason in session.reasons.items()}
    findings = {
        node_id: finding_entry(
            seen,
            **told[node_id],
            headline=same(seen.headline),
            detail=same(seen.detail),
            replay=session.command(seen, "python", "-m", "pytest"),
        )
        for node_id, seen in session.findings.items()
    }
    for node_id, saved in session.unread.items():
        known = {"node_id": node_id, "detail": reasons[node_id], "result": session.results.get(node_id, "")}
        findings.setdefault(node_id, finding_entry(None, **saved, **known))
    # A search that runs now has an empty record, which is what a session that is killed leaves of it.
    searches = [
        {each.name: getattr(search, each.name) for each in fields(Search) if each.name not in NOT_WRITTEN}
        | {"runs": search.runs, "failing": search.failing, "finds": [find.id for find in search.finds]}
        | {"failures": sorted(({"id": id_, "signature": shown.told} for id_, shown in search.failures), key=str)}
        | {**told[node_id], "message": reasons.get(node_id, "")}
        for node_id, search in sorted(session.searches.items())
    ]
    folders, gone = (Counter(file.rpartition("/")[0] for file in files) for files in (session.left, session.fails))
    expected, _, advice = ADVICE.partition("; ")
    data = {
        "pafot_json": VERSION,
        "exit": session.exit,
        "day": day,
        "versions": installed_versions(),
        "searches": searches,
        "findings": [findings[node_id] for node_id in sorted(findings)],
        "orphans": [
            {"folder": folder, "files": count, "expected": expected, "way_out": advice, "is_gone": folder in gone}
            for folder, count in sorted(folders.items())
            if session.exit is not None
        ],
        "warnings": sorted(session.warnings),
        "problems": session.problems,
    }
    return quiet_json(json.dumps(data, indent=2, sort_keys=True, default=asdict)) + "\n"


# The result of a session in a few lines of Markdown, for the page of a CI job.
#
# Texts from users, files and exceptions appear as they are: nothing in them becomes markup, a mention or a link.

MAX_LISTED = 20
"""The largest number of entries that a list in the summary names. Any more are only counted."""
MAX_TOLD = 5
"""The largest number of failures in the summary, over all of its lists."""


def markdown(session: Session, page: str = "") -> str:
    """Return the summary of a session; empty if nothing in the session concerned this plugin.

    ``page`` is the path of the report page; empty without one.
    """
    where, rest = further(page)
    is_used = session.searches or session.seen or session.unread or session.left or session.problems
    return "\n".join(_lines(session, f"see {code(where)}{rest}")) + "\n" if is_used else ""


def _lines(session: Session, rest: str) -> Iterator[str]:
    groups: dict[str, list[list[str]]] = {status: [] for status in GROUPS}
    for seen in sorted(session.findings.values(), key=lambda seen: seen.rank):
        groups[seen.label].append(list(_finding_lines(seen, session)))
    for node_id, saved in sorted(session.unread.items()):
        if node_id not in session.seen:
            told = f"{code(saved['test'])}: {plain(session.reasons[node_id])}"
            groups[UNREAD].append([f"- {told}", f"  <br>{code(saved['replay'])}"])
    counts = [f"{len(group)} {status}" for status, group in groups.items() if group]
    yield f"### pafot: {', '.join([*([] if groups['new'] else ['nothing new']), *counts])}"
    yield ""
    yield from _search_lines(session)
    left = MAX_TOLD
    for status, group in groups.items():
        if group:
            yield from ("", f"**{GROUPS[status]}**", "")
            is_failure = status not in ("accepted", "passes", "fixed")
            most = left if is_failure else MAX_LISTED
            left -= min(most, len(group)) if is_failure else 0
            for lines in group[:most]:
                yield from lines
            others = f"{len(group) - most} more" if most else f"{len(group)}"
            yield from ([f"- ... and {others}: {rest}" if most else f"- {others}: {rest}"] if len(group) > most else [])
    searches = [session.searches[node_id] for node_id in sorted(session.searches)]
    # The new findings of the others make these fail.
    failed = [each.node_id for each in searches if session.results.get(each.node_id) in RESULTS[-2:] and not each.finds]
    faulty = [f"{code(node_id)}: {plain(session.reasons.get(node_id, ''))}" for node_id in failed]
    yield from _listed("Searches that failed", faulty)
    lost = sorted({file.rpartition("/")[0] for file in session.left})
    yield from _listed("Saved scenarios that were left out", [f"{code(each)}: {plain(ADVICE)}" for each in lost])
    yield from _listed("Warnings", [plain(each) for each in sorted(session.warnings)])
    yield from _listed("Problems", [plain(each) for each in session.problems])


def _search_lines(session: Session) -> Iterator[str]:
    """Yield a line with the number of searches and runs, and with the options that repeat them."""
    ran = sorted(session.ended, key=lambda search: search.node_id)
    if not ran:
        yield "No search ran to its end." if session.searches else "No search was requested."
        return
    options = " or ".join(code(options) for options in dict.fromkeys(search.options for search in ran))
    count = "1 search" if len(ran) == 1 else f"{len(ran)} searches"
    yield f"{count}, {plural(sum(search.runs for search in ran), 'run')}; repeat with {options}."
    against = ", ".join(code(name) for name in dict.fromkeys(search.against for search in ran) if name)
    if against:
        yield f"A run counts as a failure only if {against} passes it."
    drawn = [search.random for search in ran if search.random["runs"]]
    failing, counted = (sum(each[name] for each in drawn for name in names) for names in (FAILING, ("runs",)))
    if failing:
        yield f"Of {plural(counted, 'random scenario')}, {failing} failed."
    for compared in dict.fromkeys(plain(search.compared) for search in ran if search.compared):
        yield f"{capitalised(compared)}."


def _finding_lines(seen: Seen, session: Session) -> Iterator[str]:
    """Yield two lines on a finding: its test and its description, then the command that replays it."""
    finding, now = seen.finding, seen.observed
    parts = [plain(seen.on_search), plain(seen.headline or ("" if now.elsewhere else seen.detail))]
    if seen.headline and now.reference_passes is not None:
        parts.append("the reference passes" if now.reference_passes else "the reference fails, too")
    worse = worsening(seen.severity, now.before) if now.before is not None else ""
    parts += [f"worse: {plain(worse)}"] if worse else []
    parts += [f"flaky: {plain(finding.flaky)}"] if finding.flaky else []
    parts += [plain(seen.unshrunk), plain(seen.worst)]
    if finding.xfail is not None and seen.label == "accepted":
        parts.append(f"accepted until {finding.xfail_until}: {plain(finding.xfail)}")
    yield f"- {': '.join([code(finding.test), '; '.join(filter(None, parts))])}"
    is_pass = seen.label in ("passes", "fixed")
    yield from (f"  <br>{plain(sentence)}" for sentence in ([] if is_pass else told(seen)[1:]))
    missing = "" if seen.path else f"not saved: {plain(seen.detail)}; "
    yield f"  <br>{missing}{code(session.command(seen, 'python', '-m', 'pytest'))}"


def _listed(title: str, entries: Sequence[str], most: int = MAX_LISTED) -> Iterator[str]:
    if entries:
        yield from ("", f"**{title}**", "", *(f"- {entry}" for entry in entries[:most]))
        yield from ([f"- ... and {len(entries) - most} more"] if len(entries) > most else [])
