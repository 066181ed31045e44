"""A project with a fast ADS and short scenarios, in which pytest runs in this process."""

import os
import re
import tempfile
from itertools import chain
from pathlib import Path

# pytester forgets modules that a run imports; compiled ones must stay, since they cannot be loaded a second time
import highway_env.road.road  # noqa: F401
import numpy.fft  # noqa: F401
import pytest

import pytest_pafot
import pytest_pafot.strategies
from pytest_pafot.execution.crash_records import CrashRecord, records_of
from pytest_pafot.model.instructions import Cell, PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.searches import bench
from pytest_pafot.searches.refine import steps
from pytest_pafot.world import Highway
from tests.helpers.sessions import (
    CORE,
    imported,
    in_a_copy,
    in_process,
    quick_sessions,
    read_record,
    section,
    set_keys,
)

# pytester forgets the modules that a session imports; those of the package stay, because importing them is slow.
imported(*CORE)

EXAMINATIONS = steps.EXAMINATIONS
DIFFERENCE_IN_GYM = bench._difference_in_gym

CONFTEST = """
import pytest

@pytest.fixture
def ads():
    return lambda: lambda observation: (0.0, 0.0)
"""

DEADLY = """
import os
import pytest

SESSION = os.getpid()

def drive(observation):
    if os.getpid() != SESSION:
        os._exit(9)
    return 0.0, 0.0

@pytest.fixture
def ads():
    return lambda: drive
"""
"""A conftest with an ADS that ends every process except the session's."""

SHORT = "genes=2, gene_seconds=5, npcs=2, ego_lane=1, ego_speed=22, vehicles='car'"
"""Marker arguments of ten-second scenarios, all with the same start."""

SETTINGS = ("CI", "COLUMNS", "GITHUB_STEP_SUMMARY", "PYTEST_ADDOPTS")
"""Environment variables that affect a session's output."""

NOT_NAMED = (
    "doctest", "junitxml", "legacypath", "logging", "pastebin", "setuponly", "setupplan", "stepwise",
    "unraisableexception",  # collects all garbage at the end of each session
)  # fmt: skip
"""Parts of pytest that a session only loads if its options name them: they take a fifth of a short session."""


class Project:
    """A folder with tests, and the sessions in it."""

    def __init__(self, pytester, found):
        self.pytester = pytester
        self.found = found
        self.options = {}
        self.path = pytester.path
        pytester.makeconftest(CONFTEST)

    def write(self, source, name="test_it"):
        """Write a test file; `SHORT` in it stands for the arguments of short scenarios.

        Comments such as ``# stop_after=1`` are options of the project's sessions.
        """
        self.options[name] = [
            f"--pafot-stop-after={count}" for count in re.findall(r"# stop_after=(\d+)", source)
        ]
        text = "import pytest\nimport pytest_pafot as pafot\n\n" + source.replace("SHORT", SHORT)
        return self.pytester.makepyfile(**{name: text})

    def run(self, *args, runs=4, seed=1, plugins=(), apart=False, fresh=False, **inline):
        """Run a session with this plugin and no other plugins except those requested.

        Args:
            apart: Run in a process that the session may end.
            fresh: Run in a new interpreter that has imported nothing yet.
        """
        parallel = ["xdist"] if any(str(arg).startswith(("-n", "--dist")) for arg in args) else []
        named = "".join(map(str, args)).replace("-", "")
        names = [f"no:{name}" for name in NOT_NAMED if name not in named]
        names += ["pafot", *parallel, *plugins]
        options = [part for name in names for part in ("-p", name)]
        if runs is not None:
            options.append(f"--pafot-runs={runs}")
        if seed is not None:
            options.append(f"--pafot-seed={seed}")
        options += [*dict.fromkeys(chain(*self.options.values())), *map(str, args)]
        if fresh:
            return self.pytester.runpytest_subprocess(*options)
        if apart:
            return in_a_copy(self.pytester, *options)
        return in_process(self.pytester, *options, **inline)

    def run_once(self, *args, **options):
        """Run a session, or reuse a previous one with the same files and settings.

        The project then looks as if the session had run. A test that patches a session's code must not use this.
        """
        before = self._tree
        settings = {name: value for name, value in os.environ.items() if name in SETTINGS}
        whole = bench._difference_in_gym is DIFFERENCE_IN_GYM
        arguments = [str(arg).replace(str(self.path), "") for arg in args]
        key = repr((before, settings, whole, arguments, options))
        if key not in self.found:
            result = self.run(*args, **options)
            after = self._tree
            changed = {name: text for name, text in after.items() if before.get(name, ...) != text}
            texts = ("\n".join(lines) for lines in (result.outlines, result.errlines))
            streams = [text.replace(str(self.path), "{project}") for text in texts]
            self.found[key] = (result.ret, streams, before.keys() - after.keys(), changed)
        status, streams, removed, changed = self.found[key]
        for name in sorted(removed & self._tree.keys(), reverse=True):
            path = self.path / name
            path.rmdir() if path.is_dir() else path.unlink()
        for name, content in changed.items():
            path = self.path / name
            path.mkdir(exist_ok=True) if content is None else path.write_bytes(content)
        shown = (text.replace("{project}", str(self.path)).splitlines() for text in streams)
        return pytest.RunResult(status, *shown, 0)

    @property
    def _tree(self):
        """Return the contents of all files except compiled ones, by name, and no contents for folders."""
        found = (path for path in sorted(self.path.rglob("*")) if "__pycache__" not in path.parts)
        return {
            path.relative_to(self.path).as_posix(): None if path.is_dir() else path.read_bytes()
            for path in found
        }

    def leave_behind(self, owner, world=None):
        """Write the record of a process that died while a test ran a scenario."""
        flight = CrashRecord(
            records_of(self.path), owner, world=world or Highway(duration=10.0).to_dict()
        )
        flight.write(Scenario(npcs=((PositionInstruction(Cell.FRONT, 20.0),) * 2,), gene_seconds=5))
        os.close(flight._descriptor)

    def leave_crash(self, owner):
        """Write such a record, with an ADS that also ends the process in which the scenario runs again."""
        self.pytester.makeconftest(DEADLY)
        self.leave_behind(owner)

    def mend(self):
        """Replace such an ADS by one that keeps its speed."""
        self.pytester.makeconftest(CONFTEST)

    def accept(self, until="9999-12-31"):
        """Accept the failures of all corpus files until a day."""
        for name, text in self.contents.items():
            accepted = f'xfail: {{reason: "planner issue 12", until: {until}}}'
            assert "# xfail: {reason, until}" in text
            (self.path / name).write_text(text.replace("# xfail: {reason, until}", accepted))

    @property
    def files(self):
        """Return all corpus files, relative to the project."""
        found = sorted(self.path.rglob("*.pafot.yaml"))
        return [path.relative_to(self.path).as_posix() for path in found]

    @property
    def contents(self):
        """Return the contents of all corpus files."""
        return {name: (self.path / name).read_text() for name in self.files}

    @property
    def record(self):
        """Return what the last session wrote for programs with ``--pafot-json=pafot.json``."""
        return read_record((self.path / "pafot.json").read_text(encoding="utf-8"))

    @property
    def records(self):
        """Return the crash records of the project, and any others in its folder for temporary files."""
        return list(Path(tempfile.gettempdir()).rglob("*.inflight"))

    def forget(self):
        """Remove all corpus files."""
        for name in self.files:
            (self.path / name).unlink()

    @property
    def only_file(self):
        """Return the only corpus file."""
        (name,) = self.files
        return self.path / name

    @property
    def only_id(self):
        """Return the only corpus file's id."""
        return self.only_file.name.removesuffix(".pafot.yaml")


