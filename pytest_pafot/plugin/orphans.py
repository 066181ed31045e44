"""Saved scenarios that no test runs: orphans, whose test is gone, and strays, which are outside the folders of tests.

The files of a test that was only deselected are no orphans. On CI, a session fails if a test is gone: its findings
would never be replayed again, and no one would notice.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Generator, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import chain
from pathlib import Path

import pytest

from pytest_pafot.campaign.options import BY_NAME, is_ci
from pytest_pafot.corpus.layout import (
    SUFFIX,
    entries_of,
    files_below,
    files_in,
    folder_of_test,
    is_folder,
    is_misnamed,
    link_below,
    may_be_of,
    module_named,
    modules_in,
    name_within,
    relative,
    safe_name,
    unlisted_below,
)
from pytest_pafot.corpus.saved import Saved, saved_in
from pytest_pafot.plugin.option_sources import value_if_right
from pytest_pafot.plugin.session import DRIVEN, SUMMARY_LINES, UNRUN, Collected, Orphan
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.files import open_regular
from pytest_pafot.support.git import git
from pytest_pafot.support.text import plural, visible

# Only a node id matches: the name is also printed for broken files, and a broken file may contain anything.
_TEST_LINE = re.compile(rb"^test:[ \t]*([^\n:]*\.py::[^\n]+?)\s*$", re.MULTILINE)


PACKED = (".gz", ".bz2", ".xz", ".zst", ".dvc")
"""Suffixes of a saved scenario that has to be unpacked or fetched, and whose content says nothing until then."""
_ARCHIVE = re.compile(r"(.+?)\.(?:dvc|zip|7z|tar|tar\.\w+|tgz|tbz2?|txz|tzst)")
"""The name of an archive of a folder, or of DVC's pointer to one."""
_SUBMODULE = re.compile(rb"^[ \t]*path[ \t]*=[ \t]*\"?([^\n\"]+?)\"?[ \t]*\r?$", re.MULTILINE)  # in .gitmodules
MAX_SUBMODULES = 2**20  # the size up to which such a file is read [bytes]
MAX_NAME = 120  # length of the test's name in an error; the name is from a file, which may contain anything
ERROR_ID = "pafot::saved_scenarios_without_a_test"
"""The node id of the error with which a session fails if the test of saved scenarios no longer exists."""
UNNAMED_ID = "pafot::marked_tests_that_are_not_collected"
"""The node id of the error with which a session fails if pytest leaves out a marked test because of its name."""
ADVICE = (
    "if the test has another name or place now, move the files to its folder MODULE/TEST in the corpus, and name it in "
    "their line `test:`; else delete them"
)
"""What the user can do about orphans."""


def find_orphans(collected: Collected) -> dict[Path, Orphan]:
    """Return the folders of saved scenarios that belong to no test.

    A folder is an orphan if its module is gone, or if its module or class was collected and has no such test.
    Selections by ``-k``, ``-m`` or node ids make no orphans: pytest collects all members of a module or class before it
    selects. A module that failed or was skipped at import makes no orphans either.
    """
    return {
        folder: _orphan(folder, root, directory, collected)
        for root, directory in sorted(collected.roots.items())
        for module in modules_in(root)
        for folder in entries_of(module)
        # In a shared corpus, subfolders of packages are next to modules: a folder with subfolders may be one of them.
        if files_in(folder) and not (_shared(root, collected) and any(map(is_folder, entries_of(folder))))
        if _is_orphan(folder, directory, collected)
    }


