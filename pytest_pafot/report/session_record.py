"""The result of a session for programs, as ``--pafot-json`` writes it.

The record contains no clock time and no duration, and nothing on processes, and its keys and entries are sorted. So the
same seed gives the same text, for any number of workers. Its day and its commit are what the options say.

The same result in a few lines of Markdown is for the page of a CI job.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.labels import GROUPS, Observed, label
from pytest_pafot.findings.severity import Severity, worsening
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.findings.sighting import Sighting, on_search
from pytest_pafot.model.vehicle_type import STYLES
from pytest_pafot.report.terminal import further, parameter_shares
from pytest_pafot.support.proportions import none_text
from pytest_pafot.support.text import capitalised, code, plain, plural, quiet_json

VERSION = 2
"""The version of the JSON layout. It grows if a key is removed or changes its meaning, not if a key is added."""

NOT_WRITTEN = ("outcomes", "responsibilities", "seconds", "process_notes")
"""The attributes of a search that only pages or the terminal show; of the last two, the same seed may give others."""

RESULTS = ("", "passed", "skipped", "xfailed", "failed", "error")
"""The results that an item can have, the worst last. The empty result is for an item that never ended."""
FAILED = ("failed", "error")


class Key(NamedTuple):
    """A key of the entry of a saved scenario or a new finding."""

    meaning: str
    nothing: Any  # its value in the entry of a file that could not be read or run
    of: Callable[[Sighting], Any] | None = None  # None for what only the end of the session knows


def _data(value: Any) -> dict[str, Any] | None:
    return None if value is None else asdict(value)


def _rate_of(sighting: Sighting) -> dict[str, Any] | None:
    then, now = sighting.finding.rate, sighting.observed
    if then is None:
        return None
    return asdict(then) | {"of": sighting.finding.drawn, "now": None if now is None else _data(now.rate)}


def _acceptance_of(finding: Finding) -> dict[str, Any] | None:
    until = finding.xfail_until
    return None if until is None else {"reason": finding.xfail, "until": until.isoformat()}


FINDING: Mapping[str, Key] = MappingProxyType({
    "node_id": Key("of the item that replays it, if new from the next session on.", "", lambda seen: seen.node_id),
    "id": Key("name of its file without the suffix.", "", lambda seen: seen.id),
    "test": Key("node id of its test.", "", lambda seen: seen.finding.test),
    "status": Key(
        "`new`; `no worse`, if new but not counted in a comparison with a reference; the label of its replay; or "
        "`error`, with which only ids, `test`, `result`, `file`, `replay` and `detail` are known.",
        str(label(Observed(is_error=True))), lambda seen: str(seen.label),
    ),
    "result": Key("`passed`, `skipped`, `xfailed`, `failed` or `error`; empty if the item did not end.", ""),
    "file": Key("path relative to the rootdir; null if not saved.", None, lambda seen: seen.path or None),
    "replay": Key("the command that replays it.", "", lambda seen: seen.command),
    "scenario": Key(
        "as in its file, for `pafot.Scenario.from_canonical`; null with `error`.",
        None, lambda seen: seen.finding.scenario.plain(),
    ),
    "world": Key("as in its file; null likewise.", None, lambda seen: dict(seen.finding.world)),
    "headline": Key("how the run ended; empty if it passes.", "", lambda seen: seen.headline),
    "sentences": Key("the sentences of the verdict on a collision.", [], lambda seen: list(seen.sentences)),
    "detail": Key("what differs from the file, why there is no file, or the error.", "", lambda seen: seen.detail),
    "signature": Key("what makes two failures the same.", "", lambda seen: seen.finding.signature.text),
    "kind": Key("short name of the signature, with which ids begin.", "", lambda seen: seen.finding.signature.slug),
    "failure": Key("as in `expect` of its file.", "", lambda seen: seen.finding.expect.failure),
    "assertion": Key("as in `expect` of its file.", "", lambda seen: seen.finding.expect.assertion),
    "outcome": Key("as in `expect` of its file.", "", lambda seen: str(seen.finding.expect.outcome)),
    "time": Key("as in `expect` of its file.", None, lambda seen: seen.finding.expect.time),
    "responsible": Key("`ego`, `npc`, `both` or `none`.", "none", lambda seen: seen.responsible),
    "preventable_by": Key(
        "names of reference drivers that avoid it.", [], lambda seen: list(seen.finding.expect.preventable_by),
    ),
    "size": Key(
        "size of the scenario in words.", "", lambda seen: size_of(seen.finding.scenario, seen.finding.longest_run),
    ),
    "traffic": Key(
        "how the NPCs drive, in words; empty for the paper's.",
        "", lambda seen: STYLES[seen.finding.scenario.traffic].described,
    ),
    "runs": Key("number of runs that failed so; 0 for a saved scenario (see `known` of the search).", 0),
    "seed": Key("as in `found` of its file.", None, lambda seen: seen.finding.found.seed),
    "algorithm": Key("as in `found` of its file.", "", lambda seen: seen.finding.found.algorithm),
    "against": Key("the reference that passed then; empty without one.", "", lambda seen: seen.finding.expect.against),
    "rate": Key(
        "of a policy that draws random numbers: `failing` of `runs`, each with another seed if `of` is `seeds`; of a "
        "replay also `now`, with `failing` and `runs`.",
        None, _rate_of,
    ),
    "flaky": Key("what differed when it was run again, or null.", None, lambda seen: seen.finding.flaky),
    "unshrunk": Key("that no time was left to confirm it, or to shrink it fully.", "", lambda seen: seen.unshrunk),
    "moment": Key(
        "the last decision that could have avoided it: `time` [s], `npc`, and in words: `seen`, where the policy saw "
        "the NPC; `action`, its answer; `hidden`, the answer with the NPC hidden (empty for the same, null if "
        "unknown); `otherwise`, the smallest change of the NPC that changes it; `reference`, the reference's answer; "
        "`conditions`, pairs of whom conditions are about (`NPC 1`, `no NPC, or unknown which`, or empty if "
        "nothing is known) and of those that it evaluated, first those that come out otherwise with that change. "
        "Or null.",
        None, lambda seen: _data(seen.moment),
    ),
    "searched": Key(
        "number of runs of its test's search without such a failure, if `fixed`.",
        0, lambda seen: seen.observed.searched if seen.observed else 0,
    ),
    "drawn": Key(
        "number of these whose scenarios are random.",
        0, lambda seen: seen.observed.drawn if seen.observed else 0,
    ),
    "elsewhere": Key(
        "id of the finding with the same failure, if its scenario passes and it is still failing elsewhere.",
        "", lambda seen: seen.observed.elsewhere if seen.observed else "",
    ),
    "reference_passes": Key(
        "whether the reference passes the scenario of a replay, or null.",
        None, lambda seen: seen.observed.reference_passes if seen.observed else None,
    ),
    "severity": Key(
        "`kind`, `collision` or `check`; `value`, the closing speed [m/s] or by how much the check is broken [`unit`]; "
        "`margin` and `name` of a check. Null if it passes or has no measure.",
        None, lambda seen: _data(seen.severity),
    ),
    "severity_before": Key(
        "the same for the reference, if it fails as well, or null.",
        None, lambda seen: _data(seen.severity_before),
    ),
    "xfail": Key(
        "`reason` and `until` of an accepted failure, or null.",
        None, lambda seen: _acceptance_of(seen.finding),
    ),
})  # fmt: skip
"""The keys of an entry on a saved scenario that was replayed, or on a new finding."""


def finding_entry(sighting: Sighting | None, **more: Any) -> dict[str, Any]:
    """Return the entry of a finding for programs; without a sighting, of a file that could not be read or run.

    ``more`` are the values of further keys, or of those that the end of the session changes.
    """
    values = (copy(key.nothing) if sighting is None or key.of is None else key.of(sighting) for key in FINDING.values())
    return dict(zip(FINDING, values, strict=True)) | more


@dataclass(frozen=True, slots=True, kw_only=True)
class OrphanRecord:
    """A folder with saved scenarios that the session left out.

    Attributes:
        folder, files: path relative to the rootdir, and the number of these saved scenarios.
        expected: what was expected of the session.
        way_out: what to do with the files.
        is_gone: true if the session fails by it.
    """

    folder: str
    files: int
    expected: str
    way_out: str
    is_gone: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionRecord:
    """The record of a whole session.

    Attributes:
        exit: pytest's exit code; null while the session runs, or if it was killed.
        commit, day: values of `--pafot-commit` and `--pafot-today`, or null.
        versions: of the packages on which a run depends.
        searches, findings: in the order of node ids; `findings` are new or replayed.
        orphans: folders with saved scenarios that the session left out.
        warnings, problems: saved scenarios that are no longer accepted, and what went wrong outside the tests.
    """

    exit: int | None = None
    commit: str | None = None
    day: str | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    searches: list[SearchSummary] = field(default_factory=list)
    findings: list[dict[str, Any]] = field(default_factory=list)
    orphans: list[OrphanRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def to_text(record: SessionRecord) -> str:
    """Write a record as JSON with sorted keys."""
    ids = [[sighting.id for sighting in search.finds] for search in record.searches]
    data = {"pafot_json": VERSION, **asdict(replace(record, searches=[replace(s, finds=()) for s in record.searches]))}
    for search, finds in zip(data["searches"], ids, strict=True):
        search["finds"] = finds
        for name in NOT_WRITTEN:
            del search[name]
    return quiet_json(json.dumps(data, indent=2, sort_keys=True)) + "\n"


def worst(results: Iterable[str]) -> str:
    """Return the worst of the results of an item's phases, which is the item's result."""
    return max(results, key=RESULTS.index, default="")


# The result of a session in a few lines of Markdown, for the page of a CI job.
#
# Texts from users, files and exceptions appear as they are: nothing in them becomes markup, a mention or a link.

MAX_LISTED = 20
"""The largest number of entries that a list in the summary names. Any more are only counted."""
MAX_TOLD = 5
"""The largest number of failures in the summary, over all of its lists."""


def markdown(record: SessionRecord, page: str = "") -> str:
    """Return the summary of a session; empty if nothing in the session concerned this plugin.

    ``page`` is the path of the report page; empty without one.
    """
    where, rest = further(page)
    is_used = record.searches or record.findings or record.orphans or record.problems
    return "\n".join(_lines(record, f"see {code(where)}{rest}")) + "\n" if is_used else ""


def _lines(record: SessionRecord, rest: str) -> Iterator[str]:
    groups: dict[str, list[dict[str, Any]]] = {status: [] for status in GROUPS}
    for entry in record.findings:
        groups[entry["status"]].append(entry)
    counts = [f"{len(group)} {status}" for status, group in groups.items() if group]
    yield f"### pafot: {', '.join([*([] if groups['new'] else ['nothing new']), *counts])}"
    yield ""
    yield from _search_lines(record)
    left = MAX_TOLD
    for status, group in groups.items():
        if group:
            yield from ("", f"**{GROUPS[status]}**", "")
            is_failure = status not in ("accepted", "passes", "fixed")
            most = left if is_failure else MAX_LISTED
            left -= min(most, len(group)) if is_failure else 0
            for entry in sorted(group, key=_rank)[:most]:
                yield from _finding_lines(entry)
            others = f"{len(group) - most} more" if most else f"{len(group)}"
            yield from ([f"- ... and {others}: {rest}" if most else f"- {others}: {rest}"] if len(group) > most else [])
    for test, shares in parameter_shares(record.searches).items():
        worst_ones = [f"{code(share.parameters)} {share.result}" for share in shares if share.failing]
        yield from _listed(f"Parameters of {code(test)} that fail most", worst_ones, MAX_TOLD)
    failed = [each for each in record.searches if each.result in FAILED]
    faulty = [each for each in failed if not each.finds]  # their new findings did not make them fail
    yield from _listed("Searches that failed", [f"{code(each.node_id)}: {plain(each.message)}" for each in faulty])
    lost = [f"{code(each.folder)}: {plain(each.expected)}; {plain(each.way_out)}" for each in record.orphans]
    yield from _listed("Saved scenarios that were left out", lost)
    yield from _listed("Warnings", [plain(each) for each in record.warnings])
    yield from _listed("Problems", [plain(each) for each in record.problems])


def _search_lines(record: SessionRecord) -> Iterator[str]:
    """Yield a line with the number of searches and runs, and with the options that repeat them."""
    ran = [search for search in record.searches if search.began]
    if not ran:
        yield "No search ran to its end." if record.searches else "No search was requested."
        return
    options = " or ".join(code(options) for options in dict.fromkeys(search.options for search in ran))
    count = "1 search" if len(ran) == 1 else f"{len(ran)} searches"
    yield f"{count}, {plural(sum(search.runs for search in ran), 'run')}; repeat with {options}."
    against = ", ".join(code(name) for name in dict.fromkeys(search.against for search in ran) if name)
    if against:
        yield f"A run counts as a failure only if {against} passes it."
    drawn = [search for search in ran if search.random_runs]
    failing, others = (sum(getattr(each, name) for each in drawn) for name in ("random_failing", "random_otherwise"))
    if failing or others:
        checks, counted = (sum(getattr(each, name) for each in drawn) for name in ("random_checks", "random_runs"))
        more = [f"{checks} failed a check"] if checks else []
        more += [f"{others - checks} failed in other ways"] if others > checks else []
        told = none_text(counted) if not failing and len(drawn) == 1 else ""
        told += "".join(f", {each}" for each in more)
        yield f"Of {plural(counted, 'random scenario')} {failing} failed by the ego's fault{told}."
    for compared in dict.fromkeys(plain(search.compared) for search in ran if search.compared):
        yield f"{capitalised(compared)}."


def _rank(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the key that sorts findings of one group: the worst first, then those with the most runs."""
    severity = None if entry["severity"] is None else Severity(**entry["severity"])
    return *Severity.worst_first(entry["responsible"], severity), -entry["runs"], entry["node_id"]


