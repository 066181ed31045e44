"""The command `python -m pytest_pafot bisect`: the commit of a policy since which a saved scenario fails."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

from pytest_pafot.__main__ import DRIVES, main
from pytest_pafot.extras.revisions.bisect_command import Trials, _group, parted
from pytest_pafot.extras.revisions.bisect_session import TOLD
from tests.helpers.processes import begun
from tests.helpers.sessions import Copy
from tests.plugin.test_driving_on import replay as replayed
from tests.plugin.test_driving_on import saved  # noqa: F401  (a fixture)

GUIDE = Path(__file__).parents[3] / "docs" / "guide" / "what-broke.md"
FILE = "pafot_corpus/test_safety/test_never_at_fault/leader-unanswered-b5ed63.pafot.yaml"
FINDING = """\
pafot: 2
test: test_safety.py::test_never_at_fault
world: {kind: highway, lanes: 4, speed_limit: 26.8, physics_hz: 15, ads_hz: 5, duration: 60.0, clearance: 3.0,
        headway: 2.0,
        limits: {acceleration: 5.0, braking: 8.0, jerk: 10.0, lateral_acceleration: 4.0, overspeed: 1.1, heading: 0.5},
        hang_limit: 30.0}
scenario:
  seed: 0
  ego: {lane: 1, speed: 22.0}
  npcs:
    - - {cell: 7, speed: 15.0}
      - {cell: 6, speed: 0.0}
    - - {cell: 2, speed: 10.0}
expect: {failure: AssertionError, assertion: not run.collision, outcome: collision, time: 15.333, npc: 1, cell: 2,
         side: front, responsibility: ego, fault: leader-unanswered, npc_manoeuvre: lane-keeping,
         ego_manoeuvre: lane-keeping,
         situation: {npc: 1, time: 13.2, ahead: 20.0, lane: 0, ego_speed: 9.0, npc_speed: 0.1}}
found: {seed: 1977854157, generation: 0, algorithm: distinct, versions: {numpy: 0.0.1}}
"""
"""A saved scenario with a standing leader: a planner with a headway of 0.6 s hits it, and one with 0.9 s does not."""

GOOD, BAD, BROKEN, OTHER = "good", "bad", "import nothing", "other"


def git(*arguments):
    return subprocess.run(["git", *arguments], check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def commit(tmp_path, monkeypatch):
    """Return a function that commits a policy, in a repository that also has the test and the saved scenario."""
    root = tmp_path / "project"
    (root / FILE).parent.mkdir(parents=True)
    (root / FILE).write_text(FINDING)
    (root / "test_safety.py").write_text("")
    monkeypatch.chdir(root)
    monkeypatch.syspath_prepend(root)
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "Ann")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "ann@example.org")
        monkeypatch.setenv(f"GIT_{name}_DATE", "2026-10-05T09:00:00+0000")
    git("init", "-q", "-b", "main")

    def write(text, subject="Change the policy"):
        (root / "planner.py").write_text(text)
        git("add", "planner.py")
        git("commit", "-q", "--allow-empty", "-m", subject)
        return git("rev-parse", "HEAD")

    return write


@pytest.fixture
def tried(monkeypatch):
    """Replace trials by the result that the policy's text states; return the texts that were tried."""
    texts = []

    def session(self):
        policy = self.tree / "planner.py"
        texts.append(policy.read_text() if policy.exists() else "")
        verdict = {GOOD: True, BAD: False}.get(texts[-1].partition("#")[0].strip())
        decisions = [[1.0, 0.0], [1.0, 0.0], [-6.0 if verdict else 0.5, 0.0]]
        told = {"passes": verdict, "why": "as it says", "is_other": texts[-1] == OTHER}
        return (
            told
            if verdict is None
            else {**told, "decisions": decisions, "speeds": [20, 21, 22], "ticks": [0, 3, 6], "hz": 15}
        )

    monkeypatch.setattr(Trials, "_session", session)
    return texts


def bisect(*arguments):
    return main(["bisect", FILE, "--policy", "planner.py", *arguments])


