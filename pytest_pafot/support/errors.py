"""Errors that the user can fix."""

from __future__ import annotations

import math
import operator
import re
import shlex
from argparse import ArgumentTypeError
from collections.abc import Callable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

RESTORE = "restore the file from version control, or delete it"


class OutOfTime(BaseException):
    """The exception that ends a run at its search's time limit. ``except Exception`` does not catch it."""


class RequestError(ArgumentTypeError):
    """An error in a user's request. argparse prints its message."""


class FieldError(ValueError):
    """An error about an invalid value, with the parts of its message as attributes."""

    def __init__(
        self,
        field: str = "",
        expected: str = "",
        received: str = "",
        fix: str = "",
        *,
        text: str = "",
    ) -> None:
        from pytest_pafot.support.text import visible  # noqa: PLC0415  (most sessions of pytest meet no such error)

        if (
            not expected and not text
        ):  # a message without parts is the only argument, as after unpickling
            field, text = "", field
        # One line that is safe to print, even if it quotes a file from an untrusted source.
        super().__init__(visible(text or sentence(field, expected, received, fix)))
        self.field = field
        self.expected = expected
        self.received = received
        self.fix = fix


def sentence(field: str, expected: str, received: str, fix: str) -> str:
    """Format the message ``field: expected this, received that. Fix``."""
    text = f"expected {expected}, received {received}"
    if field:
        text = f"{field}: {text}"
    # A fix that starts with code stays as it is.
    if re.match(r"[a-z]+[ ,:]", fix):
        fix = fix[0].upper() + fix[1:]
    return f"{text}. {fix}" if fix else text


def refused_policy(expected: str, received: str, fix: str) -> AdsFactoryError:
    """Return the error to raise for a policy that cannot drive."""
    return AdsFactoryError(sentence("ads", expected, received, fix))


# The smallest positive float, a lower limit that excludes zero.
POSITIVE = math.ulp(0.0)


def checked_number(
    value: object,
    field: str,
    expected: str,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    error: type[FieldError] = FieldError,
) -> float:
    """Return a value as a float, or raise ``error`` if it is not a finite number from ``least`` to ``most``."""
    number = plain_number(value)
    if number is None or not least <= number <= most:
        raise error(field, expected, f"{value!r:.100}")
    return float(number)


def checked_whole(
    value: object,
    field: str,
    expected: str,
    *,
    least: int,
    most: float = math.inf,
    error: type[FieldError] = FieldError,
) -> int:
    """Return a value as an int, or raise ``error`` if it is not a whole number from ``least`` to ``most``."""
    number = plain_whole(value)
    if number is None or not least <= number <= most:
        raise error(field, expected, f"{value!r:.100}")
    return number


def plain_number(value: object) -> float | None:
    """Return a finite number as Python's own int or float, or None for any other value."""
    if isinstance(value, bool) or not isinstance(value, Real):
        return None
    kind: Any = int if isinstance(value, Integral) else float
    try:
        number: float = kind(value)
        if math.isfinite(number):
            return number
    except OverflowError:  # The int is too large for a float.
        pass
    return None


def plain_whole(value: object) -> int | None:
    """Return a whole number as Python's own int, or None for any other value."""
    if isinstance(value, bool) or not hasattr(type(value), "__index__"):
        return None
    try:
        return operator.index(value)  # type: ignore[arg-type]
    except TypeError:  # numpy's arrays and booleans have __index__, but it raises
        return None


class WorldError(FieldError):
    """A world that cannot be run, or a scenario that does not fit it."""


class DriverError(WorldError):
    """A driver that a world cannot simulate as the ego."""


class AdsFactoryError(TypeError):
    """A factory that does not make a policy for the world of the search."""


class BadAction(Exception):  # noqa: N818  (findings show this name, so it names the mistake)
    """An invalid action that a policy has returned."""


class CorpusError(FieldError):
    """A corpus file that cannot be used."""

    def __init__(
        self,
        path: Path,
        expected: str,
        received: str,
        fix: str = RESTORE,
        *,
        field: str = "",
        line: int | None = None,
    ) -> None:
        place = str(path)
        if line is not None:
            place += f":{line}"
        text = f"{place}: {sentence(field, expected, received, fix)}"
        super().__init__(field, expected, received, fix, text=text)
        self.path = path
        self.line = line


# The commands, options and packages that messages recommend. A test runs everything that these functions return.

# The environment variable with the command that started the pytest session, such as `search`, as it was typed.
OF_SEARCH = "PYTEST_PAFOT_SEARCH"

# The environment variable with the options of the command `replay` for scenarios that this `search` saves.
OF_REPLAY = "PYTEST_PAFOT_REPLAY"


def command(*words: object) -> str:
    """Format a shell command such as ``python -m pytest_pafot corpus list``."""
    return shlex.join(["python", "-m", *map(str, words)])


def flag(name: str, value: object = None) -> str:
    """Format an option for pytest or the command ``search``, such as ``--pafot-max-time=5``."""
    option = f"--pafot-{name.replace('_', '-')}"
    if value is None:
        return option
    return shlex.join([f"{option}={value}"])


def install(name: str) -> str:
    """Return the command that installs an extra of this package."""
    return f"pip install 'pytest-pafot[{name}]'"


def rerun(words: Sequence[str], environ: Mapping[str, str], *options: str, saved: str = "") -> str:
    """Return the command that repeats part of a session, or only the scenario with the id ``saved``."""
    # The commands `search` and `replay` leave no test files that pytest could run. So in their sessions, the result is
    # the command itself, or `replay` for one saved scenario.
    if not environ.get(OF_SEARCH):
        return shlex.join([*words, *options])
    if saved and OF_REPLAY in environ:
        return command("pytest_pafot", "replay", saved, *shlex.split(environ[OF_REPLAY]))
    given = shlex.split(environ[OF_SEARCH])
    # Options cannot follow "--".
    end = [*given, "--"].index("--")
    return shlex.join([*given[:end], *options, *given[end:]])


def asserts_run(function: Callable[..., Any]) -> bool:
    """Return whether Python executes the assertions in a function."""
    # `python -O` disables all assertions that pytest does not rewrite. This package does not need assertions.
    if __debug__:
        return True
    known = getattr(function, "__globals__", None)
    if not known:
        known = getattr(type(function).__call__, "__globals__", {})
    package, _, _ = str(known.get("__name__")).partition(".")
    return "@pytest_ar" in known or package == "pytest_pafot"


def check_asserts(holds: Callable[..., Any]) -> None:
    """Raise a ``RequestError`` if Python skips the assertions in a function."""
    if not asserts_run(holds):  # otherwise, every run would pass
        name = getattr(holds, "__name__", type(holds).__name__)
        raise RequestError(
            f"{name}: expected a function whose assertions run, but Python skips them with -O or PYTHONOPTIMIZE, so "
            "every run would pass. Run Python without -O and PYTHONOPTIMIZE"
        )
