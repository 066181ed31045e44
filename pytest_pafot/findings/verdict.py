"""The verdict of a test function on a run."""

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

from pytest_pafot.attribution.responsibility import (
    BY_FAULT,
    NOT_GIVEN_WAY,
    Fault,
    Manoeuvre,
    Mistake,
    Responsibility,
)
from pytest_pafot.model.crossings import Kind, Origin, Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import Outcome, Side
from pytest_pafot.oracle.run import Check, CheckFailed, Run

# The metadata of fields that are not stored (see :mod:`pytest_pafot.report.messages`).
IN_MEMORY: Mapping[str, bool] = MappingProxyType({"is_stored": False})

MAX_ASSERTION = 200
MAX_SLUG = 32
NUMBER = "N"

_ADDRESS = re.compile(r"\b0x[0-9a-fA-F]+")
_NUMBER = re.compile(
    r"(?<![\w.])[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|(?<![\w.])[-+]?(?:inf|nan)\b"
)
_PATH = re.compile(r"(?<!\w)(?:[A-Za-z]:)?(?:[\\/][\w.@~+-]+){2,}|[\w.-]+\.py\b(?::\d+)?")

# The name of a failure in which the process died. It replaces the name of an exception.
PROCESS_CRASH = "ProcessCrash"

# The name of a failure of a check. Its assertion is the name of the check.
CHECK_FAILED = CheckFailed.__name__

# Attributes of a run that concern the collision: an assertion that uses one is about the collision.
_OF_COLLISIONS = frozenset(
    {"collision", "responsibility", "attribution", "outcome", "second_opinion", "sentences", "explain"}
)  # fmt: skip

# Faults at a zone. The position of the contact inside the zone does not matter.
AT_ZONES = frozenset({"did-not-give-way", "entered-taken-zone"})

# The groups of zones, such as ``crossing from the left``; the many zones of a junction fall into a few groups.
ZONES = tuple(
    f"{kind} from {'the ' if origin in ('left', 'right') else ''}{origin}"
    for kind in get_args(Kind)
    for origin in get_args(Origin)
)

