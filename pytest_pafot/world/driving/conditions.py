"""The conditions that a policy evaluates in one decision, with their values, if the policy's source can be read.

During this decision, the user's functions run modified copies of their code, which pass each condition to a recorder.
So nothing is evaluated twice, and the recorder sees the values that the policy used.
"""

from __future__ import annotations

import ast
import gc
import warnings
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from itertools import count, islice
from pathlib import Path
from threading import get_ident
from types import CodeType, FunctionType, GeneratorType, GetSetDescriptorType, MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from pytest_pafot.support.text import visible

PARTING = 3  # the largest number of rows for conditions that another decision evaluates differently

# the largest number of evaluations per condition that are compared with another decision
FIRST = 500

# the largest number of characters in a row; a longer row omits the condition's text, which no person wrote
LONGEST = 1000

# the largest number of elements of a value that are compared with those in another decision
LOOKED_AT = 50

# a constant in the copied code that is replaced by the recorder, so the code needs no name for it
_RECORDER = "pytest-pafot: the recorder of conditions"

# the nodes that have conditions, and the names of the fields that contain them
_TESTS = {
    ast.If: "test",
    ast.While: "test",
    ast.IfExp: "test",
    ast.comprehension: "ifs",
    ast.match_case: "guard",
}

# parts of a condition that have names or conditions of their own
_OTHERS = (
    ast.Lambda,
    ast.IfExp,
    ast.ListComp,
    ast.SetComp,
    ast.DictComp,
    ast.GeneratorExp,
    ast.JoinedStr,
)

_SIMPLE = (bool, int, float, str, type(None))


class Evaluation(NamedTuple):
    """One evaluation of a condition."""

    number: int  # among all evaluations of the decision
    outcome: str
    values: tuple[tuple[str, str], ...]  # with their names, as strings
    exact: tuple[str, ...]  # the same values in full, for comparisons


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluated:
    """A condition that was evaluated in a decision, with its evaluations."""

    condition: str  # file, line and text
    last: Evaluation  # the last evaluation with the rarest outcome
    first: tuple[Evaluation, ...] = ()

    def row(self, evaluation: Evaluation) -> str:
        """Describe an evaluation of the condition in one line."""
        place, _, text = self.condition.partition(": ")
        told = [  # values that repeat the condition or its outcome are omitted
            f"{name} = {value}"
            for name, value in evaluation.values
            if value != name and (name, value) != (text, evaluation.outcome)
        ]
        values = ""
        if told:
            values = f"  ({', '.join(told)})"
        row = f"{self.condition}{values} -> {evaluation.outcome}"
        if len(row) <= LONGEST:
            return row
        return f"{place}: condition of {len(text)} characters -> {evaluation.outcome}"


def differing_numbers(evaluated: Iterable[Evaluated], others: Iterable[Evaluated]) -> set[int]:
    """Return the numbers of the evaluations with different values or a different outcome in another decision.

    The comparison stops where the two decisions evaluate different conditions.
    """
    found = set()
    for (own, condition), (other, its) in zip(
        _in_order(evaluated),
        _in_order(others),
        strict=False,
    ):
        if condition != its:
            break
        if (own.outcome, own.exact) != (other.outcome, other.exact):
            found.add(own.number)
    return found


def _in_order(conditions: Iterable[Evaluated]) -> list[tuple[Evaluation, str]]:
    return sorted((first, each.condition) for each in conditions for first in each.first)


Whom = Mapping[int, tuple[int, ...]]
"""The indices of the NPCs on which each evaluation depends, by the evaluation's number."""


class Parted(NamedTuple):
    """An evaluation with a different result in another decision."""

    evaluation: Evaluation
    ending: str  # added to its row
    # the moved NPC, on which the outcome depends, even if no value shows this
    whom: tuple[int, ...]


