"""Maps: what becomes of a scenario at each point, islands, and what has changed since an earlier map."""

import csv
import io
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pytest_pafot as pafot
from pytest_pafot.corpus.writer import write
from pytest_pafot.extras.sweeps.entries import entry_of
from pytest_pafot.extras.sweeps.maps import KINDS, MOST_BYTES, Change
from pytest_pafot.model.trace import Outcome
from pytest_pafot.support.errors import RequestError
from tests.extras.sweeps.planted import COLUMNS, ROWS, Planted, keeps_speed, mapped, picture_of, two_numbers
from tests.findings.builders import plain_finding
from tests.helpers.tables import table
from tests.helpers.toy_world import Toy

CUT_IN = entry_of("r157/cut-in")


def brakes_within(distance):
    """Return a policy that brakes for a vehicle in its lane at less than a distance, and else keeps its speed."""

    def drive(seen):
        gaps = [other.x - seen.ego.x - other.length for other in seen.others if abs(other.y - seen.ego.y) < 2.5]
        return (-6.0 if any(0 < gap < distance for gap in gaps) else 0.0), 0.0

    return lambda: drive


def speeds_up():
    return lambda seen: (3.0, 0.0)


# What becomes of a point.


def kind_alone(world, scenario, ads):
    """Return what becomes of a scenario that comes up as asked, by its own runs."""
    fails = [world.rollout(scenario, ads).outcome is Outcome.COLLISION]
    fails += [world.rollout_reference(scenario, name).outcome is Outcome.COLLISION for name in world.reference_drivers]
    return "avoided" if not fails[0] else "unavoidable" if all(fails) else "preventable"


def test_points_equal_single_runs_of_a_policy_with_a_threshold():
    ads, entry = brakes_within(12.0), entry_of("r157/braking-leader")
    made = pafot.sweep(entry.name, ads, over={"headway": "1.2:2:2", "ego_speed": "10:30:4"}, deceleration=8.0)
    world, kinds = entry.world(), []
    for point in made.points:
        headway, ego_speed = point.at
        scenario = entry.scenario(headway=headway, ego_speed=ego_speed, deceleration=8.0)
        kinds.append(kind_alone(world, scenario, ads))
        assert point.trace.states.tobytes() == world.rollout(scenario, ads).states.tobytes()
    assert [point.kind for point in made.points] == kinds
    assert {*kinds} == {"avoided", "preventable"}


def test_each_kind_arises_and_is_explained():
    def only(ads, gap):
        (point, _) = pafot.sweep("r157/cut-in", ads, over={"gap": [gap, 60]}).points
        return point.kind, point.words

    assert only(keeps_speed, 0) == (
        "unavoidable",
        "collision after 2.1 s, closing at 6.1 m/s: NPC 0 on the right, NPC at fault; no reference driver avoids it",
    )
    kind, words = only(keeps_speed, 30)
    assert (kind, words.endswith("NPC 0 ahead, ego at fault; careful-human avoids it")) == ("preventable", True)
    assert only(brakes_within(20.0), 30) == ("avoided", "no collision in 20.0 s")
    kind, words = only(speeds_up, 20)
    assert (kind, words.partition(";")[0]) == ("not as asked", "ego speed asked 16.7 m/s, was 19.3 m/s")


PICTURE = (".X#", "?.X")


def test_map_counts_what_became_of_its_points():
    world, told = Planted(*PICTURE), []
    made = mapped(*PICTURE, world=world, on_point=told.append)
    assert picture_of(made) == PICTURE
    counts = [made.count(kind) for kind in ("avoided", "preventable", "unavoidable", "not as asked")]
    assert counts == [2, 2, 1, 1]
    assert (made.shape, told) == ((2, 3), [1, 2, 3, 4, 5, 6])
    assert world.runs == 5  # one of the points does not fit the world
    assert [made.point(0, 0).trace, made.point(0, 0).words] == [
        None,
        "cannot be driven: ego_speed: expected another one, received this one",
    ]
    assert [point.at for point in made.points] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    assert made.where((1.0, 2.0)) == "ego.speed 1 m/s, npcs.0.0.speed 2 m/s"
    assert made.headline == (
        "6 points: 2 avoided, 2 failed though a reference driver avoids it, 1 unavoidable, 1 not as asked"
    )
    assert repr(made) == f"<Sweep {made.name}, {made.headline}>"


