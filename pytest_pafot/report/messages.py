"""The messages that items send to the session's record: events as JSON-compatible data, and back."""

from __future__ import annotations

import json
import math
import operator
import types
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from itertools import repeat
from types import MappingProxyType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import IN_MEMORY, Signature
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searches.events import Note, Progress, Search
from pytest_pafot.support.errors import FieldError

T = TypeVar("T")

Event = Progress | Search | Seen | Note
"""An event that an item sends to the session's record."""

# The type of a value decides how it is written: a frozen dataclass as the list of its fields, a mapping as the list of
# its pairs, a set as a sorted list, and a number that JSON cannot express as a string. The reader specifies the type,
# and rejects everything else, because the file may be from an untrusted source.

_AS_THEY_ARE = frozenset({type(None), bool, int, str})
_PLAIN_ALREADY = Mapping[str, Any]
_NO_NUMBERS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}


def event_of(kind: str, text: str) -> Event:
    """Build an event from the name of its class and its JSON."""
    kinds: tuple[type[Event], ...] = (Progress, Search, Seen, Note)
    cls = next(each for each in kinds if each.__name__ == kind)
    return from_plain(cls, json.loads(text))


def plain(value: Any) -> Any:
    """Convert a value to lists, strings, numbers, booleans and None.

    Fields with the type Any or ``metadata=IN_MEMORY`` are omitted.

    Raises:
        ValueError: for a value of another type.
    """
    kind = type(value)
    if kind in _AS_THEY_ARE:
        return value
    if kind is tuple or kind is list:
        return [plain(each) for each in value]
    if isinstance(value, float):
        number = float(value)
        if math.isfinite(number):
            return number
        return repr(number)
    if isinstance(value, Enum):
        return value.value
    try:
        if isinstance(value, Scenario):
            return value.plain()
        if hasattr(value, "isoformat"):
            return value.isoformat()
        if is_dataclass(value) and not isinstance(value, type):
            # A field of the type Mapping[str, Any] is JSON-compatible already.
            parts: list[Any] = []
            for name, hint in _hints(type(value)).items():
                part = getattr(value, name)
                parts.append(dict(part) if hint == _PLAIN_ALREADY else plain(part))
            return parts
        if isinstance(value, Mapping):
            return [[plain(key), plain(each)] for key, each in value.items()]
        if isinstance(value, AbstractSet):
            # the order of a set differs from process to process
            return sorted(map(plain, value), key=json.dumps)
        return operator.index(value)
    except TypeError:
        raise ValueError(
            f"expected a value that JSON can store, or a dataclass of such values, but received {value!r:.100}"
        ) from None


def from_plain(kind: type[T], data: Any) -> T:
    """Convert data from :func:`plain` back to a value of the type ``kind``.

    Raises:
        FieldError: for data that does not fit the type. The message contains its position, such as ``[2][0]``.
        TypeError: for a type that cannot be stored.
    """
    return cast("T", _read(kind, data))


@lru_cache(maxsize=256)
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    stored = (each.name for each in fields(kind) if each.init and each.metadata != IN_MEMORY)
    return {name: hints[name] for name in stored if hints[name] is not Any}


def _read(kind: Any, data: Any) -> Any:
    if kind is float:
        if type(data) is float or type(data) is int:
            return float(data)
        if isinstance(data, str) and data in _NO_NUMBERS:
            return _NO_NUMBERS[data]
        raise _refuse("a number", data)
    if kind in _WORDS:
        if type(data) is not kind:
            raise _refuse(_WORDS[kind], data)
        return data
    if kind is Scenario:
        try:
            return Scenario.from_canonical(data)
        except ScenarioError:
            raise  # it is a ValueError, but its message is better than the one below
        except (TypeError, ValueError):
            raise _refuse(
                "a scenario as a list of chains, seed, lane, speed and duration", data
            ) from None
    if kind is Hashable:  # a kind of failure, which is stored as its signature
        kind = Signature
    origin = get_origin(kind)
    inner = get_args(kind)
    if origin is Union or origin is types.UnionType:
        if data is None and type(None) in inner:
            return None
        *others, last = (each for each in inner if each is not type(None))
        for each in others:
            with suppress(FieldError):
                return _read(each, data)
        return _read(last, data)  # if this fails as well, its error is reported
    is_enum = isinstance(kind, type) and issubclass(kind, Enum)
    if is_enum or origin is Literal:
        known = [each.value for each in kind] if is_enum else inner
        if type(data) not in (str, int) or data not in known:
            raise _refuse(f"one of {', '.join(map(str, known))}", data)
        if is_enum:
            return kind(data)
        return data

    if hasattr(kind, "fromisoformat"):
        try:
            return kind.fromisoformat(data)
        except (TypeError, ValueError):
            raise _refuse("a date such as 2026-11-20", data) from None
    if kind == _PLAIN_ALREADY:
        if type(data) is not dict:
            raise _refuse("a mapping", data)
        return data

    # All other types are stored as lists: with a value for each field of a dataclass or each type of a tuple, or with
    # any number of values.
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _hints(kind)
        parts = _read_each(list(hints.values()), data)
        try:
            return kind(**dict(zip(hints, parts, strict=True)))
        except (TypeError, ValueError) as error:
            raise _refuse(f"values that fit together ({error!s:.100})", data) from None
    if origin is tuple and inner[-1] is not Ellipsis:
        return tuple(_read_each(inner, data))
    if origin in (tuple, frozenset, set):
        return origin(_read_each(repeat(inner[0]), data))
    if origin is Mapping:
        return dict(_read_each(repeat(types.GenericAlias(tuple, inner)), data))
    if origin is Counter:
        pairs = _read_each(repeat(types.GenericAlias(tuple, (inner[0], int))), data)
        return Counter(dict(pairs))
    raise TypeError(
        f"expected a type whose values can be stored, but received {kind!r}. See pytest_pafot.report.messages."
    )


# The wording for values of types that are stored as they are.
_WORDS = MappingProxyType({int: "a whole number", str: "a string", bool: "true or false"})


def _read_each(kinds: Sequence[Any] | repeat[Any], data: Any) -> list[Any]:
    # Read the values of a list, each as its kind. `repeat` allows any number of values.
    expected = "a list"
    is_right = type(data) is list
    if not isinstance(kinds, repeat):
        expected = f"a list of {len(kinds)} values"
        is_right = is_right and len(data) == len(kinds)
    if not is_right:
        raise _refuse(expected, data)
    parts: list[Any] = []
    try:
        for kind, part in zip(kinds, data, strict=False):
            parts.append(_read(kind, part))
    except FieldError as error:  # the error names the part that does not fit
        place = f"[{len(parts)}]"
        if error.field and not error.field.startswith("["):
            place = f"{place}."
        raise FieldError(
            field=f"{place}{error.field}",
            expected=error.expected,
            received=error.received,
            fix=error.fix,
        ) from None
    return parts


def _refuse(expected: str, data: Any) -> FieldError:
    return FieldError(expected=expected, received=f"{data!r:.60}")
