"""What the corpora of several machines come to together: the simplest finding of each kind, under names that follow.

A join: what is kept depends on which findings there are, and neither on the order in which folders give them, nor on
how often one comes, nor on whether the folders come at once or one after the other.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date

from pytest_pafot.corpus.saved import Saved
from pytest_pafot.corpus.yaml_text import text_of
from pytest_pafot.findings.finding import Finding
from pytest_pafot.findings.shrink import sort_key
from pytest_pafot.findings.signature import Signature

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
    conflicts = [group for group in kinds.values() if len(acceptances(group)) > 1]
    best = [_best(group) for group in kinds.values() if group not in conflicts]
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


def _best(group: Sequence[Candidate]) -> Candidate:
    first = min(group, key=_order)
    reason, until = next(iter(acceptances(group)), (None, None))
    return replace(first, finding=replace(first.finding, xfail=reason, xfail_until=until))


def _order(candidate: Candidate) -> tuple[bool, tuple[int, ...], str, str]:
    finding = candidate.finding
    # The text tells apart what else is equal, such as two searches that have found the same scenario.
    text = text_of(replace(finding, xfail=None, xfail_until=None))
    return finding.flaky is not None, sort_key(finding.scenario), _stem(finding), text


def _stem(finding: Finding) -> str:
    numbered = _NUMBERED.fullmatch(finding.id)
    return numbered[1] if numbered else finding.id
