"""Whose fault stays whose: the rules treat a free NPC as any vehicle."""

from pytest_pafot import Drive, Free, Highway, Run, Scenario
from tests.helpers.tables import table


def steady(observation):
    return 0.0, 0.0


def ramming(observation):
    return 3.0, 0.0


def swerving(observation):
    """Overtake in the next lane, and move into the ego's side."""
    ego = observation.others[0]
    return Drive(lane=ego.lane if observation.ego.x > ego.x - 2.0 else observation.ego.lane, speed=24.0)


def braking(observation):
    return (-2.0 if observation.time > 2.0 else 0.0), 0.0


@table(
    ("driver", "start", "responsibility"),
    [
        (ramming, {"beside": 0, "ahead": -20.0, "speed": 22.0}, "npc"),
        (swerving, {"beside": 1, "ahead": -12.0, "speed": 24.0}, "npc"),
        (braking, {"beside": 0, "ahead": 40.0, "speed": 22.0}, "ego"),
    ],
)
def test_rear_ender_and_cutter_are_at_fault_but_no_leader_that_brakes(driver, start, responsibility):
    world = Highway(duration=20.0).with_drivers({"own": lambda: driver})
    run = Run(world.rollout(Scenario(npcs=((Free(driver="own", **start),),)), lambda: steady))
    assert run.collision
    assert run.responsibility == responsibility
    assert (responsibility == "ego") == ("NPC 0 is responsible." not in run.explain())
