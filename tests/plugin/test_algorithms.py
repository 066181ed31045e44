"""Searches by other algorithms: the same items, files, replays and reports."""

import re

import pytest

from pytest_pafot.searching import resolve_algorithm
from pytest_pafot.searching.algorithms.catalogue import ALGORITHMS
from tests.helpers.sessions import section

TEST = "@pafot.search(SHORT, algorithm={!r})  # stop_after=1\ndef test_it(run):\n    assert not run.collision\n"


def test_lane_finding_is_saved_confirmed_shrunk_and_replayed(project, in_highway_env):
    project.write(TEST.format("random-manoeuvre"))
    result = project.run("--pafot-shrink-rollouts=50", runs=24)
    result.assert_outcomes(failed=2)
    result.stdout.no_fnmatch_line("*flaky*")
    text = project.only_file.read_text()
    assert re.search(r"- \{lane: (keep|left|right), speed: \d", text)
    assert "algorithm: random-manoeuvre" in text
    assert "shrunk:" in text
    assert "{cell:" not in text
    again = project.run(runs=0)
    again.assert_outcomes(failed=1, skipped=1)
    again.stdout.fnmatch_lines(["*still failing*"])


KINDS = {
    "cells": "kinds == {'PositionInstruction'}",
    "lanes": "kinds == {'LaneInstruction'}",
    "both": "kinds <= {'PositionInstruction', 'LaneInstruction'}",
}


def test_every_algorithm_searches_with_every_kind_it_supports(project):
    lines, supported = [], []
    for algorithm in ALGORITHMS:
        for kind, check in KINDS.items():
            supported.append(kind in resolve_algorithm(algorithm).instructions)
            lines += [
                f"@pafot.search(SHORT, algorithm={algorithm!r}, instructions={kind!r})",
                f"def test_{len(supported) - 1}(run):",
                "    kinds = {type(chain[0]).__name__ for chain in run.trace.scenario.npcs}",
                f"    assert {check}",
            ]
    project.write("\n".join(lines))
    result = project.run(runs=16)
    result.assert_outcomes(passed=supported.count(True), failed=supported.count(False))
    for number, is_supported in enumerate(supported):
        if not is_supported:
            text = section(result, f"test_{number}")
            assert re.search(r"instructions=\.\.\.\): expected '(cells|lanes)' for the algorithm \S+, received '", text)
    assert supported.count(False) == 4, "av-fuzzer and random-manoeuvre have lanes only"


def test_unknown_algorithm_or_kind_error_lists_the_choices(project):
    told = {
        "SHORT, algorithm='random-manoeuvre', instructions='both'": "*instructions=*expected 'lanes' for the algorithm "
        "random-manoeuvre, received 'both'*",
        "SHORT, instructions='cell'": "*instructions: expected one of cells, lanes, both, received 'cell'*",
        "SHORT, algorithm='genetic'": "*expected random, pafot, *or random-manoeuvre, received 'genetic'; or give "
        "your own class*",
        "SHORT, algorithm='randm'": "*or random-manoeuvre, received 'randm'; did you mean 'random'[?]",
    }
    project.write("\n".join(f"@pafot.search({given})\ndef test_{n}(run):\n    pass\n" for n, given in enumerate(told)))
    result = project.run()
    result.assert_outcomes(failed=2, errors=2)
    for n, line in enumerate(told.values()):
        pytest.LineMatcher(section(result, f"test_{n}").splitlines()).fnmatch_lines([line])


OWN = (
    "from dataclasses import dataclass\n"
    "from pytest_pafot.searching import GenerationalSearch, GenerationState, sample\n\n"
    "@dataclass(frozen=True)\n"
    "class Own(GenerationalSearch):\n"
    "    name = 'own'\n"
    "    fitness = 'paper'\n"
    "    def start(self, rng):\n"
    "        return GenerationState()\n"
    "    def propose(self, state, rng):\n"
    "        return state, [sample(self.space, rng) for _ in range(self.population)]\n"
)


@pytest.mark.parametrize("workers", [1, 2])
def test_custom_algorithm_class_is_named_in_all_output(project, workers):
    project.pytester.makepyfile(own=OWN)
    project.write(
        "from own import Own\n@pafot.search(SHORT, algorithm=Own)  # stop_after=1\n"
        "def test_it(run):\n    assert not run.collision\n"
    )
    result = project.run(f"--pafot-workers={workers}", runs=32)
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*own, seed *"])
    assert "algorithm: own" in project.only_file.read_text()


def test_algorithm_option_takes_a_class_by_module_name(project):
    project.pytester.makepyfile(own=OWN)
    project.write("@pafot.search(SHORT)  # stop_after=1\ndef test_it(run):\n    assert not run.collision\n")
    project.run("--pafot-algorithm=own:Own", runs=32).assert_outcomes(failed=2)
    assert "algorithm: own" in project.only_file.read_text()


@pytest.mark.parametrize(("given", "message"), [
    ("own:Onw", "algorithm: expected a name in the module own, received 'own:Onw'; did you mean 'own:Own'?"),
    ("onw:Own", "algorithm: expected a module that can be imported, received 'onw:Own' (ModuleNotFoundError*"),
])  # fmt: skip
def test_missing_algorithm_class_fails_only_its_item(project, given, message):
    project.pytester.makepyfile(own=OWN)
    project.write("@pafot.search(SHORT)\ndef test_it(run):\n    pass\n\ndef test_ordinary():\n    pass\n")
    result = project.run(f"--pafot-algorithm={given}")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines([f"*{message.replace('[', '[[]')}*"])
