"""Runs of a comparison give the same bytes after any interruptions, and with any number of workers."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pytest_pafot.comparison import algorithm_run, resumable
from pytest_pafot.comparison.algorithm_run import run_all
from pytest_pafot.comparison.plan import Plan
from pytest_pafot.comparison.resumable import ProgressLine
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.support.errors import RequestError
from pytest_pafot.world import Highway


def clock():
    return 0.0


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*.csv"))}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, quick):
    """Return the files of an uninterrupted comparison in one process."""
    folder = tmp_path_factory.mktemp("whole")
    run_all(quick(), folder, workers=1, stream=io.StringIO(), clock=clock)
    return contents(folder)


def test_comparison_writes_one_file_per_run_in_order(whole):
    assert sorted(whole) == [
        "results.csv", "runs/av-fuzzer-000.csv", "runs/av-fuzzer-001.csv", "runs/pafot-000.csv",
        "runs/pafot-001.csv", "runs/random-000.csv", "runs/random-001.csv",
    ]  # fmt: skip
    parts = [whole[f"runs/{name}-00{run}.csv"] for name in ("pafot", "av-fuzzer", "random") for run in (0, 1)]
    header = parts[0].partition(b"\n")[0] + b"\n"
    assert whole["results.csv"] == header + b"".join(part.partition(b"\n")[2] for part in parts)


@pytest.mark.processes
def test_two_workers_leave_the_same_bytes_as_one(tmp_path, quick, quiet, whole):
    run_all(quick(), tmp_path, workers=2, stream=quiet, clock=time.monotonic)
    assert contents(tmp_path) == whole


def test_interrupted_comparison_continues_with_the_missing_runs(tmp_path, quick, quiet, whole, monkeypatch):
    begun = []
    rows = algorithm_run.run_rows

    def watched(plan, algorithm, run, tick):
        begun.append((algorithm, run))
        for number, row in enumerate(rows(plan, algorithm, run, tick)):
            if len(begun) in (2, 4, 5) and number == 3:
                raise KeyboardInterrupt
            yield row

    monkeypatch.setattr(algorithm_run, "run_rows", watched)
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            run_all(quick(), tmp_path, workers=1, stream=quiet, clock=clock)
    run_all(quick(), tmp_path, workers=1, stream=quiet, clock=clock)
    assert contents(tmp_path) == whole
    assert len(begun) == 6 + 3, "a finished run was run again"
    assert not list(tmp_path.rglob("*.tmp"))


class Pool:
    """A stand-in for processes that completes tasks from the last to the first, or returns a different answer."""

    failure = ""
    __class_getitem__ = classmethod(lambda cls, types: cls)

    def __init__(self, work, size, **options):
        self.work = work

    def __enter__(self):
        return self

    def __exit__(self, *raised):
        """Do nothing, since nothing must end."""

    def expect(self, tasks):
        self.tasks = tasks

    def completed(self, tick):
        for task in reversed(self.tasks):
            yield task, self.answer(task, tick)

    def answer(self, task, tick):
        return self.work(task, tick)


def test_worker_order_does_not_change_the_written_bytes(tmp_path, quick, quiet, whole, monkeypatch):
    monkeypatch.setattr(resumable, "WorkerPool", Pool)
    run_all(quick(), tmp_path, workers=2, stream=quiet, clock=clock)
    assert contents(tmp_path) == whole


def test_worker_failure_is_raised_with_the_way_out(tmp_path, quick, quiet, monkeypatch):
    monkeypatch.setattr(resumable, "WorkerPool", Pool)
    plan = quick(algorithms=("random",), runs=1)

    def raised(answer, kind, match):
        monkeypatch.setattr(Pool, "answer", lambda self, task, tick: answer)
        with pytest.raises(kind, match=match):
            run_all(plan, tmp_path, workers=2, stream=quiet, clock=clock)

    lost = ProcessLostError(("random", 0), pid=1, how="was ended by SIGKILL")
    raised(lost, ChildProcessError, r"finish \('random', 0\), .*: its process was ended by SIGKILL; .* fewer --workers")
    raised(LookupError("no such planner"), LookupError, "no such planner")
    monkeypatch.setattr(Pool, "failure", "no memory")
    raised(
        RuntimeError("no memory"), ChildProcessError, r"finish \('random', 0\), received: no memory; .* fewer --work"
    )


@pytest.mark.processes
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system cannot kill")
def test_killed_with_its_workers_running_it_goes_on(tmp_path, quick, quiet, whole):
    root = str(Path(__file__).parents[3])
    program = "import sys; from tests.optional.comparison.test_resumable import forever; forever(sys.argv[1])"
    command = [sys.executable, "-c", program, str(tmp_path)]
    with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        while not list(tmp_path.glob("runs/*.csv")) and process.poll() is None:
            time.sleep(0.005)
        process.send_signal(signal.SIGKILL)
        assert process.stdout.read() == b"", "ends with the last of the workers, who hear that nobody listens any more"
    left = contents(tmp_path)
    assert left
    assert all(content == whole.get(name, content) for name, content in left.items())
    run_all(quick(), tmp_path, workers=1, stream=quiet, clock=clock)
    now = contents(tmp_path)
    assert {name: now[name] for name in whole} == whole


def forever(folder):
    """Run the comparison of `quick` without an end in sight, in a separate process."""
    fields = {"ads": "constant_speed", "algorithms": ("pafot", "av-fuzzer", "random"), "generations": 3, "runs": 999}
    space = {"npcs": 2, "genes": 2, "gene_seconds": 10.0}
    plan = Plan(**fields, world=Highway(duration=20.0).to_dict(), space=space)
    run_all(plan, Path(folder), workers=2, stream=sys.stderr, clock=time.monotonic)


DAMAGE = {
    "a row less": ("random-000.csv", lambda content: content.rpartition(b"\n")[0].rpartition(b"\n")[0] + b"\n"),
    "another number": ("random-000.csv", lambda content: content.replace(b"1", b"2")),
    "nothing": ("random-000.csv", lambda content: b""),
    "no text": ("random-001.csv", lambda content: content + b"\xff"),
    "another time": ("random-000.seconds", lambda content: b"1" + content),
    "no time": ("random-000.seconds", lambda content: b"\xff"),
}


def test_damaged_results_are_made_again(tmp_path, quick, whole):
    small = quick(algorithms=("random",))
    run_all(small, tmp_path, workers=1, stream=io.StringIO(), clock=clock)
    for name, change in DAMAGE.values():
        path = tmp_path / "runs" / name
        path.write_bytes(change(path.read_bytes()))
        told = io.StringIO()
        run_all(small, tmp_path, workers=1, stream=told, clock=clock)
        assert f"{path.with_suffix('.csv')} was changed or damaged, so its task runs again" in told.getvalue()
        assert all(
            contents(tmp_path)[f"runs/random-00{run}.csv"] == whole[f"runs/random-00{run}.csv"] for run in (0, 1)
        )


def test_results_without_readable_question_are_refused(tmp_path, quick, quiet):
    small = quick(runs=1, algorithms=("random",))
    run_all(small, tmp_path, workers=1, stream=quiet, clock=clock)
    (question,) = tmp_path.glob("*.json")
    question.write_bytes(b"\xff")
    with pytest.raises(RequestError, match="json does not agree: it cannot be read"):
        run_all(small, tmp_path, workers=1, stream=quiet, clock=clock)
    question.unlink()
    with pytest.raises(RequestError, match="json does not agree: it is gone; give another folder"):
        run_all(small, tmp_path, workers=1, stream=quiet, clock=clock)


def test_more_runs_and_algorithms_can_be_added_later(tmp_path, quick, quiet, whole):
    run_all(quick(runs=1, algorithms=("random",)), tmp_path, workers=1, stream=quiet, clock=clock)
    run_all(quick(), tmp_path, workers=1, stream=quiet, clock=clock)
    assert contents(tmp_path) == whole


@pytest.mark.parametrize("changes", [{"seed": 1}, {"generations": 4}, {"blame": "ego"}, {"ads": "blind_lane_change"}])
def test_a_folder_of_another_comparison_is_refused(tmp_path, quick, quiet, changes):
    small = {"runs": 1, "algorithms": ("random",)}
    run_all(quick(**small), tmp_path, workers=1, stream=quiet, clock=clock)
    before = contents(tmp_path)
    with pytest.raises(RequestError, match=r"--out: expected an empty folder or the folder of this comparison"):
        run_all(quick(**(small | changes)), tmp_path, workers=1, stream=quiet, clock=clock)
    assert contents(tmp_path) == before


OWN_ALGORITHM = """
from dataclasses import dataclass
import sampling_of_mine
from pytest_pafot.searching import GenerationalSearch, GenerationState, sample