def test_property_of_the_user_decides_what_fails():
    def slow(run):
        assert run.scenario.ego_speed < 1

    made = mapped("XX", "XX", holds=slow)
    assert picture_of(made) == ("##", "..")  # whoever drives, the property does not hold
    assert made.point(1, 0).words.startswith("assert 1.0 < 1 (")

    def declines(run):
        pytest.skip("not for me")

    assert picture_of(mapped("..", "..", holds=declines)) == ("??", "??")


def test_finding_its_file_and_its_scenario_are_swept(tmp_path):
    finding = plain_finding()
    path = tmp_path / f"{finding.id}.pafot.yaml"
    write(path, finding)
    over = {"npcs.0.1.speed": [8, 20]}
    of_finding, of_file, of_text, of_scenario = (
        pafot.sweep(what, keeps_speed, over=over) for what in (finding, path, str(path), finding.scenario)
    )
    assert of_finding.points == of_file.points == of_text.points
    assert (of_finding.name, of_file.name, of_scenario.name) == (finding.id, finding.id, finding.scenario.id)
    assert of_finding.point(0).trace.scenario == finding.scenario


class WithoutReferences(Toy):
    longest_run = 20.0


@table(
    ("what", "options", "text"),
    [
        ("r157/cutin", {}, "catalogue: expected one of .*; did you mean 'r157/cut-in'?"),
        (3, {}, "catalogue: expected one of .*, received 3"),
        ("r157/cut-in", {"over": {}}, "over: expected one or two axes, such as {'gap': '0:60:7'}, received {}"),
        ("r157/cut-in", {"over": "gap=0:60:7"}, "over: expected one or two axes"),
        ("r157/cut-in", {"over": dict.fromkeys(("gap", "side", "ego_speed"), "0:1:2")}, "one or two axes"),
        ("r157/cut-in", {"over": {"gpa": "0:1:2"}}, "received 'gpa'; did you mean 'gap'?"),
        ("r157/cut-in", {"over": {"npcs.1.speed": "0:1:2"}}, "over: expected one of ego.speed, .*'npcs.1.speed'"),
        ("r157/cut-in", {"gpa": 3}, "received 'gpa'; did you mean 'gap'?"),
        ("r157/cut-in", {"side": 0}, r"r157/cut-in: side: expected 1 \(right\) or -1 \(left\), received 0"),
        ("r157/cut-in", {"over": {"side": "-1:1:5"}}, "side: expected 1 .*, received -0.5"),
        (two_numbers(), {"over": {"npcs.0.speed": "0:1:2"}}, "received 'npcs.0.speed'; did you mean 'npcs.0.0.speed'?"),
        ("r157/cut-in", {"ego_speed": "fast"}, "ego_speed: expected a number, received 'fast'"),
        ("r157/cut-in", {"ego_speed": -9}, "expected a point that can be driven, received none: speed: expected m/s"),
        ("r157/cut-in", {"world": WithoutReferences()}, "expected a world with reference drivers"),
        (two_numbers(), {"over": {"ego.speed": "0:1:2"}, "gap": 3}, "expected no parameters for a scenario, .* gap"),
    ],
)  # fmt: skip
def test_wrong_argument_is_refused_before_any_run(what, options, text):
    def never():
        raise AssertionError

    with pytest.raises(RequestError, match=text):
        pafot.sweep(what, never, **{"over": {"gap": "0:60:7"}, **options})


