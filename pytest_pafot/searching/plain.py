"""Conversion of values to plain data that JSON can store, and back, to store a search between two sessions.

The value decides how it is written: a frozen dataclass becomes the list of its fields, in their order; a mapping
becomes the list of its pairs; a set a sorted list; and a number that JSON cannot express a text. To read data, the
caller names its type. Everything that does not fit the type is refused, because anyone may have written the file.
"""

from __future__ import annotations

import json
import math
import operator
import types
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from itertools import repeat
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pytest_pafot.findings.signature import Signature
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.support.errors import FieldError

T = TypeVar("T")

Read = Callable[[Any], Any]
"""A function that converts plain data to a value; it raises a FieldError for data that does not fit."""

_AS_THEY_ARE = frozenset({type(None), bool, int, str})
_NO_NUMBERS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def plain(value: Any) -> Any:
    """Convert a value to lists, texts, numbers, booleans and None.

    The value may also contain dataclasses, tuples, mappings, sets, enumerations and scenarios. Fields of a dataclass
    with the type Any are left out.

    Raises:
        ValueError: for anything else.
    """
    kind = type(value)
    if kind in _AS_THEY_ARE:
        return value
    if kind is tuple or kind is list:
        return [plain(each) for each in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else repr(float(value))
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, Scenario):
        return value.plain()
    if is_dataclass(value) and not isinstance(value, type):
        return [plain(getattr(value, name)) for name in _hints(type(value))]
    if isinstance(value, Mapping):
        return [[plain(key), plain(each)] for key, each in value.items()]
    if isinstance(value, AbstractSet):
        return sorted(map(plain, value), key=json.dumps)  # the order of a set differs from process to process
    try:
        return operator.index(value)
    except TypeError:
        raise ValueError(
            f"expected a value that JSON can hold, or a dataclass of such values, received {value!r:.100}; convert it"
        ) from None


def from_plain(kind: type[T], data: Any) -> T:
    """Convert data that :func:`plain` made back to a value of the type ``kind``.

    Raises:
        FieldError: for data that does not fit the type, with the place of the mismatch, such as ``[2][0]``.
        TypeError: for a type that cannot be read.
    """
    return cast("T", _reader(cast("Hashable", kind))(data))


@lru_cache(maxsize=256)
def _hints(kind: type) -> dict[str, Any]:
    """Return the types of a dataclass's stored fields, by name."""
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in fields(kind) if each.init and hints[each.name] is not Any}


@lru_cache(maxsize=256)
def _reader(kind: Any) -> Read:
    """Return the function that reads a type. It is made once, because a state has a million values of few types."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind in _SIMPLE:
        return _SIMPLE[kind]
    if kind is Hashable:  # a kind of failure, which is stored as its signature
        return _reader(Signature)
    if origin in (Union, types.UnionType):
        return _read_union(inner)
    if origin is Literal:
        return _read_choice({each: each for each in inner})
    if origin is tuple and inner[-1] is not Ellipsis:
        return _read_list(tuple, [_reader(each) for each in inner])
    if origin in (tuple, frozenset):
        return _read_list(origin, _reader(inner[0]))
    if origin in (Mapping, Counter):
        pair = _read_list(tuple, [_reader(inner[0]), _reader(int if origin is Counter else inner[1])])
        return _read_list(dict if origin is Mapping else lambda pairs: Counter(dict(pairs)), pair)
    if isinstance(kind, type) and is_dataclass(kind):
        hints, make = _hints(kind), cast("Callable[..., Any]", kind)
        return _read_list(
            lambda parts: make(**dict(zip(hints, parts, strict=True))), [_reader(each) for each in hints.values()]
        )
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _read_choice({each.value: each for each in kind})
    raise TypeError(f"expected a type whose values can be stored, received {kind!r}; see pytest_pafot.searching.plain")


def _refuse(expected: str, data: Any) -> FieldError:
    return FieldError(expected=expected, received=f"{data!r:.60}")


def _read_float(data: Any) -> float:
    if type(data) is float or type(data) is int:
        return float(data)
    if isinstance(data, str) and data in _NO_NUMBERS:
        return _NO_NUMBERS[data]
    raise _refuse("a number", data)


def _read_exactly(kind: type, expected: str) -> Read:
    def read(data: Any) -> Any:
        if type(data) is not kind:
            raise _refuse(expected, data)
        return data

    return read


def _read_choice(known: Mapping[Any, Any]) -> Read:
    def read(data: Any) -> Any:
        if type(data) not in (str, int) or data not in known:
            raise _refuse(f"one of {', '.join(map(str, known))}", data)
        return known[data]

    return read


def _read_scenario(data: Any) -> Scenario:
    try:
        return Scenario.from_canonical(data)
    except ScenarioError:
        raise  # it is a ValueError, and already says what is wrong
    except (TypeError, ValueError):
        raise _refuse("a scenario: chains, seed, lane, speed and duration", data) from None


def _read_union(inner: tuple[Any, ...]) -> Read:
    takes_none, readers = type(None) in inner, [_reader(each) for each in inner if each is not type(None)]

    def read(data: Any) -> Any:
        if data is None and takes_none:
            return None
        for reader in readers[:-1]:
            try:
                return reader(data)
            except FieldError:
                continue  # the last reader reports what is wrong
        return readers[-1](data)

    return read


def _read_list(make: Callable[[list[Any]], Any], readers: Read | list[Read]) -> Read:
    """Return a reader of a list, from whose parts ``make`` makes the value.

    A list of readers has one for each part. A single reader reads all parts of a list of any length.
    """
    count, expected = None, "a list"
    if isinstance(readers, list):
        count, expected = len(readers), f"a list of {len(readers)} values"
    of_parts: Iterable[Read] = readers if isinstance(readers, list) else repeat(readers)

    def read(data: Any) -> Any:
        if type(data) is not list or count not in (None, len(data)):
            raise _refuse(expected, data)
        parts: list[Any] = []
        try:
            for reader, part in zip(of_parts, data, strict=False):
                parts.append(reader(part))
        except FieldError as error:  # say in which part
            separator = "." if error.field and not error.field.startswith("[") else ""
            place = f"[{len(parts)}]{separator}{error.field}"
            raise FieldError(field=place, expected=error.expected, received=error.received, fix=error.fix) from None
        try:
            return make(parts)
        except (TypeError, ValueError) as error:
            raise _refuse(f"values that fit together ({error!s:.100})", data) from None

    return read


_SIMPLE: Mapping[Any, Read] = {
    float: _read_float,
    int: _read_exactly(int, "a whole number"),
    str: _read_exactly(str, "a text"),
    bool: _read_exactly(bool, "true or false"),
    Scenario: _read_scenario,
}
