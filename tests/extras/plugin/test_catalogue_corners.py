"""Corners of named scenarios and maps: errors of the user's code, odd arguments, large and narrow maps."""

import csv
import io
from dataclasses import replace

import pytest

import pytest_pafot as pafot
from pytest_pafot.__main__ import main
from pytest_pafot.extras.sweeps import drawing
from pytest_pafot.extras.sweeps.drawing import page
from pytest_pafot.extras.sweeps.entries import ENTRIES, entry_of
from pytest_pafot.extras.sweeps.numbers import values_of
from pytest_pafot.support.errors import RequestError
from tests.extras.sweeps.planted import keeps_speed, mapped, two_numbers
from tests.extras.sweeps.test_drawing import data_of
from tests.helpers.tables import table


def brakes_late():
    def drive(seen):
        ego = seen.ego
        gaps = [other.x - ego.x - other.length for other in seen.others if abs(other.y - ego.y) < 2.5]
        return (-3.0 if any(0 < gap < 40 for gap in gaps) else 0.0), 0.0

    return drive


def speeds_up():
    return lambda seen: (3.0, 0.0)


def raises():
    return lambda seen: 1 / 0


def test_error_in_the_test_function_is_no_skip(project):
    project.write('@pafot.catalogue("r157/following")\ndef test_x(run):\n    assert not run.colision\n')
    project.run().assert_outcomes(failed=1)


def test_error_in_the_property_is_not_unavoidable():
    def misspelt(run):
        assert not run.colision

    try:
        made = pafot.sweep("r157/following", keeps_speed, over={"ego_speed": [10, 16]}, holds=misspelt)
    except (AttributeError, RequestError):
        return
    assert made.preventable == 2


def test_policy_that_raises_is_an_error_on_the_map():
    made = pafot.sweep("r157/cut-in", raises, over={"gap": [20, 40]})
    assert (made.errors, made.preventable) == (2, 0)
    assert ", 2 ended by an error of the ADS, " in made.headline
    assert made.notes[0].startswith("ADS error, such as gap 20 m: ")


@table("ads", [keeps_speed, brakes_late])
def test_tail_after_stop_comes_up_for_some_policy(ads):
    made = pafot.sweep("classic/tail-after-stop", ads, over={"headway": "1:3:3", "deceleration": [1, 4, 8]})
    assert made.not_as_asked < len(made.points)


def test_reference_driver_survives_tail_after_stop():
    entry = entry_of("classic/tail-after-stop")
    world = entry.world()
    outcomes = [world.rollout_reference(entry.scenario(world), name).outcome for name in world.reference_drivers]
    assert pafot.Outcome.SAFE in outcomes


def test_impossible_value_fails_the_item(project):
    project.write('@pafot.catalogue("r157/cut-in", ego_speed=-5.0)\ndef test_x(run): pass\n')
    project.run().assert_outcomes(failed=1)


@table("decorator", ['pytest.mark.parametrize("run", [1, 2])', "pafot.search(npcs=1)"])
def test_parameter_that_is_taken_fails_its_item_only(project, decorator):
    project.write(f'@pafot.catalogue("r157/cut-in")\n@{decorator}\ndef test_x(run): pass\n\ndef test_other(): pass\n')
    result = project.run()
    assert result.parseoutcomes().get("passed", 0) >= 1


@table("argument", ['ads="policies:keep"', 'ads="no_module:make"', "world=3", 'world="fractions:Fraction"'])
def test_wrong_policy_or_world_of_an_item_is_told_without_plugin_code(project, argument):
    project.pytester.makepyfile(policies="def keeps(): pass\n")
    project.write(f'@pafot.catalogue("r157/cut-in", {argument})\ndef test_x(run): pass\n')
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.no_fnmatch_line("*def pytest_pyfunc_call*")