def test_values_outside_of_the_range_of_an_entry_are_driven_and_told():
    over = {"deceleration": [4, 8.04, 10], "ego_speed": [0.5, 25]}
    made = pafot.sweep("r157/braking-leader", keeps_speed, over=over, headway=2.5)
    assert made.remarks == (
        "headway 2.5 s: outside of its range (1 to 2)",
        "deceleration 10 m/s^2: outside of its range (1 to 8)",
        "ego_speed 0.5 and 25 m/s: outside of its range (1.389 to 16.67)",
    )
    assert {*made.remarks} <= {*made.notes}


def test_policy_that_cannot_drive_is_the_users_error():
    def raises():
        raise ValueError("no weights")

    with pytest.raises(RequestError, match=r"ads: expected a factory of a policy, .* raises ValueError: no weights \("):
        pafot.sweep("r157/cut-in", raises, over={"gap": [0, 9]})
    with pytest.raises(RequestError, match=r"ads: expected a factory, .*, received 3"):
        pafot.sweep("r157/cut-in", 3, over={"gap": [0, 9]})


# The map as text.


def test_terminal_shows_larger_values_above_and_to_the_right():
    text = mapped(*PICTURE).explain()
    assert text.splitlines()[3:8] == [
        "ego.speed [m/s] up, npcs.0.0.speed [m/s] across",
        "   0 1 2",
        "1  . X #",
        "0  ? . X",
        "",
    ]
    assert text == str(mapped(*PICTURE))


def test_map_of_one_axis_is_one_row():
    made = pafot.sweep("r157/cut-in", keeps_speed, over={"gap": "0:60:3"})
    assert made.explain().splitlines()[3:6] == ["gap [m]", "   0 30 60", "   #  X  X"]


def test_narrow_terminal_moves_columns_together_and_wraps_notes():
    picture = ("." * 30, "X" * 30)
    wide, narrow, least = (mapped(*picture).explain(width).splitlines() for width in (100, 70, 40))
    assert "1 " + "  ." * 30 in wide
    for lines, row, step in ((wide, "  .", 1), (narrow, " .", 2), (least, ".", 3)):
        above = lines[lines.index("1 " + row * 30) - 1]  # each label ends above its column
        shown = [int(label) for label in above.split()]
        assert shown == [*range(0, 30 - step, step), 29]
        assert [above[: 2 + len(row) * (column + 1)].split()[-1] for column in shown] == [*map(str, shown)]
    long = pafot.sweep("r157/cut-in", keeps_speed, over={"gap": [round(0.1 + each * 0.3, 1) for each in range(50)]})
    above, marks = long.explain(60).splitlines()[-4:-2]
    assert (above[:5].split(), above.split()[-1], len(above)) == (["0.1"], "14.8", len(marks)), above
    assert max(map(len, least)) <= 40
    assert " ".join(" ".join(least[-3:]).split()) == ". avoided X failed though a reference driver avoids it"


def test_hostile_name_is_escaped_in_a_terminal():
    text = replace(mapped(*PICTURE), name="\x1b[31m::error::\u202e").explain()
    assert text.isascii()
    assert re.sub(r"\n", "", text).isprintable()
    assert not re.search(r"(?<!\S)::", text)


# Islands.


@table(
    ("picture", "named"),
    [
        (("....", ".X..", "...."), ["(1, 1) fails, although (0, 1) and (2, 1) pass"]),
        (("XXXX", "X.XX", "XXXX"), ["(1, 1) passes, although (0, 1) and (2, 1) fail"]),
        (("....", ".XX.", "...."), ["(1, 1) fails (and 1 point beside it), although (0, 1) and (2, 1) pass"]),
        ((".X..X", ".X..X"), []),  # limits, which reach from one end to the other
        ((".X.", "XXX"), []),
        ((".X..", ".X..", "...."), ["(1, 1) fails (and 1 point beside it), although (1, 0) and (1, 2) pass"]),
        ((".?X?.", "?????"), ["(1, 2) fails, although (1, 0) and (1, 4) pass"]),
        ((".#X#.", "#####"), []),
        (("?#?", "#?#"), []),
    ],
)  # fmt: skip
def test_islands_are_named_exactly(picture, named):
    place = r"ego\.speed (\d) m/s, npcs\.0\.0\.speed (\d) m/s"
    assert [re.sub(place, r"(\1, \2)", sentence) for sentence in mapped(*picture).islands] == named


