"""A session against a revision: whose files make the reference, what is the same, and what cannot be compared."""

import json
import mmap
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from pytest_pafot.corpus.reader import load
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.extras.revisions.revision import PROCESS, _may_count
from pytest_pafot.extras.revisions.revision_policy import RevisionPolicy
from pytest_pafot.extras.revisions.revision_process import Served, real_paths
from tests.helpers.processes import begun
from tests.helpers.tables import table

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(sys.platform == "win32", reason="a revision needs Unix sockets"),
]

ADAPTER = """
from pkg.core import SPEED_UP


class Adapter:
    def __call__(self, observation):
        return SPEED_UP, 0.0
"""
TEST = """
from pkg.adapter import Adapter


@pafot.search(SHORT, ads=Adapter, stop_after=1)
def test_keeps_its_speed(run):
    assert run.ego.speed.max() < 22.5
"""
NOW = "SPEED_UP = 1.25\n"


@pytest.fixture
def repository(quick, monkeypatch, tmp_path_factory):
    """Return a project in git whose policy keeps its speed in main, and whose present core.py makes it speed up."""
    project = quick
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    monkeypatch.setenv("TMPDIR", str(tmp_path_factory.mktemp("copies")))
    monkeypatch.setattr(tempfile, "tempdir", None)
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "Ann")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "ann@example.org")
    (project.path / "conftest.py").unlink()
    write(project, {"pkg/__init__.py": "", "pkg/core.py": "SPEED_UP = 0.0\n", "pkg/adapter.py": ADAPTER})
    write(project, {".gitignore": "__pycache__/\n.pytest_cache/\n*.npz\nstdout\nstderr\nrunpytest-*\n"})
    project.write(TEST)
    git(project, "init", "-q", "-b", "main")
    commit(project)
    write(project, {"pkg/core.py": NOW})
    yield project
    assert not list(Path(os.environ["TMPDIR"]).glob("pafot-tree-*"))
    assert len(git(project, "worktree", "list").splitlines()) == 1


def git(project, *arguments):
    return subprocess.run(["git", *arguments], cwd=project.path, check=True, capture_output=True, text=True).stdout


def write(project, files):
    for name, text in files.items():
        (project.path / name).parent.mkdir(parents=True, exist_ok=True)
        (project.path / name).write_text(text)


def commit(project, **files):
    write(project, files)
    git(project, "add", "-A")
    git(project, "commit", "-qm", "Change")


def run(project, *args, revision="rev:main", fresh=False, **options):
    """Run a session against a revision; what `sitecustomize.py` does counts only in a fresh interpreter."""
    return project.run(f"--pafot-against={revision}", *args, fresh=fresh, apart=not fresh, **options)


def test_change_in_an_imported_module_is_a_regression(repository):
    result = run(repository, "--pafot-json=pafot.json")
    result.assert_outcomes(failed=2)
    name = f"rev:main ({git(repository, 'rev-parse', 'main')[:7]})"
    result.stdout.fnmatch_lines([f"against {name}: introduces 1 failure, fixes 0, 0 as before"])
    told = [line for line in result.outlines if "pkg/core.py" in line and "note: " in line]
    both = f"{name} and now ({name[-8:-1]} and changes)"
    assert [line.strip() for line in told] == [f"note: {both}: 1 of 4 files of the policy differ: pkg/core.py"]
    assert load(repository.only_file).expect.against == name
    assert json.loads((repository.path / "pafot.json").read_text())["findings"][0]["against"] == name
    write(repository, {"pkg/core.py": "SPEED_UP = 0.0  # again\n"})
    result = run(repository)
    result.assert_outcomes(passed=2)
    result.stdout.fnmatch_lines(["replayed 1 saved scenario: 1 fixed before"])


UNNAMED = {"train.py": "LATE = 1\n"}
OTHER_TEST = {"test_other.py": "def test_other():\n    pass\n"}


