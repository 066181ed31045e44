"""The kit that checks a world accepts this package's worlds, and names the promise that a world breaks."""

from dataclasses import replace
from functools import cache
from itertools import chain
from types import SimpleNamespace

import numpy as np
import pytest

from pytest_pafot import Cell, Highway, LaneInstruction, NpcLimits, PositionInstruction, Scenario, World
from pytest_pafot.model.trace import ACCELERATION, HEADING, LANE, SPEED, STEERING, Outcome, X, Y
from pytest_pafot.testing import OBSERVED, _Calls, _check_obedience, _run, check_world
from pytest_pafot.testing.traces import contacts, end, form, motion, of_runs, places_at_start, touching
from tests.helpers.stopped_clock import StoppedClock
from tests.helpers.tables import table

pytestmark = pytest.mark.filterwarnings("ignore:check_world. no collision:RuntimeWarning")  # in runs of 4 s

SHORT = {"npcs": 2, "genes": 2, "gene_seconds": 2.0}
ROAD = Highway(duration=4.0, hang_limit=0.3)


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """Replace the clock: it advances only when the check has an ADS wait for its end, and then at once."""
    clock = StoppedClock(monkeypatch)
    monkeypatch.setattr("pytest_pafot.testing.time", SimpleNamespace(sleep=clock.sleep))


class Own:
    """A user's own world that keeps all promises; broken worlds derive from it."""

    speed_limit, longest_run, hang_limit = 26.8, 4.0, 0.3
    limits = NpcLimits()

    def __init__(self, number=1):
        self.number = number

    def rollout(self, scenario, ads_factory):
        return self.changed(ROAD.rollout(scenario, ads_factory))

    def changed(self, trace):
        return trace

    def to_dict(self):
        return {"number": self.number}

    @classmethod
    def from_dict(cls, data):
        return cls(**data)


def wrong(base=Own, change=None, **members):
    """Return a class of worlds with other members, or whose traces are changed."""
    changed = {} if change is None else {"changed": lambda self, trace: change(trace)}
    return type("Wrong", (base,), members | changed)


def with_states(trace, change):
    states = trace.states.copy()
    change(states)
    return replace(trace, states=states)


def nudged(trace):
    return with_states(trace, lambda states: np.add.at(states, (-1, 0, X), 1.0))


@pytest.mark.parametrize(("world", "given"), [
    (ROAD, {}),
    (World("highway-v0", duration=4.0, hang_limit=0.3), {"ads": lambda: lambda seen: 1}),
    (Own(), {}),
], ids=["Highway", "World", "of one's own"])  # fmt: skip
def test_a_world_that_keeps_its_promises_passes(world, given):
    check_world(world, runs=3, **SHORT, **given)


class Recorded:
    def __init__(self, world, change):
        self.world, self.change = world, change

    def __getattr__(self, name):
        return getattr(self.world, name)

    def rollout(self, scenario, ads_factory):
        return self.change(self.world.rollout(scenario, ads_factory))


@cache
def environment(env_id):
    return World(env_id, duration=3.0, hang_limit=0.3)


def constant_action():
    return lambda seen: 1


@pytest.mark.oracle
def test_an_environment_in_which_npcs_cross_passes():
    check_world(environment("intersection-v0"), runs=2, ads=constant_action, npcs=2)


@table(("env_id", "change", "promise"), [
    ("intersection-v0", {"zones": ()}, "zones are those of the instructions"),
    ("intersection-v0", {"on_way": None}, "on_way has the places of crossing NPCs"),
    ("intersection-v0", {"track": None}, "track is recorded if an NPC crosses"),
    ("merge-v0", {"track": np.full((46, 3, 5), np.nan)}, "track has NaN only for crossing NPCs"),
])  # fmt: skip
def test_only_crossing_npcs_must_be_recorded_as_crossing(env_id, change, promise):
    def changed(trace):
        return replace(trace, **change) if any(trace.zones) or env_id == "merge-v0" else trace

    with pytest.raises(AssertionError, match=promise):
        check_world(Recorded(environment(env_id), changed), runs=2, ads=constant_action, npcs=2)


