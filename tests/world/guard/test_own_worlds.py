"""A user's own world, which calls the ADS itself: a decision that hangs ends there, too."""

import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

import pytest_pafot as pafot
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.support.errors import OutOfTime
from pytest_pafot.world import Highway
from pytest_pafot.world.guard import hang_guard
from pytest_pafot.world.guard.hang_guard import AdsHang, HangGuard, LastResort, last_resort, runs_end_in
from pytest_pafot.world.guard.own_worlds import Hang, OwnWorld, rollout_of
from tests.helpers.tables import table

AHEAD = Scenario(npcs=[[PositionInstruction(2, 22.0)]], ego_speed=22.0, gene_seconds=4.0)
ROAD = Highway(duration=4.0)
STILL = ROAD.rollout(AHEAD, lambda: lambda seen: (0.0, 0.0))


class Calls:
    """A world that asks its ADS for ten decisions, and records an exception as most users would."""

    hang_limit = 0.05

    def rollout(self, scenario, ads_factory, *, decisions=()):
        ads = ads_factory()
        for decision in range(len(decisions), 10):
            try:
                self.ask(ads, decision)
            except Exception as raised:  # noqa: BLE001  (as users write it)
                error = AdsError(kind=type(raised).__name__, message=str(raised), traceback="", tick=3 * decision)
                return replace(STILL, outcome=Outcome.ADS_ERROR, error=error, states=STILL.states[: 3 * decision + 1])
        return STILL

    def ask(self, ads, decision):
        ads(decision)


class Forgives(Calls):
    calls = 0

    def ask(self, ads, decision):
        self.calls += 1
        try:
            ads(decision)
        except Exception:  # noqa: BLE001  (as users write it)
            return


class Trusts(Calls):
    def rollout(self, scenario, ads_factory):
        ads = ads_factory()
        for decision in range(10):
            ads(decision)
        return STILL


class InThread(Calls):
    def ask(self, ads, decision):
        raised = []

        def call():
            try:
                ads(decision)
            except Exception as error:  # noqa: BLE001  (as users write it)
                raised.append(error)

        thread = threading.Thread(target=call)
        thread.start()
        thread.join()
        for error in raised:
            raise error


class Slow(Calls):
    """A world of a Highway in which a decision may take 30 s."""

    def rollout(self, scenario, ads_factory):
        return ROAD.rollout(scenario, ads_factory)


class Quick(Calls):
    """A world in which a decision may take 30 s, of a Highway in which it may take less."""

    hang_limit = 30.0

    def rollout(self, scenario, ads_factory):
        return Highway(duration=4.0, hang_limit=0.05).rollout(scenario, ads_factory)


def hangs(after=4):
    """Return a factory of ADSs that sleep in their fifth decision."""

    def make():
        decisions = []

        def decide(seen):
            decisions.append(seen)
            if len(decisions) > after:
                end = time.monotonic() + 60
                while time.monotonic() < end:
                    time.sleep(0.005)
            return 0.0, 0.0

        return decide

    return make


@table("world", [Calls(), Forgives(), InThread(), Slow(), Quick()])
def test_decision_that_hangs_ends_run_as_hang(world):
    began = time.monotonic()
    trace = OwnWorld(world).rollout(AHEAD, hangs())
    assert time.monotonic() - began < 20
    assert (trace.outcome, trace.collision) == (Outcome.HANG, None)
    assert (trace.error.kind, trace.error.interrupted, trace.error.tick) == ("Hang", True, 12)
    assert "time.sleep(0.005)" in trace.error.traceback
    assert "pytest_pafot/world" not in trace.error.traceback


@table("world", [Calls(), Forgives(), InThread(), Slow(), Quick()])
def test_hang_that_the_ads_catches_ends_run_all_the_same(world):
    decisions = []

    def catches(seen):
        decisions.append(seen)
        with suppress(BaseException):
            hangs(after=0 if len(decisions) == 5 else 1)()(seen)
        return 0.0, 0.0

    trace = OwnWorld(world).rollout(AHEAD, lambda: catches)
    assert (trace.outcome, trace.error.kind, trace.error.tick, len(decisions)) == (Outcome.HANG, "Hang", 12, 5)


def test_world_that_goes_on_gets_no_second_long_decision():
    world, began = Forgives(), time.monotonic()
    OwnWorld(world).rollout(AHEAD, hangs())
    assert (world.calls, time.monotonic() - began < 5) == (10, True)


def test_world_that_catches_nothing_passes_the_hang_on():
    with pytest.raises(Hang, match="one decision took longer than the hang limit of the world and was interrupted"):
        OwnWorld(Trusts()).rollout(AHEAD, hangs())


class Swallows(Calls):
    def ask(self, ads, decision):
        try:
            ads(decision)
        except BaseException:  # noqa: BLE001  (some users write it)
            return


@table("world", [Calls(), Forgives(), Trusts(), InThread(), Swallows()])
def test_time_limit_ends_a_run_whatever_its_world_catches(world):
    with runs_end_in(0.05), pytest.raises(OutOfTime):
        OwnWorld(world).rollout(AHEAD, lambda: lambda seen: time.sleep(0.02))
    with runs_end_in(60.0):
        assert OwnWorld(world).rollout(AHEAD, lambda: lambda seen: None) == STILL