@table(
    ("name", "may_count"),
    [
        ("README.md", False),
        ("test_other.py", False),
        ("train.py", True),  # a policy may import a module by a computed name, and start any file as a program
        ("run-planner", True),
        ("map.png", True),  # native code may open it
        ("net.bin", True),
        ("pkg/late.py", True),
        ("conftest.py", True),
    ],
)
def test_only_documents_and_tests_are_no_part_of_a_policy(tmp_path, name, may_count):
    assert _may_count(tmp_path, name) is may_count


def test_real_paths_are_those_of_the_system(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "file.py").touch()
    (tmp_path / "folder").symlink_to("a/b")
    (tmp_path / "link.py").symlink_to("folder/../file.py")
    (tmp_path / "loop").symlink_to("loop")
    names = ["link.py", "./a/file.py", "folder/new.py", "folder/../file.py", "folder/.", "loop/x", "/", ""]
    names += [f"{tmp_path}/{name}" for name in names]
    assert [*map(str, real_paths(names))] == [os.path.realpath(name) for name in names]


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system does not say what is mapped")
def test_present_files_are_seen_when_they_are_imported_opened_or_mapped_later(tmp_path, monkeypatch):
    served = Served(None, SimpleNamespace(root=tmp_path, tree=tmp_path / "tree"), set())
    files = [tmp_path / name for name in ("a_late.py", "b.txt", "c.npz")]
    for file in files:
        file.write_text("0.0")
    assert served._present() == []
    module = ModuleType("a_late")
    module.__file__ = str(files[0])
    monkeypatch.setitem(sys.modules, "a_late", module)
    assert served._present() == [str(files[0])]
    served.opened.add(str(files[1]))
    assert served._present() == [*map(str, files[:2])]
    with files[2].open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ):
        assert served._present() == [*map(str, files)]
    assert served._present() == [*map(str, files)]


@pytest.mark.parametrize(("folder", "is_whole"), [("library", True), ("elsewhere", False)])
def test_a_link_out_of_the_standard_library_is_no_file_of_the_user(folder, is_whole, tmp_path, monkeypatch):
    for name in ("library", "elsewhere", "etc"):
        (tmp_path / name).mkdir()
    (tmp_path / "etc" / "sitecustomize.py").touch()
    link = tmp_path / folder / "sitecustomize.py"
    link.symlink_to("../etc/sitecustomize.py")
    module = ModuleType("sitecustomize")
    module.__file__ = str(link)
    monkeypatch.setattr("sysconfig.get_path", {"stdlib": str(tmp_path / "library")}.get)
    monkeypatch.setattr(sys, "modules", {"sitecustomize": module})
    assert Served(None, SimpleNamespace(root=tmp_path, tree=tmp_path / "tree"), set()).is_whole() is is_whole


@pytest.mark.parametrize(
    ("changes", "is_same"),
    [
        ({"README.md": "New."} | OTHER_TEST, True),
        (UNNAMED, False),
        ({"test_it.py": "# It may set the policy up.\n"}, False),
    ],
)
def test_same_policy_is_not_searched_unless_a_change_may_matter(
    repository, changes, is_same, monkeypatch, tmp_path_factory
):
    git(repository, "checkout", "-q", "pkg")
    text = (repository.path / "test_it.py").read_text()
    if "test_it.py" in changes:
        before, mark, after = text.partition("\n\n@pafot")
        changes = {"test_it.py": before + "\n" + changes["test_it.py"] + mark + after}
    write(repository, changes)
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path_factory.mktemp("job") / "summary.md"))
    result = run(repository)
    assert result.ret == 0
    summary = Path(os.environ["GITHUB_STEP_SUMMARY"]).read_text()
    assert ("No search ran." in summary, "nothing to compare" in summary) == (is_same, is_same)
    same = f"note: the policy is that of rev:main ({git(repository, 'rev-parse', 'main')[:7]}): nothing to compare"
    assert (same in [line.strip() for line in result.outlines]) is is_same
    assert result.parseoutcomes().get("skipped", 0) == is_same


