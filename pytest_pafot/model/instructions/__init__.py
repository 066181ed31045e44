"""The kinds of instructions that an NPC can have, each in a file of its own, and the table of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from functools import cached_property, wraps
from types import MappingProxyType
from typing import Any

from pytest_pafot.model.instructions.cell import PositionInstruction, random_position
from pytest_pafot.model.instructions.crossing import (
    ACTS,
    LARGEST_SLOT,
    SLOT_STEPS_PER_SECOND,
    SLOTS,
    Act,
    CrossingInstruction,
)
from pytest_pafot.model.instructions.free import BUILT_IN_DRIVERS, Free, checked_driver, random_free
from pytest_pafot.model.instructions.instruction import (
    MAX_SPEED,
    SPEED_STEPS_PER_MPS,
    Choices,
    Instruction,
    ScenarioError,
    known,
    roughness,
)
from pytest_pafot.model.instructions.lane import LANE_STARTS, SHIFTS, LaneInstruction, random_lanes
from pytest_pafot.model.instructions.manoeuvre import MOST_STEPS, Manoeuvre, Step, random_manoeuvre
from pytest_pafot.model.instructions.recorded import Recorded, Track

__all__ = [
    "ACTS", "BUILT_IN_DRIVERS", "LANE_STARTS", "LARGEST_SLOT", "MAX_SPEED", "MOST_STEPS",
    "SHIFTS", "SLOTS", "SLOT_STEPS_PER_SECOND", "SPEED_STEPS_PER_MPS", "Act", "Choices",
    "CrossingInstruction", "Free", "Instruction", "LaneInstruction", "Manoeuvre", "PositionInstruction",
    "Recorded", "ScenarioError", "Step", "Track", "checked_driver", "known", "random_free", "random_lanes",
    "random_manoeuvre", "random_position", "roughness",
]  # fmt: skip

KINDS: list[type[Instruction]] = [
    PositionInstruction,
    LaneInstruction,
    CrossingInstruction,
    Manoeuvre,
    Free,
    Recorded,
]
"""All kinds. A plain form is read by the last of them that has it."""

GROUP = "pytest_pafot.instructions"
"""The group of entry points for modules of installed packages that register kinds when they are imported."""


def _all(kind: type, value: Any) -> bool:
    return isinstance(value, (list, tuple)) and all(isinstance(each, kind) for each in value)


RETURNS: Mapping[str, tuple[str, Callable[[Any], bool]]] = MappingProxyType(
    {
        "str": ("a text", lambda value: isinstance(value, str)),
        "int": ("a whole number", lambda value: type(value) is int),
        "bool": ("True or False", lambda value: isinstance(value, bool)),
        "int | str": ("a text or a whole number", lambda value: isinstance(value, str) or type(value) is int),
        "int | None": ("a whole number or None", lambda value: value is None or type(value) is int),
        "float | None": ("a number or None", lambda value: value is None or isinstance(value, (int, float))),
        "Hashable": ("a value that can be hashed", lambda value: isinstance(value, Hashable)),
        "list[Any]": ("a list of texts and numbers", lambda value: isinstance(value, list)),
        "dict[str, Any]": ("a dict of its fields", lambda value: isinstance(value, dict)),
        "Mapping[str, Any]": ("a dict of the fields of a view", lambda value: isinstance(value, Mapping)),
        "Sequence[Any]": ("a list or tuple of pafot.Step(...)", lambda value: _all(Step, value)),
        "Sequence[Instruction]": ("a list or tuple of instructions", lambda value: _all(Instruction, value)),
        "Instruction | None": ("an instruction or None", lambda value: value is None or isinstance(value, Instruction)),
        "tuple[Instruction, Instruction] | None": (
            "two instructions or None",
            lambda value: value is None or (_all(Instruction, value) and len(value) == 2),
        ),
        **dict.fromkeys(
            ("Instruction", "Self", "Iterator[Instruction]"),
            ("an instruction", lambda value: isinstance(value, Instruction)),
        ),
    }
)
"""What :class:`Instruction` says that its properties and methods return, in words and as a check."""


def check_returns(kind: type[Instruction]) -> None:
    """Let the properties and methods of somebody else's kind refuse to return what :class:`Instruction` does not allow.

    A wrong value would otherwise come up much later, in a file, a report or a shrunk scenario, without the kind's name.
    Numbers and truth values of numpy become Python's own, which files can hold. A member that is checked already, of
    this kind or of one that it is derived from, stays as it is.
    """
    for name, promised in vars(Instruction).items():
        returns: str = getattr(_function(promised), "__annotations__", {}).get("return", "")
        owner = next(each for each in kind.__mro__ if name in vars(each))
        given = vars(owner)[name]
        function = _function(given)
        if returns not in RETURNS or owner.__module__.startswith(__name__) or not callable(function):
            continue  # of this package, or a field
        if hasattr(function, "returns"):  # from an earlier call
            continue
        checked = _checked(function, f"{kind.__name__}.{name}", returns)
        setattr(kind, name, checked if function is given else type(given)(checked))
        if isinstance(given, cached_property):
            vars(kind)[name].__set_name__(kind, name)


def _function(member: Any) -> Any:
    """Return the function of a property, a class method or a static method; else the member itself."""
    if isinstance(member, cached_property):
        return member.func
    return member.fget if isinstance(member, property) else getattr(member, "__func__", member)


def _checked(function: Callable[..., Any], name: str, returns: str) -> Callable[..., Any]:
    expected, is_fit = RETURNS[returns]

    def fitting(value: Any) -> Any:
        if is_fit(value):
            return value
        fix = "correct this property or method of the kind"
        raise ScenarioError(field=name, expected=expected, received=f"{value!r:.100}", fix=fix)

    @wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        value = _plain(function(*arguments, **named))
        if returns.startswith("Iterator"):
            return map(fitting, value if isinstance(value, Iterable) else (value,))
        return fitting(value)

    checked.returns = returns  # type: ignore[attr-defined]
    return checked


def _plain(value: Any) -> Any:
    """Return a value with Python's own numbers and truth values instead of numpy's, also in lists, tuples and dicts."""
    if type(value).__module__ == "numpy" and getattr(value, "shape", None) == ():  # numpy is slow to import
        return value.item()
    if type(value) is dict:
        return {key: _plain(each) for key, each in value.items()}
    return type(value)(map(_plain, value)) if type(value) in (list, tuple) else value


def load_registered() -> None:
    """Import what installed packages name in :data:`GROUP`, for a file or a text that no kind here can read.

    Nothing imports it before: reading the entry points of all packages takes milliseconds.

    Raises:
        ScenarioError: if one cannot be imported.
    """
    from importlib import metadata  # noqa: PLC0415  (slow to import, and usually not needed)

    for entry in metadata.entry_points(group=GROUP):
        try:
            entry.load()
        except Exception as error:
            expected = f"that {entry.value}, which is registered as {entry.name!r} in {GROUP}, can be imported"
            raise ScenarioError(expected=expected, received=f"{type(error).__name__}: {error}") from error


def kind_of(keys: Collection[str], kinds: Sequence[type[Instruction]] = KINDS) -> type[Instruction]:
    """Return the kind of the mapping in a file with some keys: the first of those with most of their marks there."""
    return max(kinds, key=lambda kind: len({*kind.marks}.intersection(keys)))


def required_keys(kind: Any) -> set[str]:
    """Return the keys that each mapping of a dataclass has, such as a kind: the fields without a default."""
    return {each.name for each in fields(kind) if each.default is MISSING and each.default_factory is MISSING}


def instruction_of(plain: Sequence[Any]) -> Instruction:
    """Return the instruction with a plain form.

    Raises:
        ScenarioError, TypeError, ValueError: if there is no such instruction.
    """
    first, *others = plain
    kind = _reader_of(first, others)
    if isinstance(first, str) and kind is PositionInstruction:
        load_registered()
        kind = _reader_of(first, others)
        if kind is PositionInstruction:
            expected = f"the form of one of {', '.join(each.__name__ for each in KINDS)}"
            fix = f"a package whose entry points {GROUP} name its kind may not be installed here"
            raise ScenarioError(field="instruction", expected=expected, received=f"{plain!r:.100}", fix=fix)
    return kind.read(plain)


def _reader_of(first: Any, others: Sequence[Any]) -> type[Instruction]:
    return next(kind for kind in reversed(KINDS) if kind.reads(first, others))
