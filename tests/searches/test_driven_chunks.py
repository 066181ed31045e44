"""A search is the same whether the session drives its scenario by scenario, or other processes drive them."""

import math
import multiprocessing
import os
import re
import signal
import sys
import time
from pathlib import Path

import pytest

from pytest_pafot.execution import runner
from pytest_pafot.searches import bench, explore, results, run_table, scenarios, search, store
from pytest_pafot.searches.search import TimedWatch
from pytest_pafot.searches.store import Store

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone"),
]

SESSION = os.getpid()
SPACE = {
    "npcs": 2,
    "genes": 3,
    "gene_seconds": 4,
    "ego_lane": 1,
    "ego_speed": 22,
    "vehicles": "car",
}
STOP = 2  # findings, of which the last is in a chunk of another process
RUNS = 98  # six chunks and a part of one
ON_USE = re.compile("runs? in this process, the rest ran in workers|: not used, because a run took")


def keep(observation):
    return 0.0, 0.0


def mortal(observation):
    """Drive on, but end the process in some scenarios."""
    if os.getpid() != SESSION and int(observation.others[0].x * 1000) % 200 == 7:
        os._exit(3)
    return 0.0, 0.0


def holds(run):
    assert not run.collision
    assert run.min_distance > 1.9


@pytest.fixture
def searched(tmp_path, monkeypatch):
    """Return a function that searches in chunks of 16 runs, and tells all about it and where given chunks begin."""
    # the session itself makes that run
    monkeypatch.setattr(bench, "_difference_in_gym", lambda run, bench: "")
    monkeypatch.setattr(scenarios, "chunk_size", lambda run_seconds, left, workers: min(16, left))
    given, task, note_of = [], scenarios.Chunk, run_table.note_of
    monkeypatch.setattr(
        scenarios, "Chunk", lambda first, *more: given.append(first) or task(first, *more)
    )

    def search(
        name,
        *,
        drives=False,
        ads=keep,
        test=holds,
        runs=RUNS,
        saves=True,
        has_table=True,
        **settings,
    ):
        # without one, runs are only counted
        monkeypatch.setattr(run_table, "note_of", note_of if has_table else None)
        monkeypatch.setattr(scenarios, "WORTH_SECONDS", 0.0 if drives else math.inf)
        settings = SPACE | {"shrink_runs": 0} | settings
        given.clear()
        corpus, own = tmp_path / name, {"node_id": "test_it.py::test_it", "runs": runs}
        found = explore.explore(
            lambda: ads, holds=test, corpus=str(corpus) if saves else None, **own, **settings
        )
        summary = found.summary
        texts = {each.name: each.read_text() for each in corpus.rglob("*.yaml")}
        assert (
            sum(summary.outcomes.values()) == sum(summary.responsibilities.values()) == summary.runs
        )
        counts = (summary.failing, summary.runs, summary.random["runs"], summary.random["at_fault"])
        return {
            "rows": [
                {name: value for name, value in row.items() if name != "run"} for row in found.runs
            ],
            "events": [
                each
                for each in found.events
                if type(each).__module__ == "pytest_pafot.algorithms.evaluation"
            ],
            "files": texts,
            "counts": (*counts, summary.outcomes, summary.responsibilities),
            "failures": dict(summary.failures),
            "worst": [each.alike for each in summary.finds],
            "notes": [each for each in summary.process_notes if not ON_USE.search(each)],
        }, [*given]

    return search


ALONE = []


@pytest.fixture
def alone(searched):
    """Return what a search tells that the session has driven alone, which the first test makes for all."""
    if not ALONE:
        ALONE.append(searched("alone")[0])
    return {**ALONE[0]}


def test_whoever_drives_the_chunks_the_search_is_the_same(searched):
    alone, numbers = searched("alone", drives=True)
    assert not numbers
    assert len(alone["files"]) >= 2
    for count in (2, 3, 8):
        found, numbers = searched(f"{count} driven", drives=True, workers=count)
        assert found == alone
        assert numbers[0] < 8
        assert numbers == [*range(numbers[0], RUNS, 16)]
    counted, _ = searched("counted", drives=True, workers=2, has_table=False)
    in_rows = ("rows", "events")
    assert len(counted["rows"]) < RUNS
    assert [counted[each] for each in counted if each not in in_rows] == [
        alone[each] for each in alone if each not in in_rows
    ]


