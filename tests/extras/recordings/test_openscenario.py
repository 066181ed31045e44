"""OpenSCENARIO as scenarios: each action and trigger is a step, and what is none is refused by its name and place."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import pytest_pafot as pafot
from pytest_pafot import Manoeuvre, Step
from pytest_pafot.extras.export.exporter import exporter
from pytest_pafot.extras.recordings.recording import RecordingError
from pytest_pafot.model.trace import HEADING, SPEED, X, Y
from pytest_pafot.support.errors import RequestError
from tests.helpers.tables import table
from tests.helpers.traces import trace_of, vehicle

FINDING = SimpleNamespace(id="run")

FILE = """<?xml version="1.0"?>
<OpenSCENARIO>
  <FileHeader revMajor="1" revMinor="2" date="2020-01-01T00:00:00" description="" author=""/>
  <ParameterDeclarations>
    <ParameterDeclaration name="EgoSpeed" parameterType="double" value="72"/>
    <ParameterDeclaration name="Owner" parameterType="string" value="Car"/>
  </ParameterDeclarations>
  <RoadNetwork><LogicFile filepath="road.xodr"/></RoadNetwork>
  <Entities>{ego}{car}{more}</Entities>
  <Storyboard>
    <Init><Actions>{everywhere}
      <Private entityRef="Ego">{ego_place}{ego_speed}</Private>
      <Private entityRef="Car">{car_place}{car_speed}</Private>
    </Actions></Init>
    <Story name="story">{acts}</Story>
    <StopTrigger/>
  </Storyboard>
