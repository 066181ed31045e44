"""The identity of failures: two failures are the same if all fields of their signatures are equal.

So hundreds of collisions come down to a handful of findings.
"""

from __future__ import annotations

import ast
import re
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from textwrap import dedent
from typing import Any, Self, cast, get_args

from pytest_pafot.attribution.mistakes import BY_FAULT, NOT_GIVEN_WAY, Manoeuvre
from pytest_pafot.attribution.responsibility import Fault, Mistake, Responsibility
from pytest_pafot.model.crossings import Kind, Origin, Zone
from pytest_pafot.model.instructions import Cell
from pytest_pafot.model.trace import Outcome, Side
from pytest_pafot.oracle.checks import Check, CheckFailed

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
    {"collision", "responsibility", "attribution", "outcome", "second_opinion", "preventable_by", "reference_drivers",
     "sentences", "explain"}
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
        mistake: what the ego did wrong; None if it is not responsible for a collision, or if the failure is from a file
            that says that the ego entered a lane, but not where the other vehicle was.
        fault: the rule by which the ego is responsible; it is not compared, and only used for the :attr:`slug`.
        side: side of the ego that was hit; None without a collision, or if there is a fault.
        cell: cell of the NPC at the collision; None without a collision, or if there is a fault.
        zone: zone in which the NPC crossed the ego's way (:func:`zone_in_words`); None if it did not cross, or if there
            is a fault that is not about a zone.
        npc_manoeuvre, ego_manoeuvre: manoeuvres shortly before the collision; None without a collision, or if there is
            a fault.
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
    def text(self) -> str:
        """All compared fields in one line; two signatures are equal if and only if their texts are equal."""
        compared = ((each.name, getattr(self, each.name)) for each in fields(self) if each.compare)
        return " ".join(f"{name}={str(value)!r}" for name, value in compared if value is not None)

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