class Random(Own):
    runs = 0

    def changed(self, trace):
        self.runs += 1
        return with_states(trace, lambda states: np.add.at(states, (-1, 0, X), 1e-9 * self.runs))


class Throws(Own):
    def rollout(self, scenario, ads_factory):
        trace = super().rollout(scenario, ads_factory)
        if trace.error is not None:
            raise ValueError(trace.error.message)
        return trace


class Harmed(Own):
    is_harmed = False

    def changed(self, trace):
        trace = nudged(trace) if self.is_harmed else trace
        self.is_harmed |= trace.error is not None
        return trace


class Different(Own):
    is_first = True

    def changed(self, trace):
        return trace if self.is_first else nudged(trace)

    @classmethod
    def from_dict(cls, data):
        again = cls(**data)
        again.is_first = False
        return again


def changing(**fields):
    return wrong(change=lambda trace: replace(trace, **fields))


def put(*place, value):
    def change(states):
        states[place] = value

    return wrong(change=lambda trace: with_states(trace, change))


def stacked(trace):
    return with_states(trace, lambda states: np.copyto(states, states[:, :1]))


BROKEN = [
    (Random, "the same scenario gives the same trace"),
    (wrong(change=lambda t: replace(t, executed=replace(t.executed, ego_speed=t.executed.ego_speed - 1.0))),
     "the scenario as executed gives the same trace"),
    (Throws, "a run ends in a trace, whatever the ADS does"),
    (wrong(change=lambda trace: replace(trace, outcome=Outcome.SAFE, error=None) if trace.error else trace),
     "an ADS that raises ends its run as ads_error"),
    (Harmed, "an ADS that raises does not affect the next run"),
    (wrong(guards_ads=True, rollout=lambda self, *given: Highway(duration=4.0).rollout(*given)),
     "an ADS that hangs ends its run as hang"),  # as it says, but its decisions may take 30 s
    (wrong(rollout=lambda self, *given: ROAD.rollout(*given).states), "rollout returns a pafot.Trace"),
    (wrong(to_dict=lambda self: {"number": object()}), "to_dict returns plain data that a file can store"),
    (wrong(from_dict=lambda data: Own(data["numbers"])), "from_dict accepts the data of to_dict"),
    (wrong(from_dict=classmethod(lambda cls, data: cls(data["number"] + 1))),
     r"from_dict\(to_dict\(\)\) has the same data"),
    (Different, r"from_dict\(to_dict\(\)\) gives the same traces"),
    (wrong(change=lambda trace: replace(trace, states=trace.states[:, :-1], sizes=trace.sizes[:-1])),
     "states contain the ego and each NPC"),
    (wrong(longest_run=3.0), "no run is longer than longest_run"),
    (wrong(limits=NpcLimits(acceleration=0.1, braking=0.1)), "the acceleration of NPCs is from"),
    (wrong(limits=NpcLimits(jerk=0.1)), "the jerk of NPCs is from"),
    (wrong(limits=NpcLimits(overspeed=1.0), speed_limit=15.0), "the speed of NPCs is from"),
    (wrong(limits=NpcLimits(heading=0.01)), "the heading of NPCs is from"),
    (wrong(limits=NpcLimits(lateral_acceleration=0.1)), "the lateral acceleration of NPCs is"),
    (changing(scenario=Scenario(npcs=[[PositionInstruction(1, 9.0)]])), "trace.scenario is the requested scenario"),
    (changing(ads_hz=7), "ads_hz divides physics_hz"),
    (changing(outcome=Outcome.COLLISION), "there is a collision if the outcome says so"),
    (changing(sizes=np.zeros((3, 2))), "vehicles have a length and a width"),
    (changing(arrivals=5), r"Run\(trace\).explain\(\) describes the run"),
    (put(-1, 0, X, value=np.nan), "states are finite"),
    (put(-1, 0, LANE, value=9), "the column lane is an index of lanes, or -1"),
    (put(0, 0, SPEED, value=9), "the ego starts as fast as the scenario says"),
    (put(0, 0, ACCELERATION, value=1), "acceleration and steering of the first row are 0"),
    (wrong(change=stacked, limits=None), "no vehicles touch at the start"),
]  # fmt: skip


