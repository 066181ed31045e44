"""What worlds say: errors in their arguments, files, environments, simulators and policies, and how runs end."""

import re
from dataclasses import replace
from functools import partial

import pytest
from highway_env.vehicle.behavior import IDMVehicle

from pytest_pafot import Highway, LaneCommand, Perception, Run, Scenario, SimulatorWorld, World
from pytest_pafot.findings.decisions import Moment
from pytest_pafot.findings.finding import Expect, ads_failure, disagreement, unhandled
from pytest_pafot.findings.verdict import Failure
from pytest_pafot.model.instructions import PositionInstruction
from pytest_pafot.model.trace import first_difference
from pytest_pafot.searches.harness import ads_text
from pytest_pafot.world import NpcLimits, from_dict
from pytest_pafot.world.codec import check_named_world, describe_limits, described
from pytest_pafot.world.driving.conditions import Evaluated, Evaluation, group_conditions, parting
from pytest_pafot.world.driving.policy import make_ads
from pytest_pafot.world.engines.episode import drive_episode
from pytest_pafot.world.engines.simulation import Simulators
from tests.helpers.refusals import error_of
from tests.helpers.stopped_clock import StoppedClock
from tests.helpers.world_cases import constant_speed
from tests.world import test_codec as codec
from tests.world import test_errors as errors
from tests.world import test_gym_environment as gym
from tests.world import test_plausible as plausible
from tests.world import test_simulator as simulator
from tests.world import test_taking_over as taking_over
from tests.world import test_vehicle_types as vehicle_types
from tests.world.conftest import register  # noqa: F401
from tests.world.driving import test_ads as ads
from tests.world.driving import test_lane_command as lane_command
from tests.world.driving import test_perception as perception
from tests.world.engines import test_egos as egos
from tests.world.engines import test_environment_hangs as hangs
from tests.world.engines import test_gym_replay as gym_replay
from tests.world.engines import test_own_ends as own_ends
from tests.world.engines import test_traffic as traffic
from tests.world.engines.test_own_ends import ending  # noqa: F401
from tests.world.guard import test_closing as closing
from tests.world.guard import test_hang_guard as forking
from tests.world.kernel import test_road_directors as road_directors
from tests.world.kernel import test_road_sensor as road_sensor
from tests.world.roads import test_every_road as every_road
from tests.world.test_gym_environment import mine  # noqa: F401


def errors_of(call, table):
    """Return the errors of a call with each row of a table, whose last column is what the error is about."""
    return {name: error_of(call, *given) for name, (*given, _) in table.items()}


def check(env_id, config=None, **options):
    World(env_id, config=config, **options).check()


def warning_of(call, *given):
    with pytest.warns(RuntimeWarning) as warned:
        call(*given)
    return str(warned[0].message)


def test_options_of_worlds(snapshot):
    limits = {name: error_of(NpcLimits, **{name: 0}) for name in errors.LIMITS}
    told = errors_of(errors.wrong_highway, errors.WRONG_HIGHWAYS)
    for rates in errors.FREQUENCIES:
        told[f"rates of {rates}"] = error_of(
            lambda hz, ads_hz: Highway(physics_hz=hz, ads_hz=ads_hz), *rates
        )
        told[f"rates of an environment of {rates}"] = error_of(
            lambda *hz: errors.gym_with(*hz).check(), *rates
        )
    gyms = errors_of(lambda options: check("highway-fast-v0", **options), errors.WRONG_GYMS)
    planners = errors_of(lambda make: make(), road_sensor.REFUSED)
    told["lasting"], told["lasts"] = (
        error_of(Highway().lasting, -5.0),
        error_of(Highway, lasts=-1.0),
    )
    told["ends"] = error_of(World, "highway-v0", ends="never")
    told["an ego that cannot follow the bends"] = error_of(
        lambda: check("racetrack-v0", ego="truck")
    )
    assert {"limits": limits, "environments": gyms, "planners": planners, **told} == snapshot


def check_traffic(kind):
    World("highway-v0", traffic.naming(kind)).rollout(traffic.LEFT_AND_ON, constant_speed)


def test_environments_and_their_configurations(snapshot, register):  # noqa: F811
    register("OwnDeadEnd-v0", every_road.OwnDeadEnd)
    names = (*errors.UNKNOWN, "CartPole-v1", "intersection-multi-agent-v0", "parking-v0")
    ids = {repr(env_id): error_of(World, env_id) for env_id in errors.NO_IDS}
    told = {env_id: error_of(check, env_id) for env_id in (*names, "OwnDeadEnd-v0")}
    told |= errors_of(check, errors.VERY_SLOW) | errors_of(
        errors.check_config, errors.WRONG_CONFIGS
    )
    # what Python says about abstract classes depends on its version
    kinds = [kind for kind in traffic.IMPOSSIBLE if kind is not traffic.Abstract]
    classes = {kind.__name__: error_of(check_traffic, kind) for kind in kinds}
    assert {"ids": ids, "classes of NPCs": classes, **told} == snapshot