def test_fixtures_parameters_and_classes_come_from_the_revision(repository):
    write(
        repository,
        {
            "conftest.py": "import pytest\nfrom pkg.adapter import Adapter\n\n"
            "@pytest.fixture(params=['a::b', '\u00fc'])\ndef ads(request):\n"
            "    yield Adapter\n    open(f'{request.config.rootpath.name}-torn', 'w').close()\n",
            "pkg/core.py": "SPEED_UP = 0.0\n",
        },
    )
    repository.write(
        "class TestIt:\n    @pafot.search(SHORT, stop_after=1)\n    def test_it(self, run):\n"
        "        assert run.ego.speed.max() < 22.5\n"
    )
    commit(repository)
    write(repository, {"pkg/core.py": NOW})
    result = run(repository)
    result.assert_outcomes(failed=4)
    result.stdout.fnmatch_lines(["against rev:main (*): introduces 2 failures, fixes 0, 0 as before"])


@pytest.mark.parametrize("name", ["test_it", "test_more"])
def test_new_test_drives_the_policy_of_the_revision(repository, name):
    repository.write(TEST.replace("test_keeps_its_speed", "test_new"), name=name)
    result = run(repository, f"{name}.py")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["against rev:main (*): introduces 1 failure, fixes 0, 0 as before"])


def test_every_failure_of_a_new_policy_counts(repository):
    write(repository, {"pkg/newer.py": "from pkg.adapter import Adapter\n\nclass Newer(Adapter):\n    pass\n"})
    repository.write(TEST.replace("pkg.adapter", "pkg.newer").replace("Adapter", "Newer"), name="test_new")
    result = run(repository, "test_new.py")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*note: the policy is new since rev:main (*): every failure counts"])
    write(repository, {".gitignore": "newer.py\n"})
    result = run(repository, "test_new.py", "--pafot-save=none")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*No module named 'pkg.newer' (*); files that git ignores or *need --pafot-copy*"])


WEIGHTS = """
from pathlib import Path

SPEED_UP = float((Path(__file__).parent / "net.npz").read_text())
"""


def test_ignored_weights_are_copied_by_the_option(repository):
    commit(repository, **{"pkg/core.py": WEIGHTS, "pkg/net.npz": "0.0"})
    write(repository, {"pkg/core.py": WEIGHTS + "SPEED_UP += 1.25\n"})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*FileNotFoundError*net.npz*; files that git ignores or *need --pafot-copy*"])
    run(repository, "--pafot-copy=pkg/net.npz").stdout.fnmatch_lines(["against rev:main (*): introduces 1 failure, *"])


def test_pointer_of_git_lfs_is_not_compared_with_weights(repository):
    pointer = f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 3\n"
    copes = WEIGHTS.replace('float((Path(__file__).parent / "net.npz").read_text())', "TEXT.startswith('1.25') * 1.25")
    copes = copes.replace("SPEED_UP", 'TEXT = (Path(__file__).parent / "net.npz").read_text()\nSPEED_UP')
    (repository.path / ".gitignore").unlink(missing_ok=True)
    commit(repository, **{"pkg/core.py": copes, "pkg/net.npz": pointer})
    git(repository, "add", "-f", "pkg/net.npz")
    git(repository, "commit", "-q", "--amend", "--no-edit")
    write(repository, {"pkg/core.py": copes + "\n", "pkg/net.npz": "1.25"})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    told = " ".join(result.stdout.str().split())
    assert "received pkg/net.npz, a pointer of Git LFS, as nothing is fetched here; name it with --pafot-copy" in told
    assert "introduces" not in told
    result = run(repository, "--pafot-copy=pkg/net.npz")
    result.stdout.fnmatch_lines(["against rev:main (*): introduces 0 failures, *"])


