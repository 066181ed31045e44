"""The collection of items: one for each marked test's search, and one for each saved scenario.

Every test file that uses the plugin imports this module, so the module itself imports little.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar, Unpack, overload
from weakref import WeakKeyDictionary

import pytest

from pytest_pafot.corpus import layout
from pytest_pafot.plugin.session import (
    GIVEN,
    INVENTORY,
    SHARED,
    Inventory,
    base_line,
    call_of,
    cost_line,
    path_of,
    value_if_right,
)

if TYPE_CHECKING:
    from pytest_pafot.corpus.reader import Saved
    from pytest_pafot.searches.request import Request, SearchArguments


SEARCH_MARK = "pafot_search"
SAVED_MARK = "pafot_saved"
SAVED_PART = "saved-"
ANY_MARK = "pafot"
WORLD_FIXTURE = "pafot_world"
DEFAULT_ADS = "ads"
RUN = "run"  # the parameter of the test function that receives the run
# the marked functions and classes, by module
MARKED: WeakKeyDictionary[ModuleType, list[Any]] = WeakKeyDictionary()
REPEAT = "repeat="  # comes before the number of a repetition in the name of an item
POSITIONAL = "<positional>"  # the key of positional arguments, which the item reports as an error

Target = TypeVar("Target", bound=Callable[..., Any] | type)


@overload
def search(target: Target, /) -> Target: ...
@overload
def search(**arguments: Unpack[SearchArguments]) -> Callable[[Target], Target]: ...
def search(*target: Any, **arguments: Any) -> Any:
    """Search for scenarios in which the decorated test function raises.

    The decorator works with and without arguments, on test functions and on test classes. Arguments are checked
    right before the test runs, so a wrong argument fails one item and does not prevent the module's import.
    """
    # @pafot.search, not @pafot.search(...): the only argument is the test, unless it looks like a policy or a factory.
    if len(target) == 1 and not arguments and _may_be_decorated(target[0]):
        return _decorate(target[0], (), {})
    return lambda function: _decorate(function, target, arguments)


def _may_be_decorated(target: object) -> bool:
    if inspect.isclass(target):
        # if not imported, there is no vehicle class
        kinematics = sys.modules.get("highway_env.vehicle.kinematics")
        if kinematics is not None and issubclass(target, kinematics.Vehicle):
            return False
        return not any("__call__" in vars(base) for base in target.__mro__)
    if not inspect.isfunction(target):
        return False
    return target.__name__.startswith("test") or RUN in inspect.signature(target).parameters


def _decorate(target: Any, positional: tuple[object, ...], arguments: Mapping[str, object]) -> Any:
    if getattr(target, "__name__", "<lambda>") == "<lambda>":
        raise TypeError(
            f"expected a test function or a test class, received {target!r}. pytest does not collect objects "
            f"without a name. Write a function `def test_...({RUN})` that calls this object, and decorate that function"
        )
    module = sys.modules.get(target.__module__)
    if module is not None:
        MARKED.setdefault(module, []).append(target)
    given = [arguments.get("ads", DEFAULT_ADS), arguments.get("against")]
    names = [each for each in given if isinstance(each, str) and each and ":" not in each]
    # usefixtures, not getfixturevalue at run time: a parametrised fixture must be known at collection.
    target = pytest.mark.usefixtures(WORLD_FIXTURE, *names)(target)
    target = getattr(pytest.mark, SEARCH_MARK).with_args(*positional, **arguments)(target)
    return getattr(pytest.mark, ANY_MARK)(target)


def is_driven(item: pytest.Item | pytest.Collector) -> bool:
    """Return whether an item is a search or a replay."""
    return item.get_closest_marker(SEARCH_MARK) is not None


def arguments_of(item: pytest.Item | pytest.Collector) -> dict[str, Any] | None:
    """Return the merged arguments of an item's search marks, or None if it has no such mark."""
    if not is_driven(item):
        return None
    merged: dict[str, Any] = {}
    # The mark that is closest to the function comes first, and takes precedence.
    for mark in reversed(list(item.iter_markers(SEARCH_MARK))):
        merged.update(mark.kwargs)
        if mark.args:
            merged[POSITIONAL] = mark.args
    return merged