</OpenSCENARIO>
"""
VEHICLE = """<ScenarioObject name="{name}"><Vehicle name="v" vehicleCategory="car">
  <BoundingBox><Center x="1.5" y="0" z="0"/><Dimensions width="2" length="{length}" height="1.5"/></BoundingBox>
  <Performance maxSpeed="70" maxAcceleration="10" maxDeceleration="10"/></Vehicle></ScenarioObject>"""
IN_LANE = '<LanePosition roadId="1" laneId="{lane}" s="{s}" offset="{offset}"/>'
ACT = """<Act name="{name}"><ManeuverGroup name="group{name}" maximumExecutionCount="1">
  <Actors selectTriggeringEntities="false"><EntityRef entityRef="{actor}"/></Actors>
  <Maneuver name="manoeuvre{name}">{events}</Maneuver></ManeuverGroup>
  <StartTrigger>{trigger}</StartTrigger></Act>"""
EVENT = """<Event name="{name}" priority="parallel">
  <Action name="do {name}"><PrivateAction>{action}</PrivateAction></Action>
  <StartTrigger>{trigger}</StartTrigger></Event>"""


def start(position):
    return f"<PrivateAction><TeleportAction><Position>{position}</Position></TeleportAction></PrivateAction>"


def in_lane(lane, s, offset=0.0):
    return start(IN_LANE.format(lane=lane, s=s, offset=offset))


def at_speed(value, target=None):
    target = target or f'<AbsoluteTargetSpeed value="{value}"/>'
    return f"<PrivateAction>{to_speed(target, 'step', 0)}</PrivateAction>"


def to_speed(target, shape="linear", value=2, dimension="rate"):
    target = target if "<" in str(target) else f'<AbsoluteTargetSpeed value="{target}"/>'
    dynamics = f'dynamicsShape="{shape}" value="{value}" dynamicsDimension="{dimension}"'
    return (
        f"<LongitudinalAction><SpeedAction><SpeedActionDynamics {dynamics}/>"
        f"<SpeedActionTarget>{target}</SpeedActionTarget></SpeedAction></LongitudinalAction>"
    )


def to_lane(target, seconds=3, dimension="time"):
    return (
        f'<LateralAction><LaneChangeAction><LaneChangeActionDynamics dynamicsShape="sinusoidal" value="{seconds}" '
        f'dynamicsDimension="{dimension}"/><LaneChangeTarget>{target}</LaneChangeTarget></LaneChangeAction></LateralAction>'
    )


def to_offset(value):
    return (
        '<LateralAction><LaneOffsetAction continuous="false"><LaneOffsetActionDynamics dynamicsShape="step"/>'
        f'<LaneOffsetTarget><AbsoluteTargetLaneOffset value="{value}"/></LaneOffsetTarget>'
        "</LaneOffsetAction></LateralAction>"
    )


def condition(inner, delay=0):
    return (
        f'<ConditionGroup><Condition name="c" delay="{delay}" conditionEdge="none">{inner}</Condition></ConditionGroup>'
    )


def at_time(seconds, delay=0):
    return condition(
        f'<ByValueCondition><SimulationTimeCondition value="{seconds}" rule="greaterThan"/></ByValueCondition>', delay
    )


def near(inner, by="Ego", delay=0):
    return condition(
        f'<ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="{by}"/>'
        f"</TriggeringEntities><EntityCondition>{inner}</EntityCondition></ByEntityCondition>",
        delay,
    )


def at_gap(value, rule="lessThan", freespace="true", kind="longitudinal", of="Car", **others):
    return near(
        f'<RelativeDistanceCondition entityRef="{of}" relativeDistanceType="{kind}" value="{value}" '
        f'freespace="{freespace}" rule="{rule}"/>',
        **others,
    )


def at_headway(value, rule="lessThan", freespace="true", of="Car", **others):
    return near(
        f'<TimeHeadwayCondition entityRef="{of}" value="{value}" freespace="{freespace}" rule="{rule}"/>',
        **others,
    )


def after(name, kind="event", state="completeState", delay=0):
    return condition(
        f'<ByValueCondition><StoryboardElementStateCondition storyboardElementType="{kind}" '
        f'storyboardElementRef="{name}" state="{state}"/></ByValueCondition>',
        delay,
    )


def event(action, trigger, name="e"):
    return EVENT.format(name=name, action=action, trigger=trigger)


@pytest.fixture
def read(tmp_path):
    """Return a function that writes a scenario of an ego at 20 m/s, and a car 50 m ahead in its lane, and reads it."""

    def of(*events, options=None, trigger=None, acts=None, **parts):
        path = tmp_path / "scenario.xosc"
        act = ACT.format(name="act", actor="$Owner", events="".join(events), trigger=trigger or at_time(0))
        given = {
            "ego": VEHICLE.format(name="Ego", length=5.0),
            "car": VEHICLE.format(name="Car", length=4.0),
            "more": "",
            "everywhere": "",
            "ego_place": in_lane(-2, 50),
            "ego_speed": at_speed("${$EgoSpeed / 3.6}"),
            "car_place": in_lane(-2, 100),
            "car_speed": at_speed(15),
            "acts": acts if acts is not None else act if events else "",
            **parts,
        }
        path.write_text(FILE.format(**given))
        return pafot.recorded(path, **(options or {}))

    return of


def steps_of(scenario):
    ((first,),) = scenario.npcs
    return first.steps


def test_start_is_lane_gap_between_bumpers_and_speed(read):
    scenario = read()
    # 50 m between places that are 1.5 m behind the centres of 5 m and 4 m.
    assert scenario.npcs == ((Manoeuvre(beside=0, ahead=45.5, speed=15.0),),)
    assert (scenario.ego_speed, scenario.ego_lane) == (20.0, 1)


@table(
    "place, beside, ahead",
    [
        (in_lane(-1, 100), -1, 45.5),
        (in_lane(-4, 20), 2, -25.5),
        (in_lane(-3, 50), 1, 0.0),
        (start('<RelativeLanePosition entityRef="Ego" dLane="1" ds="-40" offset="0"/>'), -1, -35.5),
        (start('<RelativeObjectPosition entityRef="Ego" dx="40" dy="-3.5"/>'), 1, 35.5),
        (start('<RelativeRoadPosition entityRef="Ego" ds="40" dt="3.5"/>'), -1, 35.5),
    ],
)
def test_place_of_any_kind_is_lanes_to_the_right_and_metres_ahead(read, place, beside, ahead):
    ((npc,),) = read(car_place=place).npcs
    assert (npc.beside, npc.ahead) == (beside, ahead)


def test_places_on_the_plane_are_seen_along_the_heading_of_the_ego(read):
    ego, car = (start(f'<WorldPosition x="{x}" y="{y}" h="{math.pi / 2}"/>') for x, y in ((10.0, 0.0), (13.5, 40.0)))
    ((npc,),) = read(ego_place=ego, car_place=car).npcs
    assert (npc.beside, npc.ahead) == (1, 35.5)


@table(
    "action, step",
    [
        (to_speed(5), Step(speed=5.0, acceleration=2.0)),
        (to_speed(5, value=4, dimension="time"), Step(speed=5.0, acceleration=2.5)),
        (to_speed(5, value=50, dimension="distance"), Step(speed=5.0, acceleration=2.0)),
        (to_speed('<RelativeTargetSpeed entityRef="Ego" value="1.2" speedTargetValueType="factor"/>'),
         Step(speed=24.0, acceleration=2.0)),
        (to_speed('<RelativeTargetSpeed entityRef="Ego" value="-3" speedTargetValueType="delta" continuous="false"/>'),
         Step(speed=17.0, acceleration=2.0)),
        (to_lane('<RelativeTargetLane entityRef="Ego" value="1"/>'), Step(lane="left", lateral_speed=1.5)),
        (to_lane('<RelativeTargetLane entityRef="$Owner" value="-1"/>', 2.3), Step(lane="right", lateral_speed=2.0)),
        (to_lane('<AbsoluteTargetLane value="-1"/>'), Step(lane="left", lateral_speed=1.5)),
        (to_offset(0.8), Step(offset=-0.8)),
    ],
)  # fmt: skip
def test_action_is_a_step(read, action, step):
    first, second = steps_of(read(event(to_speed(15), at_gap(40), "before"), event(action, after("before"))))
    assert first == Step(gap=40.0, speed=15.0, acceleration=2.0)
    assert second == step


@table(
    "trigger, expected",
    [
        (at_time(3), {"after": 3.0}),
        (at_time(3, delay=1), {"after": 4.0}),
        (at_gap(20), {"gap": 20.0}),
        (at_gap(20, freespace="false"), {"gap": 15.5}),
        (at_gap(20, of="Ego", by="$Owner"), {"gap": 20.0}),
        (at_gap(60), {}),  # it holds from the beginning
        (at_gap(60, rule="greaterThan"), {"gap": -60.0}),  # the car is slower, and will be behind
        (at_headway(2), {"headway": 2.0}),
        (at_headway(2, freespace="false"), {"headway": 1.8}),
        (at_headway(1, by="Car", of="Ego", rule="greaterThan"), {"headway": -1.0}),
        (after("act", "act", "startTransition"), {}),
        (after("act", "act", "runningState", delay=2), {"after": 2.0}),
    ],
)
def test_trigger_begins_the_step(read, trigger, expected):
    (step,) = steps_of(read(event(to_speed(5), trigger)))
    assert step == Step(speed=5.0, acceleration=2.0, **expected)


def test_act_that_begins_by_distance_begins_its_first_event(read):
    events = event(to_speed(10), at_time(0), "one"), event(to_speed(5), after("one", delay=1), "two")
    assert steps_of(read(*events, trigger=at_gap(30))) == (
        Step(gap=30.0, speed=10.0, acceleration=2.0),
        Step(after=1.0, speed=5.0, acceleration=2.0),
    )


def test_act_and_event_by_different_distances_begin_one_after_the_other(read):
    assert steps_of(read(event(to_speed(10), at_gap(20)), trigger=at_gap(30))) == (
        Step(gap=30.0),
        Step(gap=20.0, speed=10.0, acceleration=2.0),
    )


def test_delay_after_a_distance_is_a_step_of_its_own(read):
    assert steps_of(read(event(to_speed(10), at_gap(20, delay=1.5)))) == (
        Step(gap=20.0),
        Step(after=1.5, speed=10.0, acceleration=2.0),
    )


def test_times_are_counted_from_the_end_of_the_step_before(read):
    # The file's order is not that of the times. Braking from 15 to 5 m/s at 2 m/s^2 takes 5 s.
    events = (
        event(to_lane('<RelativeTargetLane entityRef="Car" value="1"/>'), at_time(9)),
        event(to_speed(5), at_time(2)),
    )
    assert steps_of(read(*events)) == (
        Step(after=2.0, speed=5.0, acceleration=2.0),
        Step(after=2.0, lane="left", lateral_speed=1.5),
    )


def test_speed_and_lane_that_change_together_are_one_step(read):
    events = event(to_speed(5), at_time(2)), event(to_lane('<AbsoluteTargetLane value="-3"/>'), at_time(2))
    assert steps_of(read(*events)) == (Step(after=2.0, lane="right", lateral_speed=1.5, speed=5.0, acceleration=2.0),)


def test_change_over_two_lanes_is_two_steps(read):
    scenario = read(event(to_lane('<AbsoluteTargetLane value="-4"/>', 4), at_time(1)))
    assert steps_of(scenario) == (
        Step(after=1.0, lane="right", lateral_speed=2.4),
        Step(lane="right", lateral_speed=2.4),
    )


def test_speed_joins_the_first_of_two_lane_changes(read):
    events = event(to_lane('<AbsoluteTargetLane value="-4"/>', 4), at_gap(20)), event(to_speed(5), at_gap(20))
    assert steps_of(read(*events)) == (
        Step(gap=20.0, lane="right", lateral_speed=2.4, speed=5.0, acceleration=2.0),
        Step(lane="right", lateral_speed=2.4),
    )


def test_ego_has_as_many_lanes_on_its_left_as_are_needed(read):
    scenario = read(
        event(to_lane('<RelativeTargetLane entityRef="Car" value="2"/>'), at_time(1)), car_place=in_lane(-1, 90)
    )
    assert scenario.ego_lane == 3


def test_speed_at_once_at_the_beginning_is_the_first_speed(read):
    ((npc,),) = read(event(to_speed(30, "step", 0), at_time(0)), car_speed="").npcs
    assert npc == Manoeuvre(beside=0, ahead=45.5, speed=30.0)


def test_what_the_ego_does_is_left_to_the_policy(read):
    acts = ACT.format(
        name="of ego", actor="Ego", trigger=at_time(0),
        events=event("<ControllerAction><ActivateControllerAction/></ControllerAction>", at_time(0)),
    )  # fmt: skip
    assert steps_of(read(acts=acts)) == ()


def test_event_after_that_of_another_vehicle_begins_at_its_known_time(read):
    acts = ACT.format(name="one", actor="Van", events=event(to_speed(5), at_time(1), "brakes"), trigger=at_time(0))
    acts += ACT.format(
        name="two", actor="Car", events=event(to_speed(5), after("brakes", delay=1), "too"), trigger=at_time(0)
    )
    scenario = read(
        acts=acts, more=VEHICLE.format(name="Van", length=5.0),
        car_speed=at_speed(15) + f'</Private><Private entityRef="Van">{in_lane(-3, 90)}{at_speed(15)}',
    )  # fmt: skip
    (car,), (van,) = scenario.npcs
    assert van.steps == (Step(after=1.0, speed=5.0, acceleration=2.0),)
    assert car.steps == (Step(after=7.0, speed=5.0, acceleration=2.0),)


def test_scenario_is_driven_as_the_file_says(read):
    scenario = read(
        event(to_lane('<RelativeTargetLane entityRef="Ego" value="0"/>', 3), at_gap(40), "in"),
        event(to_speed(5, value=4), after("in", delay=1)),
        car_place=in_lane(-3, 100),
    )
    trace = pafot.Highway(duration=20.0).rollout(scenario, lambda: lambda seen: (0.0, 0.0))
    run = pafot.Run(trace)
    assert run.as_asked, [each.words for each in run.asked]
    gaps = trace.states[:, 1, X] - trace.states[:, 0, X] - 5.0
    assert gaps[0] == pytest.approx(45.5)
    assert gaps[trace.begun[0][0]] == pytest.approx(40.0, abs=0.5)
    assert trace.begun[0][1] / 15 - trace.begun[0][0] / 15 == pytest.approx(3.0 + 1.0, abs=0.5)


CATALOGUE = '<OpenSCENARIO><FileHeader/><Catalog name="cars">{}</Catalog></OpenSCENARIO>'
REFERENCE = '<ScenarioObject name="Car"><CatalogReference catalogName="cars" entryName="v"/></ScenarioObject>'


def test_vehicle_of_a_catalogue_is_found_in_the_files_that_are_given(read, tmp_path):
    def catalogue(length):
        return CATALOGUE.format(VEHICLE.format(name="", length=length).partition(">")[2].rpartition("<")[0])

    (tmp_path / "cars.xosc").write_text(catalogue(4.0))
    (tmp_path / "others.xosc").write_text(catalogue(40.0).replace('<Catalog name="cars"', '<Catalog name="others"'))
    scenario = read(car=REFERENCE, options={"vehicles": [tmp_path / "others.xosc", tmp_path / "cars.xosc"]})
    assert scenario == read()
    with pytest.raises(RecordingError, match=r"CatalogReference: expected one of 0 vehicles of known catalogues"):
        read(car=REFERENCE)


WEATHER = '<GlobalAction><EnvironmentAction><Environment name="fog"/></EnvironmentAction></GlobalAction>'


def test_element_that_does_not_matter_can_be_left_out(read):
    with pytest.raises(RecordingError, match=r"Init/Actions/GlobalAction/EnvironmentAction: expected what a manoeuvre"):
        read(everywhere=WEATHER)
    assert read(everywhere=WEATHER, options={"without": ["EnvironmentAction"]}) == read()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"more": '<ScenarioObject name="Ann"><Pedestrian name="Ann"/></ScenarioObject>'}, r"received Pedestrian;"),
        ({"more": '<EntitySelection name="all"/>'}, r"received EntitySelection"),
        ({"car_place": in_lane(2, 100)}, r"a lane with a negative number, received laneId 2 and h=0; place it"),
        ({"car_place": in_lane(-2, 100, 1.0)}, r"start in the middle of a lane, received Car -0.29 lanes"),
        ({"car_place": in_lane(-3, 52)}, r"a start level with the ego, or clear of it, received 2.0 m ahead"),
        ({"car_place": in_lane(-2, 52)}, r"a start clear of the ego, received 2.0 m ahead in its lane; move it"),
        ({"more": VEHICLE.format(name="Car", length=4.0)}, r"Object\[Car\]@name: expected a name that no other"),
        ({"ego_speed": at_speed("${1}2")}, r"AbsoluteTargetSpeed@value: expected arithmetic"),
        ({"ego_speed": at_speed("$Owner" * 400)}, r"expected at most 1000 characters, received '\$Owner"),
        ({"car_place": in_lane(-2, 900)}, r"from -500 to 500 .*, received ahead 845.5; move it nearer"),
        ({"car_place": start('<RelativeRoadPosition entityRef="Car" ds="1" dt="0"/>')}, r"places that do not refer"),
        ({"car_place": start('<RoadPosition roadId="1" s="9" t="2"/>')}, r"right side of the road, received t=2"),
        ({"car_place": ""}, r"expected a TeleportAction of Car in Init, received none"),
        ({"car_place": start('<GeoPosition latitude="1"/>')}, r"xosc:17: .*Position/GeoPosition: .* GeoPosition"),
        ({"ego_speed": at_speed("$Speed")}, r"one of the parameters EgoSpeed, Owner, received \$Speed;"),
        ({"ego_speed": at_speed("${__import__('os')}")}, r"AbsoluteTargetSpeed@value: expected arithmetic"),
        ({"ego_speed": at_speed("fast")}, r"AbsoluteTargetSpeed@value: expected a finite number, received 'fast'"),
        ({"options": {"ego": "Bus"}}, r"Entities: expected one of the vehicles Ego, Car, received 'Bus' for the ego"),
        ({"options": {"ego": "Car"}, "acts": ACT.format(
            name="a", actor="Ego", events=event(to_speed(1), at_gap(5, of="Van")), trigger="")},
         r"RelativeDistanceCondition between Ego and Van, not between the ego and Ego"),
    ],
)  # fmt: skip
def test_what_no_scenario_can_express_is_refused_by_its_place(read, parts, message):
    with pytest.raises(RecordingError, match=message):
        read(**parts)


@table(
    "action, trigger, message",
    [
        (to_speed(5), at_gap(5, kind="lateral"), r"received RelativeDistanceCondition across the road"),
        (to_speed(5), near('<TimeToCollisionCondition value="2"/>'), r"received TimeToCollisionCondition"),
        (to_speed(5), at_gap(60).replace("none", "rising"), r"a distance that is not there from the beginning"),
        (to_speed(5), near('<SpeedCondition value="2"/>'), r"EntityCondition/SpeedCondition: "),
        (to_speed(5), after("nobody"), r"ElementStateCondition for the event 'nobody', which is none"),
        (to_speed(5), at_time(1) + at_time(2), r"expected one ConditionGroup, received 2"),
        (to_speed(5), after("e"), r"Event\[e\]: .*received Event, which waits for an event that never begins"),
        ("<ControllerAction/>", at_time(1), r"PrivateAction/ControllerAction: .* received ControllerAction"),
        ("<LongitudinalAction><LongitudinalDistanceAction/></LongitudinalAction>", at_time(1),
         r"received LongitudinalDistanceAction; take it out, or say without=\['LongitudinalDistanceAction'\]"),
        (to_lane('<AbsoluteTargetLane value="1"/>'), at_time(1), r"a lane with a negative number, received 1; take"),
        (to_lane('<AbsoluteTargetLane value="-1e8"/>'), at_time(1), r"at most 16 lanes to cross, received 99999998"),
        (to_offset(3), at_time(1), r"expected a number from -1.9 to 1.9 .*, received offset -3.0"),
        (to_lane('<AbsoluteTargetLane value="-2"/><A/>'), at_time(1), r"expected one element in it"),
    ],
)  # fmt: skip
def test_action_or_trigger_without_a_step_is_refused_by_its_name(read, action, trigger, message):
    with pytest.raises(RecordingError, match=message):
        read(event(action, trigger))


@pytest.mark.parametrize("count", [0, 2])
def test_event_that_does_not_happen_once_is_refused(read, count):
    often = event(to_speed(5), at_time(1)).replace("priority", f'maximumExecutionCount="{count}" priority')
    with pytest.raises(RecordingError, match=rf"@maximumExecutionCount: expected to be done once, received {count};"):
        read(often)


def test_time_after_a_distance_is_refused_because_nobody_knows_when_that_is(read):
    with pytest.raises(
        RecordingError, match=r"Event\[e\].*expected a time before all distances of the vehicle, received"
    ):
        read(event(to_speed(5), at_gap(20), "first"), event(to_speed(9), at_time(30)))


def test_times_that_overlap_are_refused(read):
    with pytest.raises(
        RecordingError, match=r"expected a time after the step before, which ends at about 7.0 s, received 4"
    ):
        read(event(to_speed(5), at_time(2), "first"), event(to_speed(9), at_time(4)))


def test_parameters_of_parameters_cannot_grow_without_end(read):
    grows = "".join(f'<ParameterDeclaration name="a{n + 1}" value="$a{n}$a{n}"/>' for n in range(64))
    declared = f'<ParameterDeclarations><ParameterDeclaration name="a0" value="x"/>{grows}</ParameterDeclarations>'
    with pytest.raises(RecordingError, match=r"\[a10\]@value: expected at most 1000 characters, received 'xxx"):
        read(more=declared)


def test_catalogue_that_is_not_there_is_named(read):
    reference = '<ScenarioObject name="Car"><CatalogReference catalogName="cars" entryName="car"/></ScenarioObject>'
    with pytest.raises(RequestError, match=r"can be read, received 'cars.xosc': No such file or directory; correct"):
        read(car=reference, options={"vehicles": ["cars.xosc"]})


@pytest.mark.parametrize("name", ["xosc", "xosc-1.0"])
def test_trajectories_of_a_run_are_read_back_as_tracks(tmp_path, name):
    pytest.importorskip("scenariogeneration")
    aside = np.arange(31) / 30 * 4.0
    trace = trace_of(
        vehicle(0.0, 4.0, speed=20.0, ticks=30),
        vehicle(30.0 + np.arange(31), 4.0 + aside, heading=0.13, speed=15.0, lane=1),
        sizes=np.array([[5.0, 2.0], [12.0, 2.5]]),
    )
    for file, content in exporter(name)(FINDING, trace).items():
        (tmp_path / file).write_bytes(content)
    read = pafot.recorded(tmp_path / "run.xosc")
    states = np.stack([each.states for each in read.vehicles], axis=1)
    assert states[..., [X, Y, HEADING]] == pytest.approx(trace.states[..., [X, Y, HEADING]], abs=1e-9)
    assert states[:, 0, SPEED] == pytest.approx(np.full(31, 20.0))
    assert [(each.name, each.length, each.width) for each in read.vehicles] == [("ego", 5.0, 2.0), ("npc0", 12.0, 2.5)]
    assert (read.ego, read.rate) == ("ego", 15.0)
    text = (tmp_path / "run.xosc").read_text()
    (tmp_path / "run.xosc").write_text(text.replace("<TimeReference>", "<A>").replace("</TimeReference>", "</A>"))
    with pytest.raises(RecordingError, match=r"FollowTrajectoryAction: expected a TimeReference with Timing"):
        pafot.recorded(tmp_path / "run.xosc")