def test_weights_that_only_some_runs_need_are_no_failure_with_both(repository):
    late = ADAPTER.replace(
        "        return", "        open(__file__ + '.npz') if observation.time > 1.0 else None\n        return"
    )
    commit(repository, **{"pkg/adapter.py": late, "pkg/core.py": "SPEED_UP = 0.0\n"})
    write(repository, {"pkg/core.py": NOW, "pkg/adapter.py.npz": ""})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*FileNotFoundError: * in a run; files that git ignores or *need --pafot-copy*"])
    result = run(repository, "--pafot-copy=pkg/adapter.py.npz pkg/core.py")
    told = [
        "*note: copied, so the same on both sides: pkg/adapter.py.npz",
        "against rev:main (*): introduces 1 failure, *",
    ]
    for line in told:
        result.stdout.fnmatch_lines([line])


def test_policy_without_its_fixture_in_the_revision_is_new(repository):
    fixture = "import pytest\nfrom pkg.adapter import Adapter\n\n@pytest.fixture\ndef ads():\n    return Adapter\n"
    repository.write(TEST.replace("ads=Adapter, ", "").replace("(run)", "(run, ads)"))
    commit(repository)
    write(repository, {"conftest.py": fixture})
    run(repository).stdout.fnmatch_lines(["*note: the policy is new since rev:main (*): every failure counts"])


def test_finder_that_is_asked_first_is_named(repository, monkeypatch, tmp_path_factory):
    in_src(repository)
    write(repository, {"src/pkg/core.py": NOW})
    site = tmp_path_factory.mktemp("site")
    finder = "import sys\nfrom importlib.util import spec_from_file_location as found\n\n\nclass Finder:\n"
    finder += "    def find_spec(name, path=None, target=None):\n        if name == 'pkg':\n"
    finder += (
        "            return found(name, SRC + '/pkg/__init__.py', submodule_search_locations=[SRC + '/pkg'])\n\n\n"
    )
    (site / "own_finder.py").write_text(f"SRC = '{repository.path}/src'\n{finder}sys.meta_path.insert(0, Finder)\n")
    (site / "sitecustomize.py").write_text("import own_finder\n")
    write(repository, {"pytest.ini": "[pytest]\npythonpath = src\n"})
    commit(repository)
    write(repository, {"src/pkg/core.py": NOW + "\n"})
    monkeypatch.setenv("PYTHONPATH", str(site))
    result = run(repository, fresh=True)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*uninstall what own_finder imports, whose finder is asked first, and put*"])
    monkeypatch.delenv("PYTHONPATH")
    run(repository, "--pafot-save=none").stdout.fnmatch_lines(["against rev:main (*): introduces 0 failures, *"])


def test_policy_that_opens_present_files_is_refused(repository):
    present = f'"{repository.path}/pkg"'
    commit(repository, **{"pkg/core.py": WEIGHTS.replace("Path(__file__).parent", f"Path({present})")})
    write(repository, {"pkg/net.npz": "0.0", "pkg/adapter.py": ADAPTER + "\n"})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    expected = f"*received {repository.path}/pkg/net.npz, of your present files: it would be compared with itself; *"
    result.stdout.fnmatch_lines([expected])


@table(
    "opens",
    [
        "import numpy; numpy.memmap(FILE, mode='r+')",
        "import sqlite3; sqlite3.connect(FILE)",
        "import sqlite3; sqlite3.connect('file:' + FILE + '?mode=ro', uri=True)",
        "import ctypes, suppress; suppress.all(lambda: ctypes.CDLL(FILE))",
        "import subprocess; subprocess.run(['cat', FILE])",
        "import subprocess; subprocess.run('cat ' + FILE, shell=True)",
        "import subprocess; subprocess.run(['cat', 'net.npz'], cwd=FILE.removesuffix('net.npz'))",
    ],
)
def test_present_files_are_refused_however_they_are_opened(repository, opens):
    catches = "def all(call):\n    try:\n        call()\n    except OSError:\n        pass\n"
    present = f"FILE = '{repository.path}/pkg/net.npz'\n{opens}\nSPEED_UP = 0.0\n"
    commit(repository, **{"pkg/core.py": present, "suppress.py": catches})
    write(repository, {"pkg/net.npz": "0.0", "pkg/core.py": NOW})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines([f"*received {repository.path}/pkg/net.npz, of your present files: *"])


