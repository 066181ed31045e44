"""Comparison of two versions of a policy in the same situations, as values and in words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, Self

from pytest_pafot.campaign.verdict import Verdict, worst_margins
from pytest_pafot.episodes.rate import p_text
from pytest_pafot.findings.severity import WORSE_BY
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.proportions import difference, holm, mcnemar
from pytest_pafot.support.text import ascii_text, markdown_table, plural

LEVEL = 0.01
"""The largest adjusted p-value with which a line of the table claims a difference. Policies are compared after each
change: with 0.05, one of twenty changes without an effect might be called better or worse."""
APART = "not told apart"


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The result of one policy in one situation."""

    failed: bool | None = None  # None if unknown
    impact: float | None = None  # closing speed of the collision that made it fail [m/s]
    margins: Mapping[str, float] = field(default_factory=dict)  # the worst of each check with a bound, of a whole run

    @classmethod
    def of(cls, run: Run, verdict: Verdict) -> Self:
        """Return the result of a policy from a run and its verdict."""
        bounded = {each.name for each in verdict.checks if set(each.bounds.values()) != {None}}
        is_whole = run.collision is None and run.ads_error is None and run.outcome != "off_road"  # nothing cut it short
        margins = {name: worst for name, worst in worst_margins(verdict) if name in bounded and math.isfinite(worst)}
        failed = None if verdict.discarded or verdict.kind == "invalid" else verdict.failed
        severity = verdict.severity
        impact = severity.value if severity is not None and severity.kind == "collision" else None
        return cls(failed=failed, impact=impact, margins=margins if is_whole else {})


