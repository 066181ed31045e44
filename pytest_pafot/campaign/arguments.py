"""The arguments of the decorator, for type checkers and for the check of their names."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypedDict

if TYPE_CHECKING:
    from pytest_pafot.searching.ask_tell import Algorithm
    from pytest_pafot.searching.fitness import Weights
    from pytest_pafot.trace import Trace


class SearchArguments(TypedDict, total=False):
    """What :func:`pytest_pafot.search` accepts; every argument is optional."""

    world: Any
    lanes: int
    speed_limit: float
    clearance: float
    npcs: int
    genes: int
    gene_seconds: float
    ego_lane: int
    ego_speed: float
    ads: Any
    arg: str
    fitness: str | Weights | Callable[[Trace], float]
    blame: str
    decision_limit: float
    generations: int
    population: int
    seed: int
    algorithm: str | type[Algorithm[Any]]
    max_time: float
    stop_after: int
    shrink_rollouts: int
    max_saved: int
    corpus: str
    save: str
    workers: int | str
    isolate: bool
    report: str
    profile: str
    strict_drift: bool
    strict_health: bool