def find_strays(collected: Collected, orphans: Collection[Path]) -> dict[str, tuple[str, bool]]:
    """Return the saved scenarios that no item can run, each with the reason, and whether the session fails by it on CI.

    They are too high or too deep for the folder of a test, or have another suffix; this is searched in the corpora, and
    in the folders between the rootdir and the folders of tests. Or pytest met them outside of any corpus, in a corpus
    that the option does not name, or their test file was not collected.
    """
    top = collected.rootpath
    strays: dict[str, tuple[str, bool]] = {}
    tests = {each for folder in collected.folders for each in (folder.parent, folder)}
    for broken in filter(lambda each: not is_folder(each), {*collected.roots, *tests}):
        strays |= {relative(folder, top): (why, True) for folder, why in unlisted_below(broken).items()}
    for root, directory in sorted(collected.roots.items()):
        is_asked_for = _is_asked_for(directory, collected)
        if is_folder(root):
            strays |= {relative(folder, top): (why, is_asked_for) for folder, why in unlisted_below(root).items()}
        modules = modules_in(root)
        tests = {folder for module in modules for folder in modules_in(module)}
        # The walk follows no links, which may lead anywhere. A linked folder of a module or test is only listed.
        below = {Path(each) for each, _, _ in os.walk(root)}
        for folder in sorted({*_up(root, top), *_up(directory, top), *below, *modules, *tests}):
            is_run = folder in collected.folders or folder in orphans or _is_test_folder(folder, root, tests, collected)
            for file in entries_of(folder):
                if is_misnamed(file.name) or name_within(file.name):
                    if not _is_meant_as_saved(file, root):
                        continue
                    why = f"its suffix is not {SUFFIX}; rename it, or move it out of the corpus"
                elif is_run or not file.name.endswith(SUFFIX):
                    continue
                else:
                    place = f"the folder of {_named_test(file) or 'its test'}"
                    why = f"it is in no test's folder; move it to {place}, or delete it"
                name = relative(file, top)
                strays[name] = why, is_asked_for or strays.get(name, ("", False))[1]
    found = (
        _not_fetched(collected),
        _passed_by(collected),
        _in_other_corpora(collected),
        _not_collected(collected),
        strays.items(),
    )
    return dict(chain.from_iterable(found))


def _not_fetched(collected: Collected) -> Iterator[tuple[str, tuple[str, bool]]]:
    """Yield the folders of saved scenarios whose files are still in an archive, a submodule or git, with the reason."""
    top = collected.rootpath
    folders = [folder for folder in collected.folders if folder.parents[1] in collected.roots]  # behind no refused link
    corpora = {root for root, directory in collected.roots.items() if _is_asked_for(directory, collected)}
    corpora |= {folder.parents[1] for folder in folders}
    bottom = {*folders, *(folder.parent for folder in folders), *corpora, *collected.shared}
    places = {place for folder in bottom for place in _up(folder, top) if place != top}
    for parent in sorted({place.parent for place in places}):
        for file in entries_of(parent):
            named = _ARCHIVE.fullmatch(file.name)
            if named and (place := parent / named[1]) in places and not files_below(place):
                why = f"expected the folder of saved scenarios, received only {file.name}; unpack or fetch it"
                yield relative(place, top), (why, True)
    empty = [str(root) for root in sorted(corpora) if root.is_relative_to(top) and not files_below(root)]
    above = Path(os.path.realpath(top))
    if not any(map(os.path.lexists, (each / ".git" for each in (above, *above.parents)))):
        empty = []  # no repository, which git would take some milliseconds of each session to say
    why = "git tracks it, but it is not in this checkout; restore it, or commit that it is gone"
    with suppress(RequestError):  # no git, or no repository
        for path in git(top, "ls-files", "-z", "--", *empty).split("\0") if empty else ():
            if path.endswith(SUFFIX):
                yield path, (why, True)
    for repository in (top, *top.parents):
        with suppress(OSError), open_regular(repository / ".gitmodules") as listing:
            for path in _SUBMODULE.findall(listing.read(MAX_SUBMODULES)):
                place = repository / os.fsdecode(path)
                if place in places and not entries_of(place):
                    why = "expected the files of a git submodule, received none; run git submodule update --init"
                    yield relative(place, top), (why, True)


