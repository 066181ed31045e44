"""Planners that are programs, and everything that programs can do instead of answering."""

import gc
import os
import re
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot.policies import programs
from pytest_pafot.support.errors import BadAction
from pytest_pafot.world import Observation, VehicleState
from tests.helpers.tables import table

CUT_IN = pafot.Scenario(npcs=[[pafot.PositionInstruction(2, 10.0)]])
ROAD = pafot.Highway(duration=4.0)
LOOP = """
import json, sys, time, os

def answer(**values):
    print(json.dumps(values), flush=True)

for number, line in enumerate(sys.stdin):
    seen = json.loads(line)
    {body}
"""

SEEN = Observation(0.0, VehicleState(0, 0, 0, 20, 0, 5, 2), (), 4, 4.0, 26.8)


def program(folder, body, **options):
    file = folder / f"planner_{len(list(folder.iterdir()))}.py"
    file.write_text(LOOP.replace("{body}", textwrap.indent(textwrap.dedent(body), "    ").strip()))
    # these options halve the start
    return pafot.policies.process([sys.executable, "-S", "-E", str(file)], **options)


def children():
    """Return the ids of this process's children, including ended ones without a wait."""
    listed = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    return {*listed.read_text().split()} if listed.exists() else set()


@pytest.fixture(autouse=True)
def no_program_is_left():
    before = children()  # those of other tests
    gc.freeze()  # no program is in the older objects, and looking through them takes half a second
    yield
    programs._idle_in.cache_clear()
    gc.collect()
    assert children() <= before


def brakes_in_python():
    return lambda observation: (
        -1.0 if observation.others[0].x - observation.ego.x < 40 else 0.1,
        0.0,
    )


def test_program_drives_like_the_same_planner_in_python(tmp_path):
    ads = program(
        tmp_path,
        "answer(acceleration=-1.0 if seen['others'][0]['x'] - seen['ego']['x'] < 40 else 0.1, steering=0.0)",
    )
    ours, theirs = ROAD.rollout(CUT_IN, brakes_in_python), ROAD.rollout(CUT_IN, ads)
    assert theirs.error is None
    assert theirs.states.tobytes() == ours.states.tobytes()


def test_a_line_has_all_that_an_observation_has():
    lines = []

    def ads():
        return lambda observation: (
            lines.append((programs.line_of(observation, reset=True), observation)) or (0.0, 0.0)
        )

    ROAD.rollout(CUT_IN, ads)
    line, observation = lines[0]
    assert line.endswith(b"}\n")
    assert line.count(b"\n") == 1
    told = programs.json.loads(line)
    attributes = {name for name in dir(Observation) if not name.startswith("_")} - {
        "array",
        "replace",
    }
    assert told.keys() == attributes | {"reset"}
    assert told["ego"] == observation.ego._asdict()
    assert VehicleState(**told["others"][0]) == observation.others[0]
    assert told["lane_centres"] == list(observation.lane_centres)


def test_a_line_has_who_crosses_with_its_zone():
    zone = pafot.Zone(
        way="o3>o1",
        kind="crossing",
        origin="right",
        ego=(9.0, 19.0),
        npc=(8.0, 18.0),
        priority="npc",
    )
    crossing = pafot.CrossingVehicle(2, zone, 10.0, 20.0, 22.0, 9.0, -1.57, 8.0, 5.0, 2.0)
    seen = Observation(0.0, SEEN.ego, (), 4, 4.0, 26.8, crossing=(crossing,))
    (told,) = programs.json.loads(programs.line_of(seen, reset=True))["crossing"]
    assert (told["id"], told["distance"], told["zone"]["priority"]) == (2, 10.0, "npc")
    assert told["zone"]["ego"] == [9.0, 19.0]


def test_program_exchanges_observations_and_actions_of_its_environment(tmp_path):
    world = pafot.World("highway-fast-v0", duration=3.0)
    ads = program(tmp_path, "answer(action=4 if seen['observation'][0][3] > 0.2 and number else 1)")
    trace = world.rollout(CUT_IN, ads)
    assert trace.error is None
    assert set(trace.actions) == {1, 4}
    seen = {"image": np.zeros((2, 2), np.uint8), "speed": np.float32(1.5)}
    told = programs.json.loads(programs.line_of(seen, reset=False))
    assert told == {"reset": False, "observation": {"image": [[0, 0], [0, 0]], "speed": 1.5}}


def test_a_program_may_answer_with_a_lane(tmp_path):
    trace = ROAD.rollout(CUT_IN, program(tmp_path, "answer(lane=2, speed=20.0, lateral_jerk=2)"))
    assert trace.error is None
    assert trace.actions[0] == pafot.LaneCommand(lane=2, speed=20.0, lateral_jerk=2.0)


