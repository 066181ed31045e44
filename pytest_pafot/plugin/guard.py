"""The guard against lost tests: on CI, a session fails if it skips a saved scenario or a marked test.

The session must run every saved scenario below the rootdir, unless the user deselects it by name.
"""

from __future__ import annotations

import fnmatch
import os
import re
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path

import pytest

from pytest_pafot.corpus.layout import (
    CORPUS,
    FOUND,
    SUFFIX,
    entries_of,
    is_corpus,
    is_folder,
    is_misnamed,
    link_below,
    module_of_file,
    name_within,
    refusal,
    relative,
)
from pytest_pafot.corpus.layout import is_inside as is_inside_project
from pytest_pafot.plugin.session import (
    GIVEN,
    INVENTORY,
    SESSION,
    call_of,
    cause_of,
    path_of,
    value_if_right,
)
from pytest_pafot.report.session import ADVICE, UNNAMED_ADVICE
from pytest_pafot.searches.options import BY_NAME, OF_COMMAND
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import first_of, plural, visible

LISTED = 5  # the maximum number of names in a line
MAX_FOLDERS = 10_000  # the maximum number of folders to search for saved scenarios
ERROR_ID = "pafot::saved_scenarios_without_a_test"
"""The node id of the error about saved scenarios that did not run."""
UNNAMED_ID = "pafot::marked_tests_that_are_not_collected"
"""The node id of the error about marked tests that were not collected."""
# Matches only a node id, because the match is printed, and a broken file may contain anything.
_TEST_LINE = re.compile(rb"^test:[ \t]*([^\n:]*\.py::[^\n]+?)\s*$", re.MULTILINE)
_ARCHIVE = re.compile(r"(.+?)\.(?:dvc|gz|bz2|xz|zst|zip|7z|tar|tar\.\w+|tgz|tbz2?|txz|tzst)")
# arguments that deselect tests by name; -qk is -q and -k
_BY_NAME = re.compile(r"-[lqsvx]*[km]|--deselect")
_FOREIGN = {
    FOUND,
    ".git",
    ".hg",
    "__pycache__",
    "node_modules",
    "site-packages",
    "vendor",
    "third_party",
}
"""Names of folders in which saved scenarios never belong to the project."""
_SEPARATE = {".git", "pyvenv.cfg", "conda-meta"}
"""Files and folders that mark a different repository or a virtual environment."""
_CONFIGURED = ("pyproject.toml", "pytest.ini", "tox.ini", "setup.cfg", "setup.py", "package.json")
"""Files that mark the root of a project."""
_SELECTING = ("lf", "stepwise", "splits", "num_shards", "test-group-count", "testmon", "picked")
"""Options of pytest and its plugins that select only some of the tests."""


_LISTING = (
    "collectonly",
    "setupplan",
    "setuponly",
    "showfixtures",
    "show_fixtures_per_test",
    "cacheshow",
)
"""Options with which pytest runs no test."""

ENDS = (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED)
"""The exit codes with which a session that ran tests can end."""


