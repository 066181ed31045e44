"""The saved scenarios with which a search begins: those of a corpus, or those in which policies of others failed."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from importlib import resources
from pathlib import Path

from pytest_pafot.campaign.request import Request
from pytest_pafot.corpus import reader
from pytest_pafot.corpus.layout import SUFFIX, files_below
from pytest_pafot.model.instructions import (
    SPEED_STEPS_PER_MPS,
    Instruction,
    ScenarioError,
)
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.support.errors import CorpusError, RequestError
from pytest_pafot.world.base_world import BaseWorld

OTHERS = "others"
"""The value of the option ``begin_with`` for the corpus in the package, of failures of policies by others."""


def others() -> Path:
    """Return the folder of the corpus in the package, which has a folder for each policy."""
    return Path(str(resources.files("pytest_pafot") / OTHERS))


def begun_with(
    given: str, space: SearchSpace, world: BaseWorld, request: Request, own: Path | None = None
) -> tuple[SearchSpace, str]:
    """Return the space whose search begins with saved scenarios, and a note on those that are left out.

    The ego starts as close to the start in the file as the space allows. The NPCs keep to the traffic of the space and
    to its lowest and highest speed. Of several folders the first scenarios come first, then the second ones, so that a
    short search begins with some of each. The folder ``own`` is left out: it is that of the test, whose files are
    replayed.

    Raises:
        RequestError: if there is no file, or a file cannot be read.
    """
    option = request.option("begin_with", given)
    if given == OTHERS and Path(OTHERS).is_dir():
        raise RequestError(
            f"{option}: expected the scenarios of the package or those of a folder, received a name that is both; "
            f"write ./{OTHERS} for the folder here, or search in another folder"
        )
    files = _in_turn(others() if given == OTHERS else Path(given), own)
    if not files:
        raise RequestError(
            f"{option}: expected {OTHERS}, a saved scenario (*{SUFFIX}) or a folder with some, received "
            f"{Path(given).absolute()}, which has none; correct the path, and name no folder that is a link"
        )
    if not request.algorithm.begins_with_given:
        return space, f"{option}: the algorithm {request.algorithm.name} begins with no saved scenarios"
    fitting: dict[Scenario, None] = {}
    fit = 0
    for file in files:
        try:
            scenario = _fitted(reader.load(file).scenario, space, world)
        except CorpusError as error:
            raise RequestError(f"{option}: {error}") from None
        if scenario is not None:
            fitting[scenario] = None
            fit += 1
    note = "" if fit == len(files) else f"{fit} of {len(files)} saved scenarios fit this search"
    return replace(space, first=tuple(fitting)), note


def _in_turn(folder: Path, own: Path | None) -> list[Path]:
    """Return the first files of all folders, then the second ones, and so on."""
    by_folder: dict[Path, list[Path]] = {}
    for file in [folder] if folder.name.endswith(SUFFIX) and folder.is_file() else files_below(folder):
        if own is None or file.parent.absolute() != own.absolute():
            by_folder.setdefault(file.parent, []).append(file)
    return [file for files in itertools.zip_longest(*by_folder.values()) for file in files if file is not None]


def _fitted(scenario: Scenario, space: SearchSpace, world: BaseWorld) -> Scenario | None:
    """Return a scenario with the start of the space that is nearest to its own; None if it fits with no start."""
    if not all(gene.is_drawn_in(space) for chain in scenario.npcs for gene in chain):
        return None
    if space.around is None and not set(scenario.all_vehicles) <= {*space.vehicles}:  # a recording has its own
        return None
    lanes = space.ego_lanes or (space.ego_lane,)
    slowest, fastest = space.ego_speeds or (space.ego_speed, space.ego_speed)
    speed = min(max(scenario.ego_speed, slowest), fastest)
    npcs = tuple(tuple(_within(chain, space)) for chain in scenario.npcs)
    for lane in sorted(lanes, key=lambda lane: abs(lane - scenario.ego_lane)):
        with suppress(ScenarioError):
            moved = replace(scenario, npcs=npcs, ego_lane=lane, ego_speed=speed, traffic=space.traffic)
            world.check_fits(moved)
            return moved
    return None


def _within(chain: Iterable[Instruction], space: SearchSpace) -> Iterable[Instruction]:
    """Yield instructions with speeds that a space has."""
    low, high = space.low_step / SPEED_STEPS_PER_MPS, space.top_step / SPEED_STEPS_PER_MPS
    return (gene.with_speed(min(max(gene.speed, low), high)) for gene in chain)
