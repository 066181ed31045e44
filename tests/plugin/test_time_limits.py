"""Time limits: one for each search, and one for the session that its searches share."""

import math
import re
import time
from types import SimpleNamespace

import pytest

from pytest_pafot.campaign.watch import time_limit
from pytest_pafot.plugin.marks import SEARCH_MARK
from pytest_pafot.plugin.search_item import searches_left
from pytest_pafot.plugin.session import SHARED
from pytest_pafot.world.guard import hang_guard

pytestmark = pytest.mark.processes

TWO = """
import time

def slow(observation):
    time.sleep(0.002)
    return 0.0, 0.0

@pafot.search(SHORT, ads=lambda: slow)
def test_first(run):
    pass

@pafot.search(SHORT, ads=lambda: slow)
def test_second(run):
    pass
"""


@pytest.fixture
def two(project):
    """Return a project with two searches of a slow ADS."""
    project.write(TWO)
    return project


def limits(max_time=None, total_time=None):
    return SimpleNamespace(max_time=max_time, total_time=total_time)


@pytest.mark.parametrize(
    ("settings", "left", "expected"),
    [
        (limits(), 1, ("--pafot-max-time", math.inf)),
        (limits(max_time=30), 2, ("--pafot-max-time", 130)),
        (limits(total_time=60), 1, ("--pafot-total-time", 150)),  # 10 of 60 s are gone
        (limits(total_time=60), 2, ("--pafot-total-time", 125)),
        (limits(max_time=10, total_time=60), 2, ("--pafot-max-time", 110)),
        (limits(max_time=30, total_time=60), 2, ("--pafot-total-time", 125)),
        (limits(total_time=5), 3, ("--pafot-total-time", 100)),  # no time is left: one run, and no more
    ],
)
def test_search_ends_at_own_limit_or_total_share(settings, left, expected):
    assert time_limit(settings, now=100.0, began=90.0, left=left) == expected


@pytest.mark.parametrize("searches", range(1, 9))
def test_full_shares_of_searches_add_up_to_total(searches):
    now, shares = 0.0, []
    for left in range(searches, 0, -1):
        until = time_limit(limits(total_time=80), now=now, began=0.0, left=left).end
        shares.append(until - now)
        now = until
    assert now == pytest.approx(80)
    assert shares == pytest.approx([80 / searches] * searches)


class Item(SimpleNamespace):
    """A search among others."""

    def get_closest_marker(self, name):
        return name == SEARCH_MARK or None


@pytest.mark.parametrize(
    ("searches", "workers", "begun", "left"),
    [(4, None, 0, 4), (4, None, 1, 3), (4, None, 3, 1), (5, 2, 0, 3), (5, 2, 1, 2), (5, 2, 4, 1), (1, 8, 0, 1)],
)
def test_remaining_searches_are_counted_per_process(searches, workers, begun, left):
    shared = SimpleNamespace(begun={f"other{number}" for number in range(begun)} | {"this"})
    config = SimpleNamespace(stash={SHARED: shared})
    if workers is not None:
        config.workerinput = {"workercount": workers}
    item = Item(nodeid="this", config=config)
    item.session = SimpleNamespace(items=[item] * searches)
    assert searches_left(item) == left


def runs(result):
    """Return the number of runs of each search."""
    return [int(found) for found in re.findall(r"^  (\d+) runs? in ", result.stdout.str(), re.MULTILINE)]


@pytest.mark.parametrize("args", [(), ("-n2",)], ids=["alone", "workers"])
def test_two_searches_share_total_time_and_say_so(two, args):
    if args:
        pytest.importorskip("xdist")
    begun = time.monotonic()
    result = two.run("--pafot-total-time=2", *args, generations=9999, apart=True)
    assert time.monotonic() - begun < 60  # without limits, each would take many minutes
    result.assert_outcomes(passed=2)
    text = result.stdout.str()
    assert text.count("ended: --pafot-total-time") == 2
    assert text.count("note: cut by --pafot-total-time: the same seed may find other scenarios next time") == 2


def test_expired_total_time_still_runs_one_scenario_each(two):
    result = two.run("--pafot-total-time=0", generations=50)
    result.assert_outcomes(passed=2)
    assert runs(result) == [1, 1]


SLOW = """
import time

def slow(observation):
    time.sleep(0.2)
    return 0.0, 0.0

@pafot.search(ads=lambda: slow)
def test_slow(run):
    pass
"""


def test_limit_ends_a_run_of_slow_decisions_between_two(project):
    project.write(SLOW)  # a run takes up to a minute
    begun = time.monotonic()
    result = project.run("--pafot-max-time=1", generations=3)
    assert time.monotonic() - begun < 15
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["  0 runs in *", "*ended: --pafot-max-time", "*no scenario was simulated*"])
    assert not project.files


def test_limit_ends_a_factory_that_never_returns(project, monkeypatch):
    monkeypatch.setattr(hang_guard, "LATE", 0.2)
    project.write(SLOW.replace("ads=lambda: slow", "ads=lambda: time.sleep(1000)"))
    begun = time.monotonic()
    project.run("--pafot-total-time=0.5", generations=3).assert_outcomes(failed=1)
    assert time.monotonic() - begun < 30


def test_limit_ends_a_run_in_an_isolated_process(project):
    project.write(SLOW)
    begun = time.monotonic()
    result = project.run("--pafot-max-time=1", "--pafot-isolate", generations=3)
    assert time.monotonic() - begun < 20
    result.stdout.fnmatch_lines(["  0 runs in *", "*ended: --pafot-max-time"])
    assert not project.files


def test_deselected_searches_leave_their_time_to_others(two):
    result = two.run("--pafot-total-time=3", "-k", "second", generations=9999)
    result.assert_outcomes(passed=1, deselected=1)
    (seconds,) = re.findall(r"runs? in (\S+) s", result.stdout.str())
    assert float(seconds) > 1.5  # more than a half, which is the share of one of two


def test_it_is_no_argument_of_one_search(project):
    project.write("@pafot.search(SHORT, total_time=3)\ndef test_it(run):\n    pass\n")
    result = project.run()
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["*(total_time=...): this applies to the whole session; give --pafot-total-time*"])