def test_scenarios_that_do_not_fit(snapshot, mine):  # noqa: F811
    junction = road_directors.world_of("intersection-v0")
    fits = lambda npc: junction.check_fits(road_directors.scenario_of(npc))  # noqa: E731
    drive = lambda scenario: Highway().rollout(scenario, constant_speed)  # noqa: E731
    told = errors_of(drive, errors.UNFITTING) | errors_of(fits, road_directors.UNFITTING)
    told["in a circle"] = errors_of(every_road.start_in_circle, every_road.CROWDED)
    told["no crossing"] = error_of(road_directors.check_crossing, World("highway-v0"))
    told["a truck in a bend"] = error_of(vehicle_types.check_truck, "o3>o0")
    blocked = mine(gym.Blocked, duration=12.0)
    for lane, ego in ((1, gym.IDLE), (2, gym.IDLE), (0, gym.Lorry)):
        scenario = replace(gym.BLOCKED, ego_lane=lane)
        told[f"an object in lane {lane}"] = error_of(blocked.rollout, scenario, ego)
    assert told == snapshot


def test_worlds_in_files(snapshot):
    told = errors_of(from_dict, codec.FAULTY)
    for path in (*codec.CODE, None, codec.CODE[:1], f"{traffic.__name__}.Slowing"):
        told[f"the class {path!r}"] = error_of(codec.gym_with, path)
    told["a longer world"] = error_of(from_dict, {**Highway().to_dict(), "lasts": 20.0})
    world, own = Highway(duration=60.0).to_dict(), Highway(duration=20.0)
    (told["a limit"],) = describe_limits(world, codec.SIX_GENES, own)
    named = described(SimulatorWorld(partial(simulator.Counted, "own")))
    told["another simulator"] = error_of(check_named_world, named, simulator.TOY)
    assert told == snapshot


def test_simulators(snapshot, monkeypatch):
    monkeypatch.setattr("pytest_pafot.world.guard.hang_guard.LEAST_FOR_WORLD", 0.2)
    monkeypatch.setattr("pytest_pafot.world.engines.simulation.CLOSING", 0.2)
    given, blurred = simulator.scenarios()[0], Perception(simulator.Following, latency=0.5)

    def run(members, ahead=simulator.AHEAD, policy=simulator.swerving, **base):
        simulator.broken(**base, **members).rollout(ahead, policy)

    def run_native(members):
        run(members, simulator.SLOWER, simulator.Following, base=simulator.Pedals)

    jump = plausible.world_of("bicycle", "jump", 0, 1)
    told = (
        errors_of(run, simulator.WRONG)
        | errors_of(run_native, simulator.WRONG_NATIVE)
        | {
            "a step that hangs": error_of(simulator.stuck().rollout, given, simulator.swerving),
            "a fault in the first tick": error_of(
                jump.rollout, plausible.AHEAD, plausible.STRAIGHT
            ),
            "an object": error_of(SimulatorWorld, 3),
            "a class as a policy": error_of(simulator.TOY.rollout, given, simulator.IDMVehicle),
            "imperfect sight": error_of(simulator.PEDALS.rollout, simulator.SLOWER, blurred),
        }
    )
    told["a tick too much"] = error_of(egos.overrun)
    moment = Moment(time=4.2, npc=0, seen="6.7 m ahead", action="[0, 0.67]", hidden="[0, -0.5]")
    told["a decision"] = [
        str(moment),
        str(replace(moment, seen="", was="6.7 m ahead", hidden=None)),
    ]
    told["a note"] = error_of(run, {"step": simulator.raising}).__notes__
    for name, each in simulator.NO_ACTIONS.items():
        told[f"an action: {name}"] = simulator.error_of_policy(*each).message
    for name, close in simulator.CLOSES.items():
        world = simulator.closing(close)
        world.rollout(given, simulator.Slowing)
        told[f"close {name}"] = warning_of(Simulators.close_all)
    assert told == snapshot


