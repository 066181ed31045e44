"""The saved scenarios with which a search begins: those of a corpus, or those in which policies of others failed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

from pytest_pafot.campaign.request import Request
from pytest_pafot.corpus import reader
from pytest_pafot.corpus.layout import files_below
from pytest_pafot.model.scenario import Scenario, ScenarioError
from pytest_pafot.searching.algorithms.distinct import NicheSearch
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import CorpusError, RequestError
from pytest_pafot.support.text import plural
from pytest_pafot.world import protocol

OTHERS = "others"
"""The value of the option ``begin_with`` for the corpus in the package, of failures of policies by others."""


def others() -> Path:
    """Return the folder of the corpus in the package, which has a folder for each policy."""
    return Path(str(resources.files("pytest_pafot") / OTHERS))


def begun_with(given: str, space: SearchSpace, world: Any, request: Request) -> tuple[SearchSpace, str]:
    """Return the space whose search begins with saved scenarios, and a note on how many of them fit the world.

    The ego starts as close to the start in the file as the space allows, no NPC is asked for more than the space's
    limit of speed, and the traffic is that of the space. Of several folders the first scenarios come first, then the
    second ones, so that a short search begins with some of each.

    Raises:
        RequestError: if the algorithm cannot begin with given scenarios, a file cannot be read, or no scenario fits.
    """
    folder = others() if given == OTHERS else Path(given)
    by_folder: dict[Path, list[Path]] = {}
    for file in files_below(folder):
        by_folder.setdefault(file.parent, []).append(file)
    option = request.option("begin_with", given)
    made_by = request.algorithm.made_by
    if not (isinstance(made_by, type) and issubclass(made_by, NicheSearch)):
        raise RequestError(
            f"{option}: expected the algorithm distinct or map-elites, received {request.algorithm.name}; leave one out"
        )
    if not by_folder:
        raise RequestError(
            f"{option}: expected {OTHERS} or a folder with saved scenarios (*.pafot.yaml), received {folder}, in and "
            "below which there are none; correct the path"
        )
    files = list(filter(None, chain.from_iterable(zip_longest(*by_folder.values()))))
    fitting: dict[Scenario, None] = {}
    left_out = 0
    for file in files:
        try:
            scenario = reader.load(file).scenario
        except CorpusError as error:
            raise RequestError(f"{option}: {error}") from None
        fitted = next(_starts(scenario, space, world), None)
        left_out += fitted is None
        fitting |= {} if fitted is None else {fitted: None}
    if not fitting:
        raise RequestError(
            f"{option}: expected scenarios that fit the world, received {len(files)} in {folder}, none of which does: "
            f"they are of another road; leave {option} out"
        )
    note = f"began with {plural(len(fitting), 'saved scenario')}; {left_out} of {len(files)} do not fit this world"
    return replace(space, first=tuple(fitting)), note if left_out else ""


def _starts(scenario: Scenario, space: SearchSpace, world: Any) -> Iterator[Scenario]:
    """Yield a scenario with each start that the space has and that fits the world, the nearest to its own first."""
    lanes = space.ego_lanes or (space.ego_lane,)
    slowest, fastest = space.ego_speeds or (space.ego_speed, space.ego_speed)
    speed = min(max(scenario.ego_speed, slowest), fastest)
    npcs = tuple(
        tuple(replace(gene, speed=min(gene.speed, space.speed_limit)) for gene in chain) for chain in scenario.npcs
    )
    for lane in sorted(lanes, key=lambda lane: abs(lane - scenario.ego_lane)):
        with suppress(ScenarioError):
            moved = replace(scenario, npcs=npcs, ego_lane=lane, ego_speed=speed, traffic=space.traffic)
            protocol.check_fits(world, moved)
            yield moved