def test_bisect_reports_commit_changes_and_first_different_decision(commit, tried, capsys):
    first = commit(GOOD)
    for number in range(8):
        commit(f"{GOOD} # {number}")
    last = commit(f"{BAD} # \x1b[31m", "Go \x1b[31mfaster\n\n::error::not of the subject")
    for number in range(8):
        commit(f"{BAD} # {number}")
    before = git("status"), git("worktree", "list"), Path(".git/index").read_bytes()
    assert bisect("--good", first[:8]) == 0
    told = capsys.readouterr().out
    assert f"\n{last} is the first that fails, by Ann at 2026-10-05T09:00:00+00:00:\n" in told
    assert "+00:00:\n  Go \\x1b[31mfaster\n" in told
    assert "\n-good # 7\n" in told
    assert "\n+bad # \\x1b[31m\n" in told
    assert "\x1b" not in told
    assert told.endswith(
        "the first decision that differs is at tick 6, after 0.4 s at 22.0 m/s\n"
        "  before: acceleration -6 m/s^2, steering 0 rad\n"
        "  now:    acceleration 0.5 m/s^2, steering 0 rad\n"
    )
    assert len(tried) <= 2 + 5
    assert (git("status"), git("worktree", "list"), Path(".git/index").read_bytes()) == before


def test_untestable_commits_are_skipped_and_listed_if_suspect(commit, tried, capsys):
    first = commit(GOOD)
    commit(BROKEN)
    commit(GOOD)
    hidden = [commit(f"{BROKEN} # {number}") for number in range(3)]
    last = commit(BAD)
    commit(OTHER)
    commit(BAD, "The same again")
    assert bisect("--good", first) == 1
    told = capsys.readouterr().out
    assert "one of these 4 commits is the first that fails; all except the last have no verdict:\n" in told
    assert re.findall(r"^  ([0-9a-f]{40}) ", told, re.MULTILINE) == [*hidden, last]
    assert len(tried) == len(set(tried)), "the same policy is tried once"


def test_merge_is_searched_and_blamed_if_parents_pass(commit, tried, capsys):
    first = commit(GOOD)
    git("checkout", "-qb", "side")
    commit(f"{GOOD} # side")
    guilty = commit(f"{BAD} # side")
    commit(f"{BAD} # side, more")
    git("checkout", "-q", "main")
    Path("notes").write_text("of main")
    git("add", "notes")
    git("commit", "-qm", "Take notes")
    git("merge", "-q", "--no-edit", "side")
    commit(f"{BAD} # after")
    assert bisect("--good", first) == 0
    assert f"\n{guilty} is the first that fails" in capsys.readouterr().out
    assert bisect("--good", guilty, "--bad", "main") == 2
    assert "expected --good to pass, received: fails: as it says; give another --good" in capsys.readouterr().err

    git("checkout", "-qB", "side", first)
    commit(f"{GOOD} # other side")
    git("checkout", "-qB", "main", first)
    commit(f"{GOOD} # own")
    git("merge", "-q", "-s", "ours", "--no-commit", "side")
    merge = commit(f"{BAD} # merged")
    assert bisect("--good", first) == 0
    assert f"\n{merge} is the first that fails" in capsys.readouterr().out


def test_good_commit_on_another_branch_proves_nothing(commit, tried, capsys):
    commit(BAD)
    git("checkout", "-qb", "side")
    good = commit(GOOD)
    git("checkout", "-q", "main")
    commit(f"{BAD} # own")
    git("merge", "-q", "-s", "ours", "--no-edit", "side")
    assert bisect("--good", good) == 2
    assert "expected the commit before these to pass, received: fails" in capsys.readouterr().err


def test_pass_outside_the_situation_counts_only_on_request(commit, tried, capsys):
    first = commit(OTHER)
    last = commit(BAD)
    assert bisect("--good", first) == 2
    assert "received: no verdict: as it says; give another --good, or --any-pass" in capsys.readouterr().err
    assert bisect("--good", first, "--any-pass") == 0
    assert f"\n{last} is the first that fails" in capsys.readouterr().out