# The names of items: ``test_x[1-search]`` is a search, ``test_x[1-saved-<id>]`` replays a saved scenario.
#
# Both belong to the test ``test_x[1]``. This module calls that name the base name.


def saved_part(id_: str) -> str:
    """Return the part of an item's name that identifies its saved scenario, such as ``saved-<id>``."""
    from pytest_pafot.support.text import visible  # noqa: PLC0415  (few sessions have a saved scenario)

    # pytest escapes non-ASCII characters in the names of items, and a terminal obeys control characters.
    if id_.isascii() and "\\" not in id_ and visible(id_) == id_:
        return f"{SAVED_PART}{id_}"
    from urllib.parse import quote  # noqa: PLC0415

    return f"{SAVED_PART}{quote(id_, errors='surrogateescape')}"


def base_name(item: pytest.Item) -> str:
    """Return the name of an item's test: ``test_x[1]`` for ``test_x[1-search]``."""
    part, mark = layout.SEARCH_PART, item.get_closest_marker(SAVED_MARK)
    if mark is not None:
        part = saved_part(mark.args[0].id)
    name = layout.name_without(part, item.name)
    # All repetitions of a test have the same saved scenarios, so their numbers are not part of the base name.
    for part in re.findall(rf"(?<=[\[-]){REPEAT}\d+(?=[\]-])", name):
        name = layout.name_without(part, name)
    return name


def base_id(item: pytest.Item) -> str:
    """Return the node id of an item's test, which is the same for its search and its replays."""
    return _node_id(item, base_name(item))


def saved_node_id(item: pytest.Item, id_: str) -> str:
    """Return the node id of the item that will replay a finding."""
    return _node_id(item, renamed(item.name, id_))


def saved_name(item: pytest.Item, id_: str) -> str:
    """Return the name of the item that will replay a finding, for the location in a report."""
    return renamed(item.location[2], id_)


def qualified_name(item: pytest.Item) -> str:
    """Return the name of an item's test with its classes and parameters: ``TestBraking::test_x[1]``."""
    classes = [node.name for node in item.listchain() if isinstance(node, pytest.Class)]
    return "::".join([*classes, base_name(item)])


def _node_id(item: pytest.Item, name: str) -> str:
    if item.parent is None:
        return name
    return f"{item.parent.nodeid}::{name}"


def renamed(text: str, id_: str) -> str:
    """Return the name of the item that replays a saved scenario, given the name of its search."""
    parts = layout.around(layout.SEARCH_PART, text)
    if parts is None:
        return text
    return saved_part(id_).join(parts)


COLLECTED: pytest.StashKey[dict[Path, dict[str, Saved]]] = pytest.StashKey()
"""The saved scenarios that existed at collection, by folder and file name."""

REQUEST: pytest.StashKey[Request] = pytest.StashKey()
"""The checked mark and options of an item."""

SEARCH = "search"  # a placeholder argument, which each simulated run replaces


def accept_files(config: pytest.Config) -> tuple[set[Path], set[Path]]:
    """Replace corpus files and corpus folders on the command line with the test files that replay them.

    Return the corpus files, and the test files that were added.
    """
    given: dict[str, list[Path]] = {}
    others = []
    for arg in config.args:
        paths = []
        if _is_in_corpus(config, arg):
            paths = layout.files_below(path_of(config, arg))
        if arg.endswith(layout.SUFFIX):
            paths = paths or [config.invocation_params.dir / arg]
        if paths:
            given[arg] = paths
        else:
            others.append(arg)
    # Paths are resolved only now, because this raises an error for a link to itself, which pytest reports better.
    if not given:
        return set(), set()
    elsewhere = [path_of(config, arg).resolve() for arg in others]
    # not resolved: a link has its own item
    files = [path.parent.resolve() / path.name for paths in given.values() for path in paths]
    modules = dict.fromkeys(_module_of(file, config) for file in files)
    # A test file that is also on the command line is collected with all its tests.
    added = [
        module
        for module in modules
        if not any(each in (module, *module.parents) for each in elsewhere)
    ]
    config.args[:] = [*others, *map(str, added)]
    return set(files), set(added)