def shows(result, name, *lines):
    """Check that the failure of a test is told by lines in this order."""
    pytest.LineMatcher(section(result, name).splitlines()).fnmatch_lines(list(lines))


def labels(result):
    """Return the labels of a session's replays with their numbers, such as ``1 still failing``."""
    lines = [line for line in result.outlines if line.startswith("replayed ")]
    return lines[0].rpartition(": ")[2] if lines else ""


@pytest.fixture(scope="session")
def found():
    """Cache the output and files of every session that runs once for all tests."""
    return {}


@pytest.fixture
def project(request, pytester, monkeypatch, found, tmp_path_factory):
    """Return a project whose sessions omit slow steps unless a test requests them.

    Findings are saved without shrinking, without moments, and without a second run in highway-env's own environment.
    Tests of several processes have whole sessions: what one process does, the others must do as well.
    """
    for name in ("CI", "BUILD_NUMBER", "PYTEST_ADDOPTS", "GITHUB_ACTIONS", "GITHUB_STEP_SUMMARY"):
        monkeypatch.delenv(name, raising=False)
    quick_sessions(monkeypatch)
    if not request.node.get_closest_marker("processes"):
        omit_slow_steps(monkeypatch)
    monkeypatch.setattr(steps, "EXAMINATIONS", {})
    monkeypatch.setenv("PYTHONPATH", str(Path(pytest_pafot.__file__).parents[1]))
    monkeypatch.setenv("COLUMNS", "500")  # messages on one line each
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    temporary = str(tmp_path_factory.mktemp("temporary"))
    monkeypatch.setenv("TMPDIR", temporary)
    monkeypatch.setattr(tempfile, "tempdir", temporary)
    return Project(pytester, found)


def omit_slow_steps(monkeypatch):
    monkeypatch.setattr(bench, "_difference_in_gym", lambda run, bench: "")
    set_keys(monkeypatch, shrink_runs=0)


@pytest.fixture
def examined(project, monkeypatch):
    """Let sessions also examine the decisions that led to each finding, as users' sessions do."""
    monkeypatch.setattr(steps, "EXAMINATIONS", EXAMINATIONS)


@pytest.fixture
def in_highway_env(project, monkeypatch):
    """Let sessions also run each finding in highway-env's own environment, as users' sessions do."""
    monkeypatch.setattr(bench, "_difference_in_gym", DIFFERENCE_IN_GYM)


@pytest.fixture
def shrinking(project, monkeypatch):
    """Let sessions shrink their findings, as users' sessions do."""
    set_keys(monkeypatch, shrink_runs=None)


FAILING = """
@pafot.search(SHORT)  # stop_after=1
def test_fails(run):
    assert run.duration < 1
"""


@pytest.fixture
def failing(project):
    """Return a project whose only test fails for every run, so that a search finds one failure at once."""
    project.write(FAILING)
    return project


@pytest.fixture
def saved(failing):
    """Return the failing project after a session that has saved its failure."""
    failing.run_once()
    return failing
