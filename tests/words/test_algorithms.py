"""What is said of algorithms and fitness functions that cannot be used, and of searches that tested too little."""

from functools import partial

import numpy as np

from pytest_pafot.algorithms import Health, PafotSearch, SearchSpace, resolve_algorithm
from pytest_pafot.algorithms.av_fuzzer import AvFuzzerSearch
from pytest_pafot.algorithms.evaluation import LEAVING
from pytest_pafot.algorithms.fitness import resolve
from pytest_pafot.algorithms.plan import Plan
from pytest_pafot.algorithms.space import sample
from pytest_pafot.model.trace import Outcome
from pytest_pafot.report.messages import from_plain, plain
from tests.algorithms.conftest import _evaluation as evaluation
from tests.algorithms.test_algorithms import NO_ALGORITHMS, out_of_turn
from tests.algorithms.test_av_fuzzer import WRONG as OF_AV_FUZZER
from tests.algorithms.test_crossing_traffic import NO_START
from tests.algorithms.test_fitness import NO_FITNESSES, NO_NUMBERS, broken, following
from tests.algorithms.test_health_check import GOAL, health_of
from tests.algorithms.test_pafot import WRONG as OF_PAFOT
from tests.algorithms.test_space import EMPTY
from tests.helpers.refusals import error_of
from tests.helpers.searches import Fresh, run_plan
from tests.report.test_messages import WRONG_DATA

SPACES = [
    SearchSpace(),
    SearchSpace(npcs=4, ego_lanes=(1, 2), ego_speeds=(12.0, 26.8)),
    SearchSpace(most_npcs=(5,), traffic="everyday"),
]
INVALID, DISCARDED = {"outcome": Outcome.INVALID}, {"discarded": True}
JUMPED = INVALID | {"ended": "Jumps.states, tick 60: NPC 0 moved 50.5 m in a tick"}
OFF_ROAD = GOAL | {"ended": LEAVING[Outcome.OFF_ROAD]}
RUNS = {
    "invalid": [(4, INVALID)],
    "a few invalid": [(2, {}), (1, INVALID)],
    "discarded": [(4, DISCARDED)],
    "errors of the environment": [(4, INVALID | {"ended": "GoalEnv._is_terminated: KeyError: 'goal'"})],
    "one error of the environment": [
        (4, INVALID | {"ended": "GoalEnv._is_terminated failed: KeyError: 'goal'"}),
    ],
    "errors of a simulator": [(5, {}), (1, JUMPED), (1, JUMPED | {"ended": "Jumps.states, tick 61: too far"})],
    "early ends": [(1, GOAL | {"is_close": True}), (5, GOAL), (4, {})],
    "off the road": [(3, GOAL), (6, OFF_ROAD)],
    "over at once": [(3, GOAL | {"duration": 0.3})],
    "no interaction": [(1, {}), (2, {"interaction": False})],
    "the ego stands": [(1, {}), (2, {"barely_moved": True})],
}  # fmt: skip


def test_searches_that_tested_too_little_say_so(snapshot):
    healths = {name: health_of(evaluation, *groups) for name, groups in RUNS.items()}
    told = {name: health.warnings() for name, health in healths.items()}
    told["no run"] = Health().warnings()
    told["one early end"] = health_of(evaluation, (2, GOAL), (8, {})).early_ends
    assert told | {repr(space): space.described for space in SPACES} == snapshot


def test_algorithms_and_spaces_that_cannot_be_used_are_told(snapshot):
    told = {str(given): error_of(resolve_algorithm, given) for given in NO_ALGORITHMS}
    for search in (PafotSearch(), AvFuzzerSearch(), Fresh()):
        calls = out_of_turn(search, evaluation)
        told |= {f"{search.name}: {name}": error_of(call) for name, (_, call) in calls.items()}
    wrong = {SearchSpace: EMPTY, PafotSearch: OF_PAFOT, AvFuzzerSearch: OF_AV_FUZZER}
    for cls, rows in wrong.items():
        for name, value in rows:
            told[f"{cls.__name__} {name}={value}"] = error_of(cls, **{name: value})
    told["population"] = error_of(Fresh, population=0)
    told["no start"] = error_of(sample, NO_START, np.random.default_rng(0))
    for given in ({"generations": 0}, {"seed": -1}):
        told[f"plan {given}"] = error_of(
            Plan, PafotSearch(), **{"generations": 1, "seed": 1} | given
        )
    plan = run_plan(Fresh(), lambda scenario: evaluation(), generations=1, seed=1)
    told["another scenario"] = error_of(list, plan)
    assert told == snapshot


def test_fitness_functions_that_cannot_be_used_are_told(snapshot):
    told = {name: error_of(resolve, value) for name, value in NO_FITNESSES.items()}
    told["no name of the module"] = error_of(resolve, "tests.algorithms.test_algorithms:own_fitnes")
    told["raises"] = error_of(resolve(broken), following())
    for value in NO_NUMBERS:

        def odd(trace, value=value):
            return value

        told[repr(value)] = error_of(resolve(odd), following())
    assert told == snapshot


def test_wrong_stored_data_is_told_with_its_place(snapshot):
    told = {
        f"{kind} {data}"[:100]: error_of(from_plain, kind, data) for kind, data, _ in WRONG_DATA
    }
    assert told | {"no JSON": error_of(partial(plain, [object()]))} == snapshot
