"""A world without physics whose runs end as a picture says, so that a map of hundreds of points takes milliseconds."""

import pytest_pafot as pafot
from pytest_pafot.extras.sweeps.maps import MARKS
from pytest_pafot.model.instructions import LaneInstruction, ScenarioError
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Outcome
from tests.helpers.traces import trace_of, vehicle

KINDS = {mark: kind for kind, mark in MARKS.items()}


def keeps_speed():
    return lambda seen: (0.0, 0.0)


def two_numbers(lane="keep"):
    """Return a scenario whose numbers ``ego.speed`` and ``npcs.0.0.speed`` are the row and the column of a picture."""
    return Scenario(npcs=((LaneInstruction(lane, 0.0),),), ego_speed=0.0)


ROWS, COLUMNS = "ego.speed", "npcs.0.0.speed"


class Planted:
    """A world in which each scenario ends as the mark in its row, counted from below, and column says."""

    guards_ads = True
    reference_drivers = ("able",)

    def __init__(self, *picture):
        self.rows = picture[::-1]
        self.runs = 0

    def kind_of(self, scenario):
        return KINDS[self.rows[int(scenario.ego_speed)][int(scenario.npcs[0][0].speed)]]

    def check_fits(self, scenario):
        if self.kind_of(scenario) == "not as asked":
            raise ScenarioError(field="ego_speed", expected="another one", received="this one")

    def rollout(self, scenario, ads_factory):
        self.runs += 1
        return ended(scenario, self.kind_of(scenario) != "avoided")

    def rollout_reference(self, scenario, name):
        return ended(scenario, self.kind_of(scenario) == "unavoidable")


EGO, NPC = vehicle(0.0, 4.0, speed=20.0, ticks=3), vehicle(30.0, 4.0, speed=20.0, ticks=3)


def ended(scenario, fails):
    """Return a trace of a fifth of a second, at whose end the ego is off the road if it fails."""
    return trace_of(EGO, NPC, scenario=scenario, outcome=Outcome.OFF_ROAD if fails else Outcome.SAFE, arrivals=((),))


def mapped(*picture, world=None, scenario=None, **options):
    """Return the map of a world with a picture; its last row is the lowest one, as in a map."""
    over = {ROWS: range(len(picture)), COLUMNS: range(len(picture[0]))}
    world = world or Planted(*picture)
    return pafot.sweep(scenario or two_numbers(), keeps_speed, over=over, world=world, **options)


def picture_of(sweep):
    """Return the rows of marks of a map, the last one the lowest."""
    rows, columns = sweep.shape
    return tuple("".join(MARKS[sweep.point(row, each).kind] for each in range(columns)) for row in range(rows))[::-1]