class Collection:
    """Hooks that create, filter and order the items of searches and saved scenarios."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._rootpath = config.rootpath
        call, here = call_of(config), config.invocation_params.dir
        given: list[str] = []
        if config.args_source is pytest.Config.ArgsSource.ARGS:
            # pytest has replaced it with the arguments in that file
            is_listed = any(arg.startswith("@") for arg in call)
            given = [arg for arg in config.args if is_listed or arg in call]
        is_here = config.args_source is pytest.Config.ArgsSource.INVOCATION_DIR
        if is_here and here != config.rootpath:
            # pytest collects only the folder in which it was called
            given = [str(here)]
        config.stash[GIVEN] = given
        self._given_files, self._modules_for_them = accept_files(config)
        self._saved = config.stash.setdefault(COLLECTED, {})
        self._listed: dict[Path, layout.TestFolders] = {}
        self._inventory = Inventory(set(), set(), set(), set())
        config.stash[INVENTORY] = self._inventory

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Ignore all files in a corpus, even those named like test files."""
        return any(map(self._is_corpus, (collection_path, *collection_path.parents))) or None

    def _is_corpus(self, folder: Path) -> bool:
        # Neither the rootdir nor a folder above it is a corpus, regardless of its name. A folder on the command line is
        # a corpus only if it has the default name.
        if folder.name == layout.CORPUS:
            return not self._rootpath.is_relative_to(folder)
        corpus = Path(self._corpus_name or "")
        is_corpus = bool(corpus.name) and layout.is_corpus(folder, corpus)
        return is_corpus and folder not in self._asked_for

    @cached_property
    def _corpus_name(self) -> str | None:
        return value_if_right(self._config, "corpus")  # type: ignore[no-any-return]

    @cached_property
    def _asked_for(self) -> set[Path]:
        given = [path_of(self._config, arg) for arg in self._config.args]
        folders = [self._rootpath, *filter(Path.is_dir, given)]
        return {each for folder in folders for each in (folder, *folder.parents)}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> Generator[None]:
        """Parametrise a marked test function with its search and with the saved scenarios that may belong to it."""
        if not is_driven(metafunc.definition):
            return (yield)
        parametrize = metafunc.parametrize

        def parametrize_repeated(
            argnames: str | Sequence[str], argvalues: Iterable[Any], *args: Any, **kw: Any
        ) -> None:
            if isinstance(argnames, str) and argnames.startswith("__"):
                argvalues = list(argvalues)
                kw["ids"] = [f"{REPEAT}{number}" for number in range(len(argvalues))]
            parametrize(argnames, argvalues, *args, **kw)

        # A plugin that repeats tests uses a parameter with two underscores. Its ids are replaced by known ones, so that
        # base_name can remove them.
        metafunc.parametrize = parametrize_repeated  # type: ignore[method-assign]
        yield
        if RUN not in metafunc.fixturenames or is_parametrised(metafunc, RUN):
            return  # Only one item is left. It reports the error during its set-up.
        # The values differ, because other tools distinguish items by them. Nothing else reads them.
        values = [pytest.param(SEARCH, id=layout.SEARCH_PART)]
        for saved in self._saved_by_id(metafunc.definition):
            part, mark = saved_part(saved.id), getattr(pytest.mark, SAVED_MARK)(saved)
            values.append(pytest.param(part, id=part, marks=[mark]))
        parametrize(RUN, values)

    def _saved_by_id(self, definition: pytest.Item) -> Iterable[Saved]:
        corpus = self._corpus_name
        if corpus is None:
            return []
        module_folder = layout.folder_of_module(definition.path, corpus, self._rootpath)
        name = qualified_name(definition)
        chosen = layout.chosen_folder(definition.path, corpus)
        # A link in a checkout could lead to files of other people, so such files are reported and not read.
        link = layout.link_out(chosen, module_folder.parent, self._rootpath)
        found: dict[str, Saved] = {}
        if module_folder not in self._listed:
            self._listed[module_folder] = layout.TestFolders(module_folder)
        for folder in self._listed[module_folder].folders_of(name):
            if folder not in self._saved:
                from pytest_pafot.corpus.reader import refused_in, saved_in  # noqa: PLC0415  (few sessions have any)

                read = saved_in(folder) if link is None else refused_in(folder, link)
                self._saved[folder] = {saved.path.name: saved for saved in read}
            for saved in self._saved[folder].values():
                found[saved.id] = saved
        return found.values()

    @pytest.hookimpl(wrapper=True)
    def pytest_pycollect_makeitem(self) -> Generator[None, Any, Any]:
        """Drop items whose saved scenario belongs to other parameter values of the test."""
        made = yield
        if not isinstance(made, list):
            return made
        return [item for item in made if self._belongs(item)]

    def _belongs(self, item: pytest.Item) -> bool:
        if not is_driven(item):
            return True
        corpus, folder = self._corpus_name, None
        if corpus is not None:
            folder = layout.folder_of_test(item.path, qualified_name(item), corpus, self._rootpath)
            self._inventory.corpora.add(str(folder.parents[1]))
        mark = item.get_closest_marker(SAVED_MARK)
        if mark is None:
            return True
        saved = None
        if folder is not None:
            known = self._saved.get(folder, {})
            saved = known.get(mark.args[0].path.name)
        frozen = self._config.stash[SHARED].frozen
        # a new file is dropped, since pytest-xdist ends a session whose workers differ in their items
        if saved is None or (frozen is not None and item.nodeid not in frozen):
            return False
        # Only now are the parameters known, and with them the one file that the item replays.
        item.add_marker(getattr(pytest.mark, SAVED_MARK)(saved), append=False)
        if saved.is_accepted(self._config.stash[SHARED].day):
            from pytest_pafot.support.text import visible  # noqa: PLC0415  (few sessions have one)

            accepted = pytest.mark.xfail(strict=True, reason=visible(saved.xfail or ""))
            item.add_marker(accepted, append=False)
        return True

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_collection_modifyitems(
        self, items: list[pytest.Item]
    ) -> Generator[None, None, None]:
        """Find marked tests that pytest does not collect, and drop items that were not requested."""
        if MARKED and not self._config.getoption("lf", False):
            self._inventory.unnamed.update(marked_and_left(self._config, items))
        # Items are dropped before other plugins select tests, and again after that.
        self._deselect(items, {item for item in items if self._is_beside_given(item)})
        yield
        # Under --lf, a search need not run again if its findings have become items in the meantime.
        cache = getattr(self._config, "cache", None)
        if self._config.getoption("lf", False) and cache is not None:
            lasting = cache.get("cache/lastfailed", {})
            failed = [item for item in items if item.nodeid in lasting]
            known = {base_id(item) for item in failed if saved_of(item) is not None}
            searches = {item for item in failed if is_search(item)}
            self._deselect(items, {item for item in searches if base_id(item) in known})

    def pytest_deselected(self, items: Sequence[pytest.Item]) -> None:
        # pytest-testmon also passes the names of tests.
        own = (saved_of(item) for item in items if isinstance(item, pytest.Item))
        files = [saved.path for saved in own if saved is not None]
        if files:
            from pytest_pafot.support.text import visible  # noqa: PLC0415  (few sessions have one)

            self._inventory.deselected.update(
                visible(layout.relative(file, self._rootpath)) for file in files
            )

    def _is_beside_given(self, item: pytest.Item) -> bool:
        if item.path not in self._modules_for_them:
            return False
        saved = saved_of(item)
        return saved is None or saved.path not in self._given_files

    def _deselect(self, items: list[pytest.Item], dropped: set[pytest.Item]) -> None:
        if dropped:
            gone = [item for item in items if item in dropped]
            self._config.hook.pytest_deselected(items=gone)
            items[:] = [item for item in items if item not in dropped]

    def pytest_report_collectionfinish(self, items: list[pytest.Item]) -> list[str]:
        """Return lines with the numbers of searches, saved scenarios and runs."""
        searches = [item for item in items if is_search(item)]
        saved = sum(saved_of(item) is not None for item in items)
        if not searches and not saved:
            return []
        found = "1 search" if len(searches) == 1 else f"{len(searches)} searches"
        scenarios = "1 saved scenario" if saved == 1 else f"{saved} saved scenarios"
        parts = [f"pafot: {found}, {scenarios}", base_line(self._config)]
        # pytest rewrites the assertions of test files, conftest.py and plugins, so these assertions still run.
        if not __debug__:
            parts.append(
                "with python -O, Python skips assertions in modules that pytest does not rewrite"
            )
        lines = ["; ".join(filter(None, parts))]
        cost = cost_line(self._config, [arguments_of(item) or {} for item in searches])
        if cost:
            lines.append(cost)
        return lines