def test_motions_that_no_vehicle_makes(snapshot):
    motions = {name: plausible.moved(*states) for name, (states, _) in plausible.MOTIONS.items()}
    told = {name: first_difference(*pair) for name, pair in plausible.differing().items()}
    told |= {name: disagreement(*pair) for name, pair in gym_replay.differing().items()}
    faster, drive = plausible.world_of("coarse", "faster", 0, 12), plausible.STRAIGHT
    runs = [(plausible.CUSHION, plausible.AHEAD, drive, ""), (faster, plausible.AHEAD, drive, "")]
    ends = [run[0].rollout(*run[1:3]).users_error_text for run in (*runs, *plausible.LEAPS)]
    assert {"motions": motions, "runs": ends, **told} == snapshot


def test_environments_that_no_run_can_use(snapshot, mine, register):  # noqa: F811
    def run(kind, scenario=gym.SCENARIO):
        mine(kind, duration=6.0).rollout(scenario, gym.IDLE)

    told, gym.Harder.episodes = {}, 0
    for name, given in gym.REGISTERED.items():
        register(f"registered-{len(name)}-v0", **given)
        told[f"wrapped {name}"] = error_of(check, f"registered-{len(name)}-v0")
    for name, rates in gym.UNFIT.items():
        told[name] = error_of(run, type(f"Unfit{name}", (gym.unfit(name, rates),), {}))
    for kind, wrappers in gym.DIFFERING:
        text = str(error_of(mine(kind, wrappers=wrappers).check))
        told[f"resets of {kind.__name__}"] = re.sub(r"\d+\.\d{3,}", "N", text)
    for kind in (gym.keeping(gym.KEEPERS[0]), gym.Depot):
        told[kind.__name__] = error_of(run, kind)
    for kind in (*gym.BOTHERED, *gym.RESTLESS):
        told[kind.__name__] = error_of(run, kind, gym.TWO if kind in gym.BOTHERED else gym.STILL)
    for config in (None, {"duration": 9}):
        told[f"a reset with {config}"] = error_of(mine(gym.Refusing, config=config).check)
    assert told == snapshot


def test_wrappers(snapshot):
    def run(wrappers, **options):
        World("highway-v0", wrappers=wrappers, **options).rollout(gym.SCENARIO, gym.IDLE)

    told = errors_of(run, gym.NO_WRAPPERS)
    told["one that does not step"] = error_of(run, gym.STOPS, duration=5.0, ends="duration")
    inside = World("highway-v0", wrappers=[gym.FlattenObservation])
    told["a planner inside"] = error_of(inside.rollout, gym.SCENARIO, lambda env: gym.IDLE())
    old = World("highway-fast-v0", wrappers=[own_ends.Old])
    told["an old step"] = old.rollout(own_ends.scenario_in(old), own_ends.idle).error.message
    told["an old step beside a run"] = own_ends.by_reference(old).ended
    assert told == snapshot


def test_options_without_effect(snapshot):
    replaced = {name: given for name, (*given, names) in gym.REPLACED.items() if names}
    assert {name: gym.without_effect(*given) for name, given in replaced.items()} == snapshot


def test_ends_of_runs(snapshot, mine, ending):  # noqa: F811
    works, ahead = mine(gym.Roadworks, duration=12.0), [[PositionInstruction(2, 20.0)]]
    merge, wrong = every_road.world_of("merge-v1"), ending(own_ends.Wrong)
    far = every_road.hold(merge, 1, speed=30.0, gene_seconds=30.0)
    keeping = vehicle_types.keeping
    runs = {
        "at an object": works.rollout(Scenario(npcs=gym.AT_ONCE, ego_lane=1), gym.IDLE),
        "an NPC at an object": works.rollout(Scenario(npcs=ahead, ego_lane=1), gym.IDLE),
        "at the end of the road": merge.rollout(far, every_road.constant),
        "at an error": wrong.rollout(own_ends.scenario_in(wrong), own_ends.idle),
        "with other vehicles": Highway(ego="truck").rollout(vehicle_types.VAN_AHEAD, keeping),
    }
    told = {name: Run(trace).explain() for name, trace in runs.items()}
    failure = Failure(kind="AssertionError", assertion="not run.collision")
    told["at an object, in brief"] = Expect.from_run(Run(runs["at an object"]), failure).brief
    told["after the saved failure"] = unhandled(*own_ends.drifted(ending))
    assert told == snapshot


def test_reference_drivers(snapshot):
    trace = taking_over.HIGHWAY.rollout(taking_over.BRAKES, taking_over.weaving)
    take_over = lambda tick, name, world: world.take_over(trace, tick, name)  # noqa: E731
    told = errors_of(take_over, taking_over.REFUSED)
    told["a simulator that raises"] = error_of(taking_over.take_over_in_jam)
    told["a driver that is none"] = error_of(Highway().rollout_reference, ads.SCENARIO, "me")
    assert told == snapshot


