"""What scenarios, vehicles, imperfect sight, records and measures say."""

import sys

import numpy as np

from pytest_pafot import CrossingInstruction, LaneInstruction, PositionInstruction, Scenario
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.criticality import RssRules, sweep
from pytest_pafot.model.instructions import repair_gene
from pytest_pafot.model.sight import Sight
from tests.criticality import test_measures as measures
from tests.criticality import test_signals as signals
from tests.helpers.refusals import error_of
from tests.model import test_crossings as crossings
from tests.model import test_scenario as scenario
from tests.model import test_sight as sight
from tests.model import test_trace as trace
from tests.model import test_vehicle_type as vehicle_type
from tests.simulators import test_metadrive as metadrive
from tests.words.test_world import errors_of

one, KEEP = scenario.one, LaneInstruction("keep", 1.0)


def test_instructions(snapshot):
    told = {
        f"cell {cell!r:.20}": error_of(PositionInstruction, cell, 1.0) for cell in scenario.NO_CELLS
    }
    for name, speeds in scenario.NO_SPEEDS.items():
        told |= {
            f"{name} {speed!r:.20}": error_of(PositionInstruction, 2, speed) for speed in speeds
        }
    told |= {
        "a lane": error_of(LaneInstruction, "up", 10.0),
        "a speed in a lane": error_of(LaneInstruction, "keep", 12.34),
    }
    told |= {"a speed of one that crosses": error_of(CrossingInstruction, "a>b", 0, 0.04)}
    crossing = errors_of(lambda changes: crossings.crosses(**changes), crossings.WRONG)
    acts = {"pass": 0.5, "hold": -2, "stop": 0, "late": 5.0}
    goals = {act: crossings.crosses(slot=slot, act=act).goal for act, slot in acts.items()}
    assert {**told, "crossing": crossing, "goals": goals} == snapshot


def test_scenarios(snapshot):
    def make(fields):
        Scenario(**{"npcs": [[one()]], **fields})

    def in_lanes(*chains):
        Scenario(npcs=chains)

    told = errors_of(make, scenario.BROKEN)
    told["a leap"] = error_of(in_lanes, [one(1), one(5)])
    told["two NPCs in a cell"] = error_of(in_lanes, [one(1), one(2)], [one(3), one(2)])
    told["cells, then a lane"] = error_of(in_lanes, [one()], [one(), KEEP])
    told["a lane, then cells"] = error_of(in_lanes, [one()], [KEEP, one()])
    told |= {
        f"at a zone: {name}": error_of(in_lanes, chain) for name, chain in crossings.SEVERAL.items()
    }
    told |= errors_of(
        lambda vehicles: make({"npcs": vehicle_type.of().npcs, "vehicles": vehicles}),
        vehicle_type.WRONG,
    )
    told |= {
        f"the style {style!r}": error_of(make, {"traffic": style})
        for style in vehicle_type.NO_STYLES
    }
    told["the style of a search"] = error_of(SearchSpace, traffic="fast")
    told["too few cells"] = error_of(repair_gene, None, [2, 6, 7], frozenset({2, 6}), [True] * 3)
    assert told == snapshot


def test_vehicles_and_sight(snapshot):
    told = {name: each.described for name, each in sight.SIGHTS.items()}
    told |= errors_of(lambda values: Sight(**values), sight.INVALID)
    told |= errors_of(vehicle_type.own, vehicle_type.OUT_OF_BOUNDS)
    assert told == snapshot


def test_records_and_measures(snapshot, monkeypatch):
    run = signals.random_run(3, rows=12)
    told = {
        f"states of {shape}": error_of(trace.made, np.zeros(shape), np.zeros((2, 2)))
        for shape in trace.SHAPES
    }
    told["sizes"] = error_of(trace.made, np.zeros((3, 2, 7)), np.zeros((3, 2)))
    told["a run"] = repr(
        signals.run_of(signals.vehicle(0.0, ticks=30), signals.vehicle(50.0, ticks=30)).trace
    )
    told |= {
        f"{name} = {value}": error_of(RssRules, **{name: value})
        for name, value in measures.WRONG_RULES
    }
    told |= {
        name: error_of(run.signal, function) for name, function in signals.WRONG_SIGNALS.items()
    }
    told["an unknown signal"] = error_of(lambda: run.ego.sped)
    told["arrays"] = error_of(sweep.extremes, np.zeros((4, 2, 6)), np.ones((2, 2)), (1.0, 0.0), 3.0)
    monkeypatch.setitem(sys.modules, "pandas", None)
    told["no pandas"] = error_of(run.to_pandas)
    assert told == snapshot


def test_metadrive(snapshot, monkeypatch):
    told = errors_of(lambda arguments: metadrive.use(monkeypatch, arguments), metadrive.WRONG)
    told["a later Python"] = error_of(metadrive.of_later_python, monkeypatch)
    monkeypatch.setattr(metadrive.metadrive, "version_info", (3, 11, 2))
    told["no MetaDrive"] = error_of(metadrive.missing, monkeypatch)
    assert told == snapshot