def is_search(item: pytest.Item) -> bool:
    """Return whether an item is a search, not a replay."""
    return is_driven(item) and item.get_closest_marker(SAVED_MARK) is None


def saved_of(item: pytest.Item) -> Saved | None:
    """Return the saved scenario that an item replays, or None."""
    mark = item.get_closest_marker(SAVED_MARK)
    if mark is None:
        return None
    from pytest_pafot.corpus.reader import Saved  # noqa: PLC0415  (few sessions have one)

    saved = next(iter(mark.args), None)
    return saved if isinstance(saved, Saved) else None


def is_parametrised(metafunc: pytest.Metafunc, arg: str) -> bool:
    """Return whether the user has parametrised a test function with an argument."""
    for mark in metafunc.definition.iter_markers("parametrize"):
        names, *_ = *mark.args, mark.kwargs.get("argnames", ())
        if isinstance(names, str):
            names = [name.strip() for name in names.split(",")]
        if arg in names:
            return True
    return False


def marked_and_left(config: pytest.Config, items: Iterable[pytest.Item]) -> Iterator[str]:
    """Yield the names of marked functions and classes that pytest has not collected."""
    # Decorators wrap functions, so follow __wrapped__ to the function that was marked.
    run: set[int] = set()
    for item in items:
        cls = getattr(item, "cls", None)
        run.update(map(id, getattr(cls, "__mro__", ())))
        function = getattr(item, "function", None)
        while function is not None:
            run.add(id(function))
            function = getattr(function, "__wrapped__", None)
    asked = [path_of(config, each) for each in config.args if "::" not in each]
    for module, marked in list(MARKED.items()):
        file = Path(getattr(module, "__file__", None) or os.devnull)
        is_current = sys.modules.get(module.__name__) is module
        is_ours = file.is_relative_to(config.rootpath) and "site-packages" not in file.parts
        if not (is_current and is_ours and any(map(file.is_relative_to, asked))):
            continue
        for each in marked:
            name = each.__qualname__
            owner = getattr(module, name.partition(".")[0], None)
            # A class with subclasses is probably a base class, and __test__ = False excludes a class on purpose.
            is_base = isinstance(owner, type) and bool(type.__subclasses__(owner))
            is_on = getattr(each, "__test__", True) and getattr(owner, "__test__", True)
            if id(each) not in run and "<locals>" not in name and is_on and not is_base:
                yield f"{layout.relative(file, config.rootpath)}::{name.replace('.', '::')}"


def _is_in_corpus(config: pytest.Config, arg: str) -> bool:
    path = path_of(config, arg)
    if not path.is_relative_to(config.rootpath):
        return False
    return layout.CORPUS in path.relative_to(config.rootpath).parts and path.is_dir()


def _module_of(file: Path, config: pytest.Config) -> Path:
    from pytest_pafot.support.errors import command  # noqa: PLC0415  (few sessions are given such a file)
    from pytest_pafot.support.text import visible  # noqa: PLC0415

    if not file.is_file():
        raise pytest.UsageError(
            f"{visible(str(file))}: expected the file of a saved scenario, but it does not exist"
        )
    corpus = value_if_right(config, "corpus")
    module, where = None, "its folder is not in a corpus"
    if corpus is not None:
        module = layout.module_of_file(file, corpus, config.rootpath)
    if module is not None:
        where = f"{module} does not exist"
    if module is None or not module.is_file():
        problem = f"{file}: expected a saved scenario of a test file, but {where}"
        again = command("pytest_pafot", "replay", "FILE", "--ads", "module:Class")
        fix = f"Move the folder to the corpus of the test, or replay the file without a test: `{again}`"
        raise pytest.UsageError(f"{visible(problem)}. {fix}")
    return module