_NO_SUBJECT = frozenset(
    {"run", "not", "assert", "is", "in", "none", "true", "false", "and", "or", NUMBER.lower()}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """The reason why a run fails."""

    kind: str  # name of the exception class
    message: str = ""  # message of the exception
    assertion: str = ""  # source text of the failing assertion; empty if it is unknown
    # traceback to save in the file, for example of an ADS that raised, or empty
    traceback: str = ""
    # the failed check, with its name also in `assertion`; None if something else failed
    check: Check | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Signature:
    """The identity of a failure. Failures with equal fields count as the same failure."""

    # A failed check is identified by its name, and an assertion that is not about the collision by its text. The end of
    # the run and the positions of the NPCs depend on the traffic; they would split one property into many failures. For
    # the same reason, a collision for which the ego is responsible is identified only by the ego's mistake, and at a
    # zone also by the zone's kind and the NPC's origin. Any other collision is identified by its position and its
    # manoeuvres. So hundreds of collisions become a few findings.

    failure: str  # name of the exception class
    assertion: str  # the normalised assertion, without file, line, numbers and addresses
    outcome: Outcome  # how the run ended; `safe` for a property
    # `ego` if the ego is responsible, alone or with the NPC; otherwise `npc` or `none`
    responsibility: Responsibility
    # what the ego did wrong; None if it is not responsible for a collision
    mistake: Mistake | None = None
    # The rule by which the ego is responsible, only for the slug.
    fault: Fault | None = field(default=None, compare=False, repr=False)
    # side of the ego that was hit; None without a collision, or if there is a fault
    side: Side | None = None
    # cell of the NPC at the collision; None without a collision, or if there is a fault
    cell: Cell | None = None
    # Zone in which the NPC crossed; None if it did not, or for a fault that is not about a zone.
    zone: str | None = None
    # The NPC's manoeuvre shortly before the collision; None without a collision, or if there is a fault.
    npc_manoeuvre: Manoeuvre | None = None
    ego_manoeuvre: Manoeuvre | None = None  # the ego's manoeuvre, like `npc_manoeuvre`
    # In a search, the id of the accepted file of the same failure, if this collision is faster than all collisions that
    # were known at the acceptance; otherwise None.
    worse_than: str | None = None

    @classmethod
    def from_facts(cls, **facts: Any) -> Self:
        # Keep only the facts that distinguish failures.
        told = cls(**facts)
        ended = cls(
            failure=told.failure,
            assertion=told.assertion,
            outcome=told.outcome,
            responsibility=told.responsibility,
        )
        if told.is_property:  # it is the same, however the run continued
            return replace(ended, outcome=Outcome.COMPLETED, responsibility="none")
        if told.fault is None:
            # Without a collision, the cell and the zone are only those of the most critical moment.
            is_hit = told.outcome is Outcome.COLLISION
            return told if is_hit else replace(told, cell=None, zone=None)
        ended = replace(ended, responsibility="ego", fault=told.fault)
        mistake = told.mistake or BY_FAULT.get(told.fault)
        if told.fault not in AT_ZONES:
            return replace(ended, mistake=mistake)
        # At a zone, the mistake of an ego that did not give way depends on the origin of the NPC.
        if mistake is None and told.zone is not None:
            mistake = NOT_GIVEN_WAY[cast("Origin", told.zone.rpartition(" ")[2])]
        return replace(ended, mistake=mistake, zone=told.zone)

    @property
    def is_property(self) -> bool:
        """True for a failed check or an assertion on a measure, which do not concern how the run ended."""
        if self.failure == CHECK_FAILED:
            return True
        if self.outcome in (Outcome.ADS_ERROR, Outcome.HANG):
            return False
        # An assertion that uses no attribute of a run, or that is known only by its message, concerns the end.
        named, measures = _named(self.assertion)
        return bool(measures) and not named & _OF_COLLISIONS

    @property
    def told(self) -> dict[str, str]:
        """The fields that identify the failure, as strings, without those that are None."""
        told = {}
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, Cell):
                value = value.label
            if each.compare and value is not None:
                told[each.name] = str(value)
        return told

    @property
    def text(self) -> str:
        """The fields that identify the failure, as one line of JSON."""
        return json.dumps(self.told)

    @property
    def slug(self) -> str:
        """A short name for files, such as ``rear-6``. It is not unique."""
        if self.fault is not None:
            if self.fault == "entered-lane" and self.mistake == "kept-no-distance":
                return "entered-behind"
            if self.zone is None:
                return self.fault
            return f"{self.fault}-{self.zone.rpartition(' ')[2]}"
        if self.failure == CHECK_FAILED:
            return _kebab(self.assertion.lower()) or "check"
        outcome = self.outcome.replace("_", "-")
        if self.outcome is Outcome.COLLISION and self.side:
            subject: str = self.side
        elif self.outcome in (Outcome.ADS_ERROR, Outcome.HANG):
            subject = outcome
        else:
            words = re.findall(r"[a-z][a-z0-9_]*", self.assertion.lower())
            subjects = [word for word in dict.fromkeys(words) if word not in _NO_SUBJECT]
            subject = _kebab("-".join(subjects[:3])) or _kebab(self.failure.lower()) or outcome
        if self.zone is not None:
            kind, *_, whence = self.zone.split()
            return f"{subject}-{kind}-{whence}"
        if self.cell is None:
            return subject
        return f"{subject}-{int(self.cell)}"


def zone_in_words(zone: Zone) -> str:
    """Return a zone's kind and the NPC's origin in words, one of ``ZONES``."""
    return f"{zone.kind} {zone.whence}"


def normalised(assertion: str, message: str = "") -> str:
    """Reduce a failing assertion to a string that does not depend on the run or on unrelated edits."""
    # Source text is reduced to the tested expression, without message, comments, line breaks and needless brackets, and
    # with `N` for each number. Any other string is reduced to its first line, or to the first line of `message`, with
    # `N` for numbers, `ADDRESS` for addresses and `PATH` for files. The result has at most 200 characters.
    return (_from_source(assertion) or _from_message(assertion) or _from_message(message))[
        :MAX_ASSERTION
    ].rstrip()


class _Numberless(ast.NodeTransformer):
    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        # A Boolean is an int, too.
        if isinstance(node.value, int | float | complex) and not isinstance(node.value, bool):
            return ast.Name(id=NUMBER)
        return node

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        inner = self.visit(node.operand)
        is_sign = isinstance(node.op, ast.USub | ast.UAdd)
        if is_sign and isinstance(inner, ast.Name) and inner.id == NUMBER:
            return inner
        return ast.UnaryOp(op=node.op, operand=inner)