def parting(
    evaluated: Iterable[Evaluated],
    others: Iterable[Evaluated],
    when: str,
    *,
    is_other: bool,
    npc: int | None = None,
    whom: Whom = MappingProxyType({}),
) -> dict[str, Parted]:
    """Return the evaluations that differ between two decisions, by condition.

    Args:
        evaluated, others: the conditions of both decisions, with the last condition first.
        when: a phrase that describes how the other decision differs.
        is_other: whether the other decision has a different action.
        npc: the NPC with a different position in the other decision, or None.
        whom: the NPCs on which the evaluations depend.
    """
    otherwise = {each.condition: each.first for each in others}
    moved: tuple[int, ...] = ()
    if npc is not None:
        moved = (npc,)
    found: list[tuple[int, str, Parted]] = []
    for each in evaluated:
        for here, there in zip(each.first, otherwise.get(each.condition, ()), strict=False):
            ending = f"; {when} {there.outcome}"
            if here.outcome == there.outcome:
                if is_other or here.values == there.values:
                    continue
                ending = f"; also {when}"
            # Also skip differences that exist only because a loop reaches the same vehicle earlier or later.
            if npc in whom.get(here.number, (npc,)):
                found.append((here.number, each.condition, Parted(here, ending, moved)))
                break
    # If the action differs, the first difference causes the later differences.
    ordered = sorted(found, reverse=not is_other)[:PARTING]
    return {condition: row for _, condition, row in ordered}


# the subject of rows with values that depend on no NPC; their outcomes may still follow from conditions on an NPC
NOBODY = "no NPC or an unknown NPC"
Groups = tuple[tuple[str, tuple[str, ...]], ...]
"""Rows of conditions by subject. The subject is a name such as ``NPC 1``, :data:`NOBODY`, or empty for all rows."""


def group_conditions(
    evaluated: Iterable[Evaluated],
    first: Mapping[str, Parted] = MappingProxyType({}),
    *,
    npc: int | None = None,
    whom: Whom | None = None,
) -> Groups:
    """Return the rows that describe a decision's conditions.

    Each condition has one row, or two if the NPC's evaluation does not have the rarest outcome. The conditions in
    ``first``, which :func:`parting` returned for the NPC, come first.
    """
    rows: dict[tuple[int, ...] | None, dict[str, str]] = {}

    def add(
        each: Evaluated, evaluation: Evaluation, ending: str = "", unless: tuple[int, ...] = ()
    ) -> None:
        about = None
        if whom is not None:
            about = whom.get(evaluation.number, unless)
        row = visible(f"{each.row(evaluation)}{ending}")
        rows.setdefault(about, {}).setdefault(each.condition, row)

    # first the rows of `first`, then the other rows
    conditions = {each.condition: each for each in evaluated}
    for condition, parted in first.items():
        add(conditions.pop(condition), *parted)
    for each in conditions.values():
        if whom is not None:
            own = [one for one in each.first if npc in whom.get(one.number, ())]
            if own:
                add(each, _rarest(own))
        add(each, each.last)

    def place(about: tuple[int, ...] | None) -> tuple[bool, tuple[int, ...]]:
        # rows on the NPC come first, then rows on nobody, then the rows on other NPCs
        return about is not None and npc not in about, about or ()

    order = sorted(rows, key=place)
    return tuple((_name(about), tuple(rows[about].values())) for about in order)


def _rarest(evaluations: Sequence[Evaluation]) -> Evaluation:
    counts = Counter(each.outcome for each in evaluations)
    return min(reversed(evaluations), key=lambda each: counts[each.outcome])


def _name(about: tuple[int, ...] | None) -> str:
    if about is None:
        return ""
    return ", ".join(f"NPC {npc}" for npc in about) or NOBODY


