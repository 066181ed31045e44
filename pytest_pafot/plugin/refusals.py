"""What is wrong with a marked item, in one clear message."""

from __future__ import annotations

import difflib
import inspect
import sys
from collections.abc import Sequence
from itertools import chain
from typing import Any

import pytest

from pytest_pafot.campaign.request import Request, RequestError
from pytest_pafot.campaign.verdict import is_asynchronous
from pytest_pafot.plugin.collection import saved_of
from pytest_pafot.plugin.marks import DEFAULT_ARG, SEARCH_MARK, WORLD_FIXTURE
from pytest_pafot.plugin.options import request_of_mark
from pytest_pafot.plugin.session import SEARCH_PART, SHARED
from pytest_pafot.report.wrapping import wrapped_to


def checked(item: pytest.Item, arguments: dict[str, Any]) -> Request:
    """The item's request.

    Raises:
        RequestError: when the item cannot be searched or replayed as it is written.
    """
    _check_function(item)
    request = request_of_mark(item.config, arguments, item.config.stash[SHARED].fresh_seed)
    _check_parameter(item, request.arg)
    _check_fixtures(item, request)
    return request


def missing_ads(name: str, available: Sequence[str], width: int) -> str:
    """What to do about a fixture that does not exist, in lines of a width but for those of code."""
    near = difflib.get_close_matches(name, available, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else "."
    text = (
        f"the fixture {name!r} that gives the ADS factory was not found{hint}\n"
        "Define it in the test file or in conftest.py:\n\n"
        "    @pytest.fixture\n"
        f"    def {name}():\n"
        "        return lambda: MyPlanner()    # a fresh ADS for each scenario\n\n"
        'or name another fixture with @pafot.search(ads="..."), or give a factory with @pafot.search(ads=MyPlanner).'
    )
    lines = [[line] if line.startswith(" ") else wrapped_to(line, width) for line in text.splitlines()]
    return "\n".join(chain.from_iterable(lines))


def _check_function(item: pytest.Item) -> None:
    cls = getattr(item, "cls", None)
    unittest = sys.modules.get("unittest")
    if unittest is not None and inspect.isclass(cls) and issubclass(cls, unittest.TestCase):
        raise RequestError(
            "expected a plain test function or class, received a method of the unittest.TestCase "
            f"{cls.__name__}, which takes no fixtures; move the test out of it"
        )
    if not isinstance(item, pytest.Function):
        raise RequestError(f"expected a test function, received {item!r}")
    if getattr(item.obj, "is_hypothesis_test", False) or hasattr(item.obj, "hypothesis"):
        raise RequestError(
            "expected @pafot.search or @given, received both, which would each run the function many "
            "times; use @given(scenario=pafot.strategies.scenarios()) with the fixture pafot_simulate"
        )
    if is_asynchronous(item.obj):
        raise RequestError(
            "expected a plain function, received an async one, whose assertions would never run; "
            "write `def` in place of `async def`"
        )


def _check_parameter(item: pytest.Item, arg: str) -> None:
    names = list(inspect.signature(item.obj).parameters)  # type: ignore[attr-defined]
    if arg not in names:
        hint = (
            f"name it, as in `def {item.name.partition('[')[0]}({arg})`"
            if arg == DEFAULT_ARG
            else "correct @pafot.search(arg=...)"
        )
        raise RequestError(
            f"expected a parameter {arg!r} that receives the simulated run, received the parameters "
            f"({', '.join(names)}); {hint}"
        )
    if saved_of(item) is None and SEARCH_PART not in item.name.removeprefix(item.originalname or ""):  # type: ignore[attr-defined]
        raise RequestError(
            f"expected the parameter {arg!r} to be free for the simulated run, but the test is "
            "parametrised by it already; rename one of the two, with @pafot.search(arg=...)"
        )


def _check_fixtures(item: pytest.Item, request: Request) -> None:
    names = item.fixturenames  # type: ignore[attr-defined]
    for name in (request.ads, WORLD_FIXTURE):
        if isinstance(name, str) and name not in names:
            raise RequestError(
                f"expected the fixture {name!r} among those of the test; mark it with @pafot.search(...), "
                f"which asks for it, and not with @pytest.mark.{SEARCH_MARK}"
            )