@table(
    "options",
    [{"ads": "no_module:make"}, {"world": 3}, {"over": {1: "0:1:2"}}, {"against": 3}, {"points": "x"}],
)
def test_wrong_argument_of_a_sweep_is_a_request_error(options):
    with pytest.raises(RequestError):
        pafot.sweep("r157/cut-in", **{"ads": keeps_speed, "over": {"gap": [0, 9]}, **options})


@table("given", ["0:60:nan", "0:60:inf"])
def test_count_that_is_no_number_is_refused(given):
    with pytest.raises(RequestError, match="over: gap: expected first:last:count"):
        values_of("gap", given)


@table(
    "arguments",
    [
        *(
            ["--over", "gap=0:1:2", "--set", f"{name}=1"]
            for name in ("points", "ads", "world", "holds", "what", "self")
        ),
        ["--over", "world=0:1:2"],
        ["--over", "self=0:1:2"],
    ],
)
def test_no_name_of_a_number_ends_the_command_with_a_traceback(capsys, arguments):
    assert main(["map", "r157/cut-in", "--ads", f"{__name__}:keeps_speed", *arguments]) == 2
    assert capsys.readouterr().err.startswith("map: ")


def test_map_of_another_scenario_or_other_numbers_is_refused():
    before = mapped("..", "..")
    with pytest.raises(RequestError, match="against"):
        mapped("X.", "..", scenario=two_numbers("left"), against=before)
    with pytest.raises(RequestError, match="against"):
        mapped("X.", "..", against=replace(before, axes=(replace(before.axes[0], name="gap"), before.axes[1])))


@table("lateral_speed", [1.0, 2.0, 3.0])
def test_time_to_contact_is_reached_as_the_lane_change_ends(lateral_speed):
    entry = entry_of("euro-ncap/cut-in")
    values = {"ttc": 1.5, "ego_speed": 30.0, "target_speed": 20.0, "lateral_speed": lateral_speed}
    world = entry.world()
    run = world.run_of(world.rollout(entry.scenario(**values), keeps_speed))
    tick = run.trace.begun[0][0] + round(4.0 / lateral_speed * run.trace.physics_hz)
    ego, npc = run.trace.states[tick, :, 0]
    assert (npc - ego - run.trace.sizes[:, 0].mean()) / 10.0 == pytest.approx(1.5, abs=0.3)


def test_item_drives_every_entry_of_a_highway_by_default(project):
    names = [entry.name for entry in ENTRIES if not entry.name.startswith("junction/")]
    project.write(f"@pafot.catalogue(*{names})\ndef test_x(run): pass\n")
    result = project.run("-rs")
    result.stdout.no_fnmatch_line("*this world cannot drive it*")


def test_runs_that_fail_are_played_first(monkeypatch):
    monkeypatch.setattr(drawing, "MOST_PLAYED", 1)
    assert ["frames" in told for told in data_of(page(mapped("..", ".#")))] == [False, True, False, False]


def test_all_lines_fit_a_narrow_terminal():
    assert max(map(len, mapped("X.#", "..?").explain(60).splitlines())) <= 60


def test_formulas_are_escaped_in_a_saved_map():
    def fails(run):
        raise AssertionError('=HYPERLINK("https://a.b")')

    made = replace(mapped("..", ".X", holds=fails), name="=1+1")
    for row in csv.DictReader(io.StringIO(made.csv())):
        assert not row["scenario"].startswith(("=", "+", "-", "@"))
        assert not row["words"].startswith(("=", "+", "-", "@"))


def test_item_fails_although_it_did_not_come_up_as_asked(project):
    project.write(
        '@pafot.catalogue("r157/cut-in", gap=20.0, ads=lambda: lambda seen: (3.0, 0.0))\n'
        "def test_x(run):\n    assert not run.collision\n"
    )
    (point, _) = pafot.sweep("r157/cut-in", speeds_up, over={"gap": [20, 21]}).points
    assert point.kind == "not as asked"
    project.run().assert_outcomes(failed=1)