@table(("broken", "promise"), BROKEN)
def test_broken_promise_of_a_world_is_named(broken, promise):
    with pytest.raises(AssertionError, match=f"^expected that {promise}"):
        check_world(broken(), runs=2, **SHORT)


@table("name", ["rollout", "to_dict", "speed_limit", "longest_run"])
def test_incomplete_world_is_refused_by_the_check(name):
    parts = {each: getattr(Own, each) for each in ("rollout", "to_dict", "speed_limit", "longest_run") if each != name}
    told = f"^expected that a world has all that a search needs, received no {name}$"
    with pytest.raises(AssertionError, match=told):
        check_world(type("Lacking", (), parts)())


def test_unsuitable_ads_is_distinguished_from_world_fault():
    told = r"the ADS of the check drives in this world, received .*; give a different ads="
    with pytest.raises(AssertionError, match=told):
        check_world(World("highway-v0", duration=4.0), runs=1, **SHORT)


def test_check_skips_hanging_if_it_takes_long(monkeypatch):
    monkeypatch.setattr("pytest_pafot.testing.time.sleep", lambda seconds: pytest.fail("tried"))
    check_world(Highway(duration=4.0), runs=1, **SHORT)


# --- what a trace says of the motion, the road and the contacts

LONGER = Highway(duration=20.0)


class InLanes(Own):
    """A world of more lanes in which NPCs can have Lane-Instructions, with runs that are long enough to show them."""

    longest_run, has_lane_instructions = 6.0, True

    def rollout(self, scenario, ads_factory):
        self.seen = [*getattr(self, "seen", []), scenario]
        return replace(ROAD, duration=6.0).rollout(self.told(scenario), ads_factory)

    def told(self, scenario):
        return scenario


class KeepsLanes(InLanes):
    def told(self, scenario):
        return with_lanes(scenario, {"left": "keep", "right": "keep"})

    def rollout(self, scenario, ads_factory):
        trace = super().rollout(scenario, ads_factory)
        return replace(trace, scenario=scenario, executed=scenario)


class Mirrored(KeepsLanes):
    """The world's lanes are counted from the other side, and only Lane-Instructions show it."""

    def told(self, scenario):
        return with_lanes(scenario, {"left": "right", "right": "left"})


def with_lanes(scenario, instead):
    chains = [
        tuple(replace(gene, lane=instead.get(gene.lane, gene.lane)) for gene in chain)
        if isinstance(chain[0], LaneInstruction)
        else chain
        for chain in scenario.npcs
    ]
    return replace(scenario, npcs=tuple(chains))


def test_world_is_tried_with_the_instructions_that_it_declares():
    for declares in (True, False):
        world = InLanes()
        world.has_lane_instructions = declares
        check_world(world, runs=3, npcs=2, genes=3, gene_seconds=2.0)
        kinds = {type(chain[0]) for scenario in world.seen for chain in scenario.npcs}
        assert kinds == ({PositionInstruction, LaneInstruction} if declares else {PositionInstruction})


@table("made", [KeepsLanes, Mirrored])
def test_world_that_declares_lane_instructions_must_follow_them(made):
    with pytest.raises(AssertionError, match="NPCs change lanes by Lane-Instructions, as has_lane_instructions decl"):
        check_world(made(), runs=3, npcs=2, genes=3, gene_seconds=2.0)