def test_uncommitted_changes_are_reported_and_not_tried(commit, tried, capsys):
    first = commit(GOOD)
    commit(f"{GOOD} # more")
    Path("planner.py").write_text(BAD)
    assert bisect("--good", first) == 2
    told = capsys.readouterr()
    assert "not committed, so not tried: planner.py\n" in told.out
    assert "expected --bad to fail as the file says, received: passes: as it says; commit your" in told.err
    assert tried == [f"{GOOD} # more"]
    assert Path("planner.py").read_text() == BAD


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--good", "nothing"], "bisect: expected a commit, a branch or a tag, received 'nothing'"),
        (["--good", "HEAD", "--bad", "HEAD~1"], "bisect: expected a --good that is an ancestor of --bad, received"),
        (["--good", "HEAD"], "bisect: --policy: expected paths that change from"),
        (["--good", "HEAD~1", "--policy", "planner.py", "absent"], "bisect: --policy: expected paths in"),
        (["--good", "HEAD~1", "--policy", "/etc"], "bisect: --policy: expected a path inside the repository"),
        (
            ["--good", "HEAD~1", "--policy", "."],
            "bisect: --policy: expected only paths of the policy, received paths that contain",
        ),
        (
            ["--good", "HEAD~1", "--world", "a:b"],
            "bisect: --world: expected a module that can be imported, rec",
        ),
        (["--good", "HEAD~1", "--copy", "absent"], "bisect: --copy: expected files and folders, received absent"),
        (["--good", "HEAD~1"], "bisect: expected --bad to fail as the file says, received: no verdict: as it says"),
    ],
)
def test_wrong_arguments_are_told_before_anything_is_tried(commit, tried, capsys, arguments, told):
    commit(GOOD)
    commit(OTHER)
    assert bisect(*arguments) == 2
    assert capsys.readouterr().err.startswith(told)
    assert tried == ([OTHER] if "no verdict" in told else [])


@pytest.mark.parametrize("seconds", ["0", "-1", "soon"])
def test_a_time_in_which_nothing_can_run_is_refused(commit, tried, capsys, seconds):
    with pytest.raises(SystemExit, match="2"):
        bisect("--good", "HEAD", "--timeout", seconds)
    assert "argument --timeout: expected seconds" in capsys.readouterr().err


def test_runs_that_cannot_be_compared_are_told(commit):
    one, none = {"decisions": [1], "speeds": [9.0], "ticks": [0], "hz": 5, "why": "safe"}, {"why": "no module\x1b"}
    assert parted(one, none) == "decisions cannot be compared: before, safe; now, no module\x1b"
    assert parted(one, {**one, "decisions": [1, 2]}) == "both decide the same as long as both drive"
    assert parted({**one, "decisions": ["0"]}, {**one, "decisions": ["1"]}).endswith(
        "at 9.0 m/s\n  before: 0\n  now:    1"
    )


@pytest.fixture
def told(monkeypatch, tmp_path):
    """Return a function that reads a session's message to the command."""
    monkeypatch.setenv(
        TOLD, json.dumps({"file": str(tmp_path / "told.json"), "world": None, "policy": [str(tmp_path / "elsewhere")]})
    )
    return lambda: json.loads((tmp_path / "told.json").read_text())


def replay(project, told):
    Path(json.loads(os.environ[TOLD])["file"]).unlink(missing_ok=True)
    project.run(project.only_file, generations=None, plugins=["pytest_pafot.extras.revisions.bisect_session"])
    return told()


@pytest.fixture
def safety(project):
    """Return a project with the finding, whose planner has the headway that a test writes."""
    (project.path / FILE).parent.mkdir(parents=True)
    (project.path / FILE).write_text(FINDING)
    project.write(TEST, "test_safety")
    return project


TEST = """
from planner import Planner

@pafot.search(ads=Planner, blame="ego")
def test_never_at_fault(run):
    assert not run.collision, run.explain()
"""
PLANNER = """\
class Planner:
    headway = 0.6  # [s]

    def __call__(self, observation):
        ego = observation.ego
        gaps = [other.x - ego.x - other.length for other in observation.others if other.lane == ego.lane]
        if any(0 < gap < 2.0 + self.headway * ego.speed for gap in gaps):
            return -6.0, 0.0
        return min(22.0 - ego.speed, 1.0), 0.0
"""


