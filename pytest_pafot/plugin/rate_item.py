"""Items of ``@pafot.rate``, which count crashes in ordinary traffic."""

from __future__ import annotations

import inspect

import pytest

from pytest_pafot.plugin import messages
from pytest_pafot.plugin.marks import RATE_ARG, RATE_MARK
from pytest_pafot.plugin.option_sources import resolve
from pytest_pafot.plugin.session import is_worker


class Rates:
    """Hooks that measure the crash rate for a test with ``@pafot.rate``, and fail the test if the rate is too high."""

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrize a marked test function with a placeholder for the rate, if it has the parameter ``rate``."""
        if metafunc.definition.get_closest_marker(RATE_MARK) is not None and RATE_ARG in metafunc.fixturenames:
            metafunc.parametrize(RATE_ARG, [pytest.param(None, id=RATE_ARG)])

    @pytest.hookimpl(tryfirst=True)
    def pytest_pyfunc_call(self, pyfuncitem: pytest.Function) -> bool | None:
        """Drive the episodes of a marked test, then call the test function."""
        mark = pyfuncitem.get_closest_marker(RATE_MARK)
        if mark is None:
            return None
        from pytest_pafot.campaign.harness import checked_factory  # noqa: PLC0415
        from pytest_pafot.episodes.rate_request import checked_rate  # noqa: PLC0415
        from pytest_pafot.execution.pool import ProcessLostError  # noqa: PLC0415
        from pytest_pafot.plugin.own_session import session_ends_if_stuck  # noqa: PLC0415
        from pytest_pafot.support.errors import RequestError  # noqa: PLC0415
        from pytest_pafot.world import AdsFactoryError, WorldError  # noqa: PLC0415

        try:
            request = checked_rate(mark.kwargs, mark.args)
            ads = request.ads
            factory = checked_factory(pyfuncitem.funcargs[ads], ads) if isinstance(ads, str) else ads
            with session_ends_if_stuck(pyfuncitem):
                settings = resolve(pyfuncitem.config, {}, fresh_seed=0)
                workers = 1 if is_worker(pyfuncitem.config) else settings.workers
                rate = request.measured(factory, workers, isolate=settings.isolate)
        except (RequestError, WorldError, AdsFactoryError, ProcessLostError) as error:
            raise pytest.fail.Exception(str(error), pytrace=False) from None
        messages.send(pyfuncitem, "rate", {"text": f"{pyfuncitem.nodeid}: {rate.sentence}"})
        pyfuncitem.user_properties.append(("pafot_rate", rate.sentence))
        objection = request.objection(rate)
        if objection:
            pytest.fail(objection, pytrace=False)
        names = inspect.signature(pyfuncitem.obj).parameters
        given = {name: pyfuncitem.funcargs[name] for name in names if name in pyfuncitem.funcargs}
        pyfuncitem.obj(**(given | ({RATE_ARG: rate} if RATE_ARG in names else {})))
        return True
