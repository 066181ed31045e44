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
from functools import lru_cache, partial
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
    try:
        return _composed(value)
    except TypeError:
        raise ValueError(
            f"expected a value that JSON can hold, or a dataclass of such values, received {value!r:.100}; convert it"
        ) from None


def _composed(value: Any) -> Any:
    if isinstance(value, Scenario):
        return value.plain()
    if is_dataclass(value) and not isinstance(value, type):
        return [plain(getattr(value, name)) for name in _hints(type(value))]
    if isinstance(value, Mapping):
        return [[plain(key), plain(each)] for key, each in value.items()]
    if isinstance(value, AbstractSet):
        return sorted(map(plain, value), key=json.dumps)  # the order of a set differs from process to process
    return operator.index(value)


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
    origin, inner = get_origin(kind), get_args(kind)
    if origin in _READERS:
        return _READERS[origin](inner)
    if kind in _SIMPLE:
        return _SIMPLE[kind]
    if kind is Hashable:  # a kind of failure, which is stored as its signature
        return _reader(Signature)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _hints(kind)
        make: Callable[..., Any] = kind
        return _read_parts(
            lambda parts: make(**dict(zip(hints, parts, strict=True))), list(map(_reader, hints.values()))
        )
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _read_choice({each.value: each for each in kind})
    raise TypeError(f"expected a type whose values can be stored, received {kind!r}; see pytest_pafot.searching.plain")


def _reader_of_tuple(inner: tuple[Any, ...]) -> Read:
    if inner[-1] is Ellipsis:
        return _read_each(tuple, _reader(inner[0]))
    return _read_parts(tuple, [_reader(each) for each in inner])


def _reader_of_pairs(kind: Callable[[Any], Any], inner: tuple[Any, ...]) -> Read:
    return _read_each(kind, _read_parts(tuple, [_reader(inner[0]), _reader(inner[1] if len(inner) > 1 else int)]))


def _refuse(expected: str, data: Any) -> FieldError:
    return FieldError(expected=expected, received=f"{data!r:.60}")


def _read_float(data: Any) -> float:
    if type(data) is float or type(data) is int:
        return float(data)
    if isinstance(data, str) and data in _NO_NUMBERS:
        return _NO_NUMBERS[data]
    raise _refuse("a number", data)


def _read_exactly(kind: type) -> Read:
    def read(data: Any) -> Any:
        if type(data) is not kind:
            raise _refuse({int: "a whole number", str: "a text", bool: "true or false"}[kind], data)
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


def _read_each(kind: Callable[[list[Any]], Any], reader: Read) -> Read:
    def read(data: Any) -> Any:
        if type(data) is not list:
            raise _refuse("a list", data)
        return kind(_read_all(repeat(reader, len(data)), data))

    return read


def _read_parts(kind: Callable[[list[Any]], Any], readers: list[Read]) -> Read:
    def read(data: Any) -> Any:
        if type(data) is not list or len(data) != len(readers):
            raise _refuse(f"a list of {len(readers)} values", data)
        parts = _read_all(readers, data)
        try:
            return kind(parts)
        except (TypeError, ValueError) as error:
            raise _refuse(f"values that fit together ({error!s:.100})", data) from None

    return read


def _read_all(readers: Iterable[Read], data: list[Any]) -> list[Any]:
    """Return what each reader makes of its part; an error names the part that does not fit."""
    parts: list[Any] = []
    try:
        for reader, each in zip(readers, data, strict=True):
            parts.append(reader(each))
    except FieldError as error:
        separator = "." if error.field and not error.field.startswith("[") else ""
        place = f"[{len(parts)}]{separator}{error.field}"
        raise FieldError(field=place, expected=error.expected, received=error.received, fix=error.fix) from None
    return parts


_SIMPLE: Mapping[Any, Read] = {
    float: _read_float,
    int: _read_exactly(int),
    str: _read_exactly(str),
    bool: _read_exactly(bool),
    Scenario: _read_scenario,
}
_READERS: Mapping[Any, Callable[[tuple[Any, ...]], Read]] = {
    Union: _read_union,
    types.UnionType: _read_union,
    Literal: lambda inner: _read_choice({each: each for each in inner}),
    tuple: _reader_of_tuple,
    frozenset: lambda inner: _read_each(frozenset, _reader(inner[0])),
    Mapping: partial(_reader_of_pairs, dict),
    Counter: partial(_reader_of_pairs, lambda pairs: Counter(dict(pairs))),
}
"""Functions that make a reader for a generic type, by the type's origin; they receive the type's arguments."""