def test_variables_name_the_files_of_the_revision(repository, monkeypatch):
    reads = "import os\n\nSPEED_UP = float(open(os.environ['NETS'].split(os.pathsep)[1]).read())\n"
    commit(repository, **{"pkg/core.py": reads, "a net": "0.0"})
    write(repository, {"a net": "1.25"})
    monkeypatch.setenv("NETS", f"/dev/null{os.pathsep}{repository.path}/a net")
    run(repository).stdout.fnmatch_lines(["against rev:main (*): introduces 1 failure, *"])


def in_src(repository):
    """Move the package to a folder that is on no path, and commit it as it was."""
    git(repository, "checkout", "-q", "pkg")
    (repository.path / "src").mkdir()
    (repository.path / "pkg").rename(repository.path / "src" / "pkg")
    commit(repository)


def test_installed_copy_of_the_policy_is_refused(repository, monkeypatch, tmp_path_factory):
    in_src(repository)
    write(repository, {"src/pkg/core.py": NOW})
    site = tmp_path_factory.mktemp("installed")
    shutil.copytree(repository.path / "src" / "pkg", site / "pkg")
    monkeypatch.setenv("PYTHONPATH", str(site))
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    where = (
        f"*received pkg.adapter from {site}/pkg/adapter.py, which is the same on both sides; run where*PYTHONPATH=src"
    )
    result.stdout.fnmatch_lines([where])
    monkeypatch.setenv("PYTHONPATH", f"src{os.pathsep}{site}")
    run(repository).stdout.fnmatch_lines(["against rev:main (*): introduces 1 failure, *"])


def test_policy_of_another_repository_is_refused(repository, monkeypatch, tmp_path_factory):
    site = tmp_path_factory.mktemp("other")
    (site / "other.py").write_text(ADAPTER.replace("from pkg.core import SPEED_UP", "SPEED_UP = 1.25"))
    repository.write(TEST.replace("pkg.adapter", "other"))
    commit(repository)
    monkeypatch.setenv("PYTHONPATH", str(site))
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines([f"*expected a policy of the repository*received that of {site}/other.py, which is *"])


def test_files_outside_the_repository_are_a_reason_to_search(repository, monkeypatch, tmp_path_factory):
    site = tmp_path_factory.mktemp("other")
    (site / "other.py").write_text("SPEED_UP = 1.25\n")
    commit(repository, **{"pkg/core.py": "from other import SPEED_UP\n"})
    monkeypatch.setenv("PYTHONPATH", str(site))
    run(repository).stdout.fnmatch_lines(["against rev:main (*): introduces 0 failures, *"])


def test_programs_of_a_policy_import_from_its_revision(repository, monkeypatch, tmp_path_factory):
    in_src(repository)
    asks = "import subprocess, sys\n\nSPEED_UP = float(subprocess.run([sys.executable, '-c', 'import pkg.net'],"
    asks += " cwd='/', capture_output=True, text=True).stdout)\n"
    commit(repository, **{"src/pkg/core.py": asks, "src/pkg/net.py": "print(0.0)\n"})
    write(repository, {"src/pkg/net.py": "print(1.25)\n"})
    site = tmp_path_factory.mktemp("site")  # it does what an editable installation does
    (site / "sitecustomize.py").write_text(f"import sys\nsys.path.append('{repository.path}/src')\n")
    monkeypatch.setenv("PYTHONPATH", str(site))
    run(repository, fresh=True).stdout.fnmatch_lines(["against rev:main (*): introduces 1 failure, *"])