def test_policies_and_their_factories(snapshot):
    def run(policy, world=ads.HIGHWAY):
        world.rollout(ads.AHEAD, policy)

    bends, needs = World("merge-v0"), World("lane-keeping-v0")
    blurred = Perception(ads.always(1), latency=0.2)
    plan = partial(drive_episode, bends, ads.always((0.0, 0.0)), 0, is_planner=True)
    told = {repr(given): error_of(run, given) for given in ads.NO_FACTORIES[:4]}
    told |= {name: error_of(make) for name, (make, _) in perception.REFUSED.items()}
    told |= {
        "inside of a highway": error_of(run, ads.inside),
        "inside of a world for planners": error_of(road_sensor.plan_inside),
        "a class with an argument": error_of(run, ads.Aggressive),
        "a factory of such a class": error_of(run, lambda: ads.Aggressive),
        "such a class in an environment": error_of(run, ads.Aggressive, ads.GYM),
        "a class of another size": error_of(vehicle_types.drive_bus_as_van),
        "hidden imperfections": error_of(run, perception.hidden),
        "imperfections of an environment": error_of(run, blurred, perception.GYM),
        "a planner in a bend": error_of(plan),
        "an ego without a state": drive_episode(needs, lambda: IDMVehicle, 0).error.text,
        "a child process": error_of(make_ads, forking.fork_and_go_on),
    }
    assert told == snapshot


def message(world, action):
    return world.rollout(ads.SCENARIO, ads.always(action)).error.message


def test_actions(snapshot):
    planners = {repr(each): message(ads.HIGHWAY, each) for each in (None, (1.0,), "12")}
    discrete = {repr(each): message(ads.GYM, each) for each in (None, 5, 1.0)}
    continuous = {repr(each): message(ads.CONTINUOUS, each) for each in (None, 0.1, [0.1])}
    lanes = {name: lane_command.error_of(each).message for name, each in lane_command.BAD.items()}
    told = {"planners": planners, "discrete": discrete, "continuous": continuous, "lanes": lanes}
    told["a lane in an environment"] = message(ads.GYM, LaneCommand(**lane_command.IN_LANE))
    told["a lane that ends"] = lane_command.error_of_missing_lane().message
    told["km/h"] = lane_command.doubt_at(90.0)
    assert told == snapshot


def test_hangs(snapshot, monkeypatch):
    hangs.Slow.clock = clock = StoppedClock(monkeypatch)
    sleep = lambda *_: clock.sleep(1000.0)  # noqa: E731
    run = Run(hangs.by_policy(hangs.wrapped(hangs.Slow)))
    told = {"an environment": run.explain().partition("\n")[0]}
    told["the same as a failure"] = ads_text(ads_failure(run)).partition("\n")[0]
    told["a reset"] = hangs.by_policy(hangs.starting()).error.message
    hangs.Starting.left = 1
    told["a first reset"] = error_of(hangs.wrapped(hangs.Starting).check_fits, hangs.SCENARIO)
    told["a reset of own traffic"] = error_of(drive_episode, hangs.starting(), hangs.idle, 3)
    told["a policy"] = Highway().rollout(ads.SCENARIO, lambda: sleep).error.message
    for name, end in {"raises": closing.raises, "hangs": sleep}.items():
        policy = partial(closing.Program, [], end=end)
        told[f"close {name}"] = warning_of(Highway().rollout, closing.BRAKED, policy)
    assert told == snapshot


def evaluated(condition, outcome, number=0, **values):
    pairs = tuple((name, str(value)) for name, value in values.items())
    evaluation = Evaluation(number, outcome, pairs, tuple(value for _, value in pairs))
    return Evaluated(condition=condition, last=evaluation, first=(evaluation,))


def test_conditions_of_decisions(snapshot):
    others = [
        evaluated("line 7: gaps", "True", 2, gaps="tuple of 3"),
        evaluated("line 8: not seen", "False", 3, seen=3.142),
        evaluated("line 9: True", "True", 4),
        evaluated(f"line 10: {'x' * 2000}", "True", 5),
    ]
    here, nearer, further = (
        [evaluated("line 6: gap < 10", outcome, 1, gap=gap), *others]
        for gap, outcome in ((20, "False"), (8, "True"), (52, "False"))
    )
    other = parting(here, nearer, "with NPC 0 nearer", is_other=True)
    same = parting(here, further, "with NPC 0 further away", is_other=False)
    told = {"alone": group_conditions(here), "nearer": group_conditions(here, other)}
    told["further"] = group_conditions(here, same)
    told["by vehicle"] = group_conditions(here, npc=0, whom={1: (0,), 2: (1,), 3: (0, 1)})
    assert told == snapshot