class Driven:
    """A user's own world whose runs are long enough for collisions; broken worlds derive from it."""

    speed_limit, longest_run, road = 26.8, 20.0, LONGER

    def rollout(self, scenario, ads_factory):
        return self.changed(self.road.rollout(scenario, ads_factory))

    def changed(self, trace):
        return trace

    def to_dict(self):
        return {}


def columns(column, change):
    """Return a class whose traces have another column of states."""

    def changed(trace):
        return with_states(trace, lambda states: np.copyto(states[..., column], change(states[..., column])))

    return wrong(Driven, changed)


def lanes(**change):
    """Return a class whose traces have other lanes."""
    return wrong(Driven, with_lanes_of(**change))


def with_lanes_of(**new):
    return lambda trace: replace(
        trace, lanes=tuple(replace(each, **{k: f(each) for k, f in new.items()}) for each in trace.lanes)
    )


def hits(**change):
    """Return a class whose traces have other collisions."""

    def changed(trace):
        hit = trace.collision
        return (hit and replace(trace, collision=replace(hit, **{k: f(hit) for k, f in change.items()}))) or trace

    return wrong(Driven, changed)


def traces(change):
    return wrong(Driven, change)


def with_bumpers(trace):
    """Return a trace with the front bumpers of NPCs as their places."""
    return with_states(trace, lambda states: np.add(states[:, 1:, X], 2.5, out=states[:, 1:, X]))


def unreported(trace):
    """Return a trace that goes on after a collision, through the vehicle that the ego has hit."""
    if trace.collision is None:
        return trace
    states = np.concatenate([trace.states, np.repeat(trace.states[-1:], 300 - trace.ticks, axis=0)])
    ticks = np.arange(300 - trace.ticks)[:, None] + 1
    states[trace.ticks + 1 :, :, X] += ticks * trace.states[-1, :, SPEED] / 15
    states[trace.ticks + 1 :, :, [ACCELERATION, STEERING]] = 0.0
    return replace(trace, states=states, outcome=Outcome.SAFE, collision=None)


OPPOSITE = {"front": "rear", "rear": "front", "left": "right", "right": "left"}


class Resumed(Driven):
    def rollout(self, scenario, ads_factory, *, decisions=()):
        return self.changed(LONGER.rollout(scenario, ads_factory, decisions=decisions))


class Shared(Driven):
    ads = None

    def rollout(self, scenario, ads_factory):
        self.ads = self.ads or ads_factory()
        return super().rollout(scenario, lambda: self.ads)


class Hoards(Driven):
    """The world makes one ADS of each factory."""

    made = None, None

    def rollout(self, scenario, ads_factory):
        if self.made[0] is not ads_factory:
            self.made = ads_factory, ads_factory()
        return super().rollout(scenario, lambda: self.made[1])


class Misled(Driven):
    """What drives is another scenario than the requested one, as a function of a class makes it."""

    def rollout(self, scenario, ads_factory):
        trace = super().rollout(self.told(scenario), ads_factory)
        return replace(trace, scenario=scenario, executed=scenario)


def misled(told):
    return wrong(Misled, told=lambda self, scenario: told(scenario))


def without_instructions(scenario):
    npcs = [[PositionInstruction(chain[0].cell, 20.0)] * scenario.genes for chain in scenario.npcs]
    return replace(scenario, npcs=npcs)


def at_one_speed(scenario):
    return replace(scenario, npcs=[[gene.with_speed(15.0) for gene in one] for one in scenario.npcs])


class Parked(Driven):
    def rollout(self, scenario, ads_factory):
        def ignored():
            ads = ads_factory()
            return lambda seen: [ads(seen), (0.0, 0.0)][1]

        return LONGER.rollout(scenario, ignored)


def early(trace):
    return replace(trace, error=replace(trace.error, tick=1)) if trace.error else trace


