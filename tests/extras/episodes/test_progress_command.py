"""The command `python -m pytest_pafot progress`: from two versions of a policy to its outputs and exit code."""

import json
import os
import re
import subprocess

import pytest

import pytest_pafot as pafot
from pytest_pafot.__main__ import main
from tests.helpers.sessions import Copy, command_in_a_copy

POLICY = """\
import os

import pytest_pafot as pafot


class Blind:
    def __call__(self, observation):
        return 0.0, 0.0


class Careful:
    def __call__(self, observation):
        ego = observation.ego
        gaps = [other.x - ego.x - other.length for other in observation.others if abs(other.y - ego.y) < 3.0]
        near = any(0 < gap < 2.0 + 2.0 * ego.speed for gap in gaps)
        return (-6.0 if near else min(20.0 - ego.speed, 1.0)), 0.0


class SameCareful(Careful):
    pass


class Broken:
    def __call__(self, observation):
        return observation.egos


class Ends:
    def __call__(self, observation):
        os._exit(0)


class Unmade:
    def __init__(self):
        raise OSError("no weights")


def keeps_speed(run):
    assert not run.collision
    pafot.check(run.ego.speed, name="speed", at_most=40.0)


def misspelt(run):
    run.colision


class Road:
    speed_limit, longest_run = 20.0, 10.0
    rollout = staticmethod(pafot.Highway(duration=10.0).rollout)

    def to_dict(self):
        return {}


def planned():
    return pafot.World("highway-fast-v0", config={"duration": 4}, planner_hz=5)
"""
SHORT = ["--scenarios", "6", "--workers", "1"]


def slow(run):
    pafot.check(run.ego.speed, name="speed", at_most=5.0)


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """Let lines be long, so that tests can compare them."""
    monkeypatch.setenv("COLUMNS", "999")


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "versions.py").write_text(POLICY)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def progress(old, new, *more):
    named = (name if name.startswith("rev:") else f"versions:{name}" for name in (old, new))
    return main(["progress", *named, *SHORT, *more])


@pytest.fixture
def repository(here, monkeypatch):
    """Return the folder as a repository, in whose commit each policy drives with a limit of 20 m/s."""
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    monkeypatch.setattr(subprocess, "Popen", Copy)
    (here / "limits.py").write_text("LIMIT = 20.0\n")
    text = POLICY.replace("import pytest_pafot as pafot", "import pytest_pafot as pafot\nfrom limits import LIMIT")
    (here / "versions.py").write_text(text.replace("20.0 - ego", "LIMIT - ego"))
    (here / ".gitignore").write_text("__pycache__/\n*.npz\n")
    git(here, "init", "-q", "-b", "main")
    git(here, "add", "-A")
    git(here, "-c", "user.name=Ann", "-c", "user.email=a@b.c", "commit", "-qm", "Begin")
    yield here
    assert len(git(here, "worktree", "list").splitlines()) == 1