@given(st.lists(st.integers(0, 5), min_size=2, max_size=5), st.booleans())
@settings(max_examples=12)
def test_map_that_only_gets_harder_has_no_islands(heights, is_reversed):
    picture = ["." * height + "X" * (5 - height) for height in sorted(heights, reverse=is_reversed)]
    assert mapped(*picture).islands == ()


def test_notes_name_the_first_islands_and_count_the_others():
    notes = mapped(*["." * 17, ".X" * 8 + ".", "." * 17]).notes
    assert [note.partition(",")[0] for note in notes] == ["island: ego.speed 1 m/s"] * 6 + ["island: and 2 more"]


# An earlier map.


def test_map_of_another_world_or_check_is_another_map():
    def never(run):
        assert run.collision

    def made(**given):
        return pafot.sweep("r157/cut-in", keeps_speed, over={"gap": [20, 40]}, **given)

    here, there = made(), made(world=pafot.Highway(lanes=3, speed_limit=36.3, duration=20.0))
    assert there.name == "r157/cut-in in Highway lanes=3 speed_limit=36.3 duration=20.0"
    assert made(world=pafot.World("highway-v0", planner_hz=5)).name == "r157/cut-in in highway-v0"
    with pytest.raises(RequestError, match="against: expected a map of r157/cut-in, never over gap, received one of"):
        made(holds=never, against=here)


def test_changes_since_an_earlier_map_are_worse_or_better():
    before, now = mapped("..", "X#"), mapped("X.", ".?", against=mapped("..", "X#"))
    assert now.changes == (
        Change(at=(0, 0), before="preventable", now="avoided"),
        Change(at=(0, 1), before="unavoidable", now="not as asked"),
        Change(at=(1, 0), before="avoided", now="preventable"),
    )
    assert now.worse == now.changes[-1:]
    assert now.notes[-4:] == (
        "changed: 3 points, 1 for the worse",
        "worse: ego.speed 1 m/s, npcs.0.0.speed 0 m/s, from avoided to failed though a reference driver avoids it",
        "changed: ego.speed 0 m/s, npcs.0.0.speed 0 m/s, from failed though a reference driver avoids it to avoided",
        "changed: ego.speed 0 m/s, npcs.0.0.speed 1 m/s, from unavoidable to not as asked",
    )
    assert (before.changes, mapped("..", "X#", against=before).changes) == ((), ())
    good = mapped("..", "..")
    assert [len(mapped(*each, against=good).worse) for each in (("..", ".."), ("#?", "X."))] == [0, 3]
    many = mapped("X" * 9, "." * 9, against=mapped("." * 9, "." * 9))
    assert [len(many.worse), len(many.notes), many.notes[0]] == [9, 7, "changed: 9 points, 9 for the worse"]


PICTURES = st.lists(st.text(st.sampled_from(".X#?"), min_size=3, max_size=3), min_size=2, max_size=2).filter(
    lambda rows: {*"".join(rows)} != {"?"}
)


@given(PICTURES, PICTURES)
@settings(max_examples=8)
def test_saved_map_is_read_back_as_it_was(before, now):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.csv"
        saved = mapped(*before)
        saved.save(path)
        assert mapped(*before, against=path).changes == ()
        assert mapped(*now, against=path).changes == mapped(*now, against=saved).changes
    differ = sum(one != other for one, other in zip("".join(before), "".join(now), strict=True))
    assert len(mapped(*now, against=saved).changes) == differ