def cut(trace):
    return replace(trace, states=trace.states[:150]) if trace.outcome is Outcome.SAFE else trace


WRONG = [
    (columns(Y, lambda y: -y), r"states\[..., X\] and states\[..., Y\] of the ego are within the lane of"),
    (columns(HEADING, np.degrees), r"states\[..., HEADING\] is the direction of motion in rad"),
    (columns(HEADING, lambda angle: -angle), r"states\[..., HEADING\] is the direction of motion"),
    (columns(SPEED, lambda v: v * 3.6), r".*states\[0, 0, SPEED\] at scenario.ego_speed"),
    (columns(ACCELERATION, lambda a: a / 9.81), r"states\[..., ACCELERATION\] is the acceleration that"),
    (columns(STEERING, np.degrees), r"states\[..., STEERING\] is in rad"),
    (columns(STEERING, lambda angle: -angle), r"states\[..., STEERING\] of NPCs is positive where"),
    (columns(LANE, lambda lane: 0 * lane - 1), r"states\[..., LANE\] of the ego is -1 only off the road"),
    (columns(LANE, lambda lane: np.minimum(lane + 1, 3)), r"states\[..., X\] and states\[..., Y\] of"),
    (lanes(y=lambda lane: -lane.y), "states.*|lanes are listed from the left"),
    (lanes(width=lambda lane: 2 * lane.width), r"lanes\[...\].width is the width of a lane"),
    (lanes(speed_limit=lambda lane: 3.6 * lane.speed_limit), "lanes have a speed_limit in m/s"),
    (lanes(length=lambda lane: np.inf), r"lanes\[0\] has a length, a width and a speed_limit"),
    (hits(time=lambda hit: hit.time + 1.0), "collision.time is the time of collision.tick"),
    (hits(tick=lambda hit: hit.tick - 1), "collision.tick is the last tick of the run"),
    (hits(npc=lambda hit: hit.npc + 1), "collision.npc is"),
    (hits(side=lambda hit: OPPOSITE[hit.side]), "collision.side is the side of the ego that was hit"),
    (hits(cell=lambda hit: Cell((hit.cell + 3) % 8 + 1)), "collision.cell is the cell of the NPC"),
    (hits(cell=lambda hit: None), "collision.cell is a cell"),
    (hits(ego_speed=lambda hit: 3.6 * hit.ego_speed), "collision.ego_speed is the speed of the ego"),
    (hits(closing_speed=lambda hit: -hit.closing_speed), "collision.closing_speed is the difference of"),
    (traces(with_bumpers), ".*states.* are of the centres of boxes with sizes"),
    (traces(lambda trace: replace(trace, sizes=trace.sizes / 2)), ".*the boxes of the ego and of collision"),
    (traces(lambda trace: replace(trace, sizes=trace.sizes[:, ::-1])), "sizes has the length before"),
    (traces(unreported), "the ego's box touches no NPC's before the end of a run"),
    (traces(cut), "states of a run with the outcome safe last 20 s"),
    (traces(early), "error.tick is the tick of the decision of an ADS that raises"),
    (wrong(Resumed, lambda trace: replace(trace, actions=())), "actions has one action for each decision"),
    (traces(lambda trace: replace(trace, ads_hz=3)), "the ADS decides ads_hz times a second"),
    (traces(lambda trace: replace(trace, physics_hz=15.0)), "physics_hz and ads_hz are whole numbers"),
    (traces(lambda t: replace(t, outcome=Outcome.OFF_ROAD) if t.outcome is Outcome.SAFE else t),
     "the outcome is off_road if the ego was in lane -1"),
    (traces(lambda trace: replace(trace, off_road_tick=5)), "off_road_tick is the first tick with the ego"),
    (Shared, "rollout calls ads_factory once, for a fresh ADS"),
    (Hoards, "rollout calls ads_factory once, for a fresh ADS, received an ADS of an earlier run"),
    (columns(X, lambda x: x + 2.5), "an ADS that receives a pafot.Observation.* sees the ego as in states"),
    (misled(without_instructions), "NPCs follow their instructions|the scenario as executed gives the same trace"),
    (misled(lambda scenario: replace(scenario, gene_seconds=scenario.gene_seconds / 2)),
     "states depend only on the first instructions until scenario.gene_seconds|states of a run"),
    (misled(lambda scenario: replace(scenario, ego_lane=2)), "the ego starts in scenario.ego_lane"),
    (Parked, "the ego follows its ADS"),
    (wrong(Driven, takes_over="careful-human"), "takes_over is a tuple of names"),
    (wrong(Driven, speed_limit=96.5), "speed_limit is in m/s, at most 70, received 96.5"),
    (wrong(Driven, longest_run="long"), "longest_run is a number above 0"),
]  # fmt: skip