def _not_collected(collected: Collected) -> Iterator[tuple[str, tuple[str, bool]]]:
    """Yield the saved scenarios whose test file exists and was asked for, but was not collected."""
    # The same file may have two paths, one of them by a link.
    imported = {os.path.realpath(each) for each in collected.files | collected.failed}
    for root, directory in sorted(collected.roots.items()):
        is_asked_for = _is_asked_for(directory, collected)
        for folder in modules_in(root) if is_asked_for or collected.is_of_testpaths else ():
            module = module_named(directory, folder.name)
            if not os.path.lexists(module) or os.path.realpath(module) in imported:
                continue
            name, fails = relative(module, collected.rootpath), False
            if not is_asked_for:
                why = f"the setting testpaths leaves out {name}"
            elif module in collected.skipped:
                why = f"{name} was skipped at import"
            elif collected.is_ignored(module):
                why = f"--ignore or --ignore-glob leaves out {name}"
            else:
                fails = True
                why = (
                    f"pytest did not collect {name}; see python_files and norecursedirs in its settings, and "
                    "collect_ignore in a conftest.py"
                )
            for test in modules_in(folder):
                for file in files_in(test):
                    yield relative(file, collected.rootpath), (why, fails)


def _in_other_corpora(collected: Collected) -> Iterator[tuple[str, tuple[str, bool]]]:
    """Yield the saved scenarios in folders with the default name of a corpus, while the option names another."""
    why = f"the option corpus names another folder, {collected.corpus}; move it there, or correct the option"
    for folder in sorted(collected.others):
        for file in files_below(folder) if _is_asked_for(folder, collected) else ():
            yield relative(file, collected.rootpath), (why, not collected.is_ignored(file))


def _passed_by(collected: Collected) -> Iterator[tuple[str, tuple[str, bool]]]:
    """Yield the saved scenarios of collected test files that pytest met outside of any corpus.

    A file of another test file, such as an example, is not meant, and no copy of a file in its test's folder.
    """
    for file in sorted(collected.passed_by):
        if any(map(file.is_relative_to, collected.roots)) or not _is_asked_for(file, collected):
            continue  # the corpus may be an argument of a mark
        module, _, test = _named_test(file).partition("::")
        test_file = collected.rootpath / module
        if not test or test_file not in collected.files:
            continue
        home = folder_of_test(test_file, test, collected.corpus, collected.rootpath)
        if not collected.is_ignored(file) and not os.path.lexists(home / file.name):
            why = f"it is in no corpus; move it to {relative(home, collected.rootpath)}, or delete it"
            yield relative(file, collected.rootpath), (why, True)


def _is_asked_for(path: Path, collected: Collected) -> bool:
    return any(map(path.is_relative_to, collected.asked_for))


class Guard:
    """The hook that fails a session, on the controller, if no test can replay saved scenarios or run a marked test."""

    def __init__(self) -> None:
        self._ended: set[str] = set()  # node ids of the items that have run
        self._failed: set[str] = set()  # those that have failed, and of new findings

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the items that have run, and which of them have failed."""
        if report.when == "teardown":
            self._ended.add(report.nodeid)
        if report.failed:
            self._failed.add(report.nodeid)

    @pytest.hookimpl(tryfirst=True)  # before the summary and the JSON file are written
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Let no session on CI end with 0, as by ``pytest.exit(returncode=0)``, unless all policies drove well."""
        cause = _cause(session.config)
        driven, unrun = session.config.stash[DRIVEN], session.config.stash[UNRUN]
        left = sorted(driven - self._ended)
        # In a session in which no policy was to drive, tests may fail as its hooks want.
        named = left or (sorted(self._failed) if driven or any(unrun) else [])
        if (
            not cause
            or session.exitstatus != pytest.ExitCode.OK
            or not named
            or session.config.getoption("collectonly")
        ):
            return
        what = "did not run to the end" if left else "failed"
        session.exitstatus = pytest.ExitCode.INTERRUPTED if left else pytest.ExitCode.TESTS_FAILED
        session.config.stash[SUMMARY_LINES].problems.append(
            f"{plural(len(named), 'item')} {what}, {named[0]} first, but the session was to end with the exit code 0, "
            "as by pytest.exit(returncode=0) or a hook pytest_runtest_protocol; it ends with "
            f"{int(session.exitstatus)} ({cause})"
        )

    @pytest.hookimpl(wrapper=True, trylast=True)  # inside of the hook with which pytest ends the line of its results
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """Fail the session after all items have run; only then have all pytest-xdist workers reported their items."""
        result = yield
        for node_id, lines in _errors(session.config).items():
            if lines:
                _report(session, node_id, list(map(visible, lines)))
        return result


