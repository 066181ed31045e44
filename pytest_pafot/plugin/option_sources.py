"""The sources of option values.

Of several sources with a value, the first of this list is used: command line, mark, environment, configuration file,
profile, default.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pytest

from pytest_pafot.campaign.options import BUDGETS, BY_NAME, FULL, LOCAL, OPTIONS, PROFILES, Option, Settings, is_ci
from pytest_pafot.plugin.marks import DEFAULT_ADS, DEFAULT_ARG, POSITIONAL
from pytest_pafot.support.errors import RequestError

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request

_INI_TYPES: Mapping[str, Literal["int", "float", "bool"]] = {"integer": "int", "seconds": "float", "switch": "bool"}
"""The type of the ini key for each kind of option. The keys of all other kinds are strings."""
_LAST = re.compile(r"(?<=')[^']*(?='$)|[^\s']+$")
"""The last word or quoted text of a message: pytest's messages about an ini key end with the key's value."""


def add_options(parser: pytest.Parser) -> None:
    """Declare all options of the plugin to pytest, on the command line and in configuration files."""
    group = parser.getgroup("pafot", "search for traffic that makes a driving policy crash (pytest-pafot)")
    for option in OPTIONS:
        value: dict[str, Any] = {"type": option.read, "metavar": option.metavar}
        if option.kind == "switch":
            value = {"action": "store_true"}
        # The link has its own line, since the help's lines are otherwise broken at the hyphens of its flag.
        group.addoption(option.flag, dest=option.key, default=None, help=f"{option.help}\n{option.link}", **value)
        if option.everywhere:
            text = f"Same as {option.flag}."
            parser.addini(option.key, text, type=_INI_TYPES.get(option.kind, "string"), default=None)


def corpus_name(config: pytest.Config, marker: Mapping[str, object]) -> str | None:
    """Return the value of the option ``corpus``; None if that value is wrong."""
    value = option_value(config, BY_NAME["corpus"], marker)
    return None if value is None else str(value)


def option_value(config: pytest.Config, option: Option, marker: Mapping[str, object]) -> Any:
    """Return the value of an option for a mark with some arguments; None if it is wrong, which each search reports."""
    try:
        return Sources(config=config, marker=marker, environ=os.environ).value(option)
    except RequestError:
        return None


def isolates_by_profile(config: pytest.Config, marker: Mapping[str, object]) -> bool:
    """Return whether a policy is isolated only because of the profile, and nobody has asked for it.

    Raises:
        RequestError: if the value of an option is wrong.
    """
    sources, option = Sources(config=config, marker=marker, environ=os.environ), BY_NAME["isolate"]
    if sources.given(option) is not None:
        return False
    return isolates(config, marker) and not sources.ini(option)


def isolates(config: pytest.Config, marker: Mapping[str, object]) -> bool:
    """Return whether a policy is isolated in a test whose mark has the arguments ``marker``.

    Raises:
        RequestError: if the value of an option is wrong.
    """
    return bool(Sources(config=config, marker=marker, environ=os.environ).value(BY_NAME["isolate"]))


def request_of_mark(config: pytest.Config, arguments: Mapping[str, Any], fresh_seed: int) -> Request:
    """Return the checked request for the arguments of a mark. Positional arguments are under :data:`POSITIONAL`.

    Raises:
        RequestError: on the first wrong argument or option.
    """
    from pytest_pafot.campaign.request import check_names, checked_request  # noqa: PLC0415
    from pytest_pafot.support.errors import RequestError  # noqa: PLC0415

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
    except RequestError as error:
        raise RequestError(str(error)) from None
    return checked_request(given, settings)


def resolve(
    config: pytest.Config, marker: Mapping[str, object], fresh_seed: int, environ: Mapping[str, str] = os.environ
) -> Settings:
    """Return the value of every option for an item whose mark has the arguments ``marker``.

    Arguments that are not options are ignored. The base seed is ``fresh_seed`` if no source gives a base seed.

    Raises:
        RequestError: if a value is wrong; the message names its source.
    """
    sources = Sources(config=config, marker=marker, environ=environ)
    for option in OPTIONS:  # A wrong argument is an error even if another source replaces it today.
        sources.argument(option)
    values = {option.name: sources.value(option) for option in OPTIONS if option.everywhere}
    values |= sources.budget()
    if values["seed"] is None:
        values["seed"] = fresh_seed if values["resume"] is None else 0  # a resumed search needs a constant seed
    return Settings(profile=sources.profile, **values)


class Sources(NamedTuple):
    """The sources of option values. They are read one option at a time, so that an error can name the source."""

    config: pytest.Config
    marker: Mapping[str, object]
    environ: Mapping[str, str]

    @property
    def profile(self) -> str:
        """The name of the profile."""
        return FULL if is_ci(self.environ) else LOCAL

    def value(self, option: Option) -> Any:
        """Return the value of an option from the first source that has one.

        Raises:
            RequestError: if the value is wrong; the message names its source.
        """
        return next((value for source in self._sources(option) if (value := source()) is not None), option.default)

    def budget(self) -> dict[str, Any]:
        """Return the options that limit a search (:data:`BUDGETS`), all from the first source that has one of them."""
        each = [self._sources(BY_NAME[name]) for name in BUDGETS]
        together = ([source() for source in sources] for sources in zip(*each, strict=True))
        given = next((values for values in together if any(value is not None for value in values)), (None, None))
        return dict(zip(BUDGETS, given, strict=True))

    def _sources(self, option: Option) -> tuple[Callable[[], Any], ...]:
        return (
            *(partial(_read, option, place, value) for place, value in self._places(option)),
            lambda: self.ini(option),
            lambda: PROFILES[self.profile].get(option.name),
        )

    def given(self, option: Option) -> Any:
        """Return an option's value on the command line, in the mark or in the environment; None without one."""
        read = (_read(option, place, value) for place, value in self._places(option))
        return next((value for value in read if value is not None), None)

    def argument(self, option: Option) -> Any:
        """Return an option's value in the mark; None without one."""
        return _read(option, *self._places(option)[1])

    def _places(self, option: Option) -> tuple[tuple[str, object], ...]:
        """Return the names of three sources (command line, mark, environment), each with its value of an option."""
        return (
            (option.flag, self.config.getoption(option.key)),
            (f"@pafot.search({option.name}=...)", self.marker.get(option.name) if option.is_argument else None),
            (f"environment variable {option.variable}", self.environ.get(option.variable) or None),
        )

    def ini(self, option: Option) -> Any:
        """Return an option's value in pytest's configuration file; None if the file has no value."""
        place = f"ini key {option.key}"
        try:
            value = self.config.getini(option.key)
        except (TypeError, ValueError, pytest.UsageError) as error:  # the message ends with the value
            value = "".join(_LAST.findall(str(error)))
        return _read(option, place, value)


def _read(option: Option, place: str, value: object) -> Any:
    try:
        return None if value is None else option.read(value)
    except RequestError as error:
        raise RequestError(f"{place}: {error}") from None
