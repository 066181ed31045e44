"""Collection: each marked test becomes one item for its search, and one item for each of its saved scenarios."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from datetime import date
from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from pytest_pafot.campaign.options import BY_NAME, OF_COMMAND
from pytest_pafot.corpus import layout
from pytest_pafot.plugin.marks import (
    DEFAULT_ARG,
    MARKED,
    SAVED_MARK,
    SEARCH_MARK,
    arguments_of,
    base_id,
    is_driven,
    qualified_name,
    saved_part,
)
from pytest_pafot.plugin.option_sources import resolve, value_if_right
from pytest_pafot.plugin.session import SHARED, SUMMARY_LINES, UNRUN, Collected, Unrun, base_line

if TYPE_CHECKING:
    from pytest_pafot.campaign.request import Request
    from pytest_pafot.corpus.saved import Saved
    from pytest_pafot.plugin.uncollected import Left

COLLECTED: pytest.StashKey[dict[Path, dict[str, Saved]]] = pytest.StashKey()
"""The saved scenarios that existed when the session collected its items, by folder and file name."""

REQUEST: pytest.StashKey[Request] = pytest.StashKey()
"""What the mark and the options of an item ask for, once they are checked."""

SEARCH = "search"  # a placeholder for the argument of an item, which a simulated run replaces


def accept_files(config: pytest.Config) -> tuple[set[Path], set[Path]]:
    """Replace corpus files, and folders of a corpus, on the command line by the test files that replay them.

    Return the corpus files, and the test files that the command line did not name itself.
    """
    folders = {arg: layout.files_below(_given_path(config, arg)) for arg in config.args if _is_in_corpus(config, arg)}
    given = [arg for arg in config.args if arg.endswith(layout.SUFFIX) or folders.get(arg)]
    if not given:
        return set(), set()
    others = [_given_path(config, arg).resolve() for arg in config.args if arg not in given]
    paths = [path for arg in given for path in folders.get(arg) or [config.invocation_params.dir / arg]]
    files = [path.parent.resolve() / path.name for path in paths]  # not resolved: a link has its own item
    modules = dict.fromkeys(_module_of(file, config) for file in files)
    added = [module for module in modules if not any(other in (module, *module.parents) for other in others)]
    config.args[:] = [*(arg for arg in config.args if arg not in given), *map(str, added)]
    return set(files), set(added)


class Collection:
    """Hooks that create the items of searches and saved scenarios, filter them and order them."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._rootpath = config.rootpath
        self._given_files, self._modules_for_them = accept_files(config)
        self._collected = Collected(config.rootpath)
        self._corpora: set[Path] = set()  # the corpora found while pytest looked for test files
        self._others: set[Path] = set()  # those of the default name, where the option gives another
        self._passed_by: set[Path] = set()  # the saved scenarios outside of corpora
        self._saved = config.stash.setdefault(COLLECTED, {})
        self._listed: dict[Path, layout.TestFolders] = {}
        self._left_out: list[Left] = []  # what is marked and pytest has not collected
        self._deselected: set[pytest.Item] = set()
        config.stash[UNRUN] = Unrun({}, {}, {})

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Ignore everything in a corpus folder, also files that are named like tests: they are data."""
        folders = [collection_path, *collection_path.parents]
        if not any(self._is_corpus(folder) for folder in folders):
            # Noted before pytest passes by the folder, such as one named build: what is in it has a test next to it.
            if self._corpus is not None and os.path.lexists(beside := collection_path / self._corpus):
                self._corpora.add(beside)
            if collection_path.name.endswith(layout.SUFFIX):
                self._passed_by.add(collection_path)
            return None
        # Noted here, because all tests next to it may be gone, and then no item leads to it.
        if self._corpus is not None and layout.is_corpus(collection_path, self._corpus):
            self._corpora.add(collection_path)
        elif collection_path.name == layout.CORPUS:
            self._others.add(collection_path)
        return True

    def _is_ignored(self, path: Path) -> bool:
        """Return whether ``--ignore`` or ``--ignore-glob`` leaves out a path or a folder above it."""
        ignored = {_given_path(self._config, each) for each in self._config.getoption("ignore") or ()}
        globs = [str(_given_path(self._config, each)) for each in self._config.getoption("ignore_glob") or ()]
        return any(each in ignored or any(fnmatch(str(each), glob) for glob in globs) for each in (path, *path.parents))

    def _is_corpus(self, folder: Path) -> bool:
        """Return whether a folder is a corpus.

        The rootdir and the folders above it are no corpora. A folder given on the command line is a corpus only if it
        has the default name.
        """
        if folder.name == layout.CORPUS:
            return not self._rootpath.is_relative_to(folder)
        return self._corpus is not None and layout.is_corpus(folder, self._corpus) and folder not in self._asked_for

    @cached_property
    def _corpus(self) -> Path | None:
        name = self._corpus_name
        return Path(name) if name and Path(name).name else None

    @cached_property
    def _corpus_name(self) -> str | None:
        return value_if_right(self._config, "corpus")  # type: ignore[no-any-return]

    @cached_property
    def _asked_for(self) -> set[Path]:
        """The rootdir, the folders given on the command line, and all folders above them."""
        folders = [self._rootpath, *self._folders_given]
        return {each for folder in folders for each in (folder, *folder.parents)}

    @property
    def _folders_given(self) -> list[Path]:
        """The folders given on the command line, without files and tests."""
        given = (_given_path(self._config, arg) for arg in self._config.args)
        return [path for path in given if path.is_dir()]

    @pytest.hookimpl(trylast=True)  # so that its part of the name is behind those of the user's marks: test_x[1-search]
    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Parametrize a marked test function with its search, then with each saved scenario that may belong to it."""
        arguments = arguments_of(metafunc.definition)
        if arguments is None:
            return
        arg = arguments.get("arg", DEFAULT_ARG)
        if arg not in metafunc.fixturenames or is_parametrised(metafunc, arg):
            return  # One item is left. It reports what is wrong when it is set up.
        # The values differ, because other tools tell items apart by them. Nothing else reads them.
        saved = [
            pytest.param(part := saved_part(each.id), id=part, marks=[getattr(pytest.mark, SAVED_MARK)(each)])
            for each in self._saved_by_id(metafunc.definition)
        ]
        metafunc.parametrize(arg, [pytest.param(SEARCH, id=layout.SEARCH_PART), *saved])

    def _saved_by_id(self, definition: pytest.Item) -> Iterable[Saved]:
        """Return the saved scenarios of a test in all its parametrisations, one scenario per id."""
        corpus = self._corpus_name
        if corpus is None:
            return []
        module_folder = layout.folder_of_module(definition.path, corpus, self._rootpath)
        name = qualified_name(definition)
        chosen = layout.chosen_folder(definition.path, corpus)
        link = layout.link_out(chosen, module_folder.parent, self._rootpath)
        from pytest_pafot.corpus.saved import refused_in, saved_in  # noqa: PLC0415  (few sessions have searches)

        found: dict[str, Saved] = {}
        if module_folder not in self._listed:
            self._listed[module_folder] = layout.TestFolders(module_folder)
        for folder in self._listed[module_folder].of(name):
            if folder not in self._saved:
                read = saved_in(folder) if link is None else refused_in(folder, link)
                self._saved[folder] = {saved.path.name: saved for saved in read}
            found |= {saved.id: saved for saved in self._saved[folder].values()}
        return found.values()

    @pytest.hookimpl(wrapper=True, trylast=True)  # inside of that of --lf, which leaves out tests that have passed
    def pytest_make_collect_report(
        self, collector: pytest.Collector
    ) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
        """Note what became of every module, also of one in which no test is left, and marks that nothing collects."""
        report = yield
        if type(collector).__module__ == "_pytest.doctest":  # a module with examples, which may also be a test file
            return report
        if not report.result and self._config.pluginmanager.has_plugin("lfplugin-collskip"):
            self._collected.failed.add(collector.path)  # --lf has passed by the file, without an import
            return report
        if isinstance(collector, pytest.Module):
            collected = self._collected
            noted = {"passed": collected.files, "skipped": collected.skipped, "failed": collected.failed}
            noted[report.outcome].add(collector.path)
        is_own = type(collector) in (pytest.Module, pytest.Class)  # those of other plugins may have no object
        if MARKED and is_own and isinstance(collector, pytest.Module | pytest.Class) and report.passed:
            from pytest_pafot.plugin.uncollected import left_out, replaced_in  # noqa: PLC0415  (few sessions mark any)

            self._left_out += left_out(collector, report.result)
            if isinstance(collector, pytest.Module):
                self._config.stash[UNRUN].unnamed.update(replaced_in(collector))
        return report

    @pytest.hookimpl(wrapper=True)
    def pytest_pycollect_makeitem(self, collector: pytest.Collector) -> Generator[None, Any, Any]:
        """Drop items whose saved scenario belongs to other parameters of the same test."""
        made = yield
        # Note every class, even one whose members are dropped: an orphan's test may be gone together with its class.
        if isinstance(collector, pytest.Class):
            self._collected.opened.add(collector.nodeid)
        if isinstance(made, pytest.Class):
            self._collected.classes.add(made.nodeid)
        if not isinstance(made, list):
            return made
        return [item for item in made if self._belongs(item)]

    def _belongs(self, item: pytest.Item) -> bool:
        """Return whether an item is collected: a saved scenario only together with the parameters of its test."""
        if arguments_of(item) is None:
            return True
        corpus, folder = self._corpus_name, None
        if corpus is not None:
            folder = layout.folder_of_test(item.path, qualified_name(item), corpus, self._rootpath)
            self._collected.folders[folder] = base_id(item)
            self._collected.roots[folder.parents[1]] = item.path.parent
        mark = item.get_closest_marker(SAVED_MARK)
        if mark is None:
            return True
        saved = None if folder is None else self._saved.get(folder, {}).get(mark.args[0].path.name)
        frozen = self._config.stash[SHARED].frozen
        if saved is None or (frozen is not None and item.nodeid not in frozen):
            return False  # a new file is dropped, since pytest-xdist ends a session whose workers differ in their items
        # Only now are the parameters known, and with them the one file that the item replays.
        item.add_marker(getattr(pytest.mark, SAVED_MARK)(saved), append=False)
        if saved.is_accepted(date.fromisoformat(self._config.stash[SHARED].today)):
            from pytest_pafot.support.text import visible  # noqa: PLC0415  (few sessions have one)

            item.add_marker(pytest.mark.xfail(strict=True, reason=visible(saved.xfail or "")), append=False)
        return True

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> Generator[None, None, None]:
        """Find the saved scenarios that no item runs, before tests are selected; drop unneeded searches afterwards."""
        if MARKED:
            from pytest_pafot.plugin.uncollected import beside_test_files, is_base  # noqa: PLC0415  (as above)

            self._left_out += beside_test_files(self._config, self._folders_given, items)
            # Asked now, since a later module may have derived from a class of an earlier one.
            unnamed = {left.name: left.why for left in self._left_out if not is_base(left.member)}
            self._config.stash[UNRUN].unnamed.update(unnamed)
        self._find_unrun(items)
        self._deselect(items, self._is_beside_given)
        driven = [item for item in items if is_driven(item)]
        yield
        dropped = set(driven) - {*items, *self._deselected}
        why = "a hook pytest_collection_modifyitems leaves it out and does not call pytest_deselected"
        self._config.stash[UNRUN].strays.update((base_id(item), (why, False)) for item in driven if item in dropped)
        # Under --lf, a search need not run again if its findings have become items since.
        if self._config.getoption("lf", False) and getattr(self._config, "cache", None) is not None:
            failed = self._config.cache.get("cache/lastfailed", {})
            known = {base_id(item) for item in items if saved_of(item) is not None and item.nodeid in failed}
            self._deselect(items, lambda item: is_search(item) and item.nodeid in failed and base_id(item) in known)

    def pytest_deselected(self, items: Sequence[pytest.Item]) -> None:
        """Note the items that pytest counts as deselected; it says nothing of those that are left out otherwise."""
        self._deselected.update(items)

    def _find_unrun(self, items: list[pytest.Item]) -> None:
        corpus = self._corpus_name
        roots = dict(self._collected.roots)
        if corpus is not None:
            files = {item.path.parent: item.path for item in items}
            roots |= {layout.corpus_root(file, corpus, self._rootpath): directory for directory, file in files.items()}
            if Path(corpus).is_absolute():
                self._collected.shared.add(Path(corpus))
            met = [each for each in sorted(self._corpora) if any(map(each.is_relative_to, self._folders_given))]
            if not Path(corpus).is_absolute():
                # A test that was moved into a folder given here may have left its corpus behind, above that folder.
                above = {each for folder in self._folders_given for each in folder.parents}
                met += [each / corpus for each in sorted(above) if each.is_relative_to(self._rootpath)]
                if self._config.args_source is pytest.Config.ArgsSource.TESTPATHS:
                    met += [each for each in self._corpora_outside(corpus) if each not in {*roots, *met}]
            if is_outside := not Path(self._rootpath, corpus).is_relative_to(self._rootpath):
                met = [Path(corpus)]  # pytest looks for no test files there
            roots = {
                root: directory
                for root, directory in _roots_in(met, Path(corpus), self._rootpath)
                if not is_outside or any(map(directory.is_relative_to, self._folders_given))
            } | roots
        if corpus is not None and Path(corpus).is_absolute() and not os.path.lexists(corpus):
            settings = resolve(self._config, {})
            if items and not settings.is_search:  # A search makes the folder.
                why = "expected the folder of the option corpus, which does not exist, so nothing is replayed"
                self._config.stash[UNRUN].strays[corpus] = why, False  # A policy that never failed has none.
        links = {root: layout.link_out(directory, root, self._rootpath) for root, directory in roots.items()}
        for link in sorted(set(filter(None, links.values()))):  # A link is refused before its target is listed.
            from pytest_pafot.corpus.saved import refusal  # noqa: PLC0415  (few projects have any)

            self._config.stash[SUMMARY_LINES].problems.append(refusal(link))
        roots = {root: directory for root, directory in roots.items() if links[root] is None}
        collected = self._collected
        if not collected.roots and not any(map(os.path.lexists, roots)):
            if not items:  # such as a corpus with another name, alone
                folders = {file.parent for file in self._passed_by if not self._is_ignored(file)}
                corpus = BY_NAME["corpus"].flag
                why = (
                    f"no test that replays it was collected; name its test file, and {corpus}= if it is not next to it"
                )
                strays = {layout.relative(folder, self._rootpath): (why, False) for folder in folders}
                self._config.stash[UNRUN].strays.update(strays)
            return
        collected.roots, collected.asked_for = roots, self._folders_given
        collected.corpus, collected.others = corpus or layout.CORPUS, self._others - roots.keys()
        collected.passed_by, collected.is_ignored = self._passed_by, self._is_ignored
        collected.is_of_testpaths = self._config.args_source is pytest.Config.ArgsSource.TESTPATHS
        if OF_COMMAND in os.environ:
            return  # The command asks for one test, which has no file. All others of the project are not collected.
        from pytest_pafot.plugin.orphans import find_orphans, find_strays  # noqa: PLC0415  (few projects have any)

        unrun = self._config.stash[UNRUN]
        unrun.orphans.update(find_orphans(collected))
        unrun.strays.update(find_strays(collected, unrun.orphans))

    def _corpora_outside(self, corpus: str) -> Iterator[Path]:
        """Yield the corpora in the rootdir, up to four folders deep, whatever ``testpaths`` names."""
        passed_by, top = self._config.getini("norecursedirs"), len(self._rootpath.parts)
        for name, below, _ in os.walk(self._rootpath):  # which looks at no file, and follows no link
            if layout.is_folder(found := Path(name, corpus)):
                yield found
            is_deep = len(Path(name).parts) - top >= 4
            below[:] = (
                []
                if is_deep
                else sorted(each for each in below if not any(fnmatch(each, pattern) for pattern in passed_by))
            )

    def _is_beside_given(self, item: pytest.Item) -> bool:
        """Return whether an item's module was collected only to replay a corpus file, which is not the item's file."""
        saved = saved_of(item)
        return item.path in self._modules_for_them and (saved is None or saved.path not in self._given_files)

    def _deselect(self, items: list[pytest.Item], is_dropped: Callable[[pytest.Item], bool]) -> None:
        dropped = list(filter(is_dropped, items))
        if dropped:
            self._config.hook.pytest_deselected(items=dropped)
            gone = set(dropped)
            items[:] = [item for item in items if item not in gone]

    def pytest_report_collectionfinish(self, items: list[pytest.Item]) -> str | None:
        """Return the line after collection: how many items are searches, and how many replay saved scenarios."""
        searches = sum(map(is_search, items))
        saved = sum(saved_of(item) is not None for item in items)
        if not searches and not saved:
            return None
        counts = f"{searches} search{'' if searches == 1 else 'es'}, {saved} saved scenario{'' if saved == 1 else 's'}"
        # pytest rewrites the assertions of test files, conftest.py and plugins, so that they run all the same.
        off = "" if __debug__ else "python -O: assertions in modules that pytest does not rewrite are off"
        return "; ".join(filter(None, (f"pafot: {counts}", base_line(self._config), off)))


