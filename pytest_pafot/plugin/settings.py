"""The settings that an item ends up with: the value of every option, from the first source that has one."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass

import pytest

from pytest_pafot.plugin.options import BY_NAME, FULL, LOCAL, OPTIONS, Sources, is_ci, value_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The value of every option for one item. ``seed`` is the base seed."""

    generations: int
    population: int
    seed: int
    algorithm: str
    max_time: float | None
    total_time: float | None
    stop_after: int | None
    shrink_rollouts: int
    max_saved: int
    corpus: str
    save: str
    workers: int
    isolate: bool
    report: str | None
    profile: str
    strict_drift: bool
    strict_health: bool


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
