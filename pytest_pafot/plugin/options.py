"""Where the values of options come from.

Precedence: command line, marker, environment, a profile that was named, ini, the automatic profile, the default.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pytest

from pytest_pafot.campaign.options import (
    BY_NAME,
    FULL,
    LOCAL,
    OPTIONS,
    PROFILES,
    Kind,
    Option,
    OptionError,
    Settings,
    is_ci,
)
from pytest_pafot.plugin.marks import DEFAULT_ADS, DEFAULT_ARG, POSITIONAL

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request

Source = Literal["command line", "marker", "environment", "ini"]

_INI_TYPES: Mapping[Kind, Literal["int", "float", "string", "bool"]] = {
    "integer": "int",
    "seconds": "float",
    "text": "string",
    "page": "string",
    "switch": "bool",
    "workers": "string",
}


def add_options(parser: pytest.Parser) -> None:
    """Declare the whole table to pytest."""
    group = parser.getgroup("pafot", "search for traffic that makes a driving policy crash (pytest-pafot)")
    for option in OPTIONS:
        if option.kind == "switch":
            group.addoption(option.flag, dest=option.key, action="store_true", default=None, help=option.help)
        else:
            group.addoption(
                option.flag,
                dest=option.key,
                type=_argparse_type(option),
                default=None,
                metavar=option.metavar,
                help=option.help,
            )
        if option.everywhere:
            parser.addini(
                option.key, f"{option.help} Same as {option.flag}.", type=_INI_TYPES[option.kind], default=None
            )


def corpus_name(config: pytest.Config, marker: Mapping[str, object]) -> str | None:
    """The option ``corpus`` alone; None where it, or the choice of a profile, is wrong."""
    sources = Sources(config=config, marker=marker, environ=os.environ)
    try:
        return str(value_of(BY_NAME["corpus"], sources, None, LOCAL))
    except OptionError:
        return None


def request_of_mark(config: pytest.Config, arguments: Mapping[str, Any], fresh_seed: int) -> Request:
    """Check the arguments of a mark.

    Args:
        config: of the session, for options.
        arguments: of the mark, with those that it gives by position under :data:`POSITIONAL`.
        fresh_seed: the base seed when no source gives one.

    Raises:
        RequestError: on the first wrong argument or option.
    """
    from pytest_pafot.campaign.request import RequestError, check_names, checked_request  # noqa: PLC0415

    given = {"ads": DEFAULT_ADS, "arg": DEFAULT_ARG, **arguments}
    positional = given.pop(POSITIONAL, ())
    if positional:
        name = getattr(positional[0], "__name__", "")
        example = "generations=20" if not callable(positional[0]) else f"ads={name if name.isidentifier() else '...'}"
        raise RequestError(
            f"@pafot.search: expected keyword arguments only, received {positional!r:.200}; write the argument's name, "
            f"as in @pafot.search({example})"
        )
    check_names(given)
    try:
        settings = resolve(config, arguments, fresh_seed)
    except OptionError as error:
        raise RequestError(str(error)) from None
    return checked_request(given, settings)


def resolve(
    config: pytest.Config, marker: Mapping[str, object], fresh_seed: int, environ: Mapping[str, str] = os.environ
) -> Settings:
    """The settings of an item.

    Args:
        config: of the session, for command line and ini.
        marker: the arguments of the item's marker; those that are no options are not looked at.
        fresh_seed: the base seed when no source gives one.
        environ: where PAFOT_* variables and CI are looked up.

    Raises:
        OptionError: naming the source, what was expected and received.
    """
    sources = Sources(config=config, marker=marker, environ=environ)
    named = sources.first(BY_NAME["profile"], ("command line", "marker", "environment", "ini"))
    automatic = FULL if is_ci(environ) else LOCAL
    values = {
        option.name: value_of(option, sources, named, automatic)
        for option in OPTIONS
        if option.everywhere and option.name != "profile"
    }
    if values["seed"] is None:
        values["seed"] = fresh_seed
    return Settings(profile=named or automatic, **values)


class Sources(NamedTuple):
    """Where values come from, read one option at a time so that an error names its place."""

    config: pytest.Config
    marker: Mapping[str, object]
    environ: Mapping[str, str]

    def first(self, option: Option, order: tuple[Source, ...]) -> Any:
        """The value in the first of these sources that has one.

        Raises:
            OptionError: naming the source, what was expected and received.
        """
        for source in order:
            place, value = self._raw(option, source)
            if value is None:
                continue
            try:
                return option.read(value)
            except OptionError as error:
                raise OptionError(f"{place}: {error}") from None
        return None

    def _raw(self, option: Option, source: Source) -> tuple[str, object]:
        if source == "command line":
            return option.flag, self.config.getoption(option.key)
        if source == "marker":
            return f"@pafot.search({option.name}=...)", self.marker.get(option.name) if option.is_argument else None
        if source == "environment":
            return f"environment variable {option.variable}", self.environ.get(option.variable) or None
        return f"ini key {option.key}", _ini(self.config, option)


def value_of(option: Option, sources: Sources, named: str | None, automatic: str) -> Any:
    """The value of an option, by the precedence; ``named`` and ``automatic`` are profiles."""
    value = sources.first(option, ("command line", "marker", "environment"))
    if value is None and named:
        value = PROFILES[named].get(option.name)
    if value is None:
        value = sources.first(option, ("ini",))
    if value is None and not named:
        value = PROFILES[automatic].get(option.name)
    return option.default if value is None else value


def _ini(config: pytest.Config, option: Option) -> object:
    try:
        return config.getini(option.key)
    except (TypeError, ValueError, pytest.UsageError) as error:
        raise OptionError(f"ini key {option.key}: {error}") from None


def _argparse_type(option: Option) -> Callable[[str], Any]:
    def read(text: str) -> Any:
        try:
            return option.read(text)
        except OptionError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read
