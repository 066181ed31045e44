"""The result of a session for programs, as ``--pafot-json`` writes it.

The record contains no clock time and no duration, and nothing on processes, and its keys and entries are sorted. So the
same seed gives the same text, for any number of workers.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self

from pytest_pafot.campaign.events import SearchSummary
from pytest_pafot.findings.finding import Finding, portable
from pytest_pafot.findings.severity import Severity
from pytest_pafot.findings.shrink import size_of
from pytest_pafot.support.text import quiet_json

VERSION = 1
"""The version of the JSON layout. It grows if a key is removed or changes its meaning, not if a key is added."""

NEW, ERROR = "new", "error"
"""Statuses of a finding that are no labels of replays: found in this session; or could not be read or run."""

TERMINAL_ONLY = ("seconds", "process_notes")
"""The attributes of a search that are not written, because the same seed may give other values."""

SLOW = re.compile(r"(?<=^SlowDecision: a decision )took [\d.]+ s")
"""The measured time in the headline of a decision that took longer than ``decision_limit``."""

RESULTS = ("", "passed", "skipped", "xfailed", "failed", "error")
"""The results that an item can have, the worst last. The empty result is for an item that never ended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingRecord:
    """A saved scenario that was replayed, or a new finding.

    Attributes:
        node_id: node id of the item that replays it, in this session or, if it is new, from the next one on.
        id: name of its file without the suffix.
        test: node id of its test.
        status: `new`; the label of its replay; or `error` if it could not be read or run.
        result: result of the item: `passed`, `skipped`, `xfailed`, `failed`, `error`; empty if the item did not end.
        file: path relative to the rootdir; null if it was not saved.
        replay: the command that replays it.
        scenario: its scenario, which `pafot.Scenario.from_canonical` reads; null if its file could not be read.
        world: its world, as in its file; null if its file could not be read.
        headline: how the run ended, in a few words; empty if it passes.
        sentences: sentences on the collision: who did what, what was due or what avoids it, and who is responsible.
        detail: what differs from the file, such as a situation that did not occur, or why there is no file.
        signature: everything that makes two failures the same, in one line; of a saved scenario, for the failure in its
            file.
        kind: short name of the signature, from which ids are made.
        failure: name of the exception class.
        assertion: the failing assertion or the name of the check.
        outcome: how the run in the file ended.
        time: time of the event in the file [s].
        responsible: `ego`, `npc`, `both` or `none`.
        preventable_by: reference drivers that avoid it.
        size: size of the scenario, in words.
        traffic: how the NPCs drive, in words; empty for the paper's traffic.
        runs: number of runs that failed in this way, if it is a new finding; 0 for a saved scenario, whose runs are in
            `known` of the search.
        seed: seed of the search that found it, derived from its base seed.
        algorithm: algorithm that found it.
        against: the reference that passed in this scenario when it was found; empty if there was none.
        flaky: what differed when it was run again, as in the file; null if the file does not say so.
        unshrunk: why a new finding is not confirmed or not fully shrunk yet; empty if it is.
        severity: how bad this session's failure is in the scenario of the file: `kind`, which is `collision` or
            `check`; `value`, the closing speed at the impact [m/s], or by how much the check is broken [`unit`], null
            if it measured no number; `delta_v` of a collision, for equal masses [m/s]; `margin` and `name` of a check.
            Null if it passes, or if its failure has no measure.
        severity_before: the same for the reference in this scenario, if it fails as well; null otherwise.
        xfail: `reason` and `until` (null for no end) of an accepted failure; null if it is not accepted.
    """

    node_id: str
    id: str
    test: str = ""
    status: str
    result: str = ""
    file: str | None = None
    replay: str = ""
    scenario: list[Any] | None = None
    world: Mapping[str, Any] | None = None
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
        """True if this session found it."""
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
        """Make a record of a finding; further keyword arguments are attributes of the record."""
        expect, until = finding.expect, finding.xfail_until
        accepted = {"reason": finding.xfail, "until": None if until is None else until.isoformat()}
        return cls(
            node_id=node_id,
            id=finding.id,
            status=status,
            test=finding.test,
            file=file,
            scenario=finding.scenario.plain(),
            world=dict(finding.world),
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
class OrphanRecord:
    """A folder of saved scenarios that no test replays.

    Attributes:
        folder: path relative to the rootdir.
        files: number of saved scenarios in it.
        expected: the test that the folder belongs to, and what was found instead of the test.
        way_out: what to do with the files: move or remove them.
        is_gone: true if the module or the function no longer exists, which makes a session under CI fail.
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
        exit: pytest's exit code; null while the session runs, and forever if its process was killed.
        versions: versions of the packages on which the result of a run depends.
        searches: in the order of node ids.
        findings: saved scenarios that were replayed, and new findings, in the order of node ids.
        merged: result of `--pafot-merge` for each test, and the reason if it failed.
        compared: a line for each side of a comparison with a reference, with its commit and its files, a line for files
            that were copied into a revision, and one for each reference with which there was nothing to compare.
        orphans: folders of saved scenarios that no test runs any more, in the order of their paths.
        warnings: warnings about saved scenarios that are no longer accepted.
        problems: anything that went wrong outside the tests.
    """

    exit: int | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    searches: list[SearchSummary] = field(default_factory=list)
    findings: list[FindingRecord] = field(default_factory=list)
    merged: list[str] = field(default_factory=list)
    compared: list[str] = field(default_factory=list)
    orphans: list[OrphanRecord] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def is_empty(self) -> bool:
        """True if nothing in the session concerned this plugin."""
        return not any((self.searches, self.findings, self.merged, self.compared, self.orphans, self.problems))


def to_text(record: SessionRecord) -> str:
    """Write a record as JSON with sorted keys."""
    data = {"pafot_json": VERSION, **asdict(record)}
    for told, search in zip(data["searches"], record.searches, strict=True):
        told["finds"] = [find.id for find in search.finds]
        for name in TERMINAL_ONLY:
            del told[name]
    return quiet_json(json.dumps(data, indent=2, sort_keys=True)) + "\n"


def same_everywhere(text: str, root: str) -> str:
    """Return a text of this session without what differs between processes, such as a measured time or an id.

    ``root`` is the rootdir, to which paths become relative.
    """
    return SLOW.sub("took N s", portable(text, root))


def worst(results: Iterable[str]) -> str:
    """Return the worst of the results of an item's phases, which is the item's result."""
    return max(results, key=RESULTS.index, default="")
