"""Data of a page to dicts, lists, text and numbers and back: it crosses process borders and is embedded in pages."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


def encode(value: object) -> Any:
    """A value as dicts, lists, text and numbers, which JSON and pytest-xdist carry."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: encode(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, (tuple, list)):
        return [encode(inner) for inner in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"expected a view, a tuple, text or a number, received {type(value).__name__} {value!r:.60}")


def decode(kind: type[T], plain: Mapping[str, Any]) -> T:
    """The inverse of :func:`encode` for a dataclass whose fields are dataclasses, tuples, text and numbers.

    Raises:
        ValueError: when keys are missing or unknown.
        TypeError: for a field of any other type.
    """
    kinds = get_type_hints(kind)
    if set(plain) != set(kinds):
        raise ValueError(f"{kind.__name__}: expected the keys {sorted(kinds)}, received {sorted(plain)}")
    return kind(**{name: _decoded(inner, plain[name]) for name, inner in kinds.items()})


def _decoded(kind: Any, plain: Any) -> Any:
    if kind in (float, int, str, bool):
        return kind(plain)  # A float that was whole comes out of JSON as an int.
    if isinstance(kind, type) and is_dataclass(kind):
        return decode(kind, plain)
    origin, inner = get_origin(kind), get_args(kind)
    if origin is tuple:
        kinds = inner[:1] * len(plain) if inner[1:] == (...,) else inner
        return tuple(_decoded(each, value) for each, value in zip(kinds, plain, strict=True))
    if origin in (Union, types.UnionType):
        return None if plain is None else _decoded(next(each for each in inner if each is not type(None)), plain)
    raise TypeError(f"expected a field of views, tuples, text or numbers, received {kind!r}")
