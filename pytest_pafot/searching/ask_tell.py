"""Ask and tell take turns: checks that refuse everything else, and what an end of a turn says."""

from __future__ import annotations

from collections.abc import Sequence

from pytest_pafot.scenario import Scenario
from pytest_pafot.searching.evaluation import Evaluation
from pytest_pafot.searching.events import AlgorithmEvent, GenerationFinished, NewBest
from pytest_pafot.searching.operators import best_of, improves


def check_ask(asked: Sequence[Scenario]) -> None:
    """Refuse an ask while scenarios are out.

    Raises:
        RuntimeError: when the state's last ask has not been told.
    """
    if asked:
        raise asked_again(len(asked))


def asked_again(scenarios: int) -> RuntimeError:
    """The error of an ask while so many scenarios of the last one are out, which may be none."""
    return RuntimeError(
        f"ask: expected tell after the last ask, which gave {scenarios} scenarios; received another ask; "
        "evaluate them and pass the state that ask returned to tell"
    )


def check_evaluations(asked: Sequence[Scenario], evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that do not belong one by one to the scenarios asked for.

    Raises:
        RuntimeError: when nothing was asked for.
        ValueError: when the number or a scenario differs.
    """
    if not asked:
        raise RuntimeError(
            "tell: expected an ask before; received a state without one; pass the state that ask returned"
        )
    check_order("tell", asked, evaluations)


def check_order(place: str, scenarios: Sequence[Scenario], evaluations: Sequence[Evaluation]) -> None:
    """Refuse evaluations that are not those of the scenarios, one by one.

    Raises:
        ValueError: naming the place, when the number or a scenario differs.
    """
    if len(evaluations) != len(scenarios):
        raise ValueError(
            f"{place}: expected {len(scenarios)} evaluations, one per scenario, received {len(evaluations)}; "
            "evaluate each scenario, also the invalid ones"
        )
    for index, (scenario, evaluation) in enumerate(zip(scenarios, evaluations, strict=True)):
        if evaluation.scenario is not scenario and evaluation.scenario != scenario:
            raise ValueError(
                f"{place}: expected the evaluation of {scenario!r} at {index}, received one of "
                f"{evaluation.scenario!r}; keep the order of the scenarios"
            )


def end_of_generation(
    generation: int, best: Evaluation | None, evaluations: Sequence[Evaluation], *, kept: Sequence[Evaluation] = ()
) -> tuple[Evaluation | None, tuple[AlgorithmEvent, ...]]:
    """The best so far and the events at the end of a generation of an algorithm that has no local searches.

    Args:
        generation: that ends.
        best: before it.
        evaluations: of what was asked for.
        kept: what passed on untouched.
    """
    end = GenerationFinished(
        generation=generation, local_generation=0, population=(*kept, *evaluations), elites=len(kept)
    )
    candidate = best_of(evaluations)
    if candidate is None or not improves(candidate, best):
        return best, (end,)
    return candidate, (end, NewBest(generation=generation, local_generation=0, evaluation=candidate))
