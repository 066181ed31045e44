"""``ci/pafot.sh`` works when the action's commands run it in a shell."""

import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.actions import SCRIPT, copies, environment, git, inputs_of, run_action, shell
from tests.helpers.processes import begun
from tests.helpers.sessions import read_record

pytestmark = pytest.mark.processes

PLANNER = '''
class Planner:
    """Drives at 22 m/s, and brakes if a vehicle ahead in the same lane is too close."""

    headway = 2.0  # [s]

    def __call__(self, observation):
        ego = observation.ego
        gaps = [other.x - ego.x - other.length for other in observation.others if other.lane == ego.lane]
        if any(0 < gap < 2.0 + self.headway * ego.speed for gap in gaps):
            return -6.0, 0.0
        return min(22.0 - ego.speed, 1.0), 0.0
'''
TEST = """
import pytest_pafot as pafot
from planner import Planner


@pafot.search(ads=Planner, blame="ego", npcs=2)
def test_never_at_fault(run):
    assert not run.collision, run.explain()
"""
FAILS = """
import pytest_pafot as pafot


@pafot.search(ads=lambda: lambda observation: (0.0, 0.0), genes=2, gene_seconds=5, npcs=2, ego_lane=1, ego_speed=22)
def test_fails(run):
    slow = run.scenario.npcs[0][0].speed < 15
    assert not slow or run.duration < 1
    assert run.outcome == "nothing"
"""
QUICK = "--pafot-shrink-runs=0"
"""The option for searches whose findings need not be shrunk."""

FAKE = """#!/bin/sh
[ "$1" != -I ] || exec "$PYTHON" -S "$@"
echo "$@" >>"$CALLS"
[ "$1" != -c ] || exit "${IMPORTS:-0}"
if [ -n "${FINDS_NOW:-}" ]; then
  mkdir -p pafot_corpus/test_it/test_x
  echo "$FINDS_NOW" >"pafot_corpus/test_it/test_x/$FINDS_NOW.pafot.yaml"
fi
[ -z "${MEANWHILE:-}" ] || sh -c "$MEANWHILE" || exit
echo "{\\"exit\\": ${JSON:-${CODE:-0}}}" >pafot.json
[ "${JSON:-}" != none ] || rm pafot.json
exit "${CODE:-0}"
"""
"""A fake Python that records its calls, returns the requested results, and runs the command in ``MEANWHILE``.

The script's own Python code needs no installed packages. Without these, Python starts in a third of the time.
"""


@pytest.fixture
def copied():
    """Return environment variables that make sessions run in copies of this process."""
    with copies() as variables:
        yield variables


@pytest.fixture(scope="session")
def begun_repository(tmp_path_factory):
    """Return a folder that contains a repository and a clone of it with one commit."""
    folder = tmp_path_factory.mktemp("repository")
    git(folder, "init", "-q", "--bare", "--template=", "-b", "main", "origin.git")
    git(folder, "init", "-q", "--template=", "-b", "main", "clone")
    git(folder / "clone", "remote", "add", "origin", "../origin.git")
    # otherwise git checks after each command whether to clean up
    for name in ("clone", "origin.git"):
        git(folder / name, "config", "maintenance.auto", "false")
        git(folder / name, "config", "receive.autogc", "false")
    commit(folder / "clone", {".gitignore": "__pycache__/\npafot.json\n"}, "begin")
    git(folder / "clone", "push", "-q", "origin", "main")
    return folder


@pytest.fixture
def repository(begun_repository, tmp_path):
    """Return the folder of a clone with one commit, next to the original repository."""
    # creating a repository takes twenty git processes
    shutil.copytree(begun_repository, tmp_path, dirs_exist_ok=True)
    return tmp_path / "clone"


def commit(folder, files, message):
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", message)


def record_of(folder):
    return read_record((folder / "pafot.json").read_text(encoding="utf-8"))


