"""What the core asks the catalogue for the items of ``@pafot.catalogue``: names, parameters, and how a run ended."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from pytest_pafot import Run, ScenarioError
from pytest_pafot.extending import ProcessLostError, driving, refusals
from pytest_pafot.extras.sweeps.entries import NoPlaceError, chosen, fits
from pytest_pafot.extras.sweeps.maps import judged, named_factory
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import meant, visible

OF_MARK = ("ads", "world")
"""The arguments of the mark that are no parameters of entries."""


def names(given: tuple[Any, ...]) -> list[str]:
    """Return the names of the entries that a mark names."""
    return [entry.name for entry in chosen(given)]


def check(named: tuple[Any, ...], given: Mapping[str, Any]) -> None:
    """Refuse a value that no entry of the test has.

    Raises:
        RequestError: if there is one.
    """
    entries = chosen(named)
    for name in given:
        if name not in OF_MARK and not any(name in entry.parameters for entry in entries):
            known = dict.fromkeys(each for entry in entries for each in entry.parameters)
            expected, hint = f"ads, world or one of {', '.join(known)}", meant(name, (*OF_MARK, *known))
            raise RequestError(f"@pafot.catalogue: expected {expected}, received {name!r}{hint}")


class Told(NamedTuple):
    """The end of an item: the reason to skip it, or the exception to raise and lines and words about it, or nothing."""

    skip: str = ""
    exception: BaseException | None = None
    lines: Sequence[str] = ()
    words: str = ""


def driven(
    name: str,
    named: tuple[Any, ...],
    world: Any,
    ads: Any,
    given: Mapping[str, Any],
    test: Callable[[Run], Any],
    file: str,
) -> Told:
    """Drive one of the named entries with the given values, and judge the run; without a world, in that of the entry.

    Raises:
        RequestError: for a value that makes no scenario, and for a policy that cannot be driven.
    """
    __tracebackhide__ = True
    entry, ads = next(each for each in chosen(named) if each.name == name), named_factory(ads)
    world = entry.world(world)
    values = {each: value for each, value in given.items() if each in entry.parameters}
    try:
        scenario = entry.scenario(world, **values)
        why = fits(scenario, world)
    except NoPlaceError as error:
        why = str(error)
    except ScenarioError as error:  # for a value that is no such scenario
        raise RequestError(f"{entry.name}: {error}") from None
    if why:
        return Told(skip=f"{entry.name}: this world cannot drive it: {visible(why)}")
    try:
        with refusals(), driving(world, ads) as drive:
            run = drive(scenario)
    except ProcessLostError as lost:
        raise RequestError(f"{entry.name}: {lost.advice}") from None
    found = judged(run, test, file)
    if found.kind == "avoided":
        return Told()
    if found.error is not None:
        return Told(exception=found.error)
    exception = found.verdict.exception
    if exception is None or not (found.avoided_by or found.verdict.is_ads):
        return Told(skip=visible(f"{entry.name}: {found.kind}: {found.words}"))
    lines = [f"{entry.name}: {entry.about}", f"source     {entry.source}", f"result     {found.words}"]
    explanation = run.explain().splitlines()
    lines += [] if explanation[0] in str(exception) else explanation
    return Told(exception=exception, lines=lines, words=found.words)