class Conditions:
    """The functions of a policy, each with a copy of its code that records conditions.

    A function has a copy only if its source compiles to the code that it runs. So nothing is recorded if the file has
    changed since it was imported, or if pytest has rewritten the function because of an ``assert``.
    """

    def __init__(self, files: Iterable[Path], root: Path) -> None:
        root = root.resolve()
        self._recorder = _Recorder()
        self._copies: dict[str, dict[CodeType, CodeType]] = {}  # by file
        self._real: dict[str, str] = {}
        sources = [file for file in files if file.suffix == ".py" and file.is_relative_to(root)]
        for file in sources:
            place = ""
            if len(sources) > 1:
                place = f"{file.relative_to(root).as_posix()} "
            with (
                suppress(OSError, SyntaxError, ValueError, RecursionError),
                warnings.catch_warnings(),
            ):
                # Python warned about this source when it was imported.
                warnings.simplefilter("ignore")
                source = file.read_bytes()
                tree = ast.fix_missing_locations(_Marking(place).visit(ast.parse(source)))
                plain = compile(source, file, "exec", dont_inherit=True)
                marked = self._with_recorder(compile(tree, file, "exec", dont_inherit=True))
                self._copies[str(file)] = {
                    code: copy for code, copy in _pairs(plain, marked) if code != copy
                }
        self._places = {
            (code.co_name, code.co_firstlineno)
            for copies in self._copies.values()
            for code in copies
        }
        # Find the functions now, because a forked process freezes its objects and would not find them later.
        self._functions = self._found()

    def __bool__(self) -> bool:
        return any(self._copies.values())

    @contextmanager
    def recorded(self, ads: Any, evaluated: list[Evaluated]) -> Iterator[None]:
        """Record the conditions that this thread evaluates while an ADS decides.

        The conditions are appended to ``evaluated``, with the last condition first. A running generator keeps its old
        code, so nothing is recorded for an ADS that has one.
        """
        before: list[tuple[FunctionType, CodeType]] = []
        try:
            for function in {*self._functions, *self._found()}:
                before.append((function, function.__code__))
                function.__code__ = self._copy(function.__code__) or function.__code__
            self._recorder.start()
            yield
        finally:
            self._recorder.thread = None
            for function, code in before:
                function.__code__ = code
        held = [ads]
        # to the methods, attributes and variables of the ADS, and the contents of their lists
        for _ in range(3):
            held = gc.get_referents(*held)
            if any(type(each) is GeneratorType and self._copy(each.gi_code) for each in held):
                return
        evaluated += self._recorder.evaluated()

    def _found(self) -> list[FunctionType]:
        return [
            each
            for each in gc.get_objects()
            if type(each) is FunctionType and self._copy(each.__code__)
        ]

    def _copy(self, code: CodeType) -> CodeType | None:
        # much faster than resolving the path
        if (code.co_name, code.co_firstlineno) not in self._places:
            return None
        file = self._real.get(code.co_filename)
        if file is None:
            file = self._real[code.co_filename] = str(Path(code.co_filename).resolve())
        if file in self._copies:
            return self._copies[file].get(code)
        return None

    def _with_recorder(self, code: CodeType) -> CodeType:
        def put(const: Any) -> Any:
            if type(const) is CodeType:
                return self._with_recorder(const)
            if type(const) is str and const == _RECORDER:
                return self._recorder
            return const

        return code.replace(co_consts=tuple(map(put, code.co_consts)))


def _pairs(plain: CodeType, marked: CodeType) -> Iterator[tuple[CodeType, CodeType]]:
    inner, copies = (
        [each for each in code.co_consts if type(each) is CodeType] for code in (plain, marked)
    )
    names, copied_names = (
        [(each.co_name, each.co_freevars) for each in codes] for codes in (inner, copies)
    )
    if names == copied_names:
        for each, copy in zip(inner, copies, strict=True):
            yield each, copy
            yield from _pairs(each, copy)


class _Marking(ast.NodeTransformer):
    """A transformer that replaces each condition in a file, and each value in it, with a call to the recorder."""

    def __init__(self, place: str) -> None:
        self._place = place

    def visit(self, node: Any) -> Any:
        name = _TESTS.get(type(node))
        if name is not None:
            tests = getattr(node, name)
            marked: Any
            # without its tests, which `_condition` visits
            if isinstance(tests, list):
                setattr(node, name, [])
                self.generic_visit(node)
                marked = [self._condition(each, is_test=True) for each in tests]
            else:
                setattr(node, name, None)
                self.generic_visit(node)
                marked = self._condition(tests, is_test=True)
            setattr(node, name, marked)
            return node
        if isinstance(node, (ast.Compare, ast.BoolOp)):
            return self._condition(node)
        return self.generic_visit(node)

    def _condition(self, node: Any, *, is_test: bool = False) -> Any:
        if node is None or isinstance(node, ast.Constant):  # a case without a guard; `while True`
            return node
        name = ast.Constant(f"{self._place}line {node.lineno}: {ast.unparse(node)}")
        value = _Values(self, name).visit(node)
        # Its truth is evaluated only once, because its evaluation may run the user's code.
        if is_test:
            value = ast.UnaryOp(ast.Not(), ast.UnaryOp(ast.Not(), value))
        return _called("end", node, name, _called("begin", node), value)


class _Values(ast.NodeTransformer):
    """A transformer that replaces names, attributes, items and calls in a condition with calls to the recorder."""

    def __init__(self, marking: _Marking, condition: ast.Constant) -> None:
        self._marking = marking
        self._condition = condition

    def visit(self, node: Any) -> Any:
        if isinstance(node, (ast.Name, ast.Attribute, ast.Subscript, ast.Call, ast.NamedExpr)):
            named = node
            if isinstance(node, ast.NamedExpr):
                named = node.target
            text = ast.Constant(ast.unparse(named))
            return _called("value", node, self._condition, text, self._marking.generic_visit(node))
        if isinstance(node, _OTHERS):
            return self._marking.visit(node)
        return self.generic_visit(node)