def test_a_dead_process_costs_its_run_and_not_its_chunk(searched, monkeypatch):
    """At a death the session goes on with the chunk, whose scenarios run one by one in other processes."""
    given = {"ads": mortal, "isolate": True, "workers": 2}
    one_by_one, _ = searched("one by one", **given)
    assert any(name.startswith("crash") for name in one_by_one["files"])
    lost, record_death = [], search.record_death
    monkeypatch.setattr(
        search,
        "record_death",
        lambda died, *more: lost.append(died.evaluation.scenario) or record_death(died, *more),
    )
    driven, numbers = searched("driven", drives=True, **given)
    assert numbers
    assert driven == one_by_one
    assert len(lost) > 2


def test_what_a_process_ran_that_was_killed_from_outside_is_run_again_with_a_note(
    searched, alone, tmp_path, monkeypatch
):
    monkeypatch.setattr(runner, "DEAR", math.inf)  # so that processes only drive chunks
    flag = tmp_path / "flag"

    def killed(observation):
        """End the process once, after some runs of the session."""
        if os.getpid() != SESSION and not flag.exists():
            flag.touch()
            os._exit(3)
        return 0.0, 0.0

    killed.__qualname__ = keep.__qualname__  # which files have
    found, numbers = searched("killed", drives=True, ads=killed, workers=2)
    assert flag.exists()
    assert numbers
    (note,) = found.pop("notes")
    assert re.search(
        r"ended with exit code 3 while it ran scenarios \d+ to \d+ of the search, which succeeded when",
        note,
    )
    assert alone.pop("notes") == []
    assert found == alone


def speed(trace):
    return float(trace.states[1:, :, 3].max())


def test_runs_that_only_the_session_may_judge_are_made_in_advance(searched, monkeypatch):
    monkeypatch.setattr(runner, "DEAR", 0.0)
    alone, _ = searched("alone", fitness=speed)
    assert searched("ahead", workers=3, fitness=speed) == (alone, [])


class Early(list):
    """Files that are saved before their chunk is counted, and an event for other processes: that one is awaited."""

    def __init__(self):
        super().__init__()
        self.is_awaited = lambda path: True
        self.is_any = multiprocessing.get_context("fork").Event()

    def clear(self):
        super().clear()
        self.is_any.clear()


@pytest.fixture
def saved_early(monkeypatch):
    """Return the files that are saved before their chunk is counted. The first chunk waits for one that is awaited."""
    saved, add_early, drive = Early(), Store.add_early, results.Driver.__call__

    def add(self, *given):
        before = {*self.early}
        add_early(self, *given)
        saved.extend(
            path
            for each in self.early.keys() - before
            for path in self.early[each].files or (None,)
        )
        if any(map(saved.is_awaited, saved)):
            saved.is_any.set()

    def late(self, task, *given):
        if task.first < 8:
            saved.is_any.wait(30)  # however slow the machine is
        drive(self, task, *given)

    monkeypatch.setattr(Store, "add_early", add)
    monkeypatch.setattr(results.Driver, "__call__", late)
    return saved


def test_a_failure_of_a_later_chunk_is_saved_before_its_turn(searched, alone, saved_early):
    assert searched("early", drives=True, workers=2)[0] == alone
    # the first chunk has failures of their kinds
    assert not {each.name for each in saved_early} <= {*alone["files"]}


def test_a_search_that_stops_at_its_findings_forgets_those_of_later_chunks(searched, saved_early):
    alone, _ = searched("alone", stop_after=STOP)
    assert not saved_early
    assert searched("early", drives=True, workers=2, stop_after=STOP)[0] == alone
    assert saved_early


def test_a_failure_of_a_later_chunk_whose_file_cannot_be_removed_stays(
    searched, saved_early, monkeypatch
):
    unlink = Path.unlink

    def refuse(self, *given, **named):
        if self in saved_early:
            raise PermissionError(self)
        unlink(self, *given, **named)

    monkeypatch.setattr(Path, "unlink", refuse)
    found, _ = searched("early", drives=True, workers=2, stop_after=STOP)
    assert {each.name for each in saved_early} <= {*found["files"]}
    assert len(found["failures"]) == STOP


@pytest.fixture
def is_over_when_saved_early(saved_early, monkeypatch):
    """Let the time of a search be over as soon as a failure of a later chunk is saved, for which it waits."""
    reached = TimedWatch.reached

    def is_over(self, plan):
        if not saved_early:
            time.sleep(0.05)  # other processes may be slow on a busy machine
        return "time" if saved_early else reached(self, plan)

    monkeypatch.setattr(TimedWatch, "reached", is_over)


