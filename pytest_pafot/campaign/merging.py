"""Merging: finds of other machines are run here, and the corpus of a test keeps the simplest of each kind."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from pytest_pafot.campaign.replays import Replays
from pytest_pafot.campaign.request import RequestError
from pytest_pafot.corpus.file_format import text_of
from pytest_pafot.corpus.layout import SUFFIX, files_in, relative
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.corpus.writer import CorpusWriteError, overwrite
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import expectation
from pytest_pafot.findings.finding import Finding, of_failure
from pytest_pafot.findings.shrink import sort_key
from pytest_pafot.findings.signature import Signature
from pytest_pafot.support.text import plural, visible

# What the corpora of several machines come to together: the simplest finding of each kind, under names that follow.
#
# A join: what is kept depends on which findings there are, and neither on the order in which folders give them, nor
# on how often one comes, nor on whether the folders come at once or one after the other.

_NUMBERED = re.compile(r"(.+-[0-9a-f]{6})-\d+")
"""An id to which :func:`~pytest_pafot.corpus.writer.free_path` has appended a number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A saved scenario that fails here: its file, its finding as it would be written, and the kind that it shows."""

    saved: Saved
    finding: Finding
    kind: Signature


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """What to keep, by id, with the ``xfail`` of its kind; and the kinds that have several."""

    kept: Mapping[str, Candidate]
    conflicts: Sequence[Sequence[Candidate]]


def join(candidates: Iterable[Candidate], taken: Iterable[str] = ()) -> Joined:
    """The simplest candidate of each kind: by the order of shrinking, then by id. Of equals the first.

    One that is flaky comes after all that are not, however simple it is. Ids are given anew to those that share one:
    the simplest has it, the next has ``-2`` behind it. None gets an id that is taken, or that a conflict is about.
    """
    kinds: dict[Signature, list[Candidate]] = {}
    for each in candidates:
        kinds.setdefault(each.kind, []).append(each)
    conflicts, best = [], []
    for group in kinds.values():
        accepted = acceptances(group)
        if len(accepted) > 1:
            conflicts.append(group)
            continue
        first, (reason, until) = min(group, key=_order), next(iter(accepted), (None, None))
        best.append(replace(first, finding=replace(first.finding, xfail=reason, xfail_until=until)))
    ids = {*taken, *(each.finding.id for group in conflicts for each in group)}
    kept: dict[str, Candidate] = {}
    for each in sorted(best, key=_order):
        kept[free_id(each.finding, {*ids, *kept})] = each
    return Joined(kept=kept, conflicts=conflicts)


def free_id(finding: Finding, taken: Collection[str]) -> str:
    """An id for a finding that is not taken: its own without a number behind it, or with the first that is free."""
    stem = _stem(finding)
    number, name = 1, stem
    while name in taken:
        number += 1
        name = f"{stem}-{number}"
    return name


def acceptances(group: Iterable[Candidate]) -> set[tuple[str, date | None]]:
    """The reasons with which a kind of failure is accepted, each with its last day."""
    return {(each.finding.xfail, each.finding.xfail_until) for each in group if each.finding.xfail is not None}


def _order(candidate: Candidate) -> tuple[bool, tuple[int, ...], str, str]:
    finding = candidate.finding
    # The text tells apart what else is equal, such as two searches that have found the same scenario.
    text = text_of(replace(finding, xfail=None, xfail_until=None))
    return finding.flaky is not None, sort_key(finding.scenario), _stem(finding), text


def _stem(finding: Finding) -> str:
    numbered = _NUMBERED.fullmatch(finding.id)
    return numbered[1] if numbered else finding.id


SHOWS_AGAIN = ("still failing", "introduced")
"""Labels of replays that show what their file was saved for."""


@dataclass(frozen=True, slots=True)
class Merged:
    """What to tell of a merge: what became of the files, and what is to be mended."""

    lines: Sequence[str]
    errors: Sequence[str]


def merge(replays: Replays, folders: Iterable[Path], owner: str) -> Merged:
    """Bring the files of other folders into the corpus of a test; ``owner`` is that of the crash record.

    Files of the corpus that fail are of the join, so that one of them goes where another folder has a simpler one of
    its kind. One that does not fail stays as it is, and so does every file of a kind with several reasons or days of
    ``xfail``. Nothing is written under ``save="none"``.
    """
    harness = replays.harness
    own = saved_in(harness.folder)
    distinct: dict[tuple[str, str], Saved] = {}
    for saved in [*own, *(each for folder in folders for each in saved_in(folder))]:
        content = ("", str(saved.path)) if saved.finding is None else (saved.id, text_of(saved.finding))
        distinct.setdefault(content, saved)  # Of equal ones one run is enough; the first is this corpus' own.
    candidates: list[Candidate] = []
    left: list[str] = []
    errors: list[str] = []
    for saved in distinct.values():
        try:
            label, kind = _replayed(replays, saved, owner)
        except RequestError as error:
            errors.append(str(error))
            continue
        if kind is not None and saved.finding is not None:
            finding = replace(saved.finding, test=harness.node_id)
            candidates.append(Candidate(saved=saved, finding=finding, kind=kind))
        elif saved not in own:
            left.append(visible(f"  not merged: {relative(saved.path, harness.root)}: {label} here"))
    failing = {each.saved.path for each in candidates}
    result = join(candidates, taken=[saved.id for saved in own if saved.path not in failing])
    errors += [_conflict(group, harness.root) for group in result.conflicts]
    kept = {each.saved.path for group in (result.kept.values(), *result.conflicts) for each in group}
    old = {saved.path for saved in own if saved.path in failing}
    verb = "to merge (--pafot-save=none)"
    if harness.request.settings.save != "none":
        errors += _write(result, harness.folder, old)
        verb = "merged"
    added = sum(each.saved.path not in old for each in result.kept.values())
    told = f"  {plural(added, 'saved scenario')} from other folders, {len(old - kept)} of before replaced"
    return Merged([f"{verb}: {harness.node_id}", told, *sorted(left)], sorted(errors))


def _replayed(replays: Replays, saved: Saved, owner: str) -> tuple[str, Signature | None]:
    """The label of a replay, and what it shows where that is what the file was saved for.

    Raises:
        RequestError: for a file that cannot be read or run.
    """
    try:
        label, run, verdict = replays.labelled(saved, owner)
    except ProcessLostError as error:
        observed = expectation(error).signature
        return "drifted", observed if saved.finding is not None and saved.finding.signature == observed else None
    if label not in SHOWS_AGAIN or verdict.failure is None:
        return label, None
    return label, of_failure(run, verdict.failure)


def _conflict(group: Sequence[Candidate], root: Path) -> str:
    told = "; ".join(
        f"{relative(each.saved.path, root)}: {each.finding.accepted}" for each in group if each.finding.xfail
    )
    return (
        f"xfail: expected one reason and one day for a kind of failure, received {len(acceptances(group))} "
        f"({visible(told)}); write the same in these files, and merge again"
    )


def _accepts(finding: Finding | None) -> tuple[str | None, date | None]:
    return (None, None) if finding is None else (finding.xfail, finding.xfail_until)


def _write(result: Joined, folder: Path, old: set[Path]) -> list[str]:
    """Write what is kept, then remove the old files that it replaces; what is wrong where that is not possible.

    Killed at any moment, it leaves each finding in one file or two, and merging again leaves one: what goes where a
    file lies already is written under a name that is free, and takes the place of that file once all is written.
    """
    targets = {folder / f"{id_}{SUFFIX}": each for id_, each in result.kept.items()}
    in_conflict = {each.saved.path for group in result.conflicts for each in group}
    taken = {*result.kept, *(path.name.removesuffix(SUFFIX) for path in files_in(folder))}
    replacing: dict[Path, Path] = {}
    try:
        for path, each in targets.items():
            if each.saved.path == path and _accepts(each.saved.finding) == _accepts(each.finding):
                continue
            new = path
            if os.path.lexists(path):
                new = folder / f"{free_id(each.finding, taken)}{SUFFIX}"
                taken.add(new.name.removesuffix(SUFFIX))
                replacing[new] = path
            overwrite(new, replace(each.finding, id=path.name.removesuffix(SUFFIX)))
        for new, path in replacing.items():
            new.replace(path)
        for path in old - targets.keys() - in_conflict:
            path.unlink(missing_ok=True)
    except (CorpusWriteError, OSError) as error:
        return [str(error)]
    return []