def test_persistent_program_is_notified_of_next_scenario(tmp_path, capfd):
    body = """
        if seen["reset"]: print("pid", os.getpid(), "reset at", number, file=sys.stderr)
        answer(acceleration=0.0, steering=0.0)
    """
    for keep, count in ((True, 1), (False, 3)):
        ads = program(tmp_path, body, keep=keep)
        for _ in range(3):
            assert ROAD.rollout(CUT_IN, ads).error is None
        told = re.findall(r"pid (\d+) reset at (\d+)", capfd.readouterr().err)
        assert len({pid for pid, _ in told}) == count
        assert [number == "0" for _, number in told] == [True, not keep, not keep]


def test_two_runs_at_once_have_a_program_each(tmp_path):
    loader = program(tmp_path, "answer(acceleration=float(number), steering=0.0)")
    first, second = loader(), loader()
    assert [first(SEEN), first(SEEN), second(SEEN)] == [(0.0, 0.0), (1.0, 0.0), (0.0, 0.0)]
    for ads in (first, second):
        ads.close()


@pytest.mark.parametrize(("body", "kind", "message"), [
    ("sys.exit(3)", "ProgramEnded", r"ended with exit code 3 in the place of an answer"),
    ("os.kill(os.getpid(), 11)", "ProgramEnded", r"was ended by signal 11, Segmentation fault, in the place"),
    ("os.close(1); time.sleep(60)", "ProgramEnded", r"closed its output in the place of an answer"),
    ("print('hello', flush=True)", "BadAction", r"expected a line of JSON with .*received 'hello'"),
    ("answer(acceleration=1.0)", "BadAction", r"expected a line of JSON with"),
    ("answer(acceleration='fast', steering=0)", "BadAction", r"expected \(acceleration \[m/s\^2\], steering"),
    ("print(line, end='', flush=True)", "BadAction", r"a decision, as an object without .*, received an observation"),
    ("answer(lane=9, speed=1)", "BadAction", r"a lane from 0"),
    ("print('{}\\n{}', flush=True)", "BadAction", r"one line for each observation, received another.*stderr"),
    ("print('x' * 2_000_000, flush=True)", "BadAction", r"a line of at most 1048576 bytes"),
])  # fmt: skip
def test_wrong_program_behaviour_is_reported_with_its_kind(
    body, kind, message, tmp_path, monkeypatch
):
    # a busy machine ends it late
    monkeypatch.setattr(programs, "GRACE", 0.2 if "os.close" in body else 10.0)
    once = f"if seen['time'] == 1.0:\n    {body}\nelse:\n    answer(acceleration=0.0, steering=0.0)"
    ads = program(tmp_path, once)
    error = ROAD.rollout(CUT_IN, ads).error
    assert error is not None
    assert (error.kind, error.tick) == (kind, 15)
    assert re.search(message, error.message)


def test_failed_program_does_not_prevent_later_starts(tmp_path):
    ads = program(
        tmp_path, "sys.exit(3) if seen['time'] == 1.0 else answer(acceleration=0.0, steering=0.0)"
    )
    assert ROAD.rollout(CUT_IN, ads).error.tick == 15
    assert (
        ROAD.rollout(CUT_IN, program(tmp_path, "answer(acceleration=0.0, steering=0.0)")).error
        is None
    )
    assert ROAD.rollout(CUT_IN, ads).error.tick == 15


def test_program_without_timely_answer_is_killed(tmp_path):
    ads = program(tmp_path, "answer(action=1) if number == 0 else time.sleep(60)")()
    assert ads([1]) == 1  # however long it takes to start here
    ads._loader = replace(ads._loader, timeout=0.1)
    with pytest.raises(programs.ProgramTimeout, match=r"did not answer within 0.1 s"):
        ads([1])
    ads.close()
    assert programs._has_ended(ads._program._process, 0.0)


def test_hanging_program_is_ended_by_world_hang_limit(tmp_path):
    ads = program(tmp_path, "time.sleep(60)")
    error = pafot.Highway(duration=4.0, hang_limit=0.3).rollout(CUT_IN, ads).error
    assert error is not None
    assert error.kind == "Hang"


STARTS_ANOTHER = """
    import subprocess
    if number == 0:  # it inherits stdout and stderr, and says at its end that nobody has killed it
        subprocess.Popen(["sh", "-c", "sleep 10; echo lived >&0"], stdin=open({path!r}, "w"))
    {ending} if number == 1 else answer(acceleration=0.0, steering=0.0)
"""