def _cause(config: pytest.Config) -> str:
    """Return why a session must not pass if something was not tested; empty if it may."""
    strict = BY_NAME["strict_health"]
    return "CI is set" if is_ci(os.environ) else strict.flag if value_if_right(config, strict.name) else ""


def _errors(config: pytest.Config) -> dict[str, list[str]]:
    """Return the lines of each error of the session that say why it fails; no lines if it does not fail.

    After the reason, each affected file and its test is named, and then what the user can do about it.
    """
    unrun = config.stash[UNRUN]
    errors: dict[str, list[str]] = {}
    cause, allow = _cause(config), BY_NAME["allow_orphans"]
    if not cause or config.getoption("collectonly"):
        return errors
    unnamed = [f"pytest does not collect {plural(len(unrun.unnamed), 'test')} with a mark of pafot ({cause}):"]
    for name, why in sorted(unrun.unnamed.items()):
        unnamed += [name, f"  {why}"]
    unnamed.append("  rename or move it, or set its __test__ to False if it is no test")
    errors[UNNAMED_ID] = unnamed if unrun.unnamed else []
    if value_if_right(config, allow.name):
        return errors
    gone = {folder: orphan for folder, orphan in unrun.orphans.items() if orphan.is_gone}
    lines = []
    if gone:
        counts = plural(sum(len(files_in(folder)) for folder in gone), "saved scenario")
        lines.append(f"the test of {counts} is gone ({cause}; {allow.flag} lets it pass):")
        for folder, orphan in gone.items():
            lines += [*(relative(file, config.rootpath) for file in files_in(folder)), f"  {orphan.expected}"]
        lines.append(f"  {ADVICE}")
    strays = {file: why for file, (why, fails) in sorted(unrun.strays.items()) if fails}
    if strays:
        lines.append(f"no test replays {plural(len(strays), 'saved scenario')} ({cause}; {allow.flag} lets it pass):")
        for file, why in strays.items():
            lines += [file, f"  {why}"]
    return {**errors, ERROR_ID: lines}


def _report(session: pytest.Session, node_id: str, lines: Sequence[str]) -> None:
    """Report the session's error like the error of an item, so that it is counted, also in files for other tools."""
    try:
        pytest.fail("\n".join(lines), pytrace=False)
    except pytest.fail.Exception as error:
        longrepr = pytest.ExceptionInfo.from_exception(error).getrepr(style="value")
        crash = getattr(longrepr, "reprcrash", None)
        if crash is not None:  # This line is also the one in the short summary, so it names the first file.
            crash.message = " ".join(lines[:2])
    manager = session.config.pluginmanager
    # Do not inform --lf and --sw: they would wait for an item of this name, which the next session does not collect.
    rerunning = [manager.get_plugin(name) for name in ("lfplugin", "stepwiseplugin")]
    log = manager.subset_hook_caller("pytest_runtest_logreport", rerunning)
    place = ("pafot", None, node_id.partition("::")[2])
    report = partial(pytest.TestReport, nodeid=node_id, location=place, keywords={})
    session.testscollected += 1
    log(report=report(outcome="failed", longrepr=longrepr, when="setup"))
    log(report=report(outcome="passed", longrepr=None, when="teardown"))


def _shared(root: Path, collected: Collected) -> Path | None:
    """Return the shared corpus to which a corpus belongs; None if it is next to its test files."""
    return next((each for each in sorted(collected.shared) if root.is_relative_to(each)), None)


def _is_test_folder(folder: Path, root: Path, tests: Collection[Path], collected: Collected) -> bool:
    """Return whether a folder has the depth at which a test's folder is, also that of a test which was left out."""
    shared = _shared(root, collected)
    if shared is None:
        return folder in tests
    if not folder.is_relative_to(shared) or len(folder.parts) < len(shared.parts) + 2:
        return False
    # A deeper folder may be that of a test file in a deeper folder, which this session did not collect.
    directory = collected.rootpath / folder.parents[1].relative_to(shared)
    return os.path.lexists(module_named(directory, folder.parent.name))


