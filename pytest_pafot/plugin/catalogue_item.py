"""The items of ``@pafot.catalogue``: one for each named scenario, which is driven once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from pytest_pafot.door import CATALOGUE, opened
from pytest_pafot.plugin.collection import is_parametrised
from pytest_pafot.plugin.marks import CATALOGUE_MARK, DEFAULT_ADS, DEFAULT_ARG, WORLD_FIXTURE, arguments_of
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import ascii_text, fitted_lines


class Catalogued:
    """Hooks that make the items of a marked test, and run them."""

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrize a marked test function with the entries of the catalogue that its mark names."""
        mark = metafunc.definition.get_closest_marker(CATALOGUE_MARK)
        is_free = DEFAULT_ARG in metafunc.fixturenames and not is_parametrised(metafunc, DEFAULT_ARG)
        if mark is None or not is_free or arguments_of(metafunc.definition) is not None:
            return  # one item is left, which fails when it is run
        try:
            names = opened(CATALOGUE).names(mark.args)  # imports the simulation
        except RequestError:
            names = ["?"]  # the item reports what is wrong
        metafunc.parametrize(DEFAULT_ARG, names)

    @pytest.hookimpl(tryfirst=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> bool | None:
        """Drive the scenario of a marked item, and judge it by the test function."""
        mark = pyfuncitem.get_closest_marker(CATALOGUE_MARK)
        if mark is None:
            return None
        try:
            name = pyfuncitem.funcargs.get(DEFAULT_ARG)
            if not isinstance(name, str):
                raise RequestError(
                    f"expected a parameter {DEFAULT_ARG!r} that is free for the simulated run; write "
                    f"`def {pyfuncitem.originalname}({DEFAULT_ARG})`, and give other parameters other names"
                )
            opened(CATALOGUE).check(mark.args, mark.kwargs)
            _drive(pyfuncitem, name, mark.args, mark.kwargs)
        except RequestError as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        return True


def _drive(item: pytest.Function, name: str, named: tuple[Any, ...], given: Mapping[str, Any]) -> None:
    __tracebackhide__ = True
    from pytest_pafot.campaign.harness import checked_factory  # noqa: PLC0415
    from pytest_pafot.campaign.request import named_world  # noqa: PLC0415
    from pytest_pafot.campaign.verdict import source_file  # noqa: PLC0415
    from pytest_pafot.plugin.failure_reports import SUMMARY  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import bound_test, shown  # noqa: PLC0415
    from pytest_pafot.world import Highway  # noqa: PLC0415
    from pytest_pafot.world.guard.own_worlds import base_world  # noqa: PLC0415

    ads = given.get("ads", DEFAULT_ADS)
    if isinstance(ads, str) and ":" not in ads:
        ads = checked_factory(item.funcargs[ads], ads)
    world = given.get("world", item.funcargs[WORLD_FIXTURE])
    if isinstance(world, str):
        world = named_world(world, "@pafot.catalogue(world=...)")
    if base_world(world).missing:
        raise RequestError(f"world: expected a world such as pafot.Highway(...), received {world!r:.80}")
    # The default highway is too slow for some entries; a world that the user has chosen is used as it is.
    world = None if world == Highway() and "world" not in given else world
    test, file = bound_test(item, DEFAULT_ARG), source_file(item.obj, str(item.path))
    result = opened(CATALOGUE).driven(name, named, world, ads, given, test, file)
    if result.skip:  # `-rs` then names the place of the test and not of this file
        raise pytest.skip.Exception(result.skip, _use_item_location=True)
    if result.lines:
        item.add_report_section("call", "pafot", "\n".join(fitted_lines(result.lines, item.config.stash[SHARED].width)))
        item.stash[SUMMARY] = ascii_text(result.words)
    if result.exception is not None:
        raise shown(result.exception)