def is_search(item: pytest.Item) -> bool:
    """Return whether an item is a search; False for replays and for tests without a mark."""
    return item.get_closest_marker(SEARCH_MARK) is not None and item.get_closest_marker(SAVED_MARK) is None


def saved_of(item: pytest.Item) -> Saved | None:
    """Return the saved scenario that an item replays; None if the item is no replay."""
    mark = item.get_closest_marker(SAVED_MARK)
    if mark is None:
        return None
    from pytest_pafot.corpus.saved import Saved  # noqa: PLC0415  (few sessions have one)

    return mark.args[0] if mark.args and isinstance(mark.args[0], Saved) else None


def policy_of(item: pytest.Item) -> Callable[..., Any]:
    """Return the ADS factory of a search or a replay, once pytest has set up its fixtures.

    Raises:
        RequestError: if the fixture of the policy returns no factory.
    """
    from pytest_pafot.campaign.harness import checked_factory  # noqa: PLC0415

    ads = item.stash[REQUEST].ads
    return checked_factory(item.funcargs[ads], ads) if isinstance(ads, str) else ads  # type: ignore[attr-defined]


def is_parametrised(metafunc: pytest.Metafunc, arg: str) -> bool:
    """Return whether the user has parametrized a test function with an argument."""
    for mark in metafunc.definition.iter_markers("parametrize"):
        names = mark.args[0] if mark.args else mark.kwargs.get("argnames", ())
        if arg in ([name.strip() for name in names.split(",")] if isinstance(names, str) else names):
            return True
    return False