def _finding_lines(entry: Mapping[str, Any]) -> Iterator[str]:
    """Yield two lines on a finding: its test and its description, then the command that replays it."""
    is_pass = entry["status"] in ("passes", "fixed")
    searched = on_search(entry["searched"], entry["drawn"], entry["elsewhere"])
    parts = [plain(searched), plain(entry["headline"] or ("" if entry["elsewhere"] else entry["detail"]))]
    if entry["headline"] and entry["reference_passes"] is not None:
        parts.append("the reference passes" if entry["reference_passes"] else "the reference fails, too")
    if entry["severity"] is not None and entry["severity_before"] is not None:
        worse = worsening(Severity(**entry["severity"]), Severity(**entry["severity_before"]))
        parts += [f"worse: {plain(worse)}"] if worse else []
    parts += [f"flaky: {plain(entry['flaky'])}"] if entry["flaky"] else []
    parts += [plain(entry["unshrunk"])] if entry["unshrunk"] else []
    xfail = entry["xfail"]
    if xfail is not None and entry["status"] == "accepted":
        parts.append(f"accepted until {xfail['until']}: {plain(xfail['reason'])}")
    yield f"- {': '.join(filter(None, [code(entry['test'] or entry['node_id']), '; '.join(filter(None, parts))]))}"
    moment = None if entry["moment"] is None else Moment(**entry["moment"])
    told = entry["sentences"] or ([] if moment is None else [str(moment)])
    yield from (f"  <br>{plain(sentence)}" for sentence in ([] if is_pass else told))
    missing = f"not saved: {plain(entry['detail'])}; " if entry["file"] is None else ""
    yield f"  <br>{missing}{code(entry['replay'])}"


def _listed(title: str, entries: Sequence[str], most: int = MAX_LISTED) -> Iterator[str]:
    if entries:
        yield from ("", f"**{title}**", "", *(f"- {entry}" for entry in entries[:most]))
        yield from ([f"- ... and {len(entries) - most} more"] if len(entries) > most else [])