def git(folder, *arguments):
    return subprocess.run(["git", *arguments], cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.mark.processes
@pytest.mark.usefixtures("copies")
def test_old_policy_may_come_from_a_revision(repository, capsys):
    (repository / "limits.py").write_text("LIMIT = 40.0\n")
    assert progress("rev:main", "Careful", "--json", "one.json", "--workers", "2") == 0
    out, commit = capsys.readouterr().out, git(repository, "rev-parse", "main").strip()
    said = json.loads((repository / "one.json").read_text())
    assert (said["old"], said["old_commit"]) == ("rev:main", commit)
    both = f"rev:main ({commit[:7]}) and now ({commit[:7]} and changes)"
    assert f"\n- {both}: 1 of 2 files of the policy differ: limits.py\n" in out
    (repository / "before.py").write_text((repository / "versions.py").read_text().replace("limits", "before_limits"))
    (repository / "before_limits.py").write_text("LIMIT = 20.0\n")
    main(["progress", "before:Careful", "versions:Careful", *SHORT, "--json", "two.json"])
    assert json.loads((repository / "two.json").read_text())["rows"] == said["rows"]


@pytest.mark.parametrize(("world", "parts"), [("Road", {"scenarios"}), ("planned", {"scenarios", "episodes"})])
def test_versions_are_compared_in_the_world_of_a_factory(here, capsys, world, parts):
    more = ("--world", f"versions:{world}", "--json", "p.json", *(("--episodes", "2") if len(parts) == 2 else ()))
    assert progress("Blind", "Careful", *more) == 0
    rows = json.loads((here / "p.json").read_text())["rows"]
    assert ({row["part"] for row in rows} - {"alone"}, {row["told"] for row in rows if row["part"] == "episodes"}) == (
        parts,
        {""} if len(parts) == 2 else set(),
    )


@pytest.mark.processes
def test_ordinary_traffic_is_also_driven_in_the_revision(repository, capsys):
    (repository / "limits.py").write_text("LIMIT = 40.0\n")
    more = ("--world", "highway-fast-v0", "--episodes", "2", "--json", "p.json")
    assert progress("rev:main", "Careful@planner", *more) == 0
    rows = json.loads((repository / "p.json").read_text())["rows"]
    assert [row["told"] for row in rows if row["part"] == "episodes"] == ["", ""]


@pytest.mark.processes
def test_policy_of_the_revision_itself_is_not_compared(repository, capsys):
    (repository / "README.md").write_text("New.")
    assert progress("rev:main", "Careful", "--json", "p.json", "--fail-on", "not-better") == 0
    commit = git(repository, "rev-parse", "main")[:7]
    assert capsys.readouterr().out.startswith(f"the policy is that of rev:main ({commit}): nothing to compare\n")
    assert json.loads((repository / "p.json").read_text())["rows"] == []


@pytest.mark.processes
@pytest.mark.parametrize(
    ("change", "new", "told"),
    [
        (
            "class Newer(Careful):\n    pass\n",
            "Newer",
            "OLD: expected a revision with versions:Newer, received rev:main (",
        ),
        ("", "Unmade", "rev:main (*): expected a policy that drives, received OSError: no weights"),
    ],
)
def test_revision_without_a_driving_policy_is_refused(repository, capsys, change, new, told):
    (repository / "versions.py").write_text((repository / "versions.py").read_text() + change)
    assert progress("rev:main", new) == 2
    assert re.sub(r"\(\w{7}\)", "(*)", capsys.readouterr().err).count(told) == 1


def test_policy_is_not_compared_with_itself(here, capsys):
    (here / "before.py").write_text("from versions import Careful\n")
    assert main(["progress", "before:Careful", "versions:Careful", *SHORT]) == 2
    assert "OLD: expected a policy that differs from the tested one" in capsys.readouterr().err


@pytest.mark.processes
def test_progress_reports_better_version_and_exits_by_option(here, capsys):
    many = ("--scenarios", "20")
    assert progress("Careful", "Blind", *many, "--fail-on", "worse", "--json", "p.json") == 1
    out = capsys.readouterr().out
    said = json.loads((here / "p.json").read_text())
    assert said["verdict"] == said["lines"][0]["verdict"] == "worse"
    assert out.startswith(f"{said['sentence']}.\n\n")
    assert len([row for row in said["rows"] if row["part"] == "scenarios"]) == 20
    _, line, *_ = (" ".join(part.split()) for part in out.split("\n\n"))
    assert line.startswith("failures of its own: old 0, new 14; new better in 0, worse in 14 of 19; ")
    assert progress("Blind", "Careful", *many, "--fail-on", "not-better") == 0
    better = capsys.readouterr().out
    assert better.startswith("versions:Careful is better than versions:Blind: fewer failures of its own: ")


@pytest.mark.processes
def test_printed_command_saves_the_new_failures(here, capsys):
    progress("Careful", "Blind", "--json", "p.json")
    rows = json.loads((here / "p.json").read_text())["rows"]
    (command,) = re.findall(r"save and see it: `python -m (.*)`", capsys.readouterr().out)
    command_in_a_copy(*command.split(), "--", "--pafot-shrink-rollouts=0", "--pafot-neighbours=0")
    saved = sorted(path.name.removesuffix(".pafot.yaml") for path in here.rglob("*.pafot.yaml"))
    assert saved == sorted(row["name"] for row in rows if row["part"] == "alone" and row["new"]["failed"])
    progress("Blind", "Careful", "--scenarios", "1")
    labels = re.search(r"^- (\d+) saved scenarios?: (.*)$", capsys.readouterr().out, re.MULTILINE)
    assert labels
    assert int(labels[1]) == len(saved)
    assert re.fullmatch(r"(\d+ (fixed \(only the old fails\)|drifted)(, )?)+", labels[2])


@pytest.mark.processes
def test_same_policy_under_other_name_claims_no_difference(here, capsys):
    assert progress("Careful", "SameCareful", "--fail-on", "worse") == 0
    assert "versions:SameCareful is not told apart from versions:Careful: failures of" in capsys.readouterr().out
    assert progress("Careful", "SameCareful", "--fail-on", "not-better") == 1


def test_scenario_saved_for_check_uses_that_check_only(here, capsys):
    import versions

    pafot.explore(versions.Blind, holds=slow, runs=2, seed=1, shrink_rollouts=0, corpus="pafot_corpus")
    assert len(list(here.rglob("*.pafot.yaml"))) == 1
    few = ["--scenarios", "2"]
    assert progress("Careful", "SameCareful", *few) == 0
    assert "- 1 saved scenario: 1 of another check\n" in capsys.readouterr().out
    assert progress("Careful", "SameCareful", *few, "--check", "versions:keeps_speed", "--corpus", "pafot_corpus") == 0
    out = capsys.readouterr().out
    assert "margins of speed (" in out
    assert "of another check" not in out


def test_named_environment_adds_ordinary_traffic(here, capsys):
    config = '{"vehicles_count": 8, "duration": 12}'
    given = [
        "--world",
        "highway-fast-v0",
        "--config",
        config,
        "--episodes",
        "4",
        "--scenarios",
        "2",
        "--json",
        "p.json",
    ]
    assert main(["progress", "versions:Careful@planner", "versions:Blind@planner", *SHORT, *given]) == 0
    out, told = capsys.readouterr()
    (line,) = re.findall(r"^crashes in ordinary traffic: .*", out, re.MULTILINE)
    assert re.search(r": old \d, new \d; new better in \d, worse in \d of 4; ", line)
    assert "save and see it" not in out  # The command search has no --config.
    assert "progress: 16 of 16 runs" in told
    said = json.loads((here / "p.json").read_text())
    assert (said["world"], said["config"]) == ("highway-fast-v0", json.loads(config))
    assert main(["progress", "versions:Careful", "idm_mobil", *SHORT, *given]) == 2
    assert "OLD: expected a policy that drives, received AttributeError: 'numpy.nd" in capsys.readouterr().err


@pytest.mark.processes
def test_same_seed_agrees_for_any_worker_count(here, capsys):
    progress("Careful", "Blind", "--scenarios", "3", "--json", "one.json")
    progress("Careful", "Blind", "--scenarios", "3", "--json", "two.json", "--workers", "2")
    assert len(json.loads((here / "one.json").read_text())["rows"]) > 3
    assert (here / "one.json").read_bytes() == (here / "two.json").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["Blind"], "NEW: expected another version than OLD, received 'versions:Blind' again"),
        (["Blind", "--scenarios", "0"], "--scenarios: expected a whole number, at least 1, received 0"),
        (["Careful", "--episodes", "9"], "--episodes: expected an environment, received none; give --world"),
        (
            ["Blind", "--world", "highway-fast-v0", "--episodes", "-1"],
            "--episodes: expected a whole number, at least 0, received -1",
        ),
        (["Blind", "--seed", "-1"], "--seed: expected a whole number, at least 0, received -1"),
        (["Careful", "--workers", "0"], "--workers: expected a whole number, at least 1, received 0"),
        (["Careful", "--config", "{}"], "--config: expected an environment, received none; give --world"),
        (["Careful@planner"], "NEW: expected @planner after both names or none"),
        (
            ["Careful", "--world", "versions:Road", "--episodes", "9"],
            "whose traffic a search arranges; leave --episodes out\n",
        ),
        (["Careful", "--world", "versions:Rod"], "received 'versions:Rod'; did you mean 'versions:Road'?"),
        (["Careful", "--world", "highway-v7"], "expected a registered environment, received 'highway-v7'"),
        (["rev:main"], "NEW: expected the present policy, received 'rev:main'; check it out"),
        (["Nobody"], "NEW: expected a factory in the module versions, received 'versions:Nobody'; it has "),
        (["Unmade"], "NEW: expected a factory of a policy, received one that raises OSError: no weights ("),
        (
            ["Careful", "--check", "versions"],
            "--check: expected the name module:function of a function of a run, received",
        ),
        (["Broken"], "NEW: expected a policy that drives, received AttributeError: "),
        (
            ["Ends", "--fail-on", "worse"],
            "NEW: expected a policy that drives, received one whose process ended with exit code 0",
        ),
        (
            ["Careful", "--check", "versions:misspelt"],
            "--check: expected a function of a run that asserts, received At",
        ),
        (["Careful", "--corpus", "absent"], "--corpus: expected a folder, received absent; give one that exists"),
        (["Careful", "--json", "absent/p.json"], "expected a file in a folder that exists, received absent/p.json"),
    ],
)
def test_impossible_comparison_is_reported_before_any_run(here, capsys, arguments, told):
    assert progress("Blind", *arguments) == 2
    out, error = capsys.readouterr()
    assert (out, error.partition(": ")[0]) == ("", "progress")
    assert told in error
    assert not re.search(r"\d runs, \d+ %", error)
