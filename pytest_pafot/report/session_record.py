"""What came of a session, for programs: the values of ``--pafot-json``, and their text.

No clock and no duration is in it, keys and entries are sorted: the same seed gives the same text, for any number of
workers.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Self

from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.support.text import quiet_json

VERSION = 1
"""Of the layout. A key that comes to it later leaves the version as it is; one that goes or changes raises it."""

NEW, ERROR = "new", "error"
"""Of the status of a finding, beside the labels of replays: found in this session; could not be read or run."""

RESULTS = ("", "passed", "skipped", "xfailed", "failed", "error")
"""Of an item, the worst last; empty for one that never came to its end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingRecord:
    """A saved scenario that was replayed, or a new finding.

    Attributes:
        node_id: of the item that replays it, in this session or, where it is new, from the next one on.
        id: name of its file without the suffix.
        test: node id of its test.
        status: `new`; the label of its replay; or `error` where it could not be read or run.
        result: of the item: `passed`, `skipped`, `xfailed`, `failed`, `error`; empty where it did not come to its end.
        file: relative to the rootdir; null where it was not saved.
        replay: the command that shows it again.
        headline: how the run ended, in a few words; empty where it passes.
        sentences: on the collision: who did what, what was due or what avoids it, and who is responsible.
        detail: what differs from the file, such as a situation that did not come up, or why there is none.
        signature: all that makes two failures the same, in one line; of what the file was saved for.
        kind: its short name, of which ids are made.
        failure: name of the exception class.
        assertion: the failing assertion or the name of the check.
        outcome: how the run in the file ended.
        time: of the event in the file [s].
        responsible: `ego`, `npc`, `both` or `none`.
        preventable_by: reference drivers that avoid it.
        size: of the scenario, in words.
        traffic: in which it is driven, in words; empty for the paper's.
        runs: of this session's searches that failed in this way.
        seed: of the search that found it.
        algorithm: that found it.
        against: the reference that passes where it fails; empty without one.
        flaky: what differed when it was run again; null where nothing did.
        unshrunk: why a new one is not yet as simple as it is to be; empty where it is.
        severity: how bad the failure of this session is, of the scenario in the file: `kind`, which is `collision` or
            `check`; `value`, the closing speed at the impact [m/s], or by how much the check is broken [`unit`], null
            where it measured no number; `delta_v` of a collision, for equal masses [m/s]; `margin` and `name` of a
            check. Null where it passes, and for what nothing measures.
        severity_before: the same of the reference in this scenario, where it fails as well; null otherwise.
        xfail: `reason` and `until` (null for good) with which the failure is accepted; null where it is not.
    """

    node_id: str
    id: str
    test: str = ""
    status: str
    result: str = ""
    file: str | None = None
    replay: str = ""
    headline: str = ""
    sentences: list[str] = field(default_factory=list)
    detail: str = ""
    signature: str = ""
    kind: str = ""
    failure: str = ""
    assertion: str = ""
    outcome: str = ""
    time: float | None = None
    responsible: str = "none"
    preventable_by: list[str] = field(default_factory=list)
    size: str = ""
    traffic: str = ""
    runs: int = 0
    seed: int | None = None
    algorithm: str = ""
    against: str = ""
    flaky: str | None = None
    unshrunk: str = ""
    severity: Mapping[str, Any] | None = None
    severity_before: Mapping[str, Any] | None = None
    xfail: Mapping[str, str | None] | None = None

    @property
    def is_new(self) -> bool:
        """Whether this session found it."""
        return self.status == NEW

    @classmethod
    def of(
        cls,
        finding: Finding,
        *,
        node_id: str,
        status: str,
        file: str | None,
        severity: Severity | None = None,
        severity_before: Severity | None = None,
        **told: Any,
    ) -> Self:
        """From a finding; what else is told are attributes of the record."""
        expect, until = finding.expect, finding.xfail_until
        accepted = {"reason": finding.xfail, "until": None if until is None else until.isoformat()}
        return cls(
            node_id=node_id,
            id=finding.id,
            status=status,
            test=finding.test,
            file=file,
            signature=finding.signature.text,
            kind=finding.signature.slug,
            failure=expect.failure,
            assertion=expect.assertion,
            outcome=str(expect.outcome),
            time=expect.time,
            responsible=expect.responsibility,
            preventable_by=list(expect.preventable_by),
            size=size_of(finding.scenario, finding.longest_run),
            traffic=finding.scenario.traffic.described,
            seed=finding.found.seed,
            algorithm=finding.found.algorithm,
            against=expect.against,
            flaky=finding.flaky,
            severity=None if severity is None else severity.data(),
            severity_before=None if severity_before is None else severity_before.data(),
            xfail=None if finding.xfail is None else accepted,
            **told,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchRecord:
    """A search that began, or whose item failed before.

    Attributes:
        node_id: of its item.
        result: of its item, as of a finding.
        message: why the item failed, in one line; empty where it did not.
        reason: why the search ended; empty where it did not begin, or its process died.
        algorithm: its name.
        profile: that the defaults came from.
        base_seed: by which it is repeated, with `--pafot-seed`.
        seed: of this search, derived from that.
        generations: that were finished.
        asked: generations that were asked for; null where the runs decide.
        budget: runs that were asked for; null where the generations decide.
        runs: simulated scenarios.
        shrink_runs: that were taken to simplify the findings, beside `runs`.
        known_runs: scenarios that were not run, since an earlier run showed what they do.
        failing: runs that the test rejected.
        invalid: runs in which two NPCs touched.
        npc: runs that are no failures as the NPC is at fault.
        unpreventable: as no reference driver avoids them.
        common: as the reference fails as well.
        rejected: that the test function declined.
        skipped: in which it skipped.
        no_interaction: runs in which no NPC came near the ego.
        reached: share of instructions whose cell was reached; null where no run tells.
        finds: ids of its new findings.
        unsaved: runs of further findings by id, which the limit of saved ones left out.
        known: failing runs by the id of the saved scenario that shows the same.
        random_failing: of the random scenarios at its beginning those that failed by the ego's fault, which is a
            collision that it answers for, alone or with the NPC.
        random_otherwise: those of them that failed in any other way, such as by a check or an error of the ADS.
        random_runs: all of those that say something of the ego.
        drawn: from what the scenarios were drawn, in one line.
        coverage: one line on the instructions that the runs came to.
        against: the reference that failures were held against; empty without one.
        warnings: of its health.
        notes: anything else.
    """

    node_id: str
    result: str = ""
    message: str = ""
    reason: str = ""
    algorithm: str = ""
    profile: str = ""
    base_seed: int | None = None
    seed: int | None = None
    generations: int = 0
    asked: int | None = None
    budget: int | None = None
    runs: int = 0
    shrink_runs: int = 0
    known_runs: int = 0
    failing: int = 0
    invalid: int = 0
    npc: int = 0
    unpreventable: int = 0
    common: int = 0
    rejected: int = 0
    skipped: int = 0
    no_interaction: int = 0
    reached: float | None = None
    finds: list[str] = field(default_factory=list)
    unsaved: Mapping[str, int] = field(default_factory=dict)
    known: Mapping[str, int] = field(default_factory=dict)
    random_failing: int = 0
    random_otherwise: int = 0
    random_runs: int = 0
    drawn: str = ""
    coverage: str = ""
    against: str = ""
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, summary: SearchSummary) -> Self:
        """From the summary of a search."""
        failing, runs = summary.random
        other = {
            "finds": [find.id for find in summary.finds],
            "warnings": list(summary.warnings),
            "notes": list(summary.notes),
            "random_failing": failing,
            "random_runs": runs,
        }
        same = {each.name: getattr(summary, each.name) for each in fields(cls) if hasattr(summary, each.name)}
        return cls(**same | other)

    @property
    def options(self) -> str:
        """By which the same search is asked for."""
        given = (("generations", self.asked), ("runs", self.budget), ("seed", self.base_seed))
        return " ".join(f"--pafot-{name}={value}" for name, value in given if value is not None)

    @property
    def began(self) -> bool:
        """Whether it ran, and told so at its end."""
        return bool(self.reason)


