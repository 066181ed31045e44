"""Searches by other algorithms: the same items, files, replays and reports."""

import re

import pytest

from pytest_pafot.algorithms import resolve_algorithm
from pytest_pafot.algorithms.catalogue import ALGORITHMS
from pytest_pafot.corpus.reader import load
from tests.plugin.conftest import labels

TEST = "@pafot.search(SHORT, algorithm={!r})  # stop_after=1\ndef test_it(run):\n    assert not run.collision\n"


def test_lane_finding_is_saved_confirmed_shrunk_and_replayed(project, in_highway_env):
    project.write(TEST.format("random-manoeuvre"))
    result = project.run("--pafot-shrink-runs=50", runs=24)
    result.assert_outcomes(failed=2)
    assert load(project.only_file).flaky is None
    text = project.only_file.read_text()
    assert re.search(r"NPC \d: \[\{lane: (keep|left|right), speed: \d", text)
    assert "algorithm: random-manoeuvre" in text
    assert "shrunk:" in text
    assert "{cell:" not in text
    again = project.run(runs=0)
    again.assert_outcomes(failed=1, skipped=1)
    assert labels(again) == "1 still failing"


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
    project.run("--pafot-json=pafot.json", runs=16)
    results = {each.node_id: each.result == "passed" for each in project.record.searches}
    assert [results[f"test_it.py::test_{n}[search]"] for n in range(len(supported))] == supported


OWN = (
    "from dataclasses import dataclass\n"
    "from pytest_pafot.algorithms import GenerationalSearch, GenerationState, sample\n\n"
    "@dataclass(frozen=True)\n"
    "class Own(GenerationalSearch):\n"
    "    name = 'own'\n"
    "    fitness = 'paper'\n"
    "    def start(self, rng):\n"
    "        return GenerationState()\n"
    "    def propose(self, state, rng):\n"
    "        return state, [sample(self.space, rng) for _ in range(self.population)]\n"
)


@pytest.mark.parametrize(("argument", "options"), [
    ("algorithm=Own", ()), ("algorithm=Own", ("--pafot-workers=2",)), ("", ("--pafot-algorithm=own:Own",)),
])  # fmt: skip
def test_custom_algorithm_class_is_named_in_all_output(project, argument, options):
    project.pytester.makepyfile(own=OWN)
    project.write(
        f"from own import Own\n@pafot.search(SHORT, {argument})  # stop_after=1\n"
        "def test_it(run):\n    assert not run.collision\n"
    )
    result = project.run("-v", *options, runs=32)
    result.assert_outcomes(failed=2)
    assert "  Algorithm: own, " in result.stdout.str()
    assert "algorithm: own" in project.only_file.read_text()