def test_given_decisions_count_for_the_tick_of_a_hang():
    trace = OwnWorld(Forgives()).rollout(AHEAD, hangs(after=2), decisions=((0.0, 0.0),) * 3)
    assert trace.error.tick == 15


@table("world", [Calls(), Forgives(), Trusts(), InThread(), Slow(), Quick()])
def test_healthy_runs_are_those_of_the_world_itself(world):
    def drives():
        return lambda seen: (0.5, 0.0)

    assert OwnWorld(world).rollout(AHEAD, drives).states.tobytes() == world.rollout(AHEAD, drives).states.tobytes()


def test_run_that_ends_early_without_a_reason_names_its_world():
    class Short:
        longest_run = 60.0

        def rollout(self, scenario, ads_factory):
            return STILL

    longer = Scenario(npcs=AHEAD.npcs, ego_speed=22.0, gene_seconds=8.0)
    assert OwnWorld(Short()).rollout(longer, None).ended == "Short.rollout"


def test_errors_of_an_ads_stay_what_they_are():
    def breaks():
        return lambda seen: {}["no"]

    trace = OwnWorld(Calls()).rollout(AHEAD, breaks)
    assert (trace.outcome, trace.error.kind) == (Outcome.ADS_ERROR, "KeyError")


def test_traceback_shows_the_ads_and_its_world_only():
    class Ads:
        def __call__(self, seen):
            return {}["no"]

    class Asks(Calls):
        def rollout(self, scenario, ads_factory):
            ads_factory()(0)

    with pytest.raises(KeyError) as raised:
        OwnWorld(Asks()).rollout(AHEAD, Ads)
    assert {entry.path.name for entry in raised.traceback.filter(raised)} == {Path(__file__).name}


def test_imperfect_sight_drives_in_a_world_around_a_highway():
    blind = pafot.Perception(lambda: lambda seen: (-0.1 * len(seen.others), 0.0), range=0.5)
    world = Slow()
    assert OwnWorld(world).rollout(AHEAD, blind).states.tobytes() == ROAD.rollout(AHEAD, blind).states.tobytes()
    hung = OwnWorld(world).rollout(AHEAD, pafot.Perception(hangs(), range=0.5))
    assert hung.outcome is Outcome.HANG


def test_vehicle_class_is_passed_to_the_world_as_it_is():
    from highway_env.vehicle.behavior import IDMVehicle

    given = []

    class Notes(Calls):
        def rollout(self, scenario, ads_factory):
            given.append(ads_factory)
            return STILL

    OwnWorld(Notes()).rollout(AHEAD, IDMVehicle)
    assert given == [IDMVehicle]


def test_only_the_class_itself_can_say_that_it_guards():
    class Notes(Highway):
        def rollout(self, scenario, ads_factory):
            given.append(ads_factory)
            return STILL

    class Says(Notes):
        guards_ads = True

        def rollout(self, scenario, ads_factory):
            return super().rollout(scenario, ads_factory)

    class Inherits(Says):
        pass

    given, ads = [], hangs()
    for world in (Notes(), Says(), Inherits()):
        rollout_of(world)(AHEAD, ads)
    assert [each is ads for each in given] == [False, True, False]
    assert rollout_of(ROAD).args == (ROAD.rollout,)
    assert rollout_of(Calls())(AHEAD, hangs()).outcome is Outcome.HANG


@table("drivers", [None, 3, ["careful-human"]])
def test_names_of_drivers_mean_nothing_without_the_methods_that_drive_them(drivers):
    class Names(Calls):
        takes_over = drivers

    base = OwnWorld(Names())
    assert base.takes_over == ()
    assert base.run_of(base.rollout(AHEAD, lambda: lambda seen: (0.0, 0.0))).take_over is None


def test_world_may_set_attributes_of_its_ads():
    class Planner:
        def __call__(self, seen):
            return 0.0, 0.0

    planner = Planner()

    class Sets(Calls):
        def ask(self, ads, decision):
            ads.decision = decision
            assert ads.decision == planner.decision == decision

    OwnWorld(Sets()).rollout(AHEAD, lambda: planner)


def test_outer_guard_interrupts_inside_an_inner_one():
    with HangGuard(0.05) as outer, HangGuard(30.0) as inner:
        outer.decision_starts()
        inner.decision_starts()
        with pytest.raises(AdsHang):
            time.sleep(20)
        outer.decision_ends()
        inner.decision_ends()


def test_world_that_never_asks_again_ends_its_process(monkeypatch):
    monkeypatch.setattr(hang_guard, "LEAST_FOR_WORLD", 0.2)
    ended = threading.Event()

    class Stuck(Calls):
        hang_limit = 0.01

        def rollout(self, scenario, ads_factory):
            ads_factory()(0)
            assert ended.wait(20)
            return STILL

    resort = LastResort(end=lambda: pytest.fail("the decision"), grace=9.0, end_world=ended.set)
    with last_resort(resort):
        assert isinstance(OwnWorld(Stuck()).rollout(AHEAD, lambda: lambda seen: (0.0, 0.0)), Trace)