class Guard:
    """Hooks that compare the saved scenarios of the project with those that the session ran."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._session = config.stash[SESSION]
        self._ended: set[str] = set()  # node ids of the items that have run
        self._failed: set[str] = set()  # node ids of failed items, and of new findings
        self._run: set[str] = set()  # the saved scenarios that were run, as reports name them
        self._is_whole = False  # whether all items have run
        # Why the session must fail if something was not tested, or empty. Stored, as a test may change the environment.
        self.cause = cause_of(config)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            self._ended.add(report.nodeid)
        if report.failed:
            self._failed.add(report.nodeid)
        properties = dict(report.user_properties)
        # The property is the result of a replay. An item that a mark or a hook has skipped has none.
        if report.failed or "pafot" in properties:
            self._run.add(str(properties.get("pafot_file", "")))

    # inside the hook in which pytest ends the line of its results
    @pytest.hookimpl(wrapper=True, trylast=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """Fail a session with lost tests, after all items have run and all pytest-xdist workers have reported."""
        result = yield
        self._is_whole = True
        why = f"This is an error because {self.cause}"
        unnamed = self._session.unnamed = sorted(self._config.stash[INVENTORY].unnamed)
        if unnamed and self.cause and not _only_lists(self._config):
            count = plural(len(unnamed), "test")
            line = f"pytest did not collect {count} with a pafot mark: {first_of(unnamed, LISTED)}"
            _report(session, UNNAMED_ID, line, f"{UNNAMED_ADVICE}. {why}")
        self._note_left()
        fails = self._session.fails
        if fails:
            count = plural(len(fails), "saved scenario")
            line = f"this session did not run {count}: {first_of(fails, LISTED)}"
            way_out = f"To run only some of them, add {BY_NAME['allow_orphans'].flag}"
            _report(session, ERROR_ID, line, f"{ADVICE}. {why}. {way_out}")
        return result

    @pytest.hookimpl(tryfirst=True)  # before the summary and the JSON file are written
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Reject an exit code of 0, for example from ``pytest.exit(returncode=0)``, if a policy failed."""
        inventory = self._config.stash[INVENTORY]
        if not self._is_whole and session.exitstatus in ENDS:
            with self._session.faults("pafot: saved scenarios that were not run are unknown"):
                self._note_left()
        is_ok = session.exitstatus == pytest.ExitCode.OK
        if not (is_ok and self.cause) or _only_lists(self._config):
            return
        named = sorted(inventory.driven - self._ended)
        if named:
            what = "did not finish"
            session.exitstatus = pytest.ExitCode.INTERRUPTED
        # If the session runs no policy, its hooks may hide failures of tests.
        elif self._failed and (inventory.driven or inventory.unnamed or self._session.left):
            named = sorted(self._failed)
            what = "failed"
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        else:
            return
        self._session.problems.append(
            f"{plural(len(named), 'item')} {what} (first: {named[0]}), but the session would end with exit code 0. "
            f"Because {self.cause}, it ends with exit code {int(session.exitstatus)} instead. Does a test call "
            "pytest.exit(returncode=0), or does a plugin implement pytest_runtest_protocol?"
        )

    def _note_left(self) -> None:
        config = self._config
        if OF_COMMAND in os.environ or _only_lists(config):
            return  # The command runs one test. It does not collect the other tests of the project.
        left = []
        for file, test in sorted(self._left_out()):
            if not self._is_excluded(file, test):
                left.append(visible(relative(file, config.rootpath)))
        self._session.left = left
        values = [config.getoption(name, None) for name in _SELECTING]
        is_partial = any(each is True or each not in (None, 0, 1, "") for each in values)
        may_fail = self._is_whole and not is_partial and not value_if_right(config, "allow_orphans")
        if self.cause and may_fail:
            self._session.fails = left

    def _is_excluded(self, *paths: Path) -> bool:
        config, given = self._config, self._config.stash[GIVEN]
        places = {str(each) for path in paths for each in (path, *path.parents)}
        call = [f"={argument}" for argument in call_of(config)]
        patterns = [*(config.getoption("ignore") or ()), *(config.getoption("ignore_glob") or ())]
        for pattern in patterns:
            if any(argument.endswith(f"={pattern}") for argument in call):
                ignored = str(path_of(config, pattern))
                if ignored in places or fnmatch.filter(places, ignored):
                    return True
        if not given:
            return False
        # A file or a test on the command line excludes everything else. A folder requests all saved scenarios in it.
        folders = filter(is_folder, [path_of(config, each) for each in given])
        return not any(path.is_relative_to(folder) for folder in folders for path in paths)

    def _left_out(self) -> Iterator[tuple[Path, Path]]:
        """Yield each saved scenario that was neither run nor deselected by name, with its test file.

        The test file need not exist. A file outside a corpus counts as its own test file.
        """
        inventory, top = self._config.stash[INVENTORY], self._config.rootpath
        # First, skip the saved scenarios that were run, newly found, or deselected by name.
        known = set(self._run) | self._session.new_files
        if any(map(_BY_NAME.match, call_of(self._config))):
            known |= inventory.deselected
        corpus = Path(value_if_right(self._config, "corpus") or CORPUS)
        asked = list(filter(is_folder, [path_of(self._config, each) for each in self._config.args]))
        own = [each for each in map(Path, inventory.corpora) if link_below(top, each) is None]
        if corpus.is_absolute():
            own.append(corpus)
        problems = self._session.problems if inventory.driven else []
        # Second, find all files of the project that may be saved scenarios, and whether they are in a corpus.
        found = dict(_files_below(top, own, asked, corpus, problems))
        if self.cause and (inventory.driven or found):
            found.update(dict.fromkeys(_not_in_checkout(top, corpus), True))
        left = {
            file: is_inside
            for file, is_inside in found.items()
            if visible(relative(file, top)) not in known
        }
        # Third, drop copies of scenarios that were run, and files that belong to other projects.
        names = {name_within(file.name) or file.name for file in left}
        run = [top / each for each in known if Path(each).name in names]
        copies = {(file.name, _named_test(file)) for file in run}
        for file, is_inside in left.items():
            test = _named_test(file)
            name = test.partition("::")[0]
            original = name_within(file.name)
            is_copy = original != "" or is_misnamed(file.name)
            is_saved = file.name.endswith(SUFFIX) or (is_copy and test != "")
            if not is_inside:
                is_saved = is_saved and test != "" and os.path.lexists(top / name)
            elif not is_saved:
                is_saved = _may_be_packed(file)
            # In a corpus of the session, only a backup is a copy, because the folder determines the test of a file.
            may_be_copy = original or not any(map(file.is_relative_to, own))
            if not is_saved or (may_be_copy and (original or file.name, test) in copies):
                continue
            owner = module_of_file(file, str(corpus), top) or module_of_file(file, CORPUS, top)
            owner = owner or file
            # The rootdir of the session that saved the file, which the name of the test implies. Vendored projects have
            # their own.
            project = next((each for each in owner.parents if name and each / name == owner), top)
            is_asked_for = any(each.is_relative_to(project) for each in (*own, *asked))
            is_foreign = any(os.path.lexists(project / each) for each in _CONFIGURED)
            if project == top or is_asked_for or not is_foreign:
                yield file, owner


