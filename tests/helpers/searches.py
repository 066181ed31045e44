"""Plans of searches that are followed to their end, with a function as the world."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from pytest_pafot.algorithms.evaluation import Evaluation, Event
from pytest_pafot.algorithms.plan import Algorithm, GenerationalSearch, GenerationState, Plan
from pytest_pafot.algorithms.space import sample
from pytest_pafot.model.scenario import Scenario


@dataclass(frozen=True)
class Fresh(GenerationalSearch[GenerationState]):
    """An algorithm that draws each generation anew, and learns nothing."""

    name = "fresh"

    def start(self, rng):
        return GenerationState()

    def propose(self, state, rng):
        return state, [sample(self.space, rng) for _ in range(self.population)]


def run_plan(
    algorithm: Algorithm[Any],
    evaluate: Callable[[Scenario], Evaluation],
    *,
    foresee: Callable[[Iterable[Scenario]], object] = lambda scenarios: None,
    **arguments: Any,
) -> Iterator[Event]:
    """Yield the events of a :class:`Plan` with further arguments.

    ``foresee`` receives the scenarios that can be run in advance.
    """
    plan = Plan(algorithm, **arguments)
    yield plan.started
    while not (plan.is_over or plan.has_all_runs):
        if plan.is_whole:
            yield from plan.learn()
            continue
        recalled = plan.recalled()
        if recalled is None:
            foresee(plan.ahead())
        yield from plan.take(
            evaluate(plan.scenario()) if recalled is None else recalled, reused=recalled is not None
        )
    yield from plan.finished("generations" if plan.is_over else "runs")
