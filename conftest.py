"""Configuration of the project's own tests."""

import atexit
import ctypes
import gc
import os
import re
import signal
import sys
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

pytest_plugins = ["pytester"]

# Every session tries the same 20 examples per test. Of 60 seeded faults, 60 examples per test found only one more,
# which now has its own test. --hypothesis-profile=fresh tries different examples, and --hypothesis-seed=N repeats them.
settings.register_profile(
    "project",
    derandomize=True,
    deadline=None,
    max_examples=20,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "fresh", settings.get_profile("project"), derandomize=False, max_examples=60
)
settings.load_profile("project")

# If nohup or a background script started this session, all processes that tests start would ignore these signals.
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """Make pytest-randomly use the same order in every session, unless --randomly-seed=N changes it."""
    if config.getoption("randomly_seed", None) == "default":
        config.option.randomly_seed = 1


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Make every warning an error, except warnings of other plugins that are configured before this hook."""
    config.addinivalue_line("filterwarnings", "error")
    if not config.getoption("numprocesses", None):  # the controller of pytest-xdist runs no tests
        import pytest_pafot.world.stock  # noqa: F401, PLC0415  before a test imports highway-env and thus matplotlib

        # After a nested session, pytester forgets the modules that this session imported. Pandas cannot be imported
        # twice, so import it now.
        with suppress(ImportError):
            import pandas as pd  # noqa: F401, PLC0415
    # Hypothesis also tries constants from the project's modules that are already imported. A test's examples would then
    # depend on the tests that ran earlier in the same process.
    if settings.default.derandomize:
        providers.is_local_module_file = lambda path: False


TESTS = Path(__file__).parent / "tests"
OPTIONAL = TESTS / "optional"
LONG = set((TESTS / "long.txt").read_text(encoding="utf-8").split())
STAGES = ("processes", "long", "stories", "oracle", "optional")
NAMED = re.compile(rf"\bmark\.({'|'.join(STAGES)})\b|\bhelpers\.stages\b")
WHOLE = re.compile(rf"^pytestmark = (?:\[\s*)?pytest\.mark\.({'|'.join(STAGES)})\b", re.MULTILINE)
TEST = re.compile(r"^ *def (test_\w+)\(", re.MULTILINE)
HUGE_PAGE = 2 << 20
MADV_COLLAPSE = 25  # in Linux 6.1 and later


def has_stages(path: Path) -> bool:
    """Return whether a test file contains tests of a stage, according to its text, its folder or ``long.txt``."""
    file = f"{path.relative_to(TESTS.parent).as_posix()}::"
    is_listed = any(each.startswith(file) for each in LONG)
    return (
        is_listed
        or path.is_relative_to(OPTIONAL)
        or bool(NAMED.search(path.read_text(encoding="utf-8")))
    )


def left_out(config: pytest.Config) -> set[str]:
    """Return the stages that a session of all test files skips, as the README's command does."""
    words = config.option.markexpr.split(" and ")
    is_whole = config.args == config.getini("testpaths") and all(
        word.startswith("not ") for word in words
    )
    return {word.removeprefix("not ") for word in words} if is_whole else set()


