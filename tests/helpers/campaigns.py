"""Plans of searches that are followed to their end, with a function as the world."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searching.ask_tell import Algorithm
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import Event
from pytest_pafot.searching.plan import Plan, plan_of


def run_campaign(
    algorithm: Algorithm[Any],
    evaluate: Callable[[Scenario], Evaluation],
    *,
    foresee: Callable[[Iterable[Scenario]], object] = lambda scenarios: None,
    border: Callable[[Plan[Any]], object] = lambda plan: None,
    **arguments: Any,
) -> Iterator[Event]:
    """Yield the events of a plan with further arguments of ``plan_of``.

    ``foresee`` receives the scenarios that can be run in advance; ``border`` the plan before the first generation of a
    new search, and after each generation, even if the limit on runs cut it.
    """
    plan = plan_of(algorithm, **arguments)
    border(plan)
    yield plan.started
    while not (plan.is_over or plan.has_all_runs):
        while not (plan.is_whole or plan.has_all_runs):
            recalled = plan.recalled()
            if recalled is None:
                foresee(plan.ahead() or ())
            yield plan.take(evaluate(plan.scenario()) if recalled is None else recalled, reused=recalled is not None)
        if plan.is_whole:
            yield from plan.learn()
        border(plan)
    yield from plan.finished("generations" if plan.is_over else "runs")
