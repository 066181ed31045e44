"""What extras, and packages of others, may import in addition to the public names of ``pytest_pafot``.

The page docs/reference/extending.md lists them by what they are for. The module of a name is loaded when it is first
used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot.campaign.explore import AlgorithmRun
    from pytest_pafot.campaign.harness import refusals
    from pytest_pafot.campaign.request import drawn_space
    from pytest_pafot.campaign.setup_fault import SetupFaultError
    from pytest_pafot.campaign.verdict import Verdict
    from pytest_pafot.commands.policy_reference import (
        CAUTION,
        add_world_arguments,
        ads_factory,
        check_function,
        chosen_world,
        identity,
    )
    from pytest_pafot.corpus.layout import SUFFIX, files_below
    from pytest_pafot.corpus.saved import Saved
    from pytest_pafot.criticality.measures import Encounters
    from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
    from pytest_pafot.execution.runner import driving
    from pytest_pafot.execution.scenario_pool import ExecutionError, Job
    from pytest_pafot.findings.finding import Finding
    from pytest_pafot.findings.severity import Severity
    from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, STEERING, FloatArray, Lane, X, Y
    from pytest_pafot.oracle.checks import require
    from pytest_pafot.searching.algorithms.catalogue import ALGORITHMS, AlgorithmClass, resolve_algorithm
    from pytest_pafot.searching.ask_tell import (
        GenerationalSearch,
        GenerationState,
        check_ask,
        check_evaluations,
        check_parameters,
        end_of_local_search,
    )
    from pytest_pafot.searching.evaluation import Evaluation
    from pytest_pafot.searching.events import AlgorithmEvent, GenerationFinished, LocalSearchStarted, NewBest, Restarted
    from pytest_pafot.searching.operators import first_crossed, mutate, varied
    from pytest_pafot.searching.space import SearchSpace, sample, sample_manoeuvres
    from pytest_pafot.support.errors import RequestError
    from pytest_pafot.world.codec import WorldData, code_of
    from pytest_pafot.world.driving.ads import AdsFactory
    from pytest_pafot.world.driving.policy import Policy
    from pytest_pafot.world.driving.policy_driver import checked_action
    from pytest_pafot.world.engines.episode import Episode, drive_episode
    from pytest_pafot.world.guard.hang_guard import check_time
    from pytest_pafot.world.guard.own_worlds import base_world, rollout_of

_NAMES = {
    "campaign.explore": "AlgorithmRun",
    "campaign.harness": "refusals",
    "campaign.request": "drawn_space",
    "campaign.setup_fault": "SetupFaultError",
    "campaign.verdict": "Verdict",
    "commands.policy_reference": "add_world_arguments ads_factory CAUTION check_function chosen_world identity",
    "corpus.layout": "SUFFIX files_below",
    "corpus.saved": "Saved",
    "criticality.measures": "Encounters",
    "execution.pool": "ProcessLostError WorkerPool",
    "execution.runner": "driving",
    "execution.scenario_pool": "ExecutionError Job",
    "findings.finding": "Finding",
    "findings.severity": "Severity",
    "model.trace": "ACCELERATION HEADING LANE SPEED STEERING X Y FloatArray Lane",
    "oracle.checks": "require",
    "searching.algorithms.catalogue": "ALGORITHMS AlgorithmClass resolve_algorithm",
    "searching.ask_tell": "GenerationState GenerationalSearch check_ask "
    "check_evaluations check_parameters end_of_local_search",
    "searching.evaluation": "Evaluation",
    "searching.events": "AlgorithmEvent GenerationFinished LocalSearchStarted NewBest Restarted",
    "searching.operators": "first_crossed mutate varied",
    "searching.space": "SearchSpace sample sample_manoeuvres",
    "support.errors": "RequestError",
    "world.codec": "WorldData code_of",
    "world.driving.ads": "AdsFactory",
    "world.driving.policy": "Policy",
    "world.driving.policy_driver": "checked_action",
    "world.engines.episode": "Episode drive_episode",
    "world.guard.hang_guard": "check_time",
    "world.guard.own_worlds": "base_world rollout_of",
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names.split()}

__all__ = [
    "ACCELERATION",
    "ALGORITHMS",
    "CAUTION",
    "HEADING",
    "LANE",
    "SPEED",
    "STEERING",
    "SUFFIX",
    "AdsFactory",
    "AlgorithmClass",
    "AlgorithmEvent",
    "AlgorithmRun",
    "Encounters", "Episode",
    "Evaluation",
    "ExecutionError",
    "Finding",
    "FloatArray",
    "GenerationFinished",
    "GenerationState",
    "GenerationalSearch",
    "Job",
    "Lane",
    "LocalSearchStarted",
    "NewBest",
    "Policy",
    "ProcessLostError",
    "RequestError",
    "Restarted",
    "Saved",
    "SearchSpace",
    "SetupFaultError",
    "Severity",
    "Verdict",
    "WorkerPool",
    "WorldData",
    "X",
    "Y",
    "add_world_arguments",
    "ads_factory",
    "base_world",
    "check_ask",
    "check_evaluations",
    "check_function",
    "check_parameters",
    "check_time",
    "checked_action",
    "chosen_world",
    "code_of",
    "drawn_space",
    "drive_episode",
    "driving",
    "end_of_local_search",
    "files_below",
    "first_crossed",
    "identity",
    "mutate",
    "refusals",
    "require",
    "resolve_algorithm",
    "rollout_of",
    "sample",
    "sample_manoeuvres",
    "varied",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pytest_pafot.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return list(__all__)