def is_left_out(path: Path, stages: set[str]) -> bool:
    """Return whether all tests of a file belong to the given stages, because of the file's marker or ``long.txt``."""
    text, file = path.read_text(encoding="utf-8"), path.relative_to(TESTS.parent).as_posix()
    listed = {each.rpartition("::")[2] for each in LONG if each.startswith(f"{file}::")}
    mark = WHOLE.search(text)
    return mark[1] in stages if mark else "long" in stages and {*TEST.findall(text)} <= listed


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files that a session of all tests would import only to deselect their tests, unless a path names them.

    The main stage skips tests/optional, which imports pandas, matplotlib and other libraries. It also skips files that
    contain only tests of other stages. The other stages skip a third of all files, which contain none of their tests.
    """
    is_test = collection_path.suffix == ".py" and collection_path.name.startswith("test_")
    if config.option.markexpr.startswith("not "):
        is_named = any("optional" in argument for argument in config.args)
        stages = left_out(config)
        is_of_others = bool(stages) and is_test and is_left_out(collection_path, stages)
        return True if is_of_others or (collection_path == OPTIONAL and not is_named) else None
    words = set(re.findall(r"\w+", config.option.markexpr))
    is_of_stages = (
        bool(words) and words <= {*STAGES, "or"} and config.args == config.getini("testpaths")
    )
    return True if is_of_stages and is_test and not has_stages(collection_path) else None


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makeitem(
    collector: pytest.Module | pytest.Class, name: str, obj: object
) -> list[pytest.Item] | None:
    """Create no items that a session of all tests would only deselect, which are a third of all items."""
    if not name.startswith("test_") or not (stages := left_out(collector.config)):
        return None
    marks = {mark.name for mark in getattr(obj, "pytestmark", ())}
    marks |= {"long"} if f"{collector.nodeid}::{name}" in LONG else set()
    return None if marks.isdisjoint(stages) else []


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Make every second worker import the test files in reverse order.

    In a fresh clone, pytest rewrites the assertions in these files, which takes most of the collection's time. Workers
    with the same order would rewrite all files twice. With opposite orders, each reads files that the other rewrote.
    """
    report = yield
    if (
        isinstance(collector, pytest.Directory)
        and os.environ.get("PYTEST_XDIST_WORKER", "gw0")[-1] in "13579"
    ):
        report.result.reverse()
    return report


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> Generator[None, object, object]:
    """Mark the tests in ``long.txt``, and run slow tests first, so that no worker runs one while the others are idle.

    Tests that start processes come first, because copying this process takes longer after tests that use much memory.
    """
    for item in items:
        if item.nodeid.partition("[")[0] in LONG:
            item.add_marker("long")
    stages = {
        item: {mark.name for mark in item.iter_markers()}.intersection(STAGES) for item in items
    }
    for path in {item.path for item in items if stages[item]}:
        if not has_stages(path):
            raise pytest.UsageError(
                f"{path}: expected `mark.<stage>` in a file with tests of a stage, received none. Add it."
            )
    items.sort(key=lambda item: item.path)  # the same order in all workers
    done = yield
    items.sort(key=lambda item: [stage not in stages[item] for stage in STAGES[:3]])
    return done


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Generator[None, object, object]:
    """Exclude objects that were created during test collection from garbage collection, because they are never freed.

    Tests leave little garbage, so it is collected rarely. Frequent collection would take a sixth of their time.
    """
    gc.disable()
    collected = yield
    gc.freeze()
    # or libraries report leaks; earlier, pytest would search these objects five times
    atexit.register(gc.unfreeze)
    gc.set_threshold(100_000, 50, 100)
    gc.enable()
    if any(item.get_closest_marker("processes") for item in session.items):
        use_huge_pages()
    return collected


def use_huge_pages() -> None:
    """Make Linux store this process in memory pages of 2 MiB, which halves the time that copying the process takes.

    A fork copies the page table, which has 512 times as many entries if the pages have 4 KiB.
    """
    maps = Path("/proc/self/maps")
    call = getattr(ctypes.CDLL(None), "madvise", None) if maps.exists() else None
    if call is None:
        return
    call.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    for first, last in re.findall(
        r"^(\w+)-(\w+) rw-p 0+ 00:00 0 *(?:\[heap\])?$", maps.read_text(), re.MULTILINE
    ):
        begin, end = (
            -(-int(first, 16) // HUGE_PAGE) * HUGE_PAGE,
            int(last, 16) // HUGE_PAGE * HUGE_PAGE,
        )
        if begin < end:
            call(begin, end - begin, MADV_COLLAPSE)  # if it fails, the pages stay small


@pytest.fixture(autouse=True)
def modules_of_no_other_test(tmp_path_factory: pytest.TempPathFactory) -> Generator[None]:
    """Forget the modules that a test imports from its own files, because other tests may use the same names."""
    known, folder = {*sys.modules}, f"{tmp_path_factory.getbasetemp()}{os.sep}"
    yield
    for name in {*sys.modules} - known:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(folder):
            del sys.modules[name]