@table(("made", "promise"), WRONG)
def test_wrong_world_is_refused_by_name_of_field(made, promise):
    with pytest.raises(AssertionError, match=f"^expected that ({promise})"):
        check_world(made(), runs=2)


def test_world_with_long_runs_passes_without_warning(recwarn):
    check_world(Driven())
    assert [str(each.message) for each in recwarn] == []


def test_check_without_any_collision_says_so():
    with pytest.warns(RuntimeWarning, match="no collision in 20 runs, so nothing about collisions was checked"):
        check_world(Own(), runs=3, **SHORT)


def test_scaled_actions_pass_where_nothing_replays_them():
    class Slippery(Driven):
        def rollout(self, scenario, ads_factory):
            def slipping():
                ads = ads_factory()
                return lambda seen: tuple(0.5 * each for each in ads(seen))

            return LONGER.rollout(scenario, slipping)

    check_world(Slippery())


def test_instructions_without_time_to_show_are_not_demanded():
    late = misled(lambda scenario: replace(scenario, npcs=[[chain[0]] * scenario.genes for chain in scenario.npcs]))
    late.longest_run, late.road = 11.0, Highway(duration=11.0)
    check_world(late(), gene_seconds=10.0)


def test_runs_in_which_no_npc_can_follow_do_not_count_if_one_follows_in_another():
    npcs = [[PositionInstruction(Cell.REAR, 20.0), PositionInstruction(Cell.REAR, 5.0)]]
    asked = [Scenario(npcs=npcs, ego_lane=lane, gene_seconds=5.0) for lane in (0, 0, 1)]
    calls = _Calls(lambda: lambda observation: (0.0, 0.0))
    world = misled(lambda scenario: scenario if scenario.ego_lane else without_instructions(scenario))()
    done = [_run(world, scenario, calls) for scenario in asked]
    _check_obedience(world, done, [], 2)
    with pytest.raises(AssertionError, match="NPCs follow their instructions"):
        _check_obedience(world, done[:2], [], 2)


def broken_motion(*traces):
    return next(((promise, received) for is_kept, promise, received in motion(traces) if not is_kept), ("", ""))


