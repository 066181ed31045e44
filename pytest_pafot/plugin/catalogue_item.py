"""The items of ``@pafot.catalogue``: one for each named scenario, which is driven once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.plugin.marks import CATALOGUE_MARK, DEFAULT_ADS, DEFAULT_ARG, WORLD_FIXTURE
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import visible

if TYPE_CHECKING:
    from pytest_pafot.sweeps.entries import Entry


class Catalogued:
    """Hooks that make the items of a marked test, and run them."""

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrize a marked test function with the entries of the catalogue that its mark names."""
        mark = metafunc.definition.get_closest_marker(CATALOGUE_MARK)
        if mark is None or DEFAULT_ARG not in metafunc.fixturenames:
            return  # an item without the parameter fails when it is run
        from pytest_pafot.sweeps.entries import chosen  # noqa: PLC0415  (imports the simulation)

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
        from pytest_pafot.sweeps.entries import chosen, entry_of  # noqa: PLC0415

        try:
            if DEFAULT_ARG not in pyfuncitem.funcargs:
                raise RequestError(
                    f"expected a parameter {DEFAULT_ARG!r} that receives the simulated run; write "
                    f"`def {pyfuncitem.originalname}({DEFAULT_ARG})`"
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
            known = ", ".join(dict.fromkeys(each for entry in entries for each in entry.parameters))
            raise RequestError(f"@pafot.catalogue: expected ads, world or one of {known}, received {name!r}")


def _drive(item: pytest.Function, entry: Entry, given: Mapping[str, Any]) -> None:
    __tracebackhide__ = True
    from pytest_pafot.campaign.harness import checked_factory, refusals, source_file  # noqa: PLC0415
    from pytest_pafot.model.scenario import ScenarioError  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import bound_test  # noqa: PLC0415
    from pytest_pafot.support.references import factory_named  # noqa: PLC0415
    from pytest_pafot.sweeps.entries import fits  # noqa: PLC0415
    from pytest_pafot.sweeps.maps import driven, judged  # noqa: PLC0415

    ads = given.get("ads", DEFAULT_ADS)
    if isinstance(ads, str):
        ads = factory_named(ads) if ":" in ads else checked_factory(item.funcargs[ads], ads)
    world = entry.world(given.get("world", item.funcargs[WORLD_FIXTURE]))
    values = {name: value for name, value in given.items() if name in entry.parameters}
    test, file = bound_test(item, DEFAULT_ARG), source_file(item.obj, str(item.path))
    why = fits(entry, world, **values)
    if why:
        pytest.skip(f"this world cannot drive it: {visible(why)}")
    try:
        scenario = entry.scenario(world, **values)
    except ScenarioError as error:  # for a value that is no such scenario
        raise RequestError(f"{entry.name}: {error}") from None
    with refusals():
        run = driven(world, scenario, ads)
    found = judged(run, test, file)
    if found.kind == "avoided":
        return
    exception = found.verdict.exception
    if not found.avoided_by or exception is None:
        pytest.skip(visible(f"{found.kind}: {found.words}"))
    told = [f"{entry.name}: {entry.about}", f"source     {entry.source}", f"result     {found.words}"]
    explanation = run.explain().splitlines()
    told += [] if explanation[0] in str(exception) else explanation
    item.add_report_section("call", "pafot", "\n".join(map(visible, told)))
    raise exception
