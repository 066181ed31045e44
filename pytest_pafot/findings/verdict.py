"""The verdict of a test function on a run, with the identity of a failure and its severity.

Two failures are the same if all fields of their signatures are equal. So hundreds of collisions come down to a handful
of findings.
"""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache, total_ordering
from textwrap import dedent
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, cast, get_args

from pytest_pafot.attribution.mistakes import BY_FAULT, NOT_GIVEN_WAY, Manoeuvre
from pytest_pafot.attribution.responsibility import Fault, Mistake, Responsibility
from pytest_pafot.model.crossings import Kind, Origin, Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import Outcome, Side
from pytest_pafot.oracle.run import Check, CheckFailed, Run

MAX_ASSERTION = 200
MAX_SLUG = 32
NUMBER = "N"

_ADDRESS = re.compile(r"\b0x[0-9a-fA-F]+")
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|(?<![\w.])[-+]?(?:inf|nan)\b")
_PATH = re.compile(r"(?<!\w)(?:[A-Za-z]:)?(?:[\\/][\w.@~+-]+){2,}|[\w.-]+\.py\b(?::\d+)?")

PROCESS_CRASH = "ProcessCrash"
"""The name of the failure of a run whose process died, so that no exception names it."""

CHECK_FAILED = CheckFailed.__name__
"""The name of the failure of a check; its assertion is the name of the check."""

_OF_COLLISIONS = frozenset(
    {"collision", "responsibility", "attribution", "outcome", "second_opinion", "sentences", "explain"}
)  # fmt: skip
"""Attributes of a run that concern the collision: an assertion that uses one is about the collision."""

AT_ZONES = frozenset({"did-not-give-way", "entered-taken-zone"})
"""Faults that are about a zone; the place of the contact inside the zone does not matter."""

ZONES = tuple(
    f"{kind} from {'the ' if origin in ('left', 'right') else ''}{origin}"
    for kind in get_args(Kind)
    for origin in get_args(Origin)
)
"""The groups of zones, such as ``crossing from the left``; the many zones of a junction fall into few groups."""