def _may_be_packed(file: Path) -> bool:
    """Return whether a file in a corpus may contain saved scenarios, although its name is not the name of one."""
    # git may write a link to a folder as a text file
    if not os.path.isfile(file):  # noqa: PTH113  (see is_folder)
        return True
    starts = (CORPUS, "test")
    if "." not in file.name:
        return file.name.startswith(starts)
    packed = _ARCHIVE.fullmatch(file.name)
    if packed is None or not (SUFFIX in packed[1] or packed[1].startswith(starts)):
        return False
    return not os.path.lexists(file.with_name(packed[1]))


def _files_below(
    top: Path, own: Iterable[Path], asked: Iterable[Path], corpus: Path, problems: list[str]
) -> Iterator[tuple[Path, bool]]:
    """Yield each possible saved scenario below some folders, and whether it is in a corpus.

    The folders in ``own`` are corpora. ``top`` and the folders in ``asked`` are not.
    """
    # Links to folders are not followed, because they may lead anywhere. If a folder of a corpus cannot be listed, the
    # folder itself is yielded.
    queue = deque((str(each), False) for each in (top, *asked))
    queue.extend((str(each), True) for each in own)
    starts, names = set(queue), {CORPUS, corpus.name}
    seen: set[tuple[str, bool]] = set()
    while queue and len(seen) < MAX_FOLDERS:
        place = queue.popleft()
        folder, is_inside = place
        if place in seen:
            continue
        seen.add(place)
        try:
            with os.scandir(folder) as listing:
                entries = list(listing)
        except OSError:
            if is_inside and os.path.lexists(folder):
                yield Path(folder), True
            continue
        is_separate = not _SEPARATE.isdisjoint([entry.name for entry in entries])
        if is_separate and not is_inside and place not in starts:
            continue
        for entry in entries:
            name, path = entry.name, entry.path
            if entry.is_dir(follow_symlinks=False):
                is_chosen = name in names and is_corpus(Path(path), corpus)
                is_below = is_inside or name == CORPUS or is_chosen
                if is_below or name not in _FOREIGN:
                    queue.append((path, is_below))
            elif is_inside or "pafot" in name.lower():
                file = Path(path)
                # A corpus may be an archive, or a link that git wrote as a text file.
                if not is_folder(file):
                    yield file, is_inside or name.partition(".")[0] == CORPUS
                elif name == CORPUS and file != corpus and not is_inside_project(file, top):
                    problems.append(refusal(file))
                    yield file, True
    if queue:
        problems.append(
            f"the list of saved scenarios may be incomplete, as it covers only {MAX_FOLDERS:,} folders"
        )