def _called(method: str, place: Any, *arguments: Any) -> Any:
    recorder = ast.Attribute(ast.Constant(_RECORDER), method, ast.Load())
    return ast.copy_location(ast.Call(recorder, list(arguments), []), place)


class _Recorder:
    """The object that receives each value from the copied code, and returns the value."""

    def __init__(self) -> None:
        self.thread: int | None = None
        self._values: list[tuple[str, str, Any]] = []
        self._numbers = count()
        self._outcomes: dict[str, dict[str, tuple[int, Evaluation]]] = {}
        self._first: dict[str, list[Evaluation]] = {}

    def start(self) -> None:
        self.thread = get_ident()
        self._numbers = count()
        self._values.clear()
        self._outcomes.clear()
        self._first.clear()

    def begin(self) -> int:
        return len(self._values)

    def value(self, condition: str, text: str, value: Any) -> Any:
        if self.thread == get_ident():
            self._values.append((condition, text, value))
        return value

    def end(self, condition: str, since: int, value: Any) -> Any:
        if self.thread != get_ident():
            return value
        values = {text: each for whose, text, each in self._values[since:] if whose == condition}
        del self._values[since:]
        if type(_plain(value)) in _SIMPLE:
            evaluation = Evaluation(
                next(self._numbers),
                _text(value),
                tuple((text, _text(each)) for text, each in values.items()),
                tuple(map(_exact, values.values())),
            )
            first = self._first.setdefault(condition, [])
            if len(first) < FIRST:
                first.append(evaluation)
            outcomes = self._outcomes.pop(condition, {})
            times, _ = outcomes.pop(evaluation.outcome, (0, None))
            outcomes[evaluation.outcome] = times + 1, evaluation
            # at the end, because this condition was evaluated last
            self._outcomes[condition] = outcomes
        return value

    def evaluated(self) -> list[Evaluated]:
        return [
            Evaluated(
                condition=condition,
                last=min(reversed(outcomes.values()), key=lambda each: each[0])[1],
                first=tuple(self._first[condition]),
            )
            for condition, outcomes in reversed(self._outcomes.items())
        ]


def _text(value: Any) -> str:
    kind = type(value)
    value = _plain(value)
    if type(value) is float:
        is_plain = value == 0 or 1e-3 <= abs(value) < 1e6
        if is_plain:
            return f"{value:.3f}".rstrip("0").rstrip(".")
        return f"{value:.3g}"
    if type(value) is str:
        return repr(_cut(value, 20))
    if type(value) in _SIMPLE and not (type(value) is int and value.bit_length() > 64):
        return repr(value)
    if issubclass(kind, Enum):
        return f"{kind.__name__}.{value._name_}"
    if kind in (list, tuple, set, frozenset, dict, deque):
        return f"{kind.__name__} of {len(value)}"
    if kind is np.ndarray:
        return f"array of shape {value.shape}"
    return kind.__name__


def _exact(value: Any, depth: int = 2) -> str:
    kind = type(value)
    plain = _plain(value)
    if type(plain) in _SIMPLE:
        if type(plain) is int:
            return _text(plain)
        return repr(plain)
    if kind is np.ndarray:
        if value.dtype.kind in "biuf" and value.size <= LOOKED_AT**2:
            return repr(value.tobytes())
        return _text(value)
    inner: Iterable[Any] = ()
    if issubclass(kind, tuple):
        inner = tuple.__iter__(value)
    elif issubclass(kind, list):
        inner = list.__iter__(value)
    else:
        held = (vars(each)["__dict__"] for each in kind.__mro__ if "__dict__" in vars(each))
        own = next(held, None)
        if type(own) is GetSetDescriptorType:
            inner = own.__get__(value).values()
    if not depth:
        return f"{_text(value)} "
    return f"{_text(value)} {[_exact(each, depth - 1) for each in islice(inner, LOOKED_AT)]}"


def _plain(value: Any) -> Any:
    if issubclass(type(value), np.generic):
        return value.item()
    return value


def _cut(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    return f"{text[: most - 3]}..."