def _is_meant_as_saved(file: Path, root: Path) -> bool:
    """Return whether a file with another suffix is a saved scenario: by its name, or in a corpus by its content."""
    if original := name_within(file.name):  # not a backup, whose original is next to it, and not any other file
        is_alone = not os.path.lexists(file.with_name(original)) and file.is_relative_to(root)
        return is_alone and (file.suffix in PACKED or bool(_named_test(file)))
    return ".pafot." in file.name.lower() or (file.is_relative_to(root) and bool(_named_test(file)))


def _is_orphan(folder: Path, directory: Path, collected: Collected) -> bool:
    if folder in collected.folders:
        return False
    module = module_named(directory, folder.parent.name)
    if not os.path.lexists(module):  # lexists, because it returns False for a name that is too long, and does not raise
        return True
    if module not in collected.files:
        return False
    named = next(filter(None, map(_named_test, files_in(folder))), "")
    prefix = relative(module, collected.rootpath)
    for name in named.partition("[")[0].split("::")[1:-1]:  # the classes around the test
        prefix = f"{prefix}::{name}"
        if prefix not in collected.classes:
            return True
        if prefix not in collected.opened:
            return False  # Its members were not collected, because another node id was requested.
    return True


def _orphan(folder: Path, root: Path, directory: Path, collected: Collected) -> Orphan:
    """Describe an orphaned folder: which test is gone."""
    module = module_named(directory, folder.parent.name)
    file = relative(module, collected.rootpath)
    saved = saved_in(folder) if link_below(root, folder) is None else []
    named = next((name for name in map(_test_of, saved) if _is_folder_of(folder, name)), "")
    name = named.partition("::")[2] or folder.name
    there, is_gone = f"no file {file}", True
    # The tests of a module that is gone run in no session, whichever folder this one was asked for.
    is_asked_for = not os.path.lexists(module) or _is_asked_for(module, collected)
    if os.path.lexists(module):
        same_test = [
            each
            for each, test in collected.folders.items()
            if test.startswith(f"{file}::") and may_be_of(folder.name, test.removeprefix(f"{file}::").partition("[")[0])
        ]
        there = f"{file} without {'these parameters' if same_test else 'this search'}"
        # A parameter may be removed. But if no file of the test is replayed, its parameters were renamed.
        is_gone = not any(map(files_in, same_test))
    return Orphan(
        expected=f"expected the test {file}::{name:.{MAX_NAME}}, received {there}: it was renamed, moved or deleted",
        is_gone=is_gone and is_asked_for,
    )


def _is_folder_of(folder: Path, name: str) -> bool:
    """Return whether the names of a folder and of the folder above it are those of a test and its module."""
    module, _, test = name.partition("::")
    return (safe_name(Path(module).stem), safe_name(test)) == (folder.parent.name, folder.name)


def _test_of(saved: Saved) -> str:
    """Return the node id of the test that a saved scenario names; empty if the scenario names no test."""
    return _named_test(saved.path) if saved.finding is None else saved.finding.test


def _named_test(file: Path) -> str:
    """Return the node id of the test that a file names, even if the file is broken; empty if the file names no test."""
    from pytest_pafot.corpus.reader import content_of  # noqa: PLC0415  (yaml, which few sessions need)
    from pytest_pafot.support.errors import CorpusError  # noqa: PLC0415

    try:
        line = _TEST_LINE.search(content_of(file))
    except CorpusError:
        return ""
    return line.group(1).decode("utf-8", "replace").strip("'\"") if line else ""


def _up(folder: Path, top: Path) -> Iterator[Path]:
    """Yield a folder and the folders above it up to ``top``; only the folder itself if it is not below ``top``."""
    yield folder
    if folder.is_relative_to(top):
        yield from (each for each in folder.parents if each.is_relative_to(top))
