"""The search: an algorithm proposes scenarios, a campaign has them evaluated and tells it the results.

Nothing here simulates. How a scenario becomes an evaluation is given to :func:`run_campaign` as a function.
"""

from __future__ import annotations

import inspect
from typing import Any

from pytest_pafot.searching.campaign import Algorithm, Evaluate, SearchState, run_campaign
from pytest_pafot.searching.distinct import DistinctSearch
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.genetic import PafotSearch
from pytest_pafot.searching.health import Health
from pytest_pafot.searching.random_search import RandomSearch
from pytest_pafot.searching.space import SearchSpace, sample

__all__ = [
    "ALGORITHMS",
    "Algorithm",
    "DistinctSearch",
    "Evaluate",
    "Evaluation",
    "Health",
    "PafotSearch",
    "RandomSearch",
    "SearchSpace",
    "SearchState",
    "algorithm_named",
    "run_campaign",
    "sample",
]

_CLASSES: dict[str, type[DistinctSearch | PafotSearch | RandomSearch]] = {
    each.name: each for each in (DistinctSearch, PafotSearch, RandomSearch)
}

ALGORITHMS = tuple(_CLASSES)
"""Names that :func:`algorithm_named` takes."""


def algorithm_named(name: str, space: SearchSpace, **parameters: Any) -> Algorithm[Any]:
    """The search algorithm of a name, with its own parameters, such as ``population=4``.

    Raises:
        ValueError: for a name or a parameter that does not exist; the message lists those that do.
    """
    if name not in _CLASSES:
        raise ValueError(f"algorithm: expected one of {', '.join(ALGORITHMS)}, received {name!r}")
    known = [parameter for parameter in inspect.signature(_CLASSES[name]).parameters if parameter != "space"]
    for parameter in parameters:
        if parameter not in known:
            raise ValueError(
                f"{parameter}: expected a parameter of the algorithm {name!r}, which takes {', '.join(known)}"
            )
    return _CLASSES[name](space, **parameters)
