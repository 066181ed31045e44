"""What extras, and packages of others, may import in addition to the public names of ``pytest_pafot``.

The page docs/reference/extending.md says of each name what it is for. The module of a name is loaded when it is first
used.
"""

# ruff: noqa: PLC0414  (only so a type checker takes the names of other modules for this one's)

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pytest_pafot.campaign.explore import AlgorithmRun as AlgorithmRun
    from pytest_pafot.campaign.explore import judged_runs as judged_runs
    from pytest_pafot.campaign.explore import replay_saved as replay_saved
    from pytest_pafot.campaign.harness import refusals as refusals
    from pytest_pafot.campaign.harness import same_policy as same_policy
    from pytest_pafot.campaign.request import drawn_space as drawn_space
    from pytest_pafot.campaign.setup_fault import SetupFaultError as SetupFaultError
    from pytest_pafot.campaign.setup_fault import check_drives as check_drives
    from pytest_pafot.campaign.verdict import Verdict as Verdict
    from pytest_pafot.campaign.verdict import judged_with_drivers as judged_with_drivers
    from pytest_pafot.commands.inventory import Inventory as Inventory
    from pytest_pafot.commands.policy_reference import add_world_arguments as add_world_arguments
    from pytest_pafot.commands.policy_reference import ads_factory as ads_factory
    from pytest_pafot.commands.policy_reference import caution as caution
    from pytest_pafot.commands.policy_reference import check_function as check_function
    from pytest_pafot.commands.policy_reference import chosen_world as chosen_world
    from pytest_pafot.commands.policy_reference import identity as identity
    from pytest_pafot.commands.results import Session as Session
    from pytest_pafot.corpus.layout import SUFFIX as SUFFIX
    from pytest_pafot.corpus.layout import files_below as files_below
    from pytest_pafot.corpus.saved import Saved as Saved
    from pytest_pafot.criticality.measures import Encounters as Encounters
    from pytest_pafot.execution.pool import ProcessLostError as ProcessLostError
    from pytest_pafot.execution.pool import Requests as Requests
    from pytest_pafot.execution.pool import WorkerPool as WorkerPool
    from pytest_pafot.execution.runner import driving as driving
    from pytest_pafot.execution.scenario_pool import ExecutionError as ExecutionError
    from pytest_pafot.execution.scenario_pool import Job as Job
    from pytest_pafot.findings.finding import Finding as Finding
    from pytest_pafot.findings.severity import Severity as Severity
    from pytest_pafot.model.instructions.instruction import WithStart as WithStart
    from pytest_pafot.model.trace import ACCELERATION as ACCELERATION
    from pytest_pafot.model.trace import HEADING as HEADING
    from pytest_pafot.model.trace import LANE as LANE
    from pytest_pafot.model.trace import SPEED as SPEED
    from pytest_pafot.model.trace import STEERING as STEERING
    from pytest_pafot.model.trace import FloatArray as FloatArray
    from pytest_pafot.model.trace import Lane as Lane
    from pytest_pafot.model.trace import X as X
    from pytest_pafot.model.trace import Y as Y
    from pytest_pafot.oracle.checks import require as require
    from pytest_pafot.plugin.collection import policy_of as policy_of
    from pytest_pafot.plugin.collection import searched_test as searched_test
    from pytest_pafot.plugin.failure_reports import replay_of as replay_of
    from pytest_pafot.report.animation import drawn_episode as drawn_episode
    from pytest_pafot.searching.algorithms.catalogue import ALGORITHMS as ALGORITHMS
    from pytest_pafot.searching.algorithms.catalogue import AlgorithmClass as AlgorithmClass
    from pytest_pafot.searching.algorithms.catalogue import resolve_algorithm as resolve_algorithm
    from pytest_pafot.searching.algorithms.distinct import NicheSearch as NicheSearch
    from pytest_pafot.searching.ask_tell import GenerationalSearch as GenerationalSearch
    from pytest_pafot.searching.ask_tell import GenerationState as GenerationState
    from pytest_pafot.searching.ask_tell import check_ask as check_ask
    from pytest_pafot.searching.ask_tell import check_evaluations as check_evaluations
    from pytest_pafot.searching.ask_tell import check_parameters as check_parameters
    from pytest_pafot.searching.ask_tell import end_of_local_search as end_of_local_search
    from pytest_pafot.searching.evaluation import Evaluation as Evaluation
    from pytest_pafot.searching.events import AlgorithmEvent as AlgorithmEvent
    from pytest_pafot.searching.events import GenerationFinished as GenerationFinished
    from pytest_pafot.searching.events import LocalSearchStarted as LocalSearchStarted
    from pytest_pafot.searching.events import NewBest as NewBest
    from pytest_pafot.searching.events import Restarted as Restarted
    from pytest_pafot.searching.operators import first_crossed as first_crossed
    from pytest_pafot.searching.operators import mutate as mutate
    from pytest_pafot.searching.operators import varied as varied
    from pytest_pafot.searching.space import SearchSpace as SearchSpace
    from pytest_pafot.searching.space import sample as sample
    from pytest_pafot.searching.space import sample_manoeuvres as sample_manoeuvres
    from pytest_pafot.support.errors import RequestError as RequestError
    from pytest_pafot.world.codec import WorldData as WorldData
    from pytest_pafot.world.codec import code_of as code_of
    from pytest_pafot.world.driving.ads import AdsFactory as AdsFactory
    from pytest_pafot.world.driving.policy import DrivesElsewhere as DrivesElsewhere
    from pytest_pafot.world.driving.policy import Policy as Policy
    from pytest_pafot.world.driving.policy_driver import checked_action as checked_action
    from pytest_pafot.world.engines.npc_drivers import register as register
    from pytest_pafot.world.engines.ordinary_traffic import SteppedWorld as SteppedWorld
    from pytest_pafot.world.engines.ordinary_traffic import drive_episode as drive_episode
    from pytest_pafot.world.guard.hang_guard import check_time as check_time
    from pytest_pafot.world.guard.own_worlds import base_world as base_world
    from pytest_pafot.world.guard.own_worlds import rollout_of as rollout_of