@dataclass(frozen=True, slots=True, kw_only=True)
class OrphanRecord:
    """A folder of saved scenarios that no test runs.

    Attributes:
        folder: relative to the rootdir.
        files: how many saved scenarios are in it.
        expected: the test that it is of, and what is there in its place.
        way_out: where the files may belong now, and how to remove them.
        is_gone: whether neither the module nor the function is there any more, by which a session under CI fails.
    """

    folder: str
    files: int
    expected: str
    way_out: str
    is_gone: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionRecord:
    """A session.

    Attributes:
        exit: pytest's exit code; null as long as the session runs, and for ever where its process was killed.
        versions: of the packages that decide how a run goes.
        searches: in the order of node ids.
        findings: saved scenarios that were replayed, and new findings, in the order of node ids.
        rates: a sentence for each test that counted crashes in ordinary traffic.
        merged: what `--pafot-merge` told of each test, and where it failed, why.
        orphans: folders of saved scenarios that no test runs any more, in the order of their paths.
        warnings: of saved scenarios that are no longer accepted, or that fail in the same way.
        problems: anything that went wrong beside the tests.
    """

    exit: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    searches: list[SearchRecord] = field(default_factory=list)
    findings: list[FindingRecord] = field(default_factory=list)
    rates: list[str] = field(default_factory=list)
    merged: list[str] = field(default_factory=list)
    orphans: list[OrphanRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def is_empty(self) -> bool:
        """Whether nothing in the session concerned this plugin."""
        return not any((self.searches, self.findings, self.rates, self.merged, self.orphans, self.problems))


def to_text(record: SessionRecord) -> str:
    """A record as JSON, keys sorted."""
    return quiet_json(json.dumps({"pafot_json": VERSION, **asdict(record)}, indent=2, sort_keys=True)) + "\n"


def command_for(what: str, *options: str) -> str:
    """The command that replays a file, or that searches again for a node id."""
    return shlex.join(["python", "-m", "pytest", what, *options])


def worst(results: Iterable[str]) -> str:
    """The result of an item from those of its phases."""
    return max(results, key=RESULTS.index, default="")
