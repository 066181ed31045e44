"""Items: one for the search of each marked test, then one for each of its saved scenarios."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot.campaign.options import BY_NAME
from pytest_pafot.corpus import layout
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.plugin import node_ids
from pytest_pafot.plugin.marks import DEFAULT_ARG, SAVED_MARK, SEARCH_MARK, arguments_of
from pytest_pafot.plugin.node_ids import Candidates
from pytest_pafot.plugin.options import corpus_name
from pytest_pafot.plugin.session import EXPLICIT, SEARCH_PART, SHARED, Explicit, Seen, base_line

ORPHANS = pytest.StashKey[dict[Path, list[Path]]]()
"""Folders of saved scenarios whose test is gone, each with the files that may be removed."""

STRAYS = pytest.StashKey[dict[str, str]]()
"""Where saved scenarios that lie in no folder of a test should be."""

SEARCH = "search"
"""The argument of an item, until a simulated run takes its place."""


def accept_files(config: pytest.Config) -> None:
    """Let corpus files be given on the command line: their test files are collected, and filtered later."""
    given = [arg for arg in config.args if arg.endswith(layout.SUFFIX)]
    if not given:
        return
    explicit = config.stash[EXPLICIT] = Explicit()
    others = [(config.invocation_params.dir / _without_ids(arg)).resolve() for arg in config.args if arg not in given]
    added: list[str] = []
    for arg in given:
        file = (config.invocation_params.dir / arg).resolve()
        module = _module_of(file, config)
        explicit.files.add(file)
        if not any(other in (module, *module.parents) for other in others):
            explicit.modules.add(module)
            added.append(str(module))
    config.args[:] = [*(arg for arg in config.args if arg not in given), *dict.fromkeys(added)]


class Collection:
    """Hooks that make, filter and order the items."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._seen = Seen()

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """What lies in a corpus is data, whatever its name."""
        folders = [collection_path, *collection_path.parents]
        return True if any(self._is_corpus(folder) for folder in folders) else None

    def _is_corpus(self, folder: Path) -> bool:
        """What pytest runs in is none, nor, but by the usual name, what it was asked for."""
        if folder.name == BY_NAME["corpus"].default:
            return not self._config.rootpath.is_relative_to(folder)
        return self._corpus is not None and layout.is_corpus(folder, self._corpus) and folder not in self._asked_for

    @cached_property
    def _corpus(self) -> Path | None:
        name = corpus_name(self._config, {})
        return Path(name) if name and Path(name).name else None

    @cached_property
    def _asked_for(self) -> set[Path]:
        """Folders that the rootdir or an argument is, or lies in."""
        given = [self._config.invocation_params.dir / _without_ids(arg) for arg in self._config.args]
        folders = [self._config.rootpath, *(path for path in given if path.is_dir())]
        return {each for folder in folders for each in (folder, *folder.parents)}

    @pytest.hookimpl(trylast=True)
    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """The search first, then every file that may belong to an item of the function."""
        arguments = arguments_of(metafunc.definition)
        if arguments is None:
            return
        arg = arguments.get("arg", DEFAULT_ARG)
        if arg not in metafunc.fixturenames or _is_parametrised(metafunc, arg):
            return  # The one item that this leaves says what is wrong when it is set up.
        saved = [_param(candidates) for candidates in node_ids.by_id(self._saved(metafunc, arguments))]
        metafunc.parametrize(arg, [pytest.param(SEARCH, id=SEARCH_PART), *saved])

    @pytest.hookimpl(wrapper=True)
    def pytest_pycollect_makeitem(self, collector: pytest.Collector) -> Generator[None, Any, Any]:
        """Drop the combinations of parameters and files that do not belong together."""
        made = yield
        if isinstance(collector, pytest.Class):
            self._seen.opened.add(collector.nodeid)
        if isinstance(made, pytest.Class):
            self._seen.classes.add(made.nodeid)
        if not isinstance(made, list):
            return made
        return [item for item in made if self._belongs(item)]

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> Generator[None, None, None]:
        """Find what no item runs before any selection, drop known searches after all."""
        self._left_over(items)
        _keep_explicit(config, items)
        yield
        _drop_known_searches(config, items)

    def pytest_report_collectionfinish(self, items: list[pytest.Item]) -> str | None:
        """How many items are searches and replays."""
        searches = sum(is_search(item) for item in items)
        saved = sum(saved_of(item) is not None for item in items)
        if not searches and not saved:
            return None
        counts = f"{_count(searches, 'search', 'searches')}, {_count(saved, 'saved scenario', 'saved scenarios')}"
        base = base_line(self._config)
        return f"pafot: {counts}; {base}" if base else f"pafot: {counts}"

    def _belongs(self, item: pytest.Item) -> bool:
        """Whether an item is to be kept: files belong to one parametrisation, and others drop out here."""
        arguments = arguments_of(item)
        if arguments is None:
            return True
        folder = self._folder(item, arguments)
        if folder is not None:
            self._seen.folders.add(folder)
            self._seen.roots[folder.parents[1]] = item.path.parent
        mark = item.get_closest_marker(SAVED_MARK)
        if mark is None:
            return True
        frozen = self._config.stash[SHARED].frozen
        saved = mark.args[0].files.get(folder)
        if saved is None or (frozen is not None and item.nodeid not in frozen):
            return False
        _mark(item, saved)
        return True

    def _left_over(self, items: list[pytest.Item]) -> None:
        """Find the saved scenarios that no item runs."""
        corpus, rootpath = corpus_name(self._config, {}), self._config.rootpath
        roots = dict(self._seen.roots)
        if corpus is not None:
            files = {item.path.parent: item.path for item in items}
            roots |= {layout.corpus_root(file, corpus, rootpath): directory for directory, file in files.items()}
        if not self._seen.roots and not any(root.is_dir() for root in roots):
            return
        from pytest_pafot.plugin import orphans, strays  # noqa: PLC0415

        collected = {item.path for item in items}
        gone = self._config.stash[ORPHANS] = orphans.find(self._seen, roots, collected, rootpath)
        self._config.stash[STRAYS] = {
            layout.relative(file, rootpath): strays.home(file, self._seen, collected, rootpath)
            for file in strays.find(roots, {*self._seen.folders, *gone}, rootpath)
        }

    def _folder(self, item: pytest.Item, arguments: dict[str, Any]) -> Path | None:
        corpus = corpus_name(self._config, arguments)
        return None if corpus is None else node_ids.folder_of_item(item, corpus, self._config.rootpath)

    def _saved(self, metafunc: pytest.Metafunc, arguments: dict[str, Any]) -> list[Saved]:
        """Every file that may belong to an item of the function, in the order of folders and ids."""
        corpus = corpus_name(self._config, arguments)
        if corpus is None:
            return []
        module_folder = layout.folder_of_module(metafunc.definition.path, corpus, self._config.rootpath)
        return node_ids.read_saved(module_folder, metafunc.definition)