@pytest.mark.usefixtures("is_over_when_saved_early")
def test_a_search_whose_time_is_over_counts_the_failures_of_later_chunks(searched, saved_early):
    found, _ = searched("early", drives=True, workers=2)
    assert {each.name for each in saved_early} <= {*found["files"]}
    assert {f"{id_}.pafot.yaml" for id_ in found["failures"]} == {*found["files"]}
    assert found["counts"][1] >= len(found["files"])


@pytest.mark.usefixtures("is_over_when_saved_early")
def test_a_search_that_saves_nothing_counts_the_failures_of_later_chunks_when_its_time_is_over(
    searched, saved_early, monkeypatch
):
    searched("early", drives=True, workers=2)
    (early,) = saved_early
    saved_early.clear()
    found, _ = searched("none", saves=False, drives=True, workers=2)
    assert early.name.partition(".")[0] in found["failures"]


@pytest.mark.usefixtures("is_over_when_saved_early")
def test_a_failure_of_a_later_chunk_that_is_not_repeated_is_flaky(
    searched, saved_early, monkeypatch
):
    """The verdict before its turn is on the run of the other process. At this seed, its scenario is driven as drawn."""

    def elsewhere(observation):
        return (0.0 if os.getpid() == SESSION else -1.0), 0.0

    # so that processes only drive chunks, however slow the machine is
    monkeypatch.setattr(runner, "DEAR", math.inf)

    def drives_on(run):
        assert run.collision or run.ego.speed[-1] > 15

    found, _ = searched("early", ads=elsewhere, test=drives_on, drives=True, workers=2, seed=3)
    (early,) = saved_early
    assert "flaky: " in found["files"][early.name]


def test_what_the_test_function_judges_otherwise_in_the_session_is_flaky(searched):
    def holds_here(run):
        assert os.getpid() == SESSION or not run.collision

    found, numbers = searched("elsewhere", test=holds_here, drives=True, workers=2)
    assert numbers
    assert len(found["rows"]) == RUNS
    flaky = ["got a different verdict" in text for text in found["files"].values()]
    assert flaky
    assert all(flaky)


@pytest.mark.parametrize("change", ["xfail: known\n", "no YAML: ["])
def test_a_file_that_somebody_changes_before_its_turn_is_not_removed(
    searched, saved_early, monkeypatch, change
):
    add_early, changed = Store.add_early, {}

    def add(self, *given):
        add_early(self, *given)
        for path in {*saved_early} - {*changed}:
            changed[path] = path.read_text() + change
            path.write_text(changed[path])

    monkeypatch.setattr(Store, "add_early", add)
    searched("early", drives=True, workers=2, stop_after=STOP)
    assert changed
    assert {path: path.read_text() for path in changed} == changed


def test_an_interrupt_while_a_failure_is_saved_early_leaves_no_file_that_the_session_does_not_know(
    searched, saved_early, tmp_path, monkeypatch
):
    add_early, write, noted = Store.add_early, store.write, []

    def interrupted(*given):
        assert write(*given)
        signal.raise_signal(signal.SIGINT)
        return True

    def add(self, *given):
        with monkeypatch.context() as patched:
            patched.setattr(store, "write", interrupted)
            try:
                add_early(self, *given)
            finally:
                noted.extend(path for each in self.early.values() for path in each.files)

    monkeypatch.setattr(Store, "add_early", add)
    with pytest.raises(KeyboardInterrupt):
        searched("early", drives=True, workers=2)
    assert noted
    assert {*noted} <= {*(tmp_path / "early").rglob("*.yaml")}


def end_when_something_is_saved_early(end, search, monkeypatch):
    """Search in a process that gets a signal as soon as a failure is saved early."""

    def ended():
        add_early = Store.add_early
        monkeypatch.setattr(
            Store, "add_early", lambda *given: add_early(*given) or os.kill(os.getpid(), end)
        )
        search()

    session = multiprocessing.get_context("fork").Process(target=ended)
    session.start()
    session.join()


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT])
def test_a_session_that_is_killed_keeps_what_failed(
    searched, alone, saved_early, tmp_path, monkeypatch, end
):
    given = {"drives": True, "workers": 2}
    end_when_something_is_saved_early(end, lambda: searched("parts", **given), monkeypatch)
    left = {each.name for each in (tmp_path / "parts").rglob("*.yaml")}
    assert left - {*alone["files"]}