@pytest.mark.parametrize(("ending", "message"), [
    ("answer(acceleration=0.0, steering=0.0)", "no error"),
    ("os._exit(3)", "ended with exit code 3 in the place of an answer"),
    ("os.abort()", "was ended by signal 6, Aborted, in the place of an answer"),
])  # fmt: skip
def test_what_a_program_has_started_ends_with_it(ending, message, tmp_path):
    path = str(tmp_path / "lives")
    os.mkfifo(path)
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK)) as lives:
        error = ROAD.rollout(
            CUT_IN, program(tmp_path, STARTS_ANOTHER.format(path=path, ending=ending), keep=False)
        ).error
        os.set_blocking(lives.fileno(), True)
        assert lives.read() == ""  # up to the end of the last process that could write
    assert message in (error.message if error else "no error")


def test_program_with_unexpected_output_drives_no_other_run(tmp_path):
    loader = program(tmp_path, "answer(action=os.getpid())")
    first = loader()
    first([1])
    first._program._buffer += b"{}\n"  # it would answer the next run's first observation
    first.close()
    second = loader()
    assert second([1]) != first._program._process.pid
    second.close()


def test_long_stderr_output_of_program_is_shortened(tmp_path, capfd):
    ads = program(
        tmp_path, "sys.stderr.write('begin' + 'x' * 200_000 + 'end\\n'); answer(action=number)"
    )()
    assert [ads([1]) for _ in range(3)] == [0, 1, 2]
    ads.close()
    said = capfd.readouterr().err
    assert said.startswith("beginxx")
    assert re.search(
        r"xx\n\[\.\.\. 592027 bytes that .* wrote to stderr are omitted \.\.\.\]\nxx", said
    )
    assert said.endswith("xxend\n")
    assert len(said) < 2 * programs.STDERR_PRINTED + 100


@table("line", [
    b"[" * 100_000,
    b'{"lane":' * 100_000,
    b'{"acceleration": ' + b"9" * 5000 + b', "steering": 0}',
    b'{"acceleration": 0, "acceleration": -9, "steering": 0}',
    b'{"acceleration": 0, "steering": 0, "\xff": 0}',
    b'{"acceleration": 0, "steering": 0\0}',
    b"",
])  # fmt: skip
def test_unreadable_answer_is_a_bad_action(line):
    with pytest.raises(
        BadAction, match="expected a line of JSON with the keys acceleration and steering"
    ):
        programs.action_of(line)


def test_finding_includes_the_last_stderr_of_program(tmp_path, capfd):
    ads = program(tmp_path, "print('no map here', file=sys.stderr); sys.exit(1)")
    error = ROAD.rollout(CUT_IN, ads).error
    assert error is not None
    assert "the end of its stderr:\nno map here" in error.traceback
    assert "no map here" not in error.message  # this text distinguishes failures
    assert capfd.readouterr().err == "no map here\n"


def test_program_that_cannot_start_is_a_setup_error():
    with pytest.raises(
        TypeError,
        match=r"expected a program that can be started, received .*no-such.*build it first",
    ):
        ROAD.rollout(CUT_IN, pafot.policies.process(["./no-such-program"]))


@table(("command", "timeout", "message"), [
    ("./planner", None,
     r"a program and its arguments in a list, received './planner'. Write process\(\['./planner'\]\)"),
    ("python3 planner.py", None, r"Write process\(\['python3', 'planner.py'\]\)"),
    ([], None, r"in a list, received \[\]. Name the program"),
    (["./planner"], "1", "a timeout of more than 0 s, or None, received '1'"),
    (["./planner"], 0, "received 0. Use seconds"),
])  # fmt: skip
def test_invalid_command_or_timeout_is_refused_early(command, timeout, message):
    with pytest.raises(TypeError, match=message):
        pafot.policies.process(command, timeout=timeout)


def test_long_observation_passes_through_a_shorter_pipe(tmp_path):
    ads = program(tmp_path, "answer(action=len(seen['observation']))")()
    assert ads(np.zeros(30_000)) == 30_000
    ads.close()


IN_TWO_PROCESSES = """
import os, sys
import pytest_pafot as pafot

loader = pafot.policies.process(sys.argv[1:])

def answer():
    ads = loader()
    answered = ads([1])
    ads.close()
    return answered

pid = answer()
child = os.fork()
if not child:
    other = answer()
    os._exit(other == pid or other != answer())
assert os.waitpid(child, 0)[1] == 0
assert answer() == pid
print(pid)
"""


@pytest.mark.processes
def test_program_ends_with_its_process_despite_a_fork(tmp_path):
    command = program(tmp_path, "answer(action=os.getpid())").command
    pid = int(
        subprocess.check_output([sys.executable, "-W", "error", "-c", IN_TWO_PROCESSES, *command])
    )
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_program_that_ends_after_its_run_is_started_again(tmp_path):
    ads = program(
        tmp_path,
        "sys.exit(3) if seen['reset'] and number else answer(acceleration=0.0, steering=0.0)",
    )
    assert [ROAD.rollout(CUT_IN, ads).error for _ in range(3)] == [None, None, None]