_NO_SUBJECT = frozenset({"run", "not", "assert", "is", "in", "none", "true", "false", "and", "or", NUMBER.lower()})


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """The reason why a run fails.

    Attributes:
        kind: name of the exception class.
        message: message of the exception.
        assertion: source text of the failing assertion; empty if it is unknown.
        traceback: traceback worth saving in the file, such as that of an ADS that raised; otherwise empty.
        check: the check that failed, whose name is also in ``assertion``; None if something else failed.
    """

    kind: str
    message: str = ""
    assertion: str = ""
    traceback: str = ""
    check: Check | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Signature:
    """The identity of a failure; two failures are the same if all fields are equal.

    A failed check is identified by its name, and an assertion that is not about the collision by its text. The end of
    the run and the places of the NPCs depend on the traffic; they would split one property into many failures. For the
    same reason, a collision that the ego is responsible for is identified only by the ego's mistake, and at a zone also
    by the zone's kind and the NPC's origin. Any other collision is identified by its place and its manoeuvres.

    Attributes:
        failure: name of the exception class.
        assertion: the failing assertion (:func:`normalised`), without file, line, numbers and addresses.
        outcome: how the run ended; ``safe`` for a property (:attr:`is_property`).
        responsibility: ``ego`` if it is responsible for the collision, alone or with the NPC; ``npc``; ``none``.
        mistake: what the ego did wrong; None if it is not responsible for a collision.
        fault: the rule by which the ego is responsible; it is not compared, and only used for the :attr:`slug`.
        side: side of the ego that was hit; None without a collision, or if there is a fault.
        cell: cell of the NPC at the collision; None without a collision, or if there is a fault.
        zone: zone in which the NPC crossed the ego's way (:func:`zone_in_words`); None if it did not cross, or if there
            is a fault that is not about a zone.
        npc_manoeuvre, ego_manoeuvre: manoeuvres shortly before the collision; None without a collision, or if there is
            a fault.
        worse_than: in a search, the id of the accepted file of the same failure, if the collision is faster than all
            that were known when it was accepted (:meth:`.Finding.worst_known`); otherwise None.
    """

    failure: str
    assertion: str
    outcome: Outcome
    responsibility: Responsibility
    mistake: Mistake | None = None
    fault: Fault | None = field(default=None, compare=False, repr=False)
    side: Side | None = None
    cell: Cell | None = None
    zone: str | None = None
    npc_manoeuvre: Manoeuvre | None = None
    ego_manoeuvre: Manoeuvre | None = None
    worse_than: str | None = None

    @classmethod
    def of(cls, **facts: Any) -> Self:
        """Return the signature of a failure with these facts, without the facts that do not distinguish failures."""
        told = cls(**facts)
        ended = cls(
            failure=told.failure, assertion=told.assertion, outcome=told.outcome, responsibility=told.responsibility
        )
        if told.is_property:  # it is the same however its run went on
            return replace(ended, outcome=Outcome.SAFE, responsibility="none")
        if told.fault is not None:
            # At a zone the origin of the NPC says which way was not given; elsewhere the rule alone says the mistake.
            given = None if told.zone is None else NOT_GIVEN_WAY[cast("Origin", told.zone.rpartition(" ")[2])]
            known = given if told.fault == "did-not-give-way" else BY_FAULT.get(told.fault)
            at_zone = told.zone if told.fault in AT_ZONES else None
            mistake = told.mistake or known
            return replace(ended, responsibility="ego", mistake=mistake, fault=told.fault, zone=at_zone)
        return told if told.outcome is Outcome.COLLISION else replace(told, cell=None, zone=None)

    @property
    def is_property(self) -> bool:
        """True if the failure is not about how the run ended: a failed check, or an assertion on a measure.

        An assertion of which only the message is known, or that uses no attribute of a run, is taken as one on the end
        of the run.
        """
        if self.failure == CHECK_FAILED:
            return True
        if self.outcome in (Outcome.ADS_ERROR, Outcome.HANG):
            return False
        named, measures = _named(self.assertion)
        return bool(measures) and not named & _OF_COLLISIONS

    @property
    def told(self) -> dict[str, str]:
        """All compared fields in words, without those that are None, for programs."""
        compared = {each.name: getattr(self, each.name) for each in fields(self) if each.compare}
        words = {name: value.label if isinstance(value, Cell) else value for name, value in compared.items()}
        return {name: str(value) for name, value in words.items() if value is not None}

    @property
    def text(self) -> str:
        """The compared fields as JSON in one line, for reports that have only texts."""
        return json.dumps(self.told)

    @property
    def slug(self) -> str:
        """A short name for files, in lower-case letters, digits and hyphens: ``entered-lane``, ``rear-6``.

        Two different signatures may have the same slug, and two equal signatures different slugs.
        """
        if self.fault is not None:
            is_behind = self.fault == "entered-lane" and self.mistake == "kept-no-distance"
            whence = "" if self.zone is None else f"-{self.zone.rpartition(' ')[2]}"
            return "entered-behind" if is_behind else f"{self.fault}{whence}"
        if self.failure == CHECK_FAILED:
            return _kebab(self.assertion.lower()) or "check"
        outcome = self.outcome.replace("_", "-")
        if self.outcome is Outcome.COLLISION and self.side:
            subject: str = self.side
        elif self.outcome in (Outcome.ADS_ERROR, Outcome.HANG):
            subject = outcome
        else:
            words = re.findall(r"[a-z][a-z0-9_]*", self.assertion.lower())
            subjects = list(dict.fromkeys(word for word in words if word not in _NO_SUBJECT))
            subject = _kebab("-".join(subjects[:3])) or _kebab(self.failure.lower()) or outcome
        if self.zone is not None:
            kind, *_, whence = self.zone.split()
            return f"{subject}-{kind}-{whence}"
        return subject if self.cell is None else f"{subject}-{int(self.cell)}"


def zone_in_words(zone: Zone) -> str:
    """Return the group of a zone, one of :data:`ZONES`."""
    return f"{zone.kind} {zone.whence}"


def normalised(assertion: str, message: str = "") -> str:
    """Reduce a failing assertion to a text that does not vary from run to run or with unrelated edits.

    Source text is reduced to the tested expression, without message, comments, line breaks and needless brackets, and
    with ``N`` for each number. If ``assertion`` is no source text, its first line is used, or the first line of
    ``message``, with ``N`` for numbers, ``ADDRESS`` for addresses and ``PATH`` for files. The result has at most 200
    characters.
    """
    return (_from_source(assertion) or _from_message(assertion) or _from_message(message))[:MAX_ASSERTION].rstrip()


class _Numberless(ast.NodeTransformer):
    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        is_number = isinstance(node.value, (int, float, complex)) and not isinstance(node.value, bool)
        return ast.Name(id=NUMBER) if is_number else node

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        inner = self.visit(node.operand)
        signs_a_number = isinstance(node.op, (ast.USub, ast.UAdd)) and isinstance(inner, ast.Name)
        return inner if signs_a_number and inner.id == NUMBER else ast.UnaryOp(op=node.op, operand=inner)


