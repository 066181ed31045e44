"""The result of a session as JSON for ``--pafot-json``, and as Markdown for the page of a CI job.

The JSON contains no clock time, duration or process id, and is sorted. The same seed gives the same JSON for any number
of workers.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, fields
from functools import partial
from types import MappingProxyType
from typing import Any

from pytest_pafot.corpus.writer import scenario_data
from pytest_pafot.findings.finding import portable
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.findings.sighting import GROUPS, UNREAD, FoundElsewhere, Seen
from pytest_pafot.findings.verdict import worsening
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.report.session import ADVICE, RESULTS, Session
from pytest_pafot.report.terminal import (
    command_for,
    describe_failure,
    findings_of,
    random_failures,
    ranked,
    where_to_see_more,
)
from pytest_pafot.searches.events import Search
from pytest_pafot.support.process import installed_versions
from pytest_pafot.support.text import capitalised, code, plain, plural, quiet_json

# The version increases if a key is removed or gets a new meaning, but not if a key is added.
VERSION = 5

# Attributes of a search that only the terminal shows, because they may differ for the same seed.
NOT_WRITTEN = ("seconds", "process_notes")


# The entry of a finding whose file could not be read or run.
FINDING: Mapping[str, Any] = MappingProxyType({
    **dict.fromkeys((
        "node_id", "id", "test", "result", "replay", "headline", "detail", "kind", "failure", "assertion", "outcome",
        "size", "traffic", "algorithm", "against", "unshrunk", "elsewhere",
    ), ""),
    **dict.fromkeys((
        "file", "scenario", "world", "signature", "time", "takeover", "worst", "seed", "policy", "rate", "flaky",
        "moment", "reference_passes", "severity", "severity_before", "xfail",
    )),
    **dict.fromkeys(("runs", "searched", "drawn"), 0),
    "status": UNREAD, "sentences": [], "responsible": "none",
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
    if seen is None:
        return deepcopy(dict(FINDING)) | more  # a copy, because the caller may change its lists
    finding, now, moment = seen.finding, seen.replay, seen.moment
    expect, found = finding.expect, finding.found
    entry = {
        **FINDING,
        "node_id": seen.node_id,
        "id": seen.id,
        "test": finding.test,
        "status": seen.label,
        "file": seen.path or None,
        "scenario": scenario_data(finding.scenario),
        "world": dict(finding.world),
        "headline": seen.headline,
        "sentences": list(seen.sentences),
        "detail": seen.detail,
        "signature": finding.signature.told,
        "kind": finding.signature.slug,
        "failure": expect.failure,
        "assertion": expect.assertion,
        "outcome": expect.outcome,
        "time": expect.time,
        "responsible": seen.responsible,
        "takeover": expect.takeover,
        "size": size_of(finding.scenario, finding.longest_run),
        "traffic": STYLES[finding.scenario.traffic].described,
        "worst": {name: asdict(seen.alike)[name] for name in ("number", "severity")},
        "seed": found.seed,
        "algorithm": found.algorithm,
        "policy": found.policy,
        "against": expect.against,
        "flaky": finding.flaky,
        "unshrunk": seen.unshrunk,
        "searched": getattr(now.search, "runs", 0),
        "drawn": getattr(now.search, "drawn", 0),
        "elsewhere": getattr(now.search, "id", ""),
        "reference_passes": now.reference_passes,
    }
    if seen.is_new:
        entry["runs"] = 1 + seen.alike.runs
    if finding.rate is not None:
        entry["rate"] = {**asdict(finding.rate), "of": finding.drawn, "now": None}
        if now.rate is not None:
            entry["rate"]["now"] = asdict(now.rate)
    if moment is not None:
        conditions = [{"about": whom, "evaluated": list(rows)} for whom, rows in moment.conditions]
        entry["moment"] = {**asdict(moment), "conditions": conditions}
    if seen.severity is not None:
        entry["severity"] = asdict(seen.severity)
    if now.before is not None:
        entry["severity_before"] = asdict(now.before)
    if finding.xfail_until is not None:
        entry["xfail"] = {"reason": finding.xfail, "until": finding.xfail_until.isoformat()}
    return entry | more


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
    # Paths differ between machines, but the same seed must give the same JSON.
    same = partial(portable, root=root)
    reasons = {node_id: same(reason) for node_id, reason in session.reasons.items()}
    findings = {}
    for node_id, saved in session.unread.items():
        result = session.results.get(node_id, "")
        known = {"node_id": node_id, "detail": reasons[node_id], "result": result}
        findings[node_id] = finding_entry(None, **saved, **known)
    for node_id, seen in findings_of(session).items():
        findings[node_id] = finding_entry(
            seen,
            result=session.results.get(node_id, ""),
            headline=same(seen.headline),
            detail=same(seen.detail),
            replay=command_for(session, seen, "python", "-m", "pytest"),
        )
    searches = []
    # A running search has an empty record, which remains if the session is killed.
    for node_id, search in sorted(session.searches.items()):
        entry = {each.name: getattr(search, each.name) for each in fields(Search)}
        for name in NOT_WRITTEN:
            del entry[name]
        failures = [{"id": id_, "signature": shown.told} for id_, shown in search.failures]
        searches.append(
            {
                **entry,
                "runs": search.runs,
                "failing": search.failing,
                "finds": [find.id for find in search.finds],
                "failures": sorted(failures, key=str),
                "result": session.results.get(node_id, ""),
                "message": reasons.get(node_id, ""),
            }
        )
    orphans = []
    if session.exit is not None:
        gone = {_folder_of(file) for file in session.fails}
        expected, _, advice = ADVICE.partition(". ")
        for folder, count in sorted(Counter(map(_folder_of, session.left)).items()):
            about = {"folder": folder, "files": count, "is_gone": folder in gone}
            orphans.append({**about, "expected": expected, "way_out": advice})
    data = {
        "pafot_json": VERSION,
        "exit": session.exit,
        "day": day,
        "versions": installed_versions(),
        "searches": searches,
        "findings": [findings[node_id] for node_id in sorted(findings)],
        "orphans": orphans,
        "warnings": sorted(session.warnings),
        "problems": session.problems,
    }
    return quiet_json(json.dumps(data, indent=2, sort_keys=True, default=asdict)) + "\n"


def _folder_of(file: str) -> str:
    return file.rpartition("/")[0]


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
    is_driven = session.searches or session.seen or session.unread
    if not (is_driven or session.left or session.problems):
        return ""
    return "\n".join(_lines(session, f"see {code(where)}{rest}")) + "\n"


def _lines(session: Session, rest: str) -> Iterator[str]:
    groups: dict[str, list[list[str]]] = {status: [] for status in GROUPS}
    for seen in ranked(findings_of(session).values()):
        groups[seen.result].append(list(_finding_lines(seen, session)))
    for node_id, saved in sorted(session.unread.items()):
        if node_id not in session.seen:
            told = f"{code(saved['test'])}: {plain(session.reasons[node_id])}"
            groups[UNREAD].append([f"- {told}", f"  <br>{code(saved['replay'])}"])
    counts = [f"{len(group)} {status}" for status, group in groups.items() if group]
    if not groups["new"]:
        counts.insert(0, "nothing new")
    yield f"### pafot: {', '.join(counts)}"
    yield ""
    yield from _search_lines(session)
    left = MAX_TOLD
    for status, group in groups.items():
        if not group:
            continue
        yield from ("", f"**{GROUPS[status]}**", "")
        most = MAX_LISTED
        # Failures take several lines each, so all groups of failures share a limit.
        if not status.startswith(("accepted", "passed")):
            most = left
            left -= min(left, len(group))
        for lines in group[:most]:
            yield from lines
        if most == 0:
            yield f"- {len(group)}: {rest}"
        elif len(group) > most:
            yield f"- ... and {len(group) - most} more: {rest}"
    faulty = []
    for node_id, search in sorted(session.searches.items()):
        # Any other search that failed did so because of its new findings, which are listed above.
        if session.results.get(node_id) in RESULTS[-2:] and not search.finds:
            faulty.append(f"{code(node_id)}: {plain(session.reasons.get(node_id, ''))}")
    yield from _listed("Searches that failed", faulty)
    lost = [f"{code(each)}: {plain(ADVICE)}" for each in sorted(set(map(_folder_of, session.left)))]
    yield from _listed("Saved scenarios that were not replayed", lost)
    yield from _listed("Warnings", [plain(each) for each in sorted(session.warnings)])
    yield from _listed("Problems", [plain(each) for each in session.problems])


def _search_lines(session: Session) -> Iterator[str]:
    ran = sorted(session.ended, key=lambda search: search.node_id)
    if not ran:
        yield "No search was completed." if session.searches else "No search was requested."
        return
    options = " or ".join(dict.fromkeys(code(search.options) for search in ran))
    count = "1 search" if len(ran) == 1 else f"{len(ran)} searches"
    yield f"{count}, {plural(sum(search.runs for search in ran), 'run')}; repeat with {options}."
    references = dict.fromkeys(code(search.against) for search in ran if search.against)
    if references:
        against = ", ".join(references)
        yield f"A run counts as a failure only if {against} passes the same scenario."
    drawn = [search for search in ran if search.random["runs"]]
    failing = sum(map(random_failures, drawn))
    if failing:
        counted = sum(search.random["runs"] for search in drawn)
        yield f"{failing} of {plural(counted, 'random scenario')} failed."
    for compared in dict.fromkeys(plain(search.compared) for search in ran if search.compared):
        yield f"{capitalised(compared)}."


def _finding_lines(seen: Seen, session: Session) -> Iterator[str]:
    finding, now = seen.finding, seen.replay
    parts = [plain(seen.on_search)]
    if seen.headline:
        parts.append(plain(seen.headline))
    elif not isinstance(now.search, FoundElsewhere):
        parts.append(plain(seen.detail))
    if seen.headline and now.reference_passes is not None:
        parts.append("the reference passes" if now.reference_passes else "the reference also fails")
    if now.before is not None and (worse := worsening(seen.severity, now.before)):
        parts.append(f"it became worse: it {plain(worse)}")
    if finding.flaky:
        parts.append(f"flaky: {plain(finding.flaky)}")
    parts += [plain(seen.unshrunk), plain(seen.worst)]
    if finding.xfail is not None and seen.label == "accepted":
        parts.append(f"accepted until {finding.xfail_until}: {plain(finding.xfail)}")
    told = "; ".join(filter(None, parts))
    yield f"- {code(finding.test)}: {told}"
    if not seen.result.startswith("passed"):
        for sentence in describe_failure(seen)[1:]:
            yield f"  <br>{plain(sentence)}"
    again = code(command_for(session, seen, "python", "-m", "pytest"))
    if not seen.path:
        again = f"not saved: {plain(seen.detail)}; {again}"
    yield f"  <br>{again}"


def _listed(title: str, entries: Sequence[str]) -> Iterator[str]:
    if entries:
        yield from ("", f"**{title}**", "", *(f"- {entry}" for entry in entries[:MAX_LISTED]))
    if len(entries) > MAX_LISTED:
        yield f"- ... and {len(entries) - MAX_LISTED} more"