@pytest.mark.parametrize(
    ("policy", "received"),
    [
        ("raise ValueError('bad')", "received ValueError: bad (*core.py:1); files that git ignores or "),
        ("def (", "SyntaxError"),
        ("import os; os._exit(3)", "expected a process with its policy, received ended with exit code 3"),
    ],
)
def test_revision_that_cannot_be_built_is_a_usage_error(repository, policy, received):
    commit(repository, **{"pkg/core.py": policy + "\n"})
    write(repository, {"pkg/core.py": NOW})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines([f"*against*: rev:main (*{received}*"])


def test_revision_that_is_never_built_ends_with_the_time_limit(repository):
    least = "from pytest_pafot.plugin import search_item\n\nsearch_item.LEAST_TO_BUILD = 1.0\n"
    (repository.path / "conftest.py").write_text(least)  # The session has a process of its own.
    commit(repository, **{"pkg/core.py": "import time; time.sleep(1000)\n"})
    write(repository, {"pkg/core.py": NOW})
    begun = time.monotonic()
    result = run(repository, "--pafot-total-time=0.5")
    assert time.monotonic() - begun < 60
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*against*: rev:main (*it was not built before the time limit*"])


def test_slow_reference_in_its_process_ends_with_the_time_limit(repository):
    slow = ADAPTER.replace("return", "time.sleep(0.5)\n        return").replace("from", "import time\nfrom", 1)
    commit(repository, **{"pkg/adapter.py": slow})
    write(repository, {"pkg/adapter.py": ADAPTER, "pkg/core.py": NOW})
    text = (repository.path / "test_it.py").read_text()
    write(repository, {"test_it.py": text.replace("ads=Adapter", "ads=Adapter, world=pafot.Highway(duration=60.0)")})
    begun = time.monotonic()
    result = run(repository, "--pafot-total-time=6")
    assert time.monotonic() - begun < 45  # a run of the reference takes 150 s
    result.stdout.fnmatch_lines(["*ended: --pafot-total-time*"])


@pytest.mark.parametrize(
    ("decision", "how"),
    [
        ("os._exit(0)", "ProcessCrash: ended with exit code 0"),
        ("hang()", "ProcessCrash: hung, ignored every interrupt and was ended"),
        ("raise KeyError('x')", "KeyError: 'x'"),
    ],
)
def test_reference_that_dies_hangs_or_raises_has_failed(repository, decision, how):
    hang = "import os, time\n\ndef hang():\n    while True:\n        try:\n            time.sleep(9)\n"
    hang += "        except BaseException:\n            pass\n\nSPEED_UP = 0.0\n"
    broken = ADAPTER.replace("import SPEED_UP", "import *").replace("return", f"{decision}\n        return")
    commit(repository, **{"pkg/core.py": hang, "pkg/adapter.py": broken.replace("from", "import os\nfrom", 1)})
    write(repository, {"pkg/adapter.py": ADAPTER, "pkg/core.py": NOW})
    text = (repository.path / "test_it.py").read_text()
    world = "world=pafot.Highway(duration=10.0, hang_limit=0.5)"
    write(repository, {"test_it.py": text.replace("ads=Adapter", f"ads=Adapter, {world}")})
    result = run(repository, "--pafot-runs=1", generations=None)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines([f"*the reference itself failed in all its runs, at first with {how}*"])


def test_weights_that_cannot_be_loaded_are_named(repository):
    loads = "class Lost:\n    def preload(self):\n        raise OSError('no net')\n"
    loads += "    def __call__(self):\n        return lambda seen: (0.0, 0.0)\n\nAdapter = Lost()\n"
    commit(repository, **{"pkg/adapter.py": loads})
    write(repository, {"pkg/adapter.py": ADAPTER})
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*against: rev:main (*received OSError: no net (*adapter.py:3); files that git *"])


def test_branch_without_a_commit_is_a_usage_error(repository):
    git(repository, "checkout", "-q", "--orphan", "empty")
    result = run(repository)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*against (rev:main (*)): *received 'HEAD', which does not exist in *"])


DECIDES = "import os\nimport time\n\nclass Adapter:\n    __call__ = lambda self, seen: {}\n"

HANGS_SOON = """
import pytest
import pytest_pafot as pafot

@pytest.fixture
def pafot_world():
    return pafot.Highway(hang_limit=0.5)
"""

LAST = """
from pkg.adapter import Adapter
import pkg.core


@pafot.search(SHORT, ads=Adapter, drivers={"last": "rev:main"}, runs=4)
def test_others_are_driven_by_the_last_version(run):
    for number, chain in enumerate(run.scenario.npcs):
        if getattr(chain[0], "driver", "") == "last":
            speeds = run.trace.npcs[:, number, 3]
            assert abs(speeds - speeds[0]).max() < 1e-9
            print("driven by last")
    assert run.ego.speed.max() > 22.5
"""


def driven_by_last(project, policy, *args, apart=True):
    """Run a search in which a revision with some policy drives NPCs."""
    project.write(LAST)
    commit(project, **{"pkg/core.py": policy})
    write(project, {"pkg/core.py": NOW, "pkg/adapter.py": ADAPTER})
    return project.run("-rP", *args, apart=apart)


def test_revision_drives_free_npcs_as_it_was(repository):
    result = driven_by_last(repository, "SPEED_UP = 0.0\n")
    result.assert_outcomes(passed=1)
    commit_name = git(repository, "rev-parse", "main")[:7]
    result.stdout.fnmatch_lines([f"*note: free NPCs that rev:main drives: the policy of rev:main ({commit_name})"])
    assert "driven by last" in result.outlines


@pytest.mark.parametrize(
    ("policy", "told"),
    [
        (DECIDES.format("[][1]"), "RevisionError: rev:main (*): expected a policy that drives, received IndexError"),
        (DECIDES.format("os._exit(3)"), "that decides, received one whose process ended with exit code 3"),
        (DECIDES.format("time.sleep(99)"), "Hang: one decision took longer"),
        ("from highway_env.vehicle.behavior import IDMVehicle as Adapter\n", "observations*, received a vehicle class"),
    ],
)
def test_revision_that_fails_as_a_driver_is_no_failure_of_the_policy(repository, policy, told):
    write(repository, {"pkg/adapter.py": policy, "conftest.py": HANGS_SOON})
    result = driven_by_last(repository, "SPEED_UP = 0.0\n")
    text = " ".join(line.strip() for line in result.outlines)
    assert fnmatch(text, f"*{told}*")
    assert not repository.files


def test_revision_that_does_not_exist_drives_nobody(repository):
    repository.write(LAST.replace("rev:main", "rev:nowhere"))
    repository.run(apart=True).stdout.fnmatch_lines(["@pafot.search(drivers=...): rev:nowhere: expected *"])


def dies(served):
    os._exit(7)


def test_process_that_dies_in_any_call_is_lost_and_starts_again(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path / "present")
    (tmp_path / "planner.py").write_text("def make():\n    return lambda seen: (0.0, 0.0)\n")
    policy = RevisionPolicy(
        label="rev:main", commit="", root=tmp_path / "present", tree=tmp_path, folder=Path(), copy="--copy",
        program=PROCESS, name="planner:make",
    )  # fmt: skip
    try:
        for _ in range(2):
            with pytest.raises(ProcessLostError, match="ended with exit code 7"):
                policy.call(dies)
        assert policy.start() == "planner:make"
    finally:
        policy.close()


def test_prints_of_a_policy_do_not_reach_the_session(repository):
    prints = ADAPTER.replace("return", "print('x' * 999); os.write(1, b'y' * 9999); return")
    commit(
        repository, **{"pkg/adapter.py": "import os\nprint('imported')\n" + prints, "pkg/core.py": "SPEED_UP = 0.0\n"}
    )
    write(repository, {"pkg/core.py": NOW, "pkg/adapter.py": ADAPTER})
    result = run(repository, "-s")
    result.stdout.fnmatch_lines(["against rev:main (*): introduces 1 failure, *"])
    result.stdout.no_fnmatch_line("*xxx*")


@table(
    ("revision", "received"),
    [
        ("rev:", "expected a revision, such as rev:main, received 'rev:'"),
        ("rev:nothing", "expected a commit, a branch or a tag, received 'nothing'"),
        ("rev:--output=x", "expected a commit, a branch or a tag, received '--output=x'"),
        ("rev:main:pkg", "expected a commit, a branch or a tag, received 'main:pkg'"),
    ],
)
def test_what_is_no_revision_is_a_usage_error(repository, revision, received):
    result = run(repository, revision=revision)
    assert (result.ret, (repository.path / "x").exists()) == (pytest.ExitCode.USAGE_ERROR, False)
    result.stdout.fnmatch_lines([f"*against: {revision}: {received}*"])


def test_session_outside_a_repository_says_what_it_needs(project, monkeypatch):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(project.path.parent))
    project.write("@pafot.search(SHORT)\ndef test_it(run):\n    pass\n")
    result = run(project)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*against: rev:main: expected a folder in a git repository, received *"])


def test_odd_branch_names_are_revisions(repository):
    git(repository, "update-ref", "refs/heads/-x/\u00fc y".replace(" ", "_"), "main")
    result = run(repository, revision="rev:refs/heads/-x/\u00fc_y")
    result.stdout.fnmatch_lines(["against rev:refs/heads/-x/\\xfc_y (*): introduces 1 failure, *"])


def test_workers_of_xdist_each_have_their_own_copy(repository):
    repository.write(TEST.replace("test_keeps_its_speed", "test_second"), name="test_second")
    result = run(repository, "-n2")
    result.stdout.fnmatch_lines(["against rev:main (*): introduces 2 failures, fixes 0, 0 as before"])


def test_resumed_search_agrees_on_the_commit_and_not_its_name(repository):
    options = ("--pafot-resume=states", "--pafot-save=none")
    run(repository, *options)
    git(repository, "branch", "same", "main")
    result = run(repository, *options, revision="rev:same", generations=2)
    result.stdout.fnmatch_lines(["*resumed after * of earlier sessions*"])
    git(repository, "checkout", "-q", "pkg")
    commit(repository, **{"other.py": ""})
    write(repository, {"pkg/core.py": NOW})
    result = run(repository, *options, generations=2)
    result.stdout.no_fnmatch_line("*resumed after*")


@table("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_copy_of_an_ended_session_is_removed(repository, number):
    endless = git(repository, "show", "main:test_it.py").replace("stop_after=1", "max_time=99")
    write(repository, {"test_it.py": endless.replace("    assert", "    open('began', 'w').close()\n    assert")})
    began = repository.path / "began"
    began.unlink(missing_ok=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "pafot", "--pafot-against=rev:main", "--pafot-runs=1000000"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with begun(command, cwd=repository.path, **quiet) as session:
        deadline = time.monotonic() + 60
        while not began.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        session.send_signal(number)
    assert session.returncode != 0
    assert len(git(repository, "worktree", "list").splitlines()) == 1 + (number == signal.SIGKILL)
    if number == signal.SIGKILL:
        git(repository, "checkout", "-q", "test_it.py")
        run(repository).stdout.fnmatch_lines(["against rev:main (*): introduces *"])  # also what the killed one ran


def test_session_that_an_unknown_revision_ends_leaves_the_earlier_table(failing):
    (failing.path / "runs.csv").write_text("an earlier one")
    result = failing.run("--pafot-table=runs.csv", "--pafot-against=rev:none")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stdout.fnmatch_lines(["*--pafot-table=runs.csv: nothing was written, since no search ran"])
    assert (failing.path / "runs.csv").read_text() == "an earlier one"