def is_search(item: pytest.Item) -> bool:
    """Whether an item is the search itself."""
    return item.get_closest_marker(SEARCH_MARK) is not None and item.get_closest_marker(SAVED_MARK) is None


def saved_of(item: pytest.Item) -> Saved | None:
    """The saved scenario that an item replays, or None."""
    mark = item.get_closest_marker(SAVED_MARK)
    if mark is None or not mark.args or not isinstance(mark.args[0], Saved):
        return None
    return mark.args[0]


def _param(candidates: Candidates) -> Any:
    mark = getattr(pytest.mark, SAVED_MARK)(candidates)
    return pytest.param(SEARCH, id=node_ids.saved_part(candidates.id), marks=[mark])


def _mark(item: pytest.Item, saved: Saved) -> None:
    """Now that the parameters are known, so is the one file that the item replays."""
    item.add_marker(getattr(pytest.mark, SAVED_MARK)(saved), append=False)
    if saved.xfail is not None:
        item.add_marker(pytest.mark.xfail(strict=True, reason=saved.xfail), append=False)


def _is_parametrised(metafunc: pytest.Metafunc, arg: str) -> bool:
    for mark in metafunc.definition.iter_markers("parametrize"):
        names = mark.args[0] if mark.args else mark.kwargs.get("argnames", ())
        if arg in ([name.strip() for name in names.split(",")] if isinstance(names, str) else names):
            return True
    return False


def _keep_explicit(config: pytest.Config, items: list[pytest.Item]) -> None:
    explicit = config.stash.get(EXPLICIT, None)
    if explicit is None:
        return

    def is_kept(item: pytest.Item) -> bool:
        saved = saved_of(item)
        return item.path not in explicit.modules or (saved is not None and saved.path in explicit.files)

    _deselect(config, items, [item for item in items if not is_kept(item)])


def _drop_known_searches(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Under ``--lf``, a search that failed by finds which are items by now need not run again."""
    if not config.getoption("lf", False) or getattr(config, "cache", None) is None:
        return
    failed = config.cache.get("cache/lastfailed", {})
    bases = {node_ids.base_id(item) for item in items if saved_of(item) is not None and item.nodeid in failed}
    known = [item for item in items if is_search(item) and item.nodeid in failed and node_ids.base_id(item) in bases]
    _deselect(config, items, known)


def _deselect(config: pytest.Config, items: list[pytest.Item], dropped: Iterable[pytest.Item]) -> None:
    gone = list(dropped)
    if gone:
        config.hook.pytest_deselected(items=gone)
        ids = set(map(id, gone))
        items[:] = [item for item in items if id(item) not in ids]


def _module_of(file: Path, config: pytest.Config) -> Path:
    if not file.is_file():
        raise pytest.UsageError(f"{file}: expected a saved scenario, found no such file")
    corpus = corpus_name(config, {})
    module = None if corpus is None else layout.module_of_file(file, corpus, config.rootpath)
    if module is None or not module.is_file():
        where = "its folder does not lie in a corpus" if module is None else f"{module} does not exist"
        raise pytest.UsageError(
            f"{file}: expected a saved scenario of a test file, but {where}; move the folder to where the test is now"
        )
    return module


def _without_ids(arg: str) -> str:
    return arg.split("::", 1)[0]


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"