@lru_cache(maxsize=64)
def _named(assertion: str) -> tuple[set[str], set[str]]:
    """Return all attributes in an expression, and the attributes of plain names (usually a run) except helper calls.

    In ``run.ego.jerk.max()`` all three are attributes, and ``ego`` is an attribute of the plain name ``run``. The
    helper call ``helpers.is_fine(run)`` adds nothing to the second set.
    """
    try:
        nodes = list(ast.walk(ast.parse(assertion, mode="eval")))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        cut = set(re.findall(r"\b[A-Za-z_]\w*\.(\w+)", assertion)) if len(assertion) > MAX_ASSERTION - 9 else set()
        return cut, cut  # the text was cut short, so it does not parse
    calls = (node for node in nodes if isinstance(node, ast.Call))
    helpers = [call.func for call in calls if any(isinstance(argument, ast.Name) for argument in call.args)]
    attributes = [node for node in nodes if isinstance(node, ast.Attribute)]
    measures = {each.attr for each in attributes if isinstance(each.value, ast.Name) and each not in helpers}
    return {each.attr for each in attributes}, measures


@lru_cache(maxsize=64)  # most failures of a search are at a few statements
def _from_source(assertion: str) -> str:
    try:
        body = ast.parse(dedent(assertion).strip()).body
        if len(body) != 1:
            return ""
        tested = body[0].test if isinstance(body[0], ast.Assert) else body[0]
        return " ".join(ast.unparse(_Numberless().visit(tested)).split())
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return ""  # not an expression that this interpreter can parse; it is treated as a message


def _from_message(message: str) -> str:
    line = next((line for line in message.splitlines() if line.strip()), "")
    line = _NUMBER.sub(NUMBER, _PATH.sub("PATH", _ADDRESS.sub("ADDRESS", line)))
    return " ".join("".join(character if character.isprintable() else " " for character in line).split())


def _kebab(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text)[:MAX_SLUG].strip("-")


PASSES = ("passed", "npc")
"""The kinds of verdicts on runs in which the test passes, or of which ``blame`` excludes the failure."""


@total_ordering
@dataclass(frozen=True, slots=True, kw_only=True)
class Severity:
    """The severity of a failure: larger is worse. Any collision is worse than any failed check.

    Collisions are compared by their closing speeds, and failed checks by their margins, which have no unit.

    Attributes:
        kind: ``collision`` or ``check``.
        value: the closing speed at the impact [m/s], which is the magnitude of the difference of the two velocities;
            for a check, the amount by which its bound is broken [unit]. None, the worst, if a check measured no finite
            number.
        unit: unit of ``value``.
        margin: negative margin of a check in units of its scale; None for a collision, or if ``value`` is None.
        name: name of the check; empty for a collision.
    """

    WORSE_BY: ClassVar[Mapping[str, float]] = MappingProxyType({"collision": 0.1, "check": 0.01})
    """The smallest difference at which a failure counts as worse: in closing speed [m/s], or in a check's margin."""

    kind: Literal["collision", "check"]
    value: float | None
    unit: str = ""
    margin: float | None = None
    name: str = ""

    @property
    def figure(self) -> str:
        """The value in short, without its unit."""
        if self.value is None:
            return "no finite number"
        return f"{self.value:.1f}" if self.kind == "collision" else f"{self.value:.3g}"

    def __str__(self) -> str:
        """Describe the failure, such as ``hits at 9.8 m/s``."""
        figure = f"{self.figure} {self.unit}".rstrip()
        return f"hits at {figure}" if self.kind == "collision" else f"breaks {self.name} by {figure}"

    def is_fault(self, responsible: str) -> bool:
        """Return whether the failure is a collision that the ego is responsible for, alone or with the NPC."""
        return self.kind == "collision" and responsible in ("ego", "both")

    @property
    def figures(self) -> tuple[int, float, float]:
        """The numbers by which two severities are compared first; larger is worse."""
        value = math.inf if self.value is None else self.value
        if self.kind == "collision":
            return 2, value, 0.0
        return 1, math.inf if self.margin is None else -self.margin, value

    @staticmethod
    def worst_first(responsible: str, severity: Severity | None) -> tuple[float, ...]:
        """Return a sort key for findings: collisions that the ego is responsible for first, then other failures.

        Each group is sorted from the worst, and failures without a measure are last. Callers put more important
        criteria before this key, and tie-breakers after it. ``responsible`` is ``ego``, ``npc``, ``both`` or ``none``.
        """
        if severity is None:
            return 1, 0, 0.0, 0.0
        return not severity.is_fault(responsible), *(-each for each in severity.figures)

    def __lt__(self, other: Severity) -> bool:
        return (self.figures, self.name, self.unit) < (other.figures, other.name, other.unit)