@lru_cache(maxsize=64)
def _named(assertion: str) -> tuple[set[str], set[str]]:
    # The first set has all attributes: `ego`, `jerk` and `max` in `run.ego.jerk.max()`. The second set has those of
    # plain names: `ego` in this case, but none for the helper call `helpers.is_fine(run)`.
    try:
        nodes = list(ast.walk(ast.parse(assertion, mode="eval")))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        cut: set[str] = set()
        # Other long texts were cut short, so they do not parse.
        if len(assertion) > MAX_ASSERTION - 9:
            cut.update(re.findall(r"\b[A-Za-z_]\w*\.(\w+)", assertion))
        return cut, cut
    helpers, named, measures = list[ast.expr](), set[str](), set[str]()
    for node in nodes:
        # `ast.walk` visits a call before its function.
        if isinstance(node, ast.Call) and any(isinstance(each, ast.Name) for each in node.args):
            helpers.append(node.func)
        if isinstance(node, ast.Attribute):
            named.add(node.attr)
            if isinstance(node.value, ast.Name) and node not in helpers:
                measures.add(node.attr)
    return named, measures


@lru_cache(maxsize=64)  # most failures of a search are at a few statements
def _from_source(assertion: str) -> str:
    try:
        body = ast.parse(dedent(assertion).strip()).body
        if len(body) != 1:
            return ""
        tested: ast.AST = body[0]
        if isinstance(tested, ast.Assert):
            tested = tested.test
        return " ".join(ast.unparse(_Numberless().visit(tested)).split())
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return ""  # not an expression that this interpreter can parse; it is treated as a message


def _from_message(message: str) -> str:
    line = next((line for line in message.splitlines() if line.strip()), "")
    line = _PATH.sub("PATH", _ADDRESS.sub("ADDRESS", line))
    line = _NUMBER.sub(NUMBER, line)
    for character in set(line):
        if not character.isprintable():
            line = line.replace(character, " ")
    return " ".join(line.split())


