"""Configuration of the project's own tests."""

import gc
from collections.abc import Callable, Generator
from importlib import metadata

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

pytest_plugins = ["pytester"]

# Each session tries the same examples: few by default, more with --hypothesis-profile=thorough, as .ci/run does, and
# others with --hypothesis-profile=fresh, which --hypothesis-seed=N repeats.
settings.register_profile(
    "project", derandomize=True, deadline=None, max_examples=20, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("thorough", settings.get_profile("project"), max_examples=60)
settings.register_profile("fresh", settings.get_profile("thorough"), derandomize=False)
settings.load_profile("project")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    """The same order of tests in every session, where pytest-randomly is; with --randomly-seed=N another."""
    if config.getoption("randomly_seed", None) == "default":
        config.option.randomly_seed = 1


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """From here on every warning is an error; of what other plugins warn while they are configured is their matter."""
    config.addinivalue_line("filterwarnings", "error")
    # Hypothesis also tries constants of a project's modules, of those that happen to be imported by then: what a test
    # is tried with would be a matter of the tests before it in its process.
    if settings.default.derandomize:
        providers.is_local_module_file = lambda path: False


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the long ones, so that at the end no worker has one to go while the others have none."""
    items.sort(key=lambda item: not (item.get_closest_marker("stories") or item.get_closest_marker("processes")))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is made meanwhile stays to the end: looking for garbage in it, then or after every few tests, finds none.

    Tests leave little garbage too, so that it is looked for seldom: that costs a sixth of their time otherwise.
    """
    gc.disable()
    collected = yield
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)
    gc.enable()
    return collected


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Lets the entry points of a group be there, by name and value, as if packages with them were installed."""

    def put(named: str, **values: str) -> None:
        entries = tuple(metadata.EntryPoint(name, value, named) for name, value in values.items())
        monkeypatch.setattr(metadata, "entry_points", lambda *, group: entries if group == named else ())

    return put


@pytest.hookimpl(trylast=True)
def pytest_unconfigure() -> None:
    """Let the interpreter find all garbage at its end."""
    gc.unfreeze()