def _given_path(config: pytest.Config, arg: str) -> Path:
    """Return the path in a command-line argument such as ``file.py::test``, without the names of tests."""
    return Path(os.path.normpath(config.invocation_params.dir / arg.split("::", 1)[0]))


def _roots_in(corpora: Iterable[Path], corpus: Path, rootpath: Path) -> Iterator[tuple[Path, Path]]:
    """Yield each corpus to check for orphans, with the folder of the test files to which the corpus belongs."""
    for met in corpora:
        if not corpus.is_absolute():
            yield met, met.parents[len(corpus.parts) - 1]
            continue
        for root in {folder.parents[1] for folder in layout.folders_below(met)}:
            if root.is_relative_to(met):
                yield root, rootpath / root.relative_to(met)


def _is_in_corpus(config: pytest.Config, arg: str) -> bool:
    """Return whether a folder on the command line is a corpus with the default name, or in one."""
    path = _given_path(config, arg)
    names = path.relative_to(config.rootpath).parts if path.is_relative_to(config.rootpath) else ()
    return layout.CORPUS in names and path.is_dir()


def _module_of(file: Path, config: pytest.Config) -> Path:
    from pytest_pafot.support.text import visible  # noqa: PLC0415  (few sessions are given such a file)

    if not file.is_file():
        raise pytest.UsageError(f"{visible(str(file))}: expected the file of a saved scenario, but it does not exist")
    corpus = value_if_right(config, "corpus")
    module = None if corpus is None else layout.module_of_file(file, corpus, config.rootpath)
    if module is None or not module.is_file():
        where = "its folder is not in a corpus" if module is None else f"{module} does not exist"
        problem = f"{file}: expected a saved scenario of a test file, but {where}"
        raise pytest.UsageError(f"{visible(problem)}; move the folder to where the test is now")
    return module
