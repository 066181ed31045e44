"""A search is the same whether the session drives its blocks, scenario by scenario, or other processes drive them."""

import math
import os
import re
import sys

import pytest

from pytest_pafot.campaign import explore, search, workers
from pytest_pafot.execution import runner
from pytest_pafot.searching import DistinctSearch, RandomSearch

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone"),
]

SESSION = os.getpid()
SPACE = {"npcs": 2, "genes": 3, "gene_seconds": 4, "ego_lane": 1, "ego_speed": 22}
STOP = 3  # findings, of which the last is in a block of another process
RUNS = 98  # six blocks and a part of one


def keep(observation):
    return 0.0, 0.0


def mortal(observation):
    """Drive on, but end the process in some scenarios."""
    if os.getpid() != SESSION and int(observation.others[0].x * 1000) % 40 == 7:
        os._exit(3)
    return 0.0, 0.0


def holds(run):
    assert not run.collision
    assert run.min_distance > 1.9


@pytest.fixture
def searched(tmp_path, monkeypatch):
    """Return a function that searches in blocks of 16 runs, and tells all about it and which blocks were given away."""
    for each in (DistinctSearch, RandomSearch):
        monkeypatch.setattr(each, "block_runs", 16)
    given, task = [], workers.BlockTask
    monkeypatch.setattr(
        workers, "BlockTask", lambda number, *more, **named: given.append(number) or task(number, *more, **named)
    )

    def search(name, *, drives=False, ads=keep, runs=RUNS, **settings):
        monkeypatch.setattr(workers, "DRIVEN_SECONDS", 60.0 if drives else -1.0)
        monkeypatch.setattr(workers, "FED_SECONDS", 0.0)
        settings = SPACE | {"population": 4, "shrink_rollouts": 0, "neighbours": 0} | settings
        given.clear()
        corpus, own = tmp_path / name, {"node_id": "test_it.py::test_it", "runs": runs}
        found = explore.explore(lambda: ads, holds=holds, corpus=str(corpus), **own, **settings)
        summary = found.summary
        texts = {each.name: each.read_text() for each in corpus.rglob("*.yaml")}
        counts = (summary.coverage, summary.failing, summary.runs, summary.random_runs, summary.random_failing)
        return {
            "rows": [{name: value for name, value in row.items() if name != "run"} for row in found.runs],
            "events": [each for each in found.events if type(each).__module__.endswith("searching.events")],
            "files": texts,
            "counts": counts,
            "failures": summary.failures,
            "notes": [each for each in summary.process_notes if "in use" not in each],
        }, [*given]

    return search


@pytest.mark.parametrize("algorithm", ["distinct", "random"])
def test_whoever_drives_the_blocks_the_search_is_the_same(searched, algorithm):
    alone, blocks = searched("alone", drives=True, algorithm=algorithm)
    assert not blocks
    assert len(alone["files"]) >= 2
    for count, driven in ((2, [1, 2, 3, 4]), (3, [])):  # fewer than two blocks for each process are not given away
        assert searched(f"{count}", workers=count, algorithm=algorithm) == (alone, [])
        assert searched(f"{count} driven", drives=True, workers=count, algorithm=algorithm) == (alone, driven)


def test_a_search_goes_on_inside_of_a_block_that_another_process_drove(searched, tmp_path):
    alone, _ = searched("alone", runs=144, seed=7)
    given = {"seed": 7, "drives": True, "workers": 2, "resume": str(tmp_path / "states")}
    first, _ = searched("parts", runs=144, stop_after=STOP, **given)
    done = len(first["rows"])
    assert done > 16
    assert done % 4
    rest, blocks = searched("parts", runs=144 - done, **given)
    assert blocks
    assert rest["files"] == alone["files"]
    assert rest["counts"] == alone["counts"]
    assert first["rows"] + rest["rows"] == alone["rows"]


def test_a_dead_process_costs_its_run_and_not_its_block(searched, monkeypatch):
    """At the first death the session goes on with the block; later ones are in processes of those that drive."""
    given = {"ads": mortal, "isolate": True, "workers": 2, "runs": 162}
    one_by_one, _ = searched("one by one", **given)
    assert any(name.startswith("crash") for name in one_by_one["files"])
    lost, lose = [], search.lose
    monkeypatch.setattr(search, "lose", lambda died, *more: lost.append(died.task) or lose(died, *more))
    broken_off, next_ = [], workers.Workers.next
    monkeypatch.setattr(
        workers.Workers, "next", lambda self, *more: broken_off.append(self._suspect) or next_(self, *more)
    )
    driven, blocks = searched("driven", drives=True, **given)
    assert blocks == [1, 2, 3, 4, 5, 6, 7, 8]
    assert driven == one_by_one
    assert len({each.task.number for each in broken_off if each is not None}) < len(lost)


def test_a_block_whose_process_was_killed_from_outside_is_driven_again_with_a_note(searched, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "DEAR", math.inf)  # so that processes only drive blocks
    alone, _ = searched("alone")
    flag = tmp_path / "flag"

    def killed(observation):
        """End the process once, after some runs of the session."""
        if os.getpid() != SESSION and not flag.exists():
            flag.touch()
            os._exit(3)
        return 0.0, 0.0

    found, blocks = searched("killed", drives=True, ads=killed, workers=2)
    assert flag.exists()
    assert blocks
    (note,) = found.pop("notes")
    assert re.search(r"ended with exit code 3 while it ran block \d of the search, which ran to its end", note)
    assert alone.pop("notes") == []
    assert found == alone


def speed(trace):
    return float(trace.states[1:, :, 3].max())


def test_runs_of_later_blocks_that_only_the_session_may_judge_are_judged_when_they_come(searched, monkeypatch):
    monkeypatch.setattr(runner, "DEAR", 0.0)
    alone, _ = searched("alone", fitness=speed)
    early, evaluated = [], workers.Workers._evaluated_early
    monkeypatch.setattr(workers.Workers, "_evaluated_early", lambda *given: early.append(given) or evaluated(*given))
    assert searched("ahead", workers=3, fitness=speed) == (alone, [])
    assert early