_HOMES = {
    "ACCELERATION": "model.trace",
    "ALGORITHMS": "searching.algorithms.catalogue",
    "AdsFactory": "world.driving.ads",
    "AlgorithmClass": "searching.algorithms.catalogue",
    "AlgorithmEvent": "searching.events",
    "AlgorithmRun": "campaign.explore",
    "DrivesElsewhere": "world.driving.policy",
    "Encounters": "criticality.measures",
    "Evaluation": "searching.evaluation",
    "ExecutionError": "execution.scenario_pool",
    "Finding": "findings.finding",
    "FloatArray": "model.trace",
    "GenerationFinished": "searching.events",
    "GenerationState": "searching.ask_tell",
    "GenerationalSearch": "searching.ask_tell",
    "HEADING": "model.trace",
    "Inventory": "commands.inventory",
    "Job": "execution.scenario_pool",
    "LANE": "model.trace",
    "Lane": "model.trace",
    "LocalSearchStarted": "searching.events",
    "NewBest": "searching.events",
    "NicheSearch": "searching.algorithms.distinct",
    "Policy": "world.driving.policy",
    "ProcessLostError": "execution.pool",
    "RequestError": "support.errors",
    "Requests": "execution.pool",
    "Restarted": "searching.events",
    "SPEED": "model.trace",
    "STEERING": "model.trace",
    "SUFFIX": "corpus.layout",
    "Saved": "corpus.saved",
    "SearchSpace": "searching.space",
    "Session": "commands.results",
    "SetupFaultError": "campaign.setup_fault",
    "Severity": "findings.severity",
    "SteppedWorld": "world.engines.ordinary_traffic",
    "Verdict": "campaign.verdict",
    "WithStart": "model.instructions.instruction",
    "WorkerPool": "execution.pool",
    "WorldData": "world.codec",
    "X": "model.trace",
    "Y": "model.trace",
    "add_world_arguments": "commands.policy_reference",
    "ads_factory": "commands.policy_reference",
    "base_world": "world.guard.own_worlds",
    "caution": "commands.policy_reference",
    "check_ask": "searching.ask_tell",
    "check_drives": "campaign.setup_fault",
    "check_evaluations": "searching.ask_tell",
    "check_function": "commands.policy_reference",
    "check_parameters": "searching.ask_tell",
    "check_time": "world.guard.hang_guard",
    "checked_action": "world.driving.policy_driver",
    "chosen_world": "commands.policy_reference",
    "code_of": "world.codec",
    "drawn_episode": "report.animation",
    "drawn_space": "campaign.request",
    "drive_episode": "world.engines.ordinary_traffic",
    "driving": "execution.runner",
    "end_of_local_search": "searching.ask_tell",
    "files_below": "corpus.layout",
    "first_crossed": "searching.operators",
    "identity": "commands.policy_reference",
    "judged_runs": "campaign.explore",
    "judged_with_drivers": "campaign.verdict",
    "mutate": "searching.operators",
    "policy_of": "plugin.collection",
    "refusals": "campaign.harness",
    "register": "world.engines.npc_drivers",
    "replay_of": "plugin.failure_reports",
    "replay_saved": "campaign.explore",
    "require": "oracle.checks",
    "resolve_algorithm": "searching.algorithms.catalogue",
    "rollout_of": "world.guard.own_worlds",
    "same_policy": "campaign.harness",
    "sample": "searching.space",
    "sample_manoeuvres": "searching.space",
    "searched_test": "plugin.collection",
    "varied": "searching.operators",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"pytest_pafot.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return list(__all__)