def _kebab(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", text)[:MAX_SLUG].strip("-")


# The kinds of verdicts that count as a pass: the test passes, or ``blame`` excludes the failure.
PASSES = ("passed", "npc")


@total_ordering
@dataclass(frozen=True, slots=True, kw_only=True)
class Severity:
    """The severity of a failure. Larger is worse."""

    # Any collision is worse than any failed check. Collisions are compared by their closing speeds, and failed checks
    # by their margins, which have no unit.

    WORSE_BY: ClassVar[Mapping[str, float]] = MappingProxyType({"collision": 0.1, "check": 0.01})
    kind: Literal["collision", "check"]
    # The closing speed at impact, which is the magnitude of the velocity difference [m/s]; for a check, the amount by
    # which its bound is broken [unit]. None, the worst value, if a check measured no finite number.
    value: float | None
    unit: str = ""  # unit of `value`
    # Negative margin of a check in units of its scale; None for a collision, or if `value` is None.
    margin: float | None = None
    name: str = ""  # name of the check; empty for a collision

    @property
    def figure(self) -> str:
        """The value as a short string without the unit."""
        if self.value is None:
            return "no finite number"
        if self.kind == "collision":
            return f"{self.value:.1f}"
        return f"{self.value:.3g}"

    def __str__(self) -> str:
        figure = f"{self.figure} {self.unit}".rstrip()
        if self.kind == "collision":
            return f"hits at {figure}"
        return f"violates the bound of {self.name} by {figure}"

    @property
    def figures(self) -> tuple[int, float, float]:
        # The numbers that are compared, in order. Larger is worse.
        value = margin = math.inf
        if self.value is not None:
            value = self.value
        if self.kind == "collision":
            return 2, value, 0.0
        if self.margin is not None:
            margin = -self.margin
        return 1, margin, value

    @staticmethod
    def worst_first(responsible: str, severity: Severity | None) -> tuple[float, ...]:
        """Return a sort key that puts the worst failures first.

        Collisions for which the ego is responsible come before all other failures.
        """
        # Failures without a measure are last. Callers put more important criteria before this key, and tie-breakers
        # after it.
        if severity is None:
            return 1, 0, 0.0, 0.0
        is_fault = severity.kind == "collision" and responsible in ("ego", "both")
        kind, value, other = severity.figures
        return not is_fault, -kind, -value, -other

    def __lt__(self, other: Severity) -> bool:
        return (self.figures, self.name, self.unit) < (other.figures, other.name, other.unit)


def severity_of(run: Run, failure: Failure) -> Severity | None:
    """Return the severity of a failure, or None if it cannot be measured."""
    # A failed check is measured against its bound, even if there was a collision. An assertion that is not about the
    # collision has no measure, because its numbers are not known. An ADS that raises or hangs has none either.
    if failure.check is not None:
        return _of_check(failure.check)
    text = normalised(failure.assertion, failure.message)
    signature = Signature(
        failure=failure.kind, assertion=text, outcome=run.outcome, responsibility="none"
    )
    if run.collision is None or signature.is_property:
        return None
    return Severity(kind="collision", value=round(run.collision.closing_speed, 6), unit="m/s")


def _of_check(check: Check) -> Severity:
    by = -math.inf
    if check.at_most is not None:
        by = check.value - check.at_most
    if check.at_least is not None:
        by = max(by, check.at_least - check.value)
    if not math.isfinite(by + check.margin):
        return Severity(kind="check", value=None, unit=check.unit, name=check.name)
    # rounded, so that it is equal in every process
    value, margin = float(f"{by:.6g}"), float(f"{check.margin:.6g}")
    return Severity(kind="check", value=value, unit=check.unit, margin=margin, name=check.name)


def worsening(now: Severity | None, before: Severity | None) -> str:
    """Describe how much worse a failure became, or return an empty string."""
    # Two collisions are compared by closing speed, and two failures of one check by margin. A collision is worse than
    # any other failure. Other pairs cannot be compared.
    if now is None:
        return ""
    if before is None or now.kind != before.kind:
        if now.kind != "collision":
            return ""
        return f"{now}, with no collision before"
    if (now.name, now.unit) != (before.name, before.unit) or now.figure == before.figure:
        return ""
    if now.figures[1] - before.figures[1] < Severity.WORSE_BY[now.kind]:
        return ""
    return f"{now} instead of {before.figure}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The verdict of the test function on a run."""

    # ``failed`` is a finding. ``rejected`` and ``skipped`` do not count. ``npc`` is a collision for which
    # an NPC is responsible, unless ``blame="any"``. ``common`` is a failure in a scenario that the reference fails.
    # ``invalid`` is a run that shows nothing about the ego, for example because two NPCs collided, or because the run
    # of the reference is invalid.
    kind: Literal["passed", "failed", "rejected", "skipped", "npc", "common", "invalid"]
    # the exception of the function, if it failed or skipped
    exception: BaseException | None = field(default=None, metadata=IN_MEMORY)
    failure: Failure | None = field(default=None, metadata=IN_MEMORY)
    # the checks that the function made, in order, up to one that failed
    checks: tuple[Check, ...] = field(default=(), metadata=IN_MEMORY)
    is_timed: bool = False  # True if it depends on wall-clock time
    is_ads: bool = False  # True if the ADS itself failed, regardless of what the function asserts
    # severity of the failure; None if there is none, or if nothing measures it
    severity: Severity | None = None

    @property
    def failed(self) -> bool:
        return self.kind == "failed"

    @property
    def is_check(self) -> bool:
        return self.failure is not None and self.failure.kind == CHECK_FAILED

    @property
    def passes(self) -> bool:
        """True if the run passes, or if ``blame`` excludes its failure."""
        return self.kind in PASSES

    @property
    def discarded(self) -> bool:
        """True if the test skipped or rejected the run."""
        return self.kind in ("rejected", "skipped")

    @property
    def margins(self) -> tuple[tuple[str, float], ...]:
        """The worst margin of each check, sorted by the check's name."""
        worst: dict[str, float] = {}
        for each in self.checks:
            worst[each.name] = min(each.margin, worst.get(each.name, math.inf))
        return tuple(sorted(worst.items()))

    def beside(self, reference: Verdict) -> Self:
        """Return this verdict, adjusted for the verdict on a run of the reference."""
        # A failure counts only if the reference passes. If the run of the reference is invalid, that is unknown.
        if reference.passes:
            return replace(self, kind="failed")
        return replace(self, kind="invalid" if reference.kind == "invalid" else "common")