def _not_in_checkout(top: Path, corpus: Path) -> Iterator[Path]:
    """Yield the saved scenarios in a corpus that git tracks but has not checked out."""
    from pytest_pafot.support.files import git  # noqa: PLC0415  (few sessions have saved scenarios)

    above = Path(os.path.realpath(top))
    if not any(os.path.lexists(each / ".git") for each in (above, *above.parents)):
        return  # no repository; git would need some milliseconds to report that
    with suppress(RequestError):  # no git
        for entry in git(top, "ls-files", "-s", "-z").split("\0"):
            place = top / entry.partition("\t")[2]
            # the mode of a submodule
            if entry.startswith("160000 ") and (
                place.name == CORPUS or corpus.is_relative_to(place)
            ):
                if not entries_of(place):
                    yield place
            elif entry.endswith(SUFFIX) and len(place.parents) > 2:
                root = place.parents[2]
                is_root = root.name == CORPUS or is_corpus(root, corpus)
                if is_root and not os.path.lexists(root):
                    yield place


def _named_test(file: Path) -> str:
    """Return the node id that a corpus file names, even if the file is broken."""
    from pytest_pafot.corpus.reader import content_of  # noqa: PLC0415  (yaml, which few sessions need)
    from pytest_pafot.support.errors import CorpusError  # noqa: PLC0415

    try:
        line = _TEST_LINE.search(content_of(file))
    except CorpusError:
        return ""
    if line is None:
        return ""
    return line.group(1).decode("utf-8", "replace").strip("'\"")


def _only_lists(config: pytest.Config) -> bool:
    return any(config.getoption(name, False) for name in _LISTING)


def _report(session: pytest.Session, node_id: str, line: str, advice: str) -> None:
    try:
        pytest.fail(f"{line}\n  {advice}", pytrace=False)
    except pytest.fail.Exception as error:
        longrepr = pytest.ExceptionInfo.from_exception(error).getrepr(style="value")
    crash = getattr(longrepr, "reprcrash", None)
    if crash is not None:
        crash.message = line  # in the short summary
    manager = session.config.pluginmanager
    # Do not inform --lf and --sw: they would wait for an item of this name, which the next session does not collect.
    rerunning = [manager.get_plugin(name) for name in ("lfplugin", "stepwiseplugin")]
    log = manager.subset_hook_caller("pytest_runtest_logreport", rerunning)
    place = ("pafot", None, node_id.partition("::")[2])
    report = partial(pytest.TestReport, nodeid=node_id, location=place, keywords={})
    session.testscollected += 1
    log(report=report(outcome="failed", longrepr=longrepr, when="setup"))
    log(report=report(outcome="passed", longrepr=None, when="teardown"))
