"""The sources of option values, from the first to the last: the command line, the mark, the configuration file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Literal

import pytest

from pytest_pafot.campaign.options import BUDGETS, BY_NAME, OPTIONS, RUNS, Option, Settings
from pytest_pafot.plugin.marks import DEFAULT_ADS, DEFAULT_ARG, POSITIONAL
from pytest_pafot.support.errors import RequestError

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request

_INI_TYPES: Mapping[str, Literal["int", "float", "bool"]] = {"integer": "int", "seconds": "float", "switch": "bool"}
"""The type of the ini key for each kind of option. The keys of all other kinds are strings."""
_LAST = r"(?<=')[^']*(?='$)|[^\s']+$"
"""The last word or quoted text of a message: pytest's messages about an ini key end with the key's value."""


def add_options(parser: pytest.Parser) -> None:
    """Declare all options of the plugin to pytest, on the command line and in configuration files."""
    group = parser.getgroup("pafot", "search for traffic that makes a driving policy crash (pytest-pafot)")
    for option in OPTIONS:
        value: dict[str, Any] = {"type": option.read, "metavar": option.metavar}
        if option.kind == "switch":
            value = {"action": "store_true"}
        group.addoption(option.flag, dest=option.key, default=None, help=option.help, **value)
        if option.everywhere:
            text = f"Same as {option.flag}."
            parser.addini(option.key, text, type=_INI_TYPES.get(option.kind, "string"), default=None)


def request_of_mark(config: pytest.Config, arguments: Mapping[str, Any]) -> Request:
    """Return the checked request for the arguments of a mark. Positional arguments are under :data:`POSITIONAL`.

    Raises:
        RequestError: on the first wrong argument or option.
    """
    from pytest_pafot.campaign.request import check_names, checked_request  # noqa: PLC0415

    given = {"ads": DEFAULT_ADS, "arg": DEFAULT_ARG, **arguments}
    positional = given.pop(POSITIONAL, ())
    if positional:
        name = getattr(positional[0], "__name__", "")
        example = "runs=20" if not callable(positional[0]) else f"ads={name if name.isidentifier() else '...'}"
        raise RequestError(
            f"@pafot.search: expected keyword arguments only, received {positional!r:.200}; write the argument's name, "
            f"as in @pafot.search({example})"
        )
    check_names(given)
    return checked_request(given, resolve(config, arguments))


def resolve(config: pytest.Config, marker: Mapping[str, object]) -> Settings:
    """Return the value of every option for an item whose mark has the arguments ``marker``.

    Arguments that are not options are ignored.

    Raises:
        RequestError: if a value is wrong; the message names its source.
    """
    for option in OPTIONS:  # A wrong argument is an error even if the command line replaces it today.
        if option.is_argument:
            _read(option, f"@pafot.search({option.name}=...)", marker.get(option.name))
    values = {option.name: option_value(config, option, marker) for option in OPTIONS if option.everywhere}
    # The first source with a budget decides on both.
    budgets = [*zip(*(_values(config, BY_NAME[name], marker) for name in BUDGETS), strict=True)]
    given = next((budget for budget in budgets if budget != (None, None)), (RUNS, None))
    # Generations mean the paper's algorithm, also if a source before gives the number of runs.
    values["algorithm"] = values["algorithm"] or ("pafot" if any(budget[1] for budget in budgets) else None)
    return Settings(**values | dict(zip(BUDGETS, given, strict=True)))


def option_value(config: pytest.Config, option: Option, marker: Mapping[str, object]) -> Any:
    """Return the value of an option for a mark with some arguments.

    Raises:
        RequestError: if the value is wrong; the message names its source.
    """
    return next((value for value in _values(config, option, marker) if value is not None), option.default)


def value_if_right(config: pytest.Config, name: str) -> Any:
    """Return the value of an option of the whole session; None if it is wrong, which each search reports."""
    try:
        return option_value(config, BY_NAME[name], {})
    except RequestError:
        return None


def _values(config: pytest.Config, option: Option, marker: Mapping[str, object]) -> Iterator[Any]:
    """Yield an option's value on the command line, in the mark and in the configuration file; None without one."""
    yield _read(option, option.flag, config.getoption(option.key))
    argument = marker.get(option.name) if option.is_argument else None
    yield _read(option, f"@pafot.search({option.name}=...)", argument)
    try:
        value = config.getini(option.key)
    except (TypeError, ValueError, pytest.UsageError) as error:  # the message ends with the value
        value = "".join(re.findall(_LAST, str(error)))
    yield _read(option, f"ini key {option.key}", value)


def _read(option: Option, place: str, value: object) -> Any:
    try:
        return None if value is None else option.read(value)
    except RequestError as error:
        raise RequestError(f"{place}: {error}") from None
