"""The items of ``@pafot.catalogue``: one for each named scenario, which is driven once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NoReturn

import pytest

from pytest_pafot.plugin.collection import is_parametrised
from pytest_pafot.plugin.marks import CATALOGUE_MARK, DEFAULT_ADS, DEFAULT_ARG, WORLD_FIXTURE, arguments_of
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import ascii_text, fitted_lines, meant, visible

if TYPE_CHECKING:
    from pytest_pafot.extras.sweeps.entries import Entry


class Catalogued:
    """Hooks that make the items of a marked test, and run them."""

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrize a marked test function with the entries of the catalogue that its mark names."""
        mark = metafunc.definition.get_closest_marker(CATALOGUE_MARK)
        is_free = DEFAULT_ARG in metafunc.fixturenames and not is_parametrised(metafunc, DEFAULT_ARG)
        if mark is None or not is_free or arguments_of(metafunc.definition) is not None:
            return  # one item is left, which fails when it is run
        from pytest_pafot.extras.sweeps.entries import chosen  # noqa: PLC0415  (imports the simulation)

        try:
            names = [entry.name for entry in chosen(mark.args)]
        except RequestError:
            names = ["?"]  # the item reports what is wrong
        metafunc.parametrize(DEFAULT_ARG, names)

    @pytest.hookimpl(tryfirst=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> bool | None:
        """Drive the scenario of a marked item, and judge it by the test function."""
        mark = pyfuncitem.get_closest_marker(CATALOGUE_MARK)
        if mark is None:
            return None
        from pytest_pafot.extras.sweeps.entries import chosen, entry_of  # noqa: PLC0415

        try:
            if arguments_of(pyfuncitem) is not None:
                raise RequestError(
                    "expected @pafot.search or @pafot.catalogue, received both; write a test for each of them"
                )
            if not isinstance(pyfuncitem.funcargs.get(DEFAULT_ARG), str):
                raise RequestError(
                    f"expected a parameter {DEFAULT_ARG!r} that is free for the simulated run; write "
                    f"`def {pyfuncitem.originalname}({DEFAULT_ARG})`, and give other parameters other names"
                )
            entries = chosen(mark.args)
            _check_values(entries, mark.kwargs)
            _drive(pyfuncitem, entry_of(pyfuncitem.funcargs[DEFAULT_ARG]), mark.kwargs)
        except RequestError as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        return True


OF_MARK = ("ads", "world")
"""The arguments of the mark that are no parameters of entries."""


def _check_values(entries: tuple[Entry, ...], given: Mapping[str, Any]) -> None:
    """Refuse a value that no entry of the test has.

    Raises:
        RequestError: if there is one.
    """
    for name in given:
        if name not in OF_MARK and not any(name in entry.parameters for entry in entries):
            known = dict.fromkeys(each for entry in entries for each in entry.parameters)
            expected, hint = f"ads, world or one of {', '.join(known)}", meant(name, (*OF_MARK, *known))
            raise RequestError(f"@pafot.catalogue: expected {expected}, received {name!r}{hint}")


def _skip(reason: str) -> NoReturn:
    """Skip the item, which `-rs` then names by the place of the test and not of this file."""
    raise pytest.skip.Exception(reason, _use_item_location=True)


def _drive(item: pytest.Function, entry: Entry, given: Mapping[str, Any]) -> None:
    __tracebackhide__ = True
    from pytest_pafot import Highway, ScenarioError  # noqa: PLC0415
    from pytest_pafot.extending import (  # noqa: PLC0415
        ProcessLostError,
        checked_factory,
        driven_first,
        ended,
        refusals,
        source_file,
    )
    from pytest_pafot.extras.sweeps.entries import NoPlaceError, fits  # noqa: PLC0415
    from pytest_pafot.extras.sweeps.maps import driven, judged, named_factory  # noqa: PLC0415
    from pytest_pafot.plugin.failure_reports import SUMMARY  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import bound_test, shown  # noqa: PLC0415
    from pytest_pafot.world.protocol import missing  # noqa: PLC0415

    ads = given.get("ads", DEFAULT_ADS)
    is_fixture = isinstance(ads, str) and ":" not in ads
    ads = checked_factory(item.funcargs[ads], ads) if is_fixture else named_factory(ads)
    world = given.get("world", item.funcargs[WORLD_FIXTURE])
    missed = missing(world)
    if missed:
        raise RequestError(f"world: expected pafot.Highway(...) or pafot.World(...), received {world!r:.80}")
    # The default highway is too slow for some entries; a world that the user has chosen is used as it is.
    world = entry.world(None if world == Highway() and "world" not in given else world)
    values = {name: value for name, value in given.items() if name in entry.parameters}
    test, file = bound_test(item, DEFAULT_ARG), source_file(item.obj, str(item.path))
    try:
        scenario = entry.scenario(world, **values)
        why = fits(scenario, world)
    except NoPlaceError as error:
        why = str(error)
    except ScenarioError as error:  # for a value that is no such scenario
        raise RequestError(f"{entry.name}: {error}") from None
    if why:
        _skip(f"{entry.name}: this world cannot drive it: {visible(why)}")
    try:
        with refusals(), driven_first(world, ads) as drive:
            drive(scenario)
            run = driven(world, scenario, ads)
    except ProcessLostError as lost:
        raise RequestError(f"{entry.name}: {ended(lost)}") from None
    found = judged(run, test, file)
    if found.kind == "avoided":
        return
    exception = found.verdict.exception
    if found.error is not None:
        raise shown(found.error)
    if exception is None or not (found.avoided_by or found.verdict.is_ads):
        _skip(visible(f"{entry.name}: {found.kind}: {found.words}"))
    told = [f"{entry.name}: {entry.about}", f"source     {entry.source}", f"result     {found.words}"]
    explanation = run.explain().splitlines()
    told += [] if explanation[0] in str(exception) else explanation
    item.add_report_section("call", "pafot", "\n".join(fitted_lines(told, item.config.stash[SHARED].width)))
    item.stash[SUMMARY] = ascii_text(found.words)
    raise shown(exception)