@pytest.mark.parametrize(
    ("old", "new", "passes", "why"),
    [
        ("", "", False, "collision after 15.3 s, closing at"),
        ("0.6", "1.2", True, "safe for 20.0 s"),
        ("min(22.0", "min(5.0", None, "the situation did not come up: NPC 1 was 20 m ahead"),
        ("class", "import nonsense\nclass", None, "ModuleNotFoundError: No module named 'nonsense'"),
        ("class", "class class", None, "SyntaxError"),
        ("        ego =", "        raise OSError('\x1b')\n        ego =", None, "error of the set-up: OSError: "),
        (
            "        ego =",
            "        if observation.time > 1:\n            raise OSError('\x1b')\n        ego =",
            None,
            "another failure: ",
        ),
    ],
)
def test_session_reports_whether_the_saved_failure_occurs(safety, told, old, new, passes, why):
    (safety.path / "planner.py").write_text(PLANNER.replace(old, new))
    found = replay(safety, told)
    assert found["passes"] is passes
    assert why in found["why"]
    assert "\x1b" not in found["why"]
    assert found.get("is_other", False) is ("situation" in why)
    if passes is not None:
        assert found["decisions"][0] == [0.0, 0.0]
        assert found["speeds"][0] == 22.0
        assert (found["ticks"][:3], found["hz"]) == ([0, 3, 6], 15)


def test_policy_imported_from_elsewhere_gives_no_verdict(safety, told, monkeypatch, tmp_path):
    (tmp_path / "elsewhere").mkdir(exist_ok=True)
    (tmp_path / "elsewhere/planner.py").write_text(PLANNER)
    monkeypatch.syspath_prepend(tmp_path / "elsewhere")
    found = replay(safety, told)
    assert found["passes"] is None
    assert found["why"].startswith("the policy was imported from ")


@pytest.fixture
def real(commit, monkeypatch):
    """Return `commit` for a repository with the test, without the settings of the outer session."""
    Path("test_safety.py").write_text("import pytest_pafot as pafot\n" + TEST)
    for name in ("PYTEST_ADDOPTS", "PYTHONPATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(subprocess, "Popen", Copy)
    return commit


def test_slow_session_is_ended_without_a_verdict(real, capfd):
    first = real(PLANNER)
    real(f"import time\ntime.sleep(100)\n{PLANNER}")
    assert bisect("--good", first, "--timeout", "0.5") == 2
    assert "received: no verdict: it did not end within 0.5 s; " in capfd.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="threads have no signals there")
def test_a_session_has_ended_when_an_interrupt_goes_on(tmp_path):
    main_thread = threading.main_thread().ident
    interrupt = threading.Timer(0.1, signal.pthread_kill, [main_thread, signal.SIGINT])
    command = [sys.executable, "-c", "import time; time.sleep(100)"]
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore SIGINT
    try:
        with suppress(KeyboardInterrupt), _group(command, tmp_path, dict(os.environ)) as session:
            interrupt.start()
            session.communicate(timeout=60)
    finally:
        signal.signal(signal.SIGINT, before)
    assert session.returncode == -signal.SIGKILL


@pytest.mark.processes
def test_guide_shows_the_real_output_of_bisect(real, capfd):
    now = '"""Keeps its distance."""\n\n' + PLANNER
    before = now.replace("0.6", "0.9")
    real(PLANNER.replace("0.6", "0.9"), "Follow the leader")
    git("tag", "v1.0")
    real(before, "Tell what it does")
    real(f"import nets\n{before}", "Begin with nets")
    real(f"{before}\n# without nets\n", "Leave nets out again")
    real(f"{now}\n# without nets\n", "Keep less distance, as people complain")
    real(f"{now}\n# without nets\n".replace("22.0 -", "22.5 -"), "Go a little faster")
    code = bisect("--good", "v1.0")
    command = r"\$ python -m pytest_pafot bisect \S+ --good v1.0 --policy planner.py"
    (sample,) = re.findall(rf"^{command}\n(.*?)^```$", GUIDE.read_text(), re.DOTALL | re.MULTILINE)
    shown = ".*".join(map(re.escape, sample.split("...\n")))  # as in other samples, "..." stands for anything
    assert code == 0
    assert re.fullmatch(shown, capfd.readouterr().out, re.DOTALL)