def test_saved_map_is_a_table_for_other_programs():
    made = mapped(*PICTURE)
    rows = [*csv.DictReader(io.StringIO(made.csv()))]
    assert list(rows[0]) == [ROWS, COLUMNS, "scenario", "result", "words"]
    assert [row["result"] for row in rows] == [point.kind for point in made.points]
    assert rows[0]["words"] == made.points[0].words
    assert (rows[5][ROWS], rows[5][COLUMNS], rows[5]["scenario"]) == ("1", "2", made.name)
    nasty = replace(made, name='a,"b"\n\x1b')
    assert [row["scenario"] for row in csv.DictReader(io.StringIO(nasty.csv()))] == [r'a,"b"\n\x1b'] * 6


HEADER = f"{ROWS},{COLUMNS},scenario,result,words\n"
NAME = f"{two_numbers().id} in Planted"


@table(
    ("content", "text"),
    [
        ("", "expected the columns ego.speed, .*, received no rows"),
        (HEADER, "expected the columns ego.speed, .*, received no rows"),
        (f"gap,{HEADER}", "expected the columns"),
        (f"{HEADER}0,0,{NAME},avoided,\n", "same 6 points, received one with 1; they differ at"),
        (f"{HEADER}0,0,{NAME},fine,\n", f"expected one of {', '.join(KINDS)} as the result, received fine"),
        (f"{HEADER}0,0,{NAME}\n", "expected one of avoided, .* as the result, received None"),
        (f"{HEADER}0\n", "expected a map of .*, received None"),
        (f"{HEADER}0,a,{NAME},avoided,\n", "expected numbers in the columns of the axes, received "),
        (f"{COLUMNS},{ROWS},{HEADER.partition(',')[2].partition(',')[2]}1,0,,,\n",
         "expected the columns ego.speed, npcs.0.0.speed, .*, with the axes in the same order, received npcs"),
        (f"{HEADER}0,0,other,avoided,\n", f"expected a map of {NAME}, received other"),
        (f"{HEADER}0,0,\x1b[31m,avoided,\n", r"expected a map of .*, received \\x1b\[31m"),
        (f'{HEADER}0,0,"{"x" * 200_000}",avoided,\n', "expected CSV in UTF-8, received field larger than"),
        (f"{HEADER}0,0,{NAME},caf\xe9,\n".encode("latin-1"), "expected CSV in UTF-8, received "),
        (mapped("..", "..").csv(), "expected a map with the same 6 points, received one with 4; they differ at"),
        (mapped("....", "....").csv(), "expected a map with the same 6 points, received one with 8; they differ at"),
        (mapped(*PICTURE, scenario=two_numbers("left")).csv(), f"expected a map of {NAME}, received "),
        (pafot.sweep("r157/cut-in", keeps_speed, over={"gap": [0, 9]}).csv(), "expected the columns .*received gap"),
    ],
)  # fmt: skip
def test_file_that_is_no_map_of_this_is_refused(tmp_path, content, text):
    path = tmp_path / "map.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(RequestError, match=rf"against: .*map\.csv: {text}" if "same 6" not in text else text):
        mapped(*PICTURE, against=path)


def test_byte_order_mark_of_a_spreadsheet_is_skipped(tmp_path):
    made = mapped(*PICTURE)
    (tmp_path / "map.csv").write_text(made.csv(), encoding="utf-8-sig")
    assert mapped(*PICTURE, against=tmp_path / "map.csv").changes == ()


def test_links_folders_and_huge_files_are_not_read(tmp_path):
    mapped(*PICTURE).save(tmp_path / "map.csv")
    (tmp_path / "link.csv").symlink_to(tmp_path / "map.csv")
    with (tmp_path / "huge.csv").open("wb") as file:
        file.truncate(MOST_BYTES + 1)
    for name, text in (
        ("link.csv", "expected the file of a saved map"),
        (".", "expected the file of a saved map"),
        ("none.csv", "expected the file of a saved map, received No such file or directory"),
        ("huge.csv", f"expected at most {MOST_BYTES} bytes, received more"),
    ):
        with pytest.raises(RequestError, match=text):
            mapped(*PICTURE, against=tmp_path / name)