def test_vehicle_that_jumps_is_named_by_its_step_and_wrong_speeds_by_theirs():
    scenario = Scenario(npcs=[[PositionInstruction(Cell.REAR, 20.0)]])
    trace = Highway(duration=4.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    jumps = with_states(trace, lambda states: np.add(states[20:, 1, X], -119.0, out=states[20:, 1, X]))
    slow = with_states(trace, lambda states: np.divide(states[..., SPEED], 3.6, out=states[..., SPEED]))
    promise, received = broken_motion(jumps)
    assert promise.startswith("states has a row for each tick, at 15 Hz, none repeated, and no vehicle jumps")
    assert received.endswith("of NPC 0 to tick 20")
    assert broken_motion(slow)[0].startswith("states[..., SPEED] of the ego is its speed")


def test_collision_in_the_first_tick_shows_no_motion_and_no_error():
    stops = Scenario(npcs=[[PositionInstruction(Cell.FRONT, 0.0)]])
    trace = Highway(duration=20.0).rollout(stops, lambda: lambda seen: (0.0, 0.0))
    assert trace.outcome is Outcome.COLLISION
    assert broken_motion(replace(trace, states=trace.states[-2:]), trace) == ("", "")


def test_cell_beyond_the_road_asks_for_no_place():
    scenario = Scenario(npcs=[[PositionInstruction(Cell.RIGHT, 20.0)]], ego_lane=1)
    trace = Highway(duration=1.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    behind = with_states(trace, lambda states: np.add(states[:, 1:, X], -22.0, out=states[:, 1:, X]))
    for lanes_left, is_kept in ((trace.lanes, False), (trace.lanes[:2], True)):
        kept = [each for each, *_ in places_at_start(replace(behind, lanes=lanes_left))]
        assert all(kept) == is_kept


def test_npcs_that_touch_end_the_run_as_invalid():
    scenario = Scenario(npcs=[[PositionInstruction(cell, 20.0)] for cell in (Cell.FRONT_LEFT, Cell.REAR_LEFT)])
    trace = Highway(duration=2.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    touching = with_states(trace, lambda states: np.copyto(states[20:, 2], states[20:, 1]))
    ended = replace(touching, states=touching.states[:21], outcome=Outcome.INVALID)
    for each, is_kept in ((trace, True), (touching, False), (ended, True), (replace(trace, outcome="invalid"), False)):
        assert all(kept for kept, *_ in contacts(replace(each, outcome=Outcome(each.outcome)))) == is_kept


def test_run_that_ends_too_early_says_which_box_touches_the_ego_then():
    """A simulator that stops at a contact of its own, and reports none, is told which one it was."""
    world, cells = Highway(duration=20.0), (Cell.FRONT_LEFT, Cell.REAR_LEFT)
    scenario = Scenario(npcs=[[PositionInstruction(cell, 20.0)] for cell in cells])
    trace = world.rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    cut = replace(trace, states=trace.states[:21], outcome=Outcome.SAFE)
    on_ego = with_states(cut, lambda states: np.copyto(states[20, 2], states[20, 0]))
    contact = "; the boxes of the ego and of NPC 1 touch then, so is it a collision?"
    for each, ending in ((cut, " s"), (on_ego, contact)):
        promise, received = next((what, why) for kept, what, why in end(world, each) if not kept)
        assert promise.startswith("states of a run with the outcome safe last ")
        assert received.startswith(f"20 ticks at {trace.physics_hz} Hz, ")
        assert received.endswith(ending)


def test_hang_limit_of_own_world_is_kept_for_it():
    class Waits(Own):
        def rollout(self, scenario, ads_factory):
            return Highway(duration=4.0).rollout(scenario, ads_factory)  # in which a decision may take 30 s

    check_world(Waits(), runs=1, **SHORT)


# --- roads that bend


@cache
def bent():
    """Return a world on a road that bends, and a run in it in which a human drives and an NPC changes lanes."""
    racetrack = World("racetrack-v0", duration=20.0)
    world = SimpleNamespace(speed_limit=racetrack.speed_limit, longest_run=racetrack.longest_run)  # without limits
    chain = [PositionInstruction(cell, 10.0) for cell in (Cell.FRONT, Cell.FRONT_LEFT)]
    asked = Scenario(npcs=[chain], ego_lane=1, ego_speed=10.0, gene_seconds=10.0)
    return world, racetrack.rollout_reference(asked, "careful-human")


def column(index, function):
    def change(trace):
        return with_states(trace, lambda states: np.copyto(states[..., index], function(states[..., index])))

    return change


def mirrored(trace):
    return with_states(trace, lambda states: np.negative(states, out=states, where=np.isin(range(7), (Y, HEADING))))


LANES_LEFT = {
    "y": lambda lane: -lane.y,
    "heading": lambda lane: -lane.heading,
    "points": lambda lane: tuple((x, -y) for x, y in lane.points),
}


@table(("change", "promise"), [
    (lambda trace: trace, None),
    (mirrored, r"states[..., X] and states[..., Y] of the ego are within the lane"),
    (lambda trace: with_lanes_of(**LANES_LEFT)(mirrored(trace)), "lanes side by side are listed from the left"),
    (column(LANE, lambda lane: np.where(lane < 0, lane, 1 - lane)), "states[..., X] and states[..., Y] of"),
    (column(HEADING, lambda angle: 0.0 * angle), "states[..., HEADING] "),
    (column(STEERING, np.negative), "states[..., STEERING] of the ego is positive where"),
    (lambda trace: replace(trace, track=None), "track has the places of all vehicles on the ego's way if the road"),
    (with_lanes_of(width=lambda lane: 2 * lane.width), "lanes[...].width is the width of a lane"),
    (with_lanes_of(heading=lambda lane: lane.heading + 1.0), "lanes[0].heading is the direction of its first points"),
    (with_lanes_of(points=lambda lane: lane.points[::-1]), "lanes[0].points begins at x and y of the lane"),
])  # fmt: skip
def test_wrong_trace_on_a_bend_is_refused_by_name_of_field(change, promise):
    world, trace = bent()
    wrong = change(trace)
    promises = chain(form(world, wrong.scenario, wrong), of_runs(world, [wrong]))
    found = next((promise for is_kept, promise, _ in promises if not is_kept), None)
    assert found == promise or found.startswith(promise), found


# --- what NPCs do with their instructions, what becomes of errors, and what a world has


def anonymous(trace):
    return replace(trace, error=replace(trace.error, kind="Error", message="failed")) if trace.error else trace


def cleared(trace):
    return with_states(trace, lambda states: np.add.at(states, (1, 0, X), 1.0)) if trace.error else trace


@table(("made", "promise"), [
    (misled(at_one_speed), "an NPC in the cell of its instruction takes on its speed"),
    (traces(anonymous), "error.kind and error.message are those of the exception of an ADS"),
    (traces(cleared), "states has the run up to the decision of an ADS that raises"),
])  # fmt: skip
def test_ignored_instruction_or_lost_error_is_refused(made, promise):
    with pytest.raises(AssertionError, match=f"^expected that ({promise})"):
        check_world(made(), runs=4)


def collisions():
    scenarios = [
        Scenario(npcs=[[PositionInstruction(cell, 0.0)]]) for cell in (Cell.FRONT, Cell.FRONT_LEFT, Cell.FRONT)
    ]
    return [LONGER.rollout(each, lambda: lambda seen: (0.5, 0.0)) for each in scenarios]


def test_collisions_before_contacts_are_refused():
    hits = [trace for trace in collisions() if trace.collision] * 3
    assert all(is_kept for is_kept, *_ in touching(hits))
    early = [replace(trace, states=trace.states[:-3]) for trace in hits]
    assert not all(is_kept for is_kept, *_ in touching(early))


def test_ads_on_a_bend_sees_the_ego_as_states_or_track_have_it():
    class Hourly(Recorded):
        def rollout(self, scenario, ads_factory):
            def sees():
                ads = ads_factory()
                return lambda seen: ads(SimpleNamespace(**{name: getattr(seen, name) for name in OBSERVED} | ego(seen)))

            return self.world.rollout(scenario, sees)

    def ego(seen):
        return {"ego": seen.ego._replace(speed=3.6 * seen.ego.speed)}

    with pytest.raises(AssertionError, match=r"an ADS that receives a pafot.Observation.* sees the ego as in states"):
        check_world(Hourly(World("racetrack-v0", duration=3.0, planner_hz=5), None), runs=2, npcs=1)