def severity_of(run: Run, failure: Failure) -> Severity | None:
    """Return how bad a failure of a run is; None for a failure without a measure, such as an ADS that raises or hangs.

    A failed check is measured against its bound, whatever else happened in the run. An assertion that is not about the
    collision has no measure, because the numbers that it compares are not known.
    """
    if failure.check is not None:
        return _of_check(failure.check)
    text = normalised(failure.assertion, failure.message)
    signature = Signature(failure=failure.kind, assertion=text, outcome=run.outcome, responsibility="none")
    return _of_collision(signature, None if run.collision is None else round(run.collision.closing_speed, 6))


def _of_collision(signature: Signature, closing_speed: float | None) -> Severity | None:
    if closing_speed is None or signature.is_property:
        return None
    return Severity(kind="collision", value=closing_speed, unit="m/s")


def _of_check(check: Check) -> Severity:
    over = -math.inf if check.at_most is None else check.value - check.at_most
    under = -math.inf if check.at_least is None else check.at_least - check.value
    by = max(over, under)
    if not math.isfinite(by + check.margin):
        return Severity(kind="check", value=None, unit=check.unit, name=check.name)
    value, margin = float(f"{by:.6g}"), float(f"{check.margin:.6g}")  # rounded, so that it is equal in every process
    return Severity(kind="check", value=value, unit=check.unit, margin=margin, name=check.name)


def worsening(now: Severity | None, before: Severity | None) -> str:
    """Say how much worse a failure became, as in ``hits at 12.1 m/s, 8.0 before``; empty if it did not become worse.

    Two collisions are compared by closing speed and two failures of one check by margin; a collision is worse than any
    other failure. Other pairs cannot be compared.
    """
    if now is None:
        return ""
    if before is None or now.kind != before.kind:
        return f"{now}, no collision before" if now.kind == "collision" else ""
    is_same = (now.name, now.unit) == (before.name, before.unit)
    if not is_same or now.figures[1] - before.figures[1] < Severity.WORSE_BY[now.kind] or now.figure == before.figure:
        return ""
    return f"{now}, {before.figure} before"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The verdict of the test function, the oracle, on a run."""

    # ``failed`` is a finding. ``rejected`` and ``skipped`` are no judgement. ``npc`` is a collision for which an NPC is
    # responsible, unless ``blame="any"``. ``common`` is a failure that the reference does not pass either. ``invalid``
    # is a run that says nothing about the ego, such as a crash between NPCs, or of the reference in the scenario.
    kind: Literal["passed", "failed", "rejected", "skipped", "npc", "common", "invalid"]
    exception: BaseException | None = None  # the exception of the function, if it failed or skipped
    failure: Failure | None = None
    checks: tuple[Check, ...] = ()  # the checks that the function made, in order, up to one that failed
    is_timed: bool = False  # True if it depends on wall-clock time
    is_ads: bool = False  # True if the ADS itself failed, whatever the function asserts
    severity: Severity | None = None  # severity of the failure; None if there is none, or if nothing measures it
    reference: Verdict | None = None  # verdict on the reference in the same scenario; None if it was not run

    @property
    def failed(self) -> bool:
        """True if the run is a failure that counts, so it is a finding."""
        return self.kind == "failed"

    @property
    def is_check(self) -> bool:
        """True if a check with a bound is broken."""
        return self.failure is not None and self.failure.kind == CHECK_FAILED

    @property
    def passes(self) -> bool:
        """True if the test passes in the run, or if ``blame`` excludes the run's failure."""
        return self.kind in PASSES

    @property
    def discarded(self) -> bool:
        """True if the test function declined to judge the run: it skipped or rejected it."""
        return self.kind in ("rejected", "skipped")

    @property
    def margins(self) -> tuple[tuple[str, float], ...]:
        """The worst margin of each check that the test function made, sorted by the check's name."""
        worst: dict[str, float] = {}
        for each in self.checks:
            worst[each.name] = min(each.margin, worst.get(each.name, math.inf))
        return tuple(sorted(worst.items()))

    @property
    def worsening(self) -> str:
        """The words for how much worse the failure is than the reference's in its scenario; empty if it is no worse."""
        return "" if self.reference is None else worsening(self.severity, self.reference.severity)

    def beside(self, reference: Verdict) -> Self:
        """Return the verdict together with the verdict on the reference in the same scenario.

        The failure counts only if the reference passes. If the reference's run is invalid, that is not known.
        """
        without: Literal["invalid", "common"] = "invalid" if reference.kind == "invalid" else "common"
        return replace(self, kind="failed" if reference.passes else without, reference=reference)