@dataclass(frozen=True)
class Mine(GenerationalSearch):
    name = "mine"
    def start(self, rng):
        return GenerationState()
    def propose(self, state, rng):
        return state, [sample(self.space, rng) for _ in range(sampling_of_mine.COUNT)]
    def learn(self, state, evaluations, rng):
        return state
"""


@pytest.fixture
def own_algorithm(tmp_path, monkeypatch):
    """Write an algorithm that imports another file; return that file and a folder for results."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "algorithm_of_mine.py").write_text(OWN_ALGORITHM)
    imported = tmp_path / "sampling_of_mine.py"
    imported.write_text("COUNT = 2\n")
    yield imported, tmp_path / "out"
    for name in ("algorithm_of_mine", "sampling_of_mine"):
        sys.modules.pop(name, None)


def test_a_changed_algorithm_is_refused_by_file_name(quick, quiet, own_algorithm):
    imported, out = own_algorithm
    mine, both = "algorithm_of_mine:Mine", {"runs": 1, "generations": 1}
    run_all(quick(algorithms=(mine,), **both), out, workers=1, stream=quiet, clock=clock)
    before = contents(out)
    imported.write_text("COUNT = 4\n")
    why = r"names\.mine\.code\.sampling_of_mine\.py 'sha256:\w+' in the file, 'sha256:\w+' now; give another folder"
    with pytest.raises(RequestError, match=why):
        run_all(quick(algorithms=(mine, "random"), **both), out, workers=1, stream=quiet, clock=clock)
    assert contents(out) == before
    # Without the algorithm nothing is mixed, and its identity stays: it cannot come back changed afterwards.
    run_all(quick(algorithms=("random",), **both), out, workers=1, stream=quiet, clock=clock)
    with pytest.raises(RequestError, match=why):
        run_all(quick(algorithms=(mine, "random"), **both), out, workers=1, stream=quiet, clock=clock)
    run_all(quick(algorithms=(mine, "random"), **both), out.with_name("other"), workers=1, stream=quiet, clock=clock)
    imported.write_text("COUNT = 2\n")
    run_all(quick(algorithms=(mine, "random"), **both), out, workers=1, stream=quiet, clock=clock)