ROAD = """\
import pytest_pafot as pafot


class Road:
    speed_limit, longest_run, rollout = 26.8, 60.0, staticmethod(pafot.Highway().rollout)

    def to_dict(self):
        return {}
"""


@pytest.mark.processes
def test_world_of_the_command_is_that_of_the_replays(real, capfd):
    world = re.search(r"world:.*?\n(?=scenario)", FINDING, re.DOTALL)[0]
    Path(FILE).write_text(FINDING.replace(world, "world: {kind: own, class: Road, data: {}}\n"))
    Path("roads.py").write_text(ROAD)
    git("add", ".")
    first, last = real(PLANNER.replace("0.6", "0.9")), real(PLANNER)
    assert bisect("--good", first) == 2
    assert "received: no verdict: " in capfd.readouterr().err
    assert bisect("--good", first, "--world", "roads:Road") == 0
    assert f"{last} is the first that fails" in capfd.readouterr().out


@pytest.mark.processes
def test_interrupt_leaves_no_processes_or_folders_behind(real, tmp_path, monkeypatch):
    first = real(PLANNER.replace("0.6", "0.9"))
    pid = tmp_path / "pid"
    real(
        f"import os, pathlib, time\npathlib.Path({str(pid)!r}).write_text(str(os.getpid()))\ntime.sleep(100)\n{PLANNER}"
    )
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    before = git("status"), git("worktree", "list"), git("for-each-ref"), Path(".git/index").read_bytes()
    command = [sys.executable, "-m", "pytest_pafot", "bisect", FILE, "--good", first, "--policy", "planner.py"]
    for end, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)):
        pid.unlink(missing_ok=True)
        with begun(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            wait_for(lambda: pid.exists() and pid.read_text())
            process.send_signal(end)
            process.communicate(timeout=60)
        assert process.returncode == code
        assert not list((tmp_path / "temporary").iterdir())
        assert (git("status"), git("worktree", "list"), git("for-each-ref"), Path(".git/index").read_bytes()) == before
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid.read_text()), 0)


@pytest.mark.processes
@pytest.mark.skipif(os.name == "nt", reason="a session has no group of its own there")
def test_killed_bisect_takes_its_session_along(real, tmp_path, monkeypatch, capsys):
    pid = tmp_path / "pid"
    first = real(PLANNER)
    real(
        f"import os, pathlib, time\npathlib.Path({str(pid)!r}).write_text(str(os.getpid()))\ntime.sleep(100)\n{PLANNER}"
    )
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    command = [sys.executable, "-m", "pytest_pafot", "bisect", FILE, "--good", first, "--policy", "planner.py"]
    monkeypatch.setenv(DRIVES, str(os.getpid()))  # the process that drives, which would clean up if its parent died
    with begun(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
        wait_for(lambda: pid.exists() and pid.read_text())
        process.kill()
    monkeypatch.delenv(DRIVES)
    wait_for(lambda: not Path(f"/proc/{pid.read_text()}/cmdline").exists())
    assert git("worktree", "list").count("\n") == 1
    assert bisect("--good", "HEAD~1", "--timeout", "0.1") == 2
    assert git("worktree", "list").count("\n") == 0
    assert not list((tmp_path / "temporary").iterdir())


def wait_for(condition):
    until = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_bisect_names_the_failure_after_the_end(saved, monkeypatch):
    told = saved.path / "told.json"
    monkeypatch.setenv(TOLD, json.dumps({"file": str(told), "world": None, "policy": []}))
    replayed(saved, "slow", plugins=["pytest_pafot.extras.revisions.bisect_session"])
    assert json.loads(told.read_text())["why"] == (
        "collision after 6.5 s, closing at 7.6 m/s: NPC 0 ahead, ego at fault; driven on past the file's end"
    )


def test_an_error_of_a_teardown_changes_no_verdict(saved, monkeypatch):
    told = saved.path / "told.json"
    monkeypatch.setenv(TOLD, json.dumps({"file": str(told), "world": None, "policy": []}))
    full = "@pytest.fixture(autouse=True)\ndef log():\n    yield\n    raise OSError('no space left')\n"
    replayed(saved, "slow", before=full, plugins=["pytest_pafot.extras.revisions.bisect_session"])
    assert json.loads(told.read_text())["passes"] is False
