"""Merging: findings of other machines are run here, and the simplest of each kind is stored in a test's corpus."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pytest_pafot.campaign.replays import Replays
from pytest_pafot.corpus.layout import SUFFIX, files_in, relative
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.corpus.writer import CorpusWriteError, text_of, write
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import expectation
from pytest_pafot.findings.finding import NOT_ACCEPTED, Acceptance, Finding, of_failure
from pytest_pafot.findings.shrink import sort_key
from pytest_pafot.findings.signature import Signature
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.support.text import plural, visible

# The result of merging the corpora of several machines is the simplest finding of each kind.
#
# It is a join in the mathematical sense: the result and its file names depend only on the set of findings, not on the
# order of the folders, on repeated findings, or on whether the folders are merged at once or one after the other.

_NUMBERED = re.compile(r"(.+-[0-9a-f]{6})-\d+")
"""The pattern of an id that ends in a number, as :func:`~pytest_pafot.corpus.writer.free_path` appends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Candidate:
    """A saved scenario that fails in this session and may be stored: its file, its finding, its kind of failure."""

    saved: Saved
    finding: Finding
    kind: Signature


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """The result of a join.

    Attributes:
        kept: the candidates to store, by id, each with the ``xfail`` of its kind.
        conflicts: the kinds of failures whose candidates have different ``xfail``; nothing is stored for them.
    """

    kept: Mapping[str, Candidate]
    conflicts: Sequence[Sequence[Candidate]]


def join(candidates: Iterable[Candidate], taken: Iterable[str] = ()) -> Joined:
    """Return the simplest candidate of each kind of failure, by the order of shrinking, then by id.

    Of equal candidates, the first is chosen; a flaky candidate only if all of its kind are flaky. If several chosen
    candidates share an id, the simplest gets it, and ``-2`` is appended for the next candidate. Ids that are ``taken``,
    or that belong to a conflict, are not used.
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
        first = min(group, key=_order)
        best.append(replace(first, finding=first.finding.accepting(next(iter(accepted), NOT_ACCEPTED))))
    ids = {*taken, *(each.finding.id for group in conflicts for each in group)}
    kept: dict[str, Candidate] = {}
    for each in sorted(best, key=_order):
        kept[free_id(each.finding, {*ids, *kept})] = each
    return Joined(kept=kept, conflicts=conflicts)


def free_id(finding: Finding, taken: Collection[str]) -> str:
    """Return an id for a finding that is not taken: its own id without a number, or with the first free number."""
    stem = _stem(finding)
    number, name = 1, stem
    while name in taken:
        number += 1
        name = f"{stem}-{number}"
    return name


def acceptances(group: Iterable[Candidate]) -> set[Acceptance]:
    """Return the different ways in which files of one kind are accepted (``xfail``)."""
    return {each.finding.acceptance for each in group if each.finding.xfail is not None}


def _order(candidate: Candidate) -> tuple[bool, tuple[int, ...], str, str]:
    finding = candidate.finding
    # The text orders findings that are equal otherwise, such as the same scenario from two searches.
    text = text_of(finding.accepting(NOT_ACCEPTED))
    return finding.flaky is not None, sort_key(finding.scenario), _stem(finding), text


def _stem(finding: Finding) -> str:
    numbered = _NUMBERED.fullmatch(finding.id)
    return numbered[1] if numbered else finding.id


SHOWS_AGAIN = ("still failing", "introduced")
"""The labels of replays that show the failure for which their file was saved."""


@dataclass(frozen=True, slots=True)
class Merged:
    """The result of a merge: lines on the files to print, and errors that the user must correct."""

    lines: Sequence[str]
    errors: Sequence[str]


def merge(replays: Replays, folders: Iterable[Path], owner: str) -> Merged:
    """Merge the files of other folders into the corpus of a test. ``owner`` is written into crash records.

    A file of the corpus that fails takes part in the join, so it is replaced if another folder has a simpler
    file of the same kind. A file that does not fail stays unchanged. So does every file of a kind whose files have
    different ``xfail``. Nothing is written with ``save="none"``.
    """
    harness = replays.harness
    own = saved_in(harness.folder)
    distinct: dict[tuple[str, str], Saved] = {}
    for saved in [*own, *(each for folder in folders for each in saved_in(folder))]:
        content = ("", str(saved.path)) if saved.finding is None else (saved.id, text_of(saved.finding))
        distinct.setdefault(content, saved)  # Equal files run once. The file of this corpus is first.
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
    verb = f"to merge ({flag('save', 'none')})"
    if harness.request.settings.save != "none":
        errors += _write(result, harness.folder, old)
        verb = "merged"
    added = sum(each.saved.path not in old for each in result.kept.values())
    told = f"  {plural(added, 'saved scenario')} from other folders added, {len(old - kept)} of this corpus replaced"
    return Merged([f"{verb}: {harness.node_id}", told, *sorted(left)], sorted(errors))


def _replayed(replays: Replays, saved: Saved, owner: str) -> tuple[str, Signature | None]:
    """Replay a file; return its label, and its signature if it shows the failure for which the file was saved.

    Raises:
        RequestError: if the file cannot be read or run.
    """
    try:
        now = replays.labelled(saved, owner)
    except ProcessLostError as error:
        observed = expectation(error).signature
        return "drifted", observed if saved.finding is not None and saved.finding.signature == observed else None
    if now.label not in SHOWS_AGAIN or now.verdict.failure is None:
        return now.label, None
    return now.label, of_failure(now.run, now.verdict.failure)


def _conflict(group: Sequence[Candidate], root: Path) -> str:
    told = "; ".join(
        f"{relative(each.saved.path, root)}: {each.finding.accepted}" for each in group if each.finding.xfail
    )
    return (
        f"xfail: expected the same reason and day for a kind of failure, received {len(acceptances(group))} different "
        f"ones ({visible(told)}); write the same line in these files, and merge again"
    )


def _accepts(finding: Finding | None) -> Acceptance:
    return NOT_ACCEPTED if finding is None else finding.acceptance


def _write(result: Joined, folder: Path, old: set[Path]) -> list[str]:
    """Write the result of a merge, then remove the old files that it replaces; return error messages.

    If the process is killed meanwhile, each finding is in one or two files, and the next merge leaves one file. For
    that, a finding that replaces a file is first written under a free name, and renamed when everything is written.
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
            write(new, replace(each.finding, id=path.name.removesuffix(SUFFIX)), over=True)
        for new, path in replacing.items():
            new.replace(path)
        for path in old - targets.keys() - in_conflict:
            path.unlink(missing_ok=True)
    except (CorpusWriteError, OSError) as error:
        return [str(error)]
    return []