def saved(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.pafot.yaml"))


@pytest.mark.parametrize(("changes", "expected"), [
    ({"base": ""}, "expected the commit before the change as BASE, received none. Set BASE"),
    ({"base": "0123456"}, "expected a commit in this repository as BASE, received 0123456. Correct BASE, or fetch"),
    ({"base": "HEAD^{tree}"}, "expected a commit as BASE, received HEAD^{tree}, which is a tree. Name a commit"),
    ({"base": "--output=planner.py"}, "expected a commit in this repository as BASE, received --output=planner.py."),
])  # fmt: skip
def test_incomparable_pull_request_is_refused_with_advice(repository, changes, expected):
    commit(repository, {"planner.py": PLANNER}, "A planner")
    code, printed = run_action({"task": "pull-request", "base": "main"} | changes, repository)
    assert (code, expected in printed) == (2, True), printed


def test_a_night_keeps_its_finds_and_the_next_one_knows_them(repository, copied, tmp_path):
    commit(repository, {"test_it.py": FAILS}, "A test")
    git(repository, "push", "-q", "origin", "main")
    git(tmp_path, "clone", "-q", "origin.git", "next")
    inputs = inputs_of("night", "night") | {
        "runs": "4",
        "seed": "1",
        "requirements": "",
        "options": f"{QUICK} -q",
    }
    found = []
    for folder in (repository, tmp_path / "next"):
        code, printed = run_action(inputs, folder, **copied)
        assert code == 1, printed
        found.append(
            [finding.file for finding in record_of(folder).findings if finding.status == "new"]
        )
    assert found[0]
    assert not found[1]
    git(repository, "fetch", "-q", "origin", "pafot-finds")
    assert git(repository, "diff", "--name-only", "main", "FETCH_HEAD").splitlines() == sorted(
        found[0]
    )


@pytest.fixture
def fake(tmp_path):
    """Return environment variables with which the script uses the fake Python."""
    folder = tmp_path / "bin"
    folder.mkdir()
    python = folder / "python"
    python.write_text(FAKE)
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    path = os.pathsep.join([str(folder), os.environ.get("PATH", os.defpath)])
    return {"PATH": path, "CALLS": str(tmp_path / "calls"), "PYTHON": sys.executable}


def calls(fake):
    told = Path(fake["CALLS"])
    return told.read_text(encoding="utf-8").splitlines() if told.exists() else []


SESSION = "-m pytest --pafot-json=pafot.json --pafot-report=pafot.html --junitxml=pafot.xml"


def test_empty_inputs_are_omitted_and_others_become_options(repository, fake):
    run_action({"task": "search"}, repository, **fake)
    run_action({"task": "search", "runs": "40", "seed": "3", "limit": "60"}, repository, **fake)
    run_action({"task": "replay"}, repository, **fake)
    assert [call for call in calls(fake) if call.startswith("-m")] == [
        SESSION,
        f"{SESSION} --pafot-runs=40 --pafot-seed=3 --pafot-max-time=60",
        f"{SESSION} --pafot-generations=0",
    ]


@pytest.mark.parametrize("code", [0, 1, 2, 5])
def test_the_exit_code_is_that_of_pytest(repository, fake, code):
    for task in ("replay", "search", "night"):
        ended, printed = shell(
            f"sh {SCRIPT} {task}", repository, BRANCH="finds", CODE=str(code), **fake
        )
        assert ended == code, printed


@pytest.mark.parametrize(("written", "received"), [
    ("none", "received no file"),
    ("null", "received null, which means that the session did not finish"),
    ("1", "received 1"),
    ("[", "received a file without an exit code"),
])  # fmt: skip
def test_session_passes_only_by_exit_code_in_json(repository, fake, written, received):
    (repository / "pafot.json").write_text('{"exit": 0}')  # a file from an earlier session
    code, printed = shell(
        f"sh {SCRIPT} night",
        repository,
        BRANCH="finds",
        FINDS_NOW="a",
        CODE="0",
        JSON=written,
        **fake,
    )
    assert (code, f"expected the exit code 0 in pafot.json, {received}. Does" in printed) == (
        2,
        True,
    ), printed
    assert "findings were pushed to finds" in printed


@pytest.mark.parametrize(
    "leave", ["of_c._exit(0)", "of_c.exit(0)", "atexit.register(of_c._exit, 0)"]
)
def test_bypassing_pytest_with_exit_code_0_fails(repository, leave):
    commit(
        repository,
        {
            "conftest.py": f"import atexit, ctypes; of_c = ctypes.CDLL(None); {leave}",
            "json.py": "exit = 0",
        },
        "A policy",
    )
    (repository / "test_it.py").write_text(
        "import pytest\n\n@pytest.mark.pafot\ndef test_it():\n    assert 0\n"
    )
    code, printed = shell(f"sh {SCRIPT} replay", repository)
    assert (code, "pytest exited with 0: expected the exit code 0 in pafot.json" in printed) == (
        2,
        True,
    ), printed


@pytest.mark.parametrize(
    ("shells", "name"), [("bash", "SIGINT"), ("sh", "SIGTERM"), ("bash", "SIGHUP")]
)
def test_signal_ends_pytest_and_then_the_script(repository, tmp_path, shells, name):
    begins = tmp_path / "begun"
    slow = TEST.replace("npcs=2", "npcs=2, runs=100000").replace(
        "    assert", f"    open({str(begins)!r}, 'w').close()\n    assert"
    )
    commit(repository, {"planner.py": PLANNER, "test_safety.py": slow}, "A planner")
    (tmp_path / "temporary").mkdir()
    own = environment(BRANCH="finds", TMPDIR=str(tmp_path / "temporary"))
    with begun(
        [shells, SCRIPT, "night"], cwd=repository, env=own, stdout=subprocess.PIPE, text=True
    ) as script:
        deadline = time.monotonic() + 60.0
        while not begins.exists() and script.poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        script.send_signal(getattr(signal, name))
        # This also waits for pytest, which uses the same output.
        rest, _ = script.communicate(timeout=60)
    assert script.returncode == 128 + getattr(signal, name), rest
    assert re.search(
        r" The search ended early, after \d+ of \d+ runs, because it was interrupted\.",
        " ".join(rest.split()),
    ), rest
    assert not [
        path for path in (tmp_path / "temporary").iterdir() if not path.name.startswith("pytest-")
    ]


@pytest.mark.parametrize("where", ["argument", "variable"])
def test_a_json_elsewhere_is_refused_because_the_script_reads_its_own(repository, fake, where):
    option = "--pafot-json=other.json"
    given, variables = (option, {}) if where == "argument" else ("", {"PYTEST_ADDOPTS": option})
    code, printed = shell(f"sh {SCRIPT} search {given}", repository, **variables, **fake)
    assert code == 2
    assert "expected no --pafot-json" in printed
    assert not [call for call in calls(fake) if "-m pytest" in call]


def test_unknown_task_error_lists_the_known_tasks(repository):
    code, printed = shell(f"sh {SCRIPT} nihgt", repository)
    assert code == 2
    assert "expected install, replay, search, pull-request or night, received 'nihgt'" in printed


def test_install_adds_requirements_and_package_if_missing(repository, fake):
    shell(f"sh {SCRIPT} install", repository, REQUIREMENTS="needs.txt", **fake)
    assert calls(fake) == ["-m pip install -r needs.txt", "-c import pytest_pafot"]
    code, _ = shell(f"sh {SCRIPT} install", repository, IMPORTS="1", **fake)
    assert (code, calls(fake)[2:]) == (
        0,
        ["-c import pytest_pafot", f"-m pip install {SCRIPT.parent}/.."],
    )


def test_action_copied_without_package_says_what_to_do(repository, fake, tmp_path):
    shutil.copytree(SCRIPT.parent, tmp_path / "copy" / "ci")
    code, printed = shell(
        f"sh {tmp_path}/copy/ci/pafot.sh install", repository, IMPORTS="1", **fake
    )
    told = "expected pytest-pafot to be installed, received no package of this name. List it in your requirements file."
    assert (code, told in printed) == (2, True), printed


FOLDER = "pafot_corpus/test_it/test_x"


class TestTheBranch:
    """The branch to which nightly jobs push their findings."""

    def night(self, folder, fake, *, finds="", code="1", options=""):
        inputs = inputs_of("night", "night") | {"requirements": "", "options": options}
        ended, printed = run_action(inputs, folder, **fake, FINDS_NOW=finds, CODE=code)
        assert ended == int(code), printed
        return printed

    def kept(self, folder):
        git(folder, "fetch", "-q", "origin", "+refs/heads/pafot-finds:refs/kept")
        names = git(folder, "diff", "--name-only", "main", "refs/kept").splitlines()
        return [name.rpartition("/")[2][0] for name in names]

    def test_a_night_takes_its_seed_from_the_date(self, repository, fake):
        self.night(repository, fake, code="0")
        call = re.sub(r"seed=20\d{6}", "seed=DAY", calls(fake)[-1])
        assert call == f"{SESSION} --pafot-runs=1000000 --pafot-seed=DAY --pafot-max-time=5400"

    def test_a_night_without_finds_makes_no_branch(self, repository, fake):
        assert "no findings to push" in self.night(repository, fake)
        assert git(repository, "ls-remote", "origin", "pafot-finds") == ""

    def test_findings_are_one_commit_without_touching_the_checkout(self, repository, fake):
        before = git(repository, "rev-parse", "HEAD")
        assert "findings were pushed to pafot-finds" in self.night(repository, fake, finds="a")
        assert self.kept(repository) == ["a"]
        assert git(repository, "rev-parse", "refs/kept^", "HEAD").splitlines() == [before, before]
        assert git(repository, "status", "--porcelain").splitlines() == ["?? pafot_corpus/"]

    def test_next_night_in_fresh_clone_adds_its_findings(self, repository, fake, tmp_path):
        self.night(repository, fake, finds="a")
        git(tmp_path, "clone", "-q", "origin.git", "next")
        self.night(tmp_path / "next", fake, finds="b")
        assert [name[-12] for name in saved(tmp_path / "next")] == ["a", "b"]
        assert self.kept(repository) == ["a", "b"]
        git(tmp_path, "clone", "-q", "origin.git", "third")
        assert "all findings are already on pafot-finds" in self.night(tmp_path / "third", fake)

    def test_findings_merged_and_removed_do_not_return(self, repository, fake, tmp_path):
        self.night(repository, fake, finds="a")
        self.kept(repository)
        shutil.rmtree(repository / "pafot_corpus")
        git(repository, "merge", "-q", "refs/kept")
        git(repository, "rm", "-q", "-r", "pafot_corpus")
        git(repository, "commit", "-q", "-m", "Not of interest")
        git(repository, "push", "-q", "origin", "main")
        git(tmp_path, "clone", "-q", "origin.git", "next")
        self.night(tmp_path / "next", fake, finds="b")
        assert self.kept(repository) == ["b"]

    def test_shallow_clone_knows_findings_of_an_old_branch(self, repository, fake, tmp_path):
        self.night(repository, fake, finds="a")
        shutil.rmtree(repository / "pafot_corpus")
        commit(repository, {"planner.py": PLANNER}, "A planner")
        git(repository, "push", "-q", "origin", "main")
        git(tmp_path, "clone", "-q", "--depth=1", f"file://{tmp_path}/origin.git", "shallow")
        self.night(tmp_path / "shallow", fake, finds="b")
        assert [name[-12] for name in saved(tmp_path / "shallow")] == ["a", "b"]
        assert self.kept(repository) == ["a", "b"]

    @pytest.mark.parametrize(
        ("meanwhile", "kept"),
        [
            (f"FINDS_NOW=c sh {SCRIPT} night", ["a", "b", "c"]),
            ("git push -q origin :pafot-finds", ["a", "b"]),
        ],
    )
    def test_findings_reach_a_branch_that_moved_meanwhile(
        self, repository, fake, tmp_path, meanwhile, kept
    ):
        self.night(repository, fake, finds="a")
        git(tmp_path, "clone", "-q", "origin.git", "next")
        other = f"cd {repository}; unset MEANWHILE; export CODE=0; {meanwhile}"
        assert "findings were pushed to pafot-finds" in self.night(
            tmp_path / "next", fake | {"MEANWHILE": other}, finds="b"
        )
        assert self.kept(repository) == kept

    def test_rejected_push_ends_job_and_locates_findings(self, repository, fake):
        hook = repository.parent / "origin.git" / "hooks" / "pre-receive"
        hook.parent.mkdir()
        hook.write_text("#!/bin/sh\nexit 1\n")
        hook.chmod(0o755)
        inputs = inputs_of("night", "night") | {"requirements": ""}
        code, printed = run_action(inputs, repository, **fake, FINDS_NOW="a", CODE="1")
        told = f"expected to push the findings in {repository} to pafot-finds, received an error twice. Allow"
        assert (code, told in printed) == (2, True), printed

    def on_branch(self, folder, name):
        git(folder, "fetch", "-q", "origin", "+refs/heads/pafot-finds:refs/kept")
        return git(folder, "show", f"refs/kept:{name}")

    def colleague(self, repository, branch, files, remove=()):
        """Push changes of files to a branch from a second clone."""
        other = repository.parent / "other"
        if not other.exists():
            git(repository.parent, "clone", "-q", "origin.git", "other")
        git(other, "fetch", "-q")
        git(other, "checkout", "-q", "-B", branch, f"origin/{branch}")
        for name in files:
            (other / name).parent.mkdir(parents=True, exist_ok=True)
        for name in remove:
            (other / name).unlink()
        commit(other, files, "By a colleague")
        git(other, "push", "-q", "origin", branch)

    def test_changes_by_colleagues_survive_a_night(self, repository, fake):
        self.colleague(repository, "main", {f"{FOLDER}/old.pafot.yaml": "old"})
        git(repository, "pull", "-q", "origin", "main")
        self.night(repository, fake, finds="a")
        triaged = {
            f"{FOLDER}/a.pafot.yaml": "a\nxfail: known",
            f"{FOLDER}/old.pafot.yaml": "old, triaged",
        }
        self.colleague(repository, "pafot-finds", {**triaged, "NOTES.md": "a note"})
        self.colleague(
            repository, "main", {"planner.py": "now", f"{FOLDER}/old.pafot.yaml": "old on main"}
        )
        theirs = git(repository.parent / "other", "rev-parse", "pafot-finds", "main").splitlines()
        git(repository, "pull", "-q", "origin", "main")
        (repository / "staged").write_text("")
        git(repository, "add", "staged")
        index = (repository / ".git" / "index").read_bytes()

        self.night(repository, fake, finds="b")
        assert (repository / ".git" / "index").read_bytes() == index
        for name, text in triaged.items():
            assert self.on_branch(repository, name) == (repository / name).read_text() == text
        assert git(repository, "rev-parse", "refs/kept^1", "refs/kept^2").splitlines() == theirs
        changed = git(repository, "diff", "--name-only", "main...refs/kept").splitlines()
        finds = [f"{FOLDER}/{name}.pafot.yaml" for name in ("a", "b", "old")]
        assert changed == ["NOTES.md", *finds]

    def test_finding_deleted_on_the_branch_does_not_return(self, repository, fake):
        self.night(repository, fake, finds="a")
        self.colleague(
            repository, "pafot-finds", {"NOTES.md": ""}, remove=[f"{FOLDER}/a.pafot.yaml"]
        )
        assert "all findings are already on pafot-finds" in self.night(repository, fake)
        self.night(repository, fake, finds="b")
        assert self.kept(repository) == ["N", "b"]

    def test_conflicting_changes_are_left_to_manual_merge(self, repository, fake):
        self.night(repository, fake, finds="a")
        self.colleague(repository, "pafot-finds", {"planner.py": "by a colleague"})
        self.colleague(repository, "main", {"planner.py": "on main"})
        git(repository, "pull", "-q", "origin", "main")
        printed = self.night(repository, fake, finds="b")
        assert "Merge HEAD manually, because both changed these files:\nplanner.py\n" in printed
        assert self.on_branch(repository, "planner.py") == "by a colleague"
        assert git(repository, "log", "-1", "--format=%p", "refs/kept").count(" ") == 0
        assert self.on_branch(repository, f"{FOLDER}/b.pafot.yaml") == "b"

    def test_uncommitted_text_of_finding_is_not_overwritten(self, repository, fake):
        self.night(repository, fake, finds="a")
        (repository / FOLDER / "a.pafot.yaml").write_text("mine")
        self.colleague(repository, "pafot-finds", {f"{FOLDER}/a.pafot.yaml": "theirs"})
        assert (
            "the files above keep your uncommitted changes, and pafot-finds keeps its own versions"
            in self.night(repository, fake)
        )
        assert (repository / FOLDER / "a.pafot.yaml").read_text() == "mine"
        assert self.on_branch(repository, f"{FOLDER}/a.pafot.yaml") == "theirs"

    def test_odd_names_and_a_folder_below_are_kept(self, repository, fake):
        folder = repository / "sub dir"
        folder.mkdir()
        odd = [f"{name}.pafot.yaml" for name in (" a", "-x", "a\nb", ":(glob)*", '"', "ä")]
        for name in odd:
            (folder / name).write_text("1")
        self.night(folder, fake)
        self.colleague(repository, "pafot-finds", {f"sub dir/{name}": "2" for name in odd})
        self.night(folder, fake)
        assert {(folder / name).read_text() for name in odd} == {"2"}

    def test_unsuitable_branch_is_refused_before_the_search(self, repository, fake):
        git(repository, "checkout", "-q", "-b", "here")
        before = git(repository, "ls-remote", "origin")
        for branch in (
            "main",
            "MAIN",
            "here",
            "HEAD",
            "-x",
            "refs/heads/x",
            "a b",
            "fin*",
            "@{-1}",
            "$(touch x)",
        ):
            code, printed = shell(
                f"sh {SCRIPT} night", repository, BRANCH=branch, FINDS_NOW="a", **fake
            )
            assert (code, f"received {branch}" in printed) == (2, True), printed
        assert (calls(fake), git(repository, "ls-remote", "origin")) == ([], before)

    def test_unreadable_remote_ends_job_before_the_search(self, repository, fake):
        shutil.move(repository.parent / "origin.git", repository.parent / "gone.git")
        inputs = inputs_of("night", "night") | {"requirements": ""}
        code, printed = run_action(inputs, repository, **fake)
        assert (code, "expected to read pafot-finds from the remote origin" in printed) == (
            2,
            True,
        ), printed
        assert not [call for call in calls(fake) if "-m pytest" in call]


def test_without_a_branch_finds_stay_where_they_are(repository, fake):
    code, printed = shell(f"sh {SCRIPT} night", repository, FINDS_NOW="a", CODE="1", **fake)
    assert (code, saved(repository)) == (1, ["pafot_corpus/test_it/test_x/a.pafot.yaml"])
    assert git(repository, "ls-remote", "origin").count("refs/heads") == 1
    assert "pafot-finds" not in printed