MEANINGS = {"common": " (both fail)", "introduced": " (only the new fails)", "fixed": " (only the old fails)"}
"""The explanation that the summary adds to the labels of saved scenarios."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """The results of both policies in one situation: a random scenario, an episode, a saved or a found scenario."""

    part: str  # ``scenarios``, ``episodes``, ``saved`` or ``alone``
    name: str  # a number, a seed, or the id of a finding
    old: Result
    new: Result
    told: str = ""  # an error in an episode, the label of a saved scenario, the headline of a finding
    worse: str = ""  # how much worse the failure of a saved scenario became

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> Self:
        """Return the row from the data that ``dataclasses.asdict`` made of it."""
        return cls(**{**data, "old": Result(**data["old"]), "new": Result(**data["new"])})


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedLine:
    """A line of the table, which compares both policies in one quantity, pair by pair."""

    what: str  # quantity that is compared
    words: tuple[str, str]  # words for it if the new policy is better, and if it is worse
    old: float  # number of pairs, or the median if there is a unit
    new: float
    better: int  # pairs in which the new policy is better
    worse: int
    pairs: int
    unit: str | None = None
    p: float = 1.0  # sign test, for failures McNemar's: two-sided, exact, adjusted for the number of lines

    @property
    def verdict(self) -> str:
        """The verdict of this line on the new policy: ``better``, ``worse`` or ``not told apart``."""
        return APART if self.p > LEVEL else "better" if self.better > self.worse else "worse"

    @property
    def interval(self) -> str:
        """The 95 % interval of the new policy's share minus the old policy's, in words; empty for medians."""
        low, high = difference(self.worse, self.better, self.pairs)
        return f"{100 * low:+.1f} to {100 * high:+.1f} points" if self.unit is None else ""

    @property
    def sentence(self) -> str:
        """The difference that the line claims, or the numbers of both policies if it claims no difference."""
        of = f" of {self.pairs}" if self.unit is None else f"{self.unit} in the median of {self.pairs}"
        old, new = (f"{value:.4g}" if self.unit is not None else str(value) for value in (self.old, self.new))
        if self.verdict == APART:
            how_sure = f"95 %: {self.interval}" if self.interval else f"better in {self.better}, worse in {self.worse}"
            return f"{self.what} ({new} against {old}{of}, {how_sure})"
        claim = f"{self.words[self.verdict == 'worse']} {self.what}"
        return f"{claim}: {new} instead of {old}{of} (p {p_text(self.p)})"


def _line(
    what: str, words: tuple[str, str], pairs: Iterable[tuple[float, float]], by: float = 0.0, unit: str | None = None
) -> ComparedLine:
    """Compare pairs (old, new) of numbers, where a difference of at most ``by`` counts as no difference.

    Higher numbers are worse, unless the first of the ``words`` is ``larger``.
    """
    pairs = list(pairs)
    rises, falls = (sum(sign * (new - old) > by for old, new in pairs) for sign in (1, -1))
    worse, better = (falls, rises) if words[0] == "larger" else (rises, falls)
    old, new = ((sum if unit is None else median)(side) for side in zip(*pairs, strict=True)) if pairs else (0.0, 0.0)
    p = mcnemar(worse, better)
    return ComparedLine(
        what=what, words=words, old=old, new=new, better=better, worse=worse, pairs=len(pairs), unit=unit, p=p
    )


def lines_of(rows: Iterable[PairRow]) -> list[ComparedLine]:
    """Compare two policies in all quantities for which there are pairs of results.

    Saved scenarios and scenarios that a search found are not included, because they were chosen for the failure of one
    of the two policies.
    """
    both = [row for row in rows if row.old.failed is not None and row.new.failed is not None]
    drawn = [row for row in both if row.part == "scenarios"]
    failures, crashes = (
        [(bool(row.old.failed), bool(row.new.failed)) for row in both if row.part == part]
        for part in ("scenarios", "episodes")
    )
    speeds = [(row.old.impact, row.new.impact) for row in drawn]
    impacts = [(old, new) for old, new in speeds if old is not None and new is not None]
    lines = [
        _line("failures of its own", ("fewer", "more"), failures),
        _line("crashes in ordinary traffic", ("fewer", "more"), crashes),
        _line("impacts where both fail", ("milder", "harder"), impacts, WORSE_BY["collision"], " m/s"),
    ]
    for name in sorted({name for row in drawn for name in row.old.margins}):
        of_both = [(row.old.margins, row.new.margins) for row in drawn]
        margins = [(old[name], new[name]) for old, new in of_both if name in old and name in new]
        lines.append(_line(f"margins of {name}", ("larger", "smaller"), margins, WORSE_BY["check"], ""))
    lines = [line for line in lines if line.pairs]
    adjusted = holm([line.p for line in lines])
    return [replace(line, p=p) for line, p in zip(lines, adjusted, strict=True)]


def verdict_of(lines: Iterable[ComparedLine]) -> str:
    """Return the verdict on the new policy: ``better``, ``worse``, ``better and worse`` or ``not told apart``."""
    return " and ".join(sorted({line.verdict for line in lines} - {APART})) or APART


def sentence_of(old: str, new: str, lines: Sequence[ComparedLine]) -> str:
    """Return a sentence that says in which quantities the new policy is better or worse, and in which neither."""
    claims = [line.sentence for line in lines if line.verdict != APART]
    others = ", ".join(line.sentence for line in lines if line.verdict == APART)
    if not claims:
        return f"{new} is {APART} from {old}: {others or 'no run says anything of both'}"
    others = f"; {APART}: {others}" if others else ""
    return f"{new} is {verdict_of(lines)} than {old}: {'; '.join(claims)}{others}"


def text_of(old: str, new: str, rows: Sequence[PairRow]) -> str:
    """Return the sentence on two policies, the table and the notes, as Markdown."""
    lines = lines_of(rows)
    head = ["", "old", "new", "new better in", "new worse in", "of", "new - old, 95 %", "p, Holm", ""]
    table = [
        [f"{line.what}{'' if line.unit is None else f' [{line.unit.strip()}], median' if line.unit else ', median'}"]
        + [f"{each:.4g}" if line.unit is not None else str(each) for each in (line.old, line.new)]
        + [str(each) for each in (line.better, line.worse, line.pairs)]
        + [line.interval, f"{line.p:.2g}", line.verdict]
        for line in lines
    ]
    saved, notes = [row for row in rows if row.part == "saved"], []
    if saved:
        labels = Counter(row.told for row in saved).most_common()
        told = ", ".join(f"{count} {label}{MEANINGS.get(label, '')}" for label, count in labels)
        notes = [f"- {plural(len(saved), 'saved scenario')}: {told}"]
        notes += [f"  - introduced: {row.name}" for row in saved if row.told == "introduced"]
        notes += [f"  - worse: {row.name} {row.worse}" for row in saved if row.worse]
    for policy, is_new in ((new, True), (old, False)):
        found = [row for row in rows if row.part == "alone" and row.new.failed is is_new]
        notes += [f"- a search found {plural(len(found), 'kind')} of failure that only {policy} has"]
        notes += [f"  - {row.name}: {ascii_text(row.told)}" for row in found]
    errors = [row for row in rows if row.part == "episodes" and row.told]
    if errors:
        notes += [f"- errors in {plural(len(errors), 'episode')} count as crashes; seed {errors[0].name}: "]
        notes[-1] += ascii_text(errors[0].told)
    return "\n\n".join([f"{sentence_of(old, new, lines)}.", markdown_table(head, table), "\n".join(notes)]) + "\n"
