"""``python -m pytest_pafot corpus shrink``: the plugin of its session, which shrinks a saved scenario further.

It does what a search does to a finding after its last run, and rewrites the file if its scenario became simpler.
"""

from __future__ import annotations

import argparse
import time
from contextlib import closing
from dataclasses import asdict, replace
from typing import TYPE_CHECKING

import pytest

from pytest_pafot.corpus.layout import relative
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.collection import saved_of
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.support.text import visible

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request
    from pytest_pafot.corpus.saved import Saved


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the option by which an item knows that it is to shrink its saved scenario."""
    parser.addoption("--shrink-saved", action="store_true", help=argparse.SUPPRESS)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave only the items of saved scenarios, because the command is not about other tests."""
    config.hook.pytest_deselected(items=[item for item in items if saved_of(item) is None])
    items[:] = [item for item in items if saved_of(item) is not None]


def run_shrink(item: pytest.Function, request: Request, saved: Saved) -> None:
    """Shrink the saved scenario of an item; fail the item if the scenario does not fail as its file says."""
    __tracebackhide__ = True
    from pytest_pafot.campaign.events import Progress  # noqa: PLC0415  (imports the simulation)
    from pytest_pafot.campaign.later_shrinking import Later, shrink_saved  # noqa: PLC0415
    from pytest_pafot.campaign.replays import Replays  # noqa: PLC0415
    from pytest_pafot.campaign.request import build_space  # noqa: PLC0415
    from pytest_pafot.campaign.search_session import prepared  # noqa: PLC0415
    from pytest_pafot.campaign.watch import time_limit  # noqa: PLC0415
    from pytest_pafot.corpus.writer import CorpusWriteError, rewrite  # noqa: PLC0415
    from pytest_pafot.plugin.search_item import harness_of  # noqa: PLC0415
    from pytest_pafot.support.errors import RequestError  # noqa: PLC0415

    if saved.finding is None:
        pytest.fail(saved.error, pytrace=False)
    harness, path = harness_of(item, request), relative(saved.path, item.config.rootpath)
    space = build_space(request, harness.world)  # of the test: it has the ego's start that shrinking prefers
    world = Replays(harness=harness).world_of(saved)
    settings = harness.request.settings  # those of a project may switch shrinking off in its searches
    settings = replace(settings, generations=0, shrink_rollouts=settings.shrink_rollouts or None)
    harness = replace(harness, world=world, request=replace(harness.request, settings=settings))
    now = time.monotonic()
    limit = time_limit(request.settings, now=now, began=item.config.stash[SHARED].began, left=1)
    with (
        prepared(harness, space=space) as parts,
        closing(shrink_saved(parts, saved, path=path, until=limit.end)) as its,
    ):
        reported_at = now
        for event in its:
            if isinstance(event, Later):
                later = event
            elif (time_now := time.monotonic()) - reported_at >= item.config.stash[SHARED].progress_seconds:
                reported_at = time_now
                progress = Progress(
                    node_id=item.nodeid,
                    generation=0,
                    generations=None,
                    runs=0,
                    failing=0,
                    finds=0,
                    seconds=reported_at - now,
                    phase=event.text,
                    of=event.of,
                )
                messages.send(item, "progress", asdict(progress))
    # Nothing is written before all is known: an interrupt leaves the file as it was.
    for note in later.notes:
        messages.send(item, "note", {"text": note})
    result = f"{visible(path)}: {later.result}"
    if later.is_refused:
        pytest.fail(f"{result}; the file is left as it is", pytrace=False)
    if later.finding is not None:
        try:
            rewrite(saved.path, later.finding)
        except CorpusWriteError as error:
            raise RequestError(str(error)) from None
    messages.send(item, "done", {"text": result})
