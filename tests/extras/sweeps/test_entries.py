"""The catalogue: each named scenario in the world that it is for."""

import re
from functools import cache

import pytest

import pytest_pafot as pafot
from pytest_pafot.extras.sweeps.entries import ENTRIES, NAMES, NoPlaceError, chosen, entry_of, fits
from pytest_pafot.model.instructions import ScenarioError
from pytest_pafot.model.trace import SPEED
from pytest_pafot.support.errors import RequestError
from tests.extras.sweeps.planted import keeps_speed
from tests.helpers.tables import table

JUNCTIONS = chosen(("junction",))
ON_HIGHWAYS = tuple(entry for entry in ENTRIES if entry not in JUNCTIONS)
CUT_IN = entry_of("r157/cut-in")


@cache
def driven(world, scenario, ads):
    return world.run_of(world.rollout(scenario, ads))


def intersection():
    return pafot.World("intersection-v0", planner_hz=5)


def world_for(entry):
    return entry.world(intersection() if entry in JUNCTIONS else None)


def run_of(entry, **values):
    world = world_for(entry)
    return driven(world, entry.scenario(world, **values), keeps_speed)


# A tail that follows closely hits every ego that stops for the leader, so the leader never drives off.
COMING_UP = [entry for entry in ENTRIES if entry.name != "classic/tail-after-stop"]


@table("entry", COMING_UP)
def test_entry_comes_up_as_asked_for_constant_speed(entry):
    run = run_of(entry)
    assert run.ads_error is None
    assert [each.words for each in run.asked if not each.is_met] == []
    if entry in ON_HIGHWAYS:
        assert run.ego.speed[0] == pytest.approx(entry.parameters["ego_speed"].default, abs=0.05)


@table("entry", ENTRIES)
def test_defaults_lie_in_ranges_with_units_and_a_source(entry):
    assert entry.about.endswith(".")
    assert entry.source
    for name, each in entry.parameters.items():
        assert each.low <= each.default <= each.high, name
        assert bool(each.unit) == (name != "side")
        assert each.about


def ends():
    for entry in ENTRIES:
        for name, each in entry.parameters.items():
            for value in {each.low, each.default, each.high}:
                yield entry, name, value


def test_both_ends_of_each_range_fit_or_say_why_not():
    refused = []
    for entry, name, value in ends():
        world = world_for(entry)
        try:
            why = fits(entry.scenario(world, **{name: value}), world)
        except ScenarioError as error:
            why = str(error)
        if why:
            assert "expected" in why
            assert "received" in why
            refused.append((entry.name, name, value))
    # Of an ego at 5 km/h, a vehicle that is 20 km/h slower would drive backwards; junctions have their own limits.
    own = [(name, number) for name, number, _ in refused if not name.startswith("junction/")]
    assert own == [("r157/slow-leader", "ego_speed")]
    defaults = [name for name, number, value in refused if value == entry_of(name).parameters[number].default]
    assert defaults == []


@table("entry", JUNCTIONS)
def test_junction_names_a_world_that_has_it(entry):
    with pytest.raises(NoPlaceError) as caught:
        entry.scenario(entry.world())
    named = re.search(r'pafot\.World\("([\w-]+)", planner_hz=5\)', str(caught.value))
    world = entry.world(pafot.World(named[1], planner_hz=5))
    assert fits(entry.scenario(world), world) == ""


def test_junction_takes_the_way_with_the_widest_bends_and_no_speed_above_it():
    """Else all speeds above that of the bend would be one situation."""
    entry = entry_of("junction/crossing")
    world = entry.world(pafot.World("intersection-v0", planner_hz=5))
    straight = entry.scenario(world, speed=10.0)
    assert straight.npcs[0][0].zone == "o1>o3"
    run = driven(world, straight, keeps_speed)
    assert run.trace.states[run.trace.arrivals[0][0], 1, SPEED] == pytest.approx(10.0, abs=0.3)
    with pytest.raises(ScenarioError, match=r"at most 11.0 m/s, which the bends of o1>o3 allow at the zone, .* 12"):
        entry.scenario(world, speed=12.0)


def test_world_lasts_as_long_as_the_scenario_takes():
    assert [entry.world().duration for entry in ON_HIGHWAYS] == [entry.seconds for entry in ON_HIGHWAYS]
    following = entry_of("r157/following")
    assert run_of(following).duration == following.seconds
    short = pafot.Highway(duration=7.0)
    assert driven(following.world(short), following.scenario(), keeps_speed).duration == 7.0


def test_side_is_the_one_from_which_the_vehicle_comes():
    right, left = (CUT_IN.scenario(side=side).npcs[0][0] for side in (1, -1))
    assert (right.beside, right.steps[0].lane) == (1, "left")
    assert (left.beside, left.steps[0].lane) == (-1, "right")


def test_time_to_contact_is_reached_as_the_lane_change_ends():
    entry = entry_of("euro-ncap/cut-in")
    run = run_of(entry, ttc=1.5, ego_speed=30.0, target_speed=20.0, lateral_speed=0.5)
    end = run.trace.arrivals[0][0]
    ego, npc = run.trace.states[end, :, 0]
    assert (npc - ego - run.trace.sizes[:, 0].mean()) / 10.0 == pytest.approx(1.5, abs=0.3)


def test_leader_leaves_at_its_time_to_contact():
    leader, standing = (chain[0] for chain in entry_of("euro-ncap/cut-out").scenario(ttc=3.0, ego_speed=15.0).npcs)
    assert (leader.speed, standing.speed) == (15.0, 0.0)
    assert standing.ahead - leader.ahead - 5.0 == 45.0


@table(
    ("values", "error", "text"),
    [
        ({"gpa": 20.0}, RequestError, "one of the parameters ego_speed, .*, received 'gpa'; did you mean 'gap'?"),
        ({"gap": "20"}, RequestError, "r157/cut-in: gap: expected a number, received '20'"),
        ({"gap": float("nan")}, RequestError, "expected a number, received nan"),
        ({"gap": True}, RequestError, "expected a number, received True"),
        ({"ego_speed": 1.0}, ScenarioError, "speed: expected m/s, at least 0"),
        ({"gap": 1000.0}, ScenarioError, "expected a number from -500 to 500"),
    ],
)
def test_wrong_parameter_is_refused(values, error, text):
    with pytest.raises(error, match=text):
        CUT_IN.scenario(**values)


def test_names_are_unique_and_groups_stand_for_their_entries():
    assert len({*NAMES}) == len(NAMES)
    assert chosen(()) == ENTRIES
    assert [entry.name for entry in chosen(("junction", "r157/cut-in", "junction/merge"))] == [
        "junction/crossing",
        "junction/oncoming-turn",
        "junction/merge",
        "r157/cut-in",
    ]


@table("name", ["r157/cut-inn", "r157/", "", "cut-in", 3, None, ["r157"]])
def test_unknown_entry_is_refused_with_all_names(name):
    with pytest.raises(RequestError, match=r"catalogue: expected one of r157/cut-in, .*junction/merge, received"):
        chosen((name,))
