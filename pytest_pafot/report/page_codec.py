"""Frozen values to plain data and back, so that views cross process borders and are embedded in pages."""

from __future__ import annotations

import types
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

T = TypeVar("T")


def encode(value: object) -> Any:
    """A value as dicts, lists, text and numbers, which JSON and pytest-xdist carry."""
    if is_dataclass(value) and not isinstance(value, type):
        return {name: encode(getattr(value, name)) for name in _hints(type(value))}
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
    return cast("T", _built(kind, plain))


def _built(kind: Any, plain: Any) -> Any:
    if is_dataclass(kind):
        return _built_dataclass(kind, plain)
    origin = get_origin(kind)
    if origin is tuple:
        return _built_tuple(get_args(kind), plain)
    if origin in (Union, types.UnionType):
        inner = next(option for option in get_args(kind) if option is not type(None))
        return None if plain is None else _built(inner, plain)
    if origin is Literal:
        return plain
    if kind is float:
        return float(plain)
    if kind in (int, str, bool):
        return kind(plain)
    raise TypeError(f"expected a field of views, tuples, text or numbers, received {kind!r}")


def _built_dataclass(kind: Any, plain: Mapping[str, Any]) -> Any:
    hints = _hints(kind)
    if set(plain) != set(hints):
        raise ValueError(f"{kind.__name__}: expected the keys {sorted(hints)}, received {sorted(plain)}")
    return kind(**{name: _built(hint, plain[name]) for name, hint in hints.items()})


def _built_tuple(kinds: tuple[Any, ...], plain: Any) -> tuple[Any, ...]:
    if len(kinds) == 2 and kinds[1] is ...:
        return tuple(_built(kinds[0], inner) for inner in plain)
    return tuple(_built(kind, inner) for kind, inner in zip(kinds, plain, strict=True))


@lru_cache(maxsize=64)
def _hints(kind: type) -> dict[str, Any]:
    resolved = get_type_hints(kind)
    return {field.name: resolved[field.name] for field in fields(kind)}