def test_changed_algorithm_without_finished_runs_is_no_mixture(quick, quiet, own_algorithm, monkeypatch):
    imported, out = own_algorithm
    plan = quick(algorithms=("random", "algorithm_of_mine:Mine"), runs=1, generations=1)
    rows = algorithm_run.run_rows

    def interrupted(plan, algorithm, run, tick):
        if algorithm == "mine":
            raise KeyboardInterrupt
        return rows(plan, algorithm, run, tick)

    monkeypatch.setattr(algorithm_run, "run_rows", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_all(plan, out, workers=1, stream=quiet, clock=clock)
    monkeypatch.undo()
    monkeypatch.chdir(out.parent)
    imported.write_text("COUNT = 4\n")
    run_all(plan, out, workers=1, stream=quiet, clock=clock)
    assert len(contents(out)) == 3


def test_two_algorithms_of_one_name_are_not_mixed(quick, quiet, own_algorithm):
    imported, out = own_algorithm
    mine, other = "algorithm_of_mine:Mine", "other_of_mine:Mine"
    run_all(quick(algorithms=(mine,), runs=1, generations=1), out, workers=1, stream=quiet, clock=clock)
    imported.with_name("other_of_mine.py").write_text(OWN_ALGORITHM)
    with pytest.raises(RequestError, match=f"names.mine.given '{mine}' in the file, '{other}' now"):
        run_all(quick(algorithms=(other,), runs=2, generations=1), out, workers=1, stream=quiet, clock=clock)


@pytest.mark.parametrize("what", ["ads", "fitness"])
def test_a_changed_policy_or_fitness_is_refused_by_file_name(tmp_path, quick, quiet, monkeypatch, what):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    text = f"from core_of_{what} import NUMBER\ndef ads():\n    return lambda observation: (NUMBER, 0.0)\n"
    (tmp_path / f"module_of_{what}.py").write_text(f"{text}def fitness(trace):\n    return NUMBER\n")
    imported = tmp_path / f"core_of_{what}.py"
    imported.write_text("NUMBER = 0.0\n")
    plan = quick(algorithms=("random",), runs=1, generations=1, **{what: f"module_of_{what}:{what}"})
    run_all(plan, tmp_path / "out", workers=1, stream=quiet, clock=clock)
    imported.write_text("NUMBER = 1.0\n")
    with pytest.raises(RequestError, match=rf"code\.core_of_{what}\.py 'sha256:\w+' in the file"):
        run_all(plan, tmp_path / "out", workers=1, stream=quiet, clock=clock)


class TestProgressLine:
    def test_progress_has_runs_share_and_the_remaining_time_once_a_run_is_done(self):
        progress = ProgressLine(total=10, done=2, stream=io.StringIO(), clock=lambda: 100.0)
        assert progress.line(0.0, 150.0) == "compare: 2 of 10 runs, 20 %"
        progress.done = 4
        assert progress.line(0.5, 160.0) == "compare: 4 of 10 runs, 45 %, 2 min left"

    def test_progress_without_terminal_prints_every_ten_seconds(self):
        now, told = [0.0], io.StringIO()
        progress = ProgressLine(total=2, done=0, stream=told, clock=lambda: now[0])
        for second in range(25):
            now[0] = float(second)
            progress.tick(0.1)
        progress.finished(("pafot", 0))
        lines = told.getvalue().splitlines()
        assert len(lines) == 4
        assert lines[-1] == "compare: 1 of 2 runs, pafot run 0 done after 24 s"


def dying():
    """Return nothing: this factory ends its process."""
    os._exit(5)


@pytest.mark.processes
@pytest.mark.usefixtures("copies")
def test_killed_worker_is_reported_with_the_way_out(tmp_path, quick, quiet):
    plan = quick(ads="tests.optional.comparison.test_resumable:dying", algorithms=("random",), runs=1)
    with pytest.raises(ChildProcessError, match=r"finish \('random', 0\), .* exit code 5; .* fewer --workers"):
        run_all(plan, tmp_path, workers=2, stream=quiet, clock=clock)
