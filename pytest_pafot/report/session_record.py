"""The result of a session as JSON for ``--pafot-json``, and as Markdown for the page of a CI job.

The JSON contains no clock time, duration or process id, and is sorted. The same seed gives the same JSON for any number
of workers.
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

from pytest_pafot.corpus.writer import scenario_data
from pytest_pafot.findings.finding import portable
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.findings.sighting import GROUPS, Observed, Seen, label
from pytest_pafot.findings.verdict import worsening
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.report.session import ADVICE, RESULTS, Session
from pytest_pafot.report.terminal import FAILING, describe_failure, where_to_see_more
from pytest_pafot.searches.events import Search
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.text import capitalised, code, plain, plural, quiet_json

# The version increases if a key is removed or gets a new meaning, but not if a key is added.
VERSION = 5

# The label of a saved scenario that could not be read or run.
UNREAD = label(Observed(is_error=True))

# Attributes of a search that only the terminal shows, because they may differ for the same seed.
NOT_WRITTEN = ("seconds", "process_notes")


# For each key, its value if the file could not be read or run, and the function that returns it otherwise. The session
# supplies the values without a function.
FINDING: Mapping[str, tuple[Any, Callable[[Seen], Any] | None]] = MappingProxyType({
    "node_id": ("", lambda seen: seen.node_id),
    "id": ("", lambda seen: seen.id),
    "test": ("", lambda seen: seen.finding.test),
    "status": (UNREAD, lambda seen: str(seen.label)),
    "result": ("", None),
    "file": (None, lambda seen: seen.path or None),
    "replay": ("", None),
    "scenario": (None, lambda seen: scenario_data(seen.finding.scenario)),
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


def finding_entry(seen: Seen | None, **more: Any) -> dict[str, Any]:
    """Return a finding's JSON entry. None represents an unusable file.

    ``more`` contains values that only the session knows.

    Keys:
        node_id: node id of the item that replays it; a new finding has this item from the next session.
        id: name of its file without the suffix.
        test: node id of its test.
        status: `new`; `no worse` if it does not count in a comparison with a reference; the label of a replay; or
            `error`. For `error`, only ids, `test`, `result`, `file`, `replay` and `detail` are known.
        result: `passed`, `skipped`, `xfailed`, `failed` or `error`; empty if the item did not end.
        file: path, relative to the rootdir if possible; null if not saved.
        replay: command that replays it.
        scenario, world: as in its file; null for `error`.
        headline: how the run ended; empty if it passed.
        sentences: sentences of the verdict on a collision.
        detail: differences from the file, why there is no file, or the error.
        signature: what identifies the same failure; null for `error`.
        kind: short name of the signature, which starts the ids.
        failure, assertion, outcome, time: as in `expect` of its file.
        responsible: `ego`, `npc`, `both` or `none`.
        takeover: latest takeover by a careful driver that avoids the collision [s before the impact], or null.
        size: description of the scenario's size.
        traffic: description of the NPCs' driving style; empty for the paper's style.
        runs: number of runs that failed in this way; 0 for a saved scenario (see `known` of the search).
        worst: `number` (from 0) and `severity` of the worst of these runs.
        seed, algorithm, policy: as in `found` of its file.
        against: reference that passed the scenario when it was found; empty without a reference.
        rate: for a policy that draws random numbers, the number `failing` of `runs`, with different seeds if `of` is
            `seeds`. For a replay, `now` has the new numbers.
        flaky: the difference between two runs of its scenario, or null.
        unshrunk: why it was not confirmed or fully shrunk, such as a lack of time.
        moment: last decision that could have avoided it, or null: `time` [s]; `npc`; `seen`, where the policy saw the
            NPC; `action`, its response; `hidden`, the response with the NPC hidden (empty if it is the same, null
            if unknown); `otherwise`, the smallest change of the NPC that changes the response; `reference`, the
            response of the reference; `conditions` that the policy `evaluated`, and the vehicle that they are `about`.
        searched: if `fixed`, number of runs of the test's search, all without this failure.
        drawn: number of random scenarios among these.
        elsewhere: id of another finding with the same failure, if the scenario of this finding passes.
        reference_passes: whether the reference passes the scenario of a replay, or null.
        severity: `kind`, `collision` or `check`; `value`, the closing speed [m/s] or the amount by which the check
            fails [`unit`]; `margin` and `name` of a check. Null if it passes or cannot be measured.
        severity_before: the same for the reference; null unless it also fails.
        xfail: `reason` and `until` of an accepted failure, or null.
    """
    values = (
        copy(nothing) if seen is None or of is None else of(seen)
        for nothing, of in FINDING.values()
    )
    return dict(zip(FINDING, values, strict=True)) | more


def to_text(session: Session, *, root: str, day: str | None = None) -> str:
    """Return the record of a session as JSON with sorted keys.

    Paths in strings are made relative to the folder ``root``.

    Keys:
        exit: pytest's exit code; null while the session runs, or if it was killed.
        day: the value of `--pafot-today`, or null.
        versions: versions of the packages that affect a run.
        searches, findings: in the order of node ids; `findings` contains new and replayed ones.
        orphans: folders with saved scenarios that the session did not replay.
        warnings, problems: warnings, for example about expired acceptances and skipped tests; errors outside tests.
    """
    same = partial(portable, root=root)
    told = {
        node_id: {"result": session.results.get(node_id, "")}
        for node_id in (*session.searches, *session.seen)
    }
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
        known = {
            "node_id": node_id,
            "detail": reasons[node_id],
            "result": session.results.get(node_id, ""),
        }
        findings.setdefault(node_id, finding_entry(None, **saved, **known))
    # A running search has an empty record, which remains if the session is killed.
    searches = [
        {
            each.name: getattr(search, each.name)
            for each in fields(Search)
            if each.name not in NOT_WRITTEN
        }
        | {
            "runs": search.runs,
            "failing": search.failing,
            "finds": [find.id for find in search.finds],
        }
        | {
            "failures": sorted(
                ({"id": id_, "signature": shown.told} for id_, shown in search.failures), key=str
            )
        }
        | {**told[node_id], "message": reasons.get(node_id, "")}
        for node_id, search in sorted(session.searches.items())
    ]
    folders, gone = (
        Counter(file.rpartition("/")[0] for file in files)
        for files in (session.left, session.fails)
    )
    expected, _, advice = ADVICE.partition(". ")
    data = {
        "pafot_json": VERSION,
        "exit": session.exit,
        "day": day,
        "versions": installed_versions(),
        "searches": searches,
        "findings": [findings[node_id] for node_id in sorted(findings)],
        "orphans": [
            {
                "folder": folder,
                "files": count,
                "expected": expected,
                "way_out": advice,
                "is_gone": folder in gone,
            }
            for folder, count in sorted(folders.items())
            if session.exit is not None
        ],
        "warnings": sorted(session.warnings),
        "problems": session.problems,
    }
    return quiet_json(json.dumps(data, indent=2, sort_keys=True, default=asdict)) + "\n"


# The result of a session in a few lines of Markdown, for the page of a CI job.
#
# Strings from users, files and exceptions are escaped, so that nothing in them becomes markup, a mention or a link.

# The maximum number of entries in a list of the summary.
MAX_LISTED = 20
# The maximum number of failures that the summary describes, in all its lists together.
MAX_TOLD = 5


def markdown(session: Session, page: str = "") -> str:
    """Return a session's summary in Markdown, or an empty string if the session did not use this plugin.

    ``page`` is the path of the report page, or empty.
    """
    where, rest = where_to_see_more(page)
    is_used = session.searches or session.seen or session.unread or session.left or session.problems
    return "\n".join(_lines(session, f"see {code(where)}{rest}")) + "\n" if is_used else ""


def _lines(session: Session, rest: str) -> Iterator[str]:
    groups: dict[str, list[list[str]]] = {status: [] for status in GROUPS}
    for seen in sorted(session.findings.values(), key=lambda seen: seen.rank):
        groups[seen.result].append(list(_finding_lines(seen, session)))
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
            is_failure = not status.startswith(("accepted", "passed"))
            most = left if is_failure else MAX_LISTED
            left -= min(most, len(group)) if is_failure else 0
            for lines in group[:most]:
                yield from lines
            others = f"{len(group) - most} more" if most else f"{len(group)}"
            yield from (
                [f"- ... and {others}: {rest}" if most else f"- {others}: {rest}"]
                if len(group) > most
                else []
            )
    searches = [session.searches[node_id] for node_id in sorted(session.searches)]
    # Any other search that failed did so because of its new findings, which are listed above.
    failed = [
        each.node_id
        for each in searches
        if session.results.get(each.node_id) in RESULTS[-2:] and not each.finds
    ]
    faulty = [f"{code(node_id)}: {plain(session.reasons.get(node_id, ''))}" for node_id in failed]
    yield from _listed("Searches that failed", faulty)
    lost = sorted({file.rpartition("/")[0] for file in session.left})
    yield from _listed(
        "Saved scenarios that were not replayed",
        [f"{code(each)}: {plain(ADVICE)}" for each in lost],
    )
    yield from _listed("Warnings", [plain(each) for each in sorted(session.warnings)])
    yield from _listed("Problems", [plain(each) for each in session.problems])


def _search_lines(session: Session) -> Iterator[str]:
    ran = sorted(session.ended, key=lambda search: search.node_id)
    if not ran:
        yield "No search was completed." if session.searches else "No search was requested."
        return
    options = " or ".join(
        code(options) for options in dict.fromkeys(search.options for search in ran)
    )
    count = "1 search" if len(ran) == 1 else f"{len(ran)} searches"
    yield f"{count}, {plural(sum(search.runs for search in ran), 'run')}; repeat with {options}."
    against = ", ".join(
        code(name) for name in dict.fromkeys(search.against for search in ran) if name
    )
    if against:
        yield f"A run counts as a failure only if {against} passes the same scenario."
    drawn = [search.random for search in ran if search.random["runs"]]
    failing, counted = (
        sum(each[name] for each in drawn for name in names) for names in (FAILING, ("runs",))
    )
    if failing:
        yield f"{failing} of {plural(counted, 'random scenario')} failed."
    for compared in dict.fromkeys(plain(search.compared) for search in ran if search.compared):
        yield f"{capitalised(compared)}."


def _finding_lines(seen: Seen, session: Session) -> Iterator[str]:
    finding, now = seen.finding, seen.observed
    parts = [plain(seen.on_search), plain(seen.headline or ("" if now.elsewhere else seen.detail))]
    if seen.headline and now.reference_passes is not None:
        parts.append("the reference passes" if now.reference_passes else "the reference also fails")
    worse = worsening(seen.severity, now.before) if now.before is not None else ""
    parts += [f"it became worse: it {plain(worse)}"] if worse else []
    parts += [f"flaky: {plain(finding.flaky)}"] if finding.flaky else []
    parts += [plain(seen.unshrunk), plain(seen.worst)]
    if finding.xfail is not None and seen.label == "accepted":
        parts.append(f"accepted until {finding.xfail_until}: {plain(finding.xfail)}")
    yield f"- {': '.join([code(finding.test), '; '.join(filter(None, parts))])}"
    is_pass = seen.result.startswith("passed")
    yield from (
        f"  <br>{plain(sentence)}" for sentence in ([] if is_pass else describe_failure(seen)[1:])
    )
    missing = "" if seen.path else f"not saved: {plain(seen.detail)}; "
    yield f"  <br>{missing}{code(session.command(seen, 'python', '-m', 'pytest'))}"


def _listed(title: str, entries: Sequence[str], most: int = MAX_LISTED) -> Iterator[str]:
    if entries:
        yield from ("", f"**{title}**", "", *(f"- {entry}" for entry in entries[:most]))
        yield from ([f"- ... and {len(entries) - most} more"] if len(entries) > most else [])
