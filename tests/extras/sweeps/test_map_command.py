"""The command `python -m pytest_pafot map`: from its arguments to its text, files and exit code."""

import os
import re
import sys

import pytest

import pytest_pafot as pafot
from pytest_pafot.__main__ import main
from pytest_pafot.corpus.writer import write
from pytest_pafot.extras.sweeps.entries import NAMES
from pytest_pafot.support.errors import RequestError
from tests.findings.builders import plain_finding
from tests.helpers.tables import table

POLICIES = """\
def keeps_speed():
    return lambda seen: (0.0, 0.0)


def brakes():
    return lambda seen: (-4.0, 0.0)


def same():
    return lambda seen: 1  # an action of the environment


def raises():
    return lambda seen: 1 / 0


class Named:
    def __init__(self, text):
        self.action = (float(text), 0.0)

    def __call__(self, seen):
        return self.action


def not_slow(run):
    assert run.ego.speed.min() > 3, "too slow"


number = 3
"""


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch):
    """Let lines be long, so that tests can compare them."""
    monkeypatch.setenv("COLUMNS", "999")


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "policies.py").write_text(POLICIES)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.fixture
def told(here, capsys):
    """Return a function that runs the command, and returns its exit code, output and errors."""

    def run(*arguments):
        try:
            code = main(["map", *arguments])
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        assert "Traceback" not in out + err
        return code, out, err

    return run


CUT_IN = ("r157/cut-in", "--ads", "policies:keeps_speed")
OVER = ("--over", "gap=0:60:3")


def test_without_arguments_the_catalogue_is_listed(told, monkeypatch):
    monkeypatch.setenv("COLUMNS", "130")
    code, out, _ = told()
    assert code == 0
    assert [line for line in out.splitlines() if line in NAMES] == [*NAMES]
    assert max(map(len, out.splitlines())) <= 130
    assert "\n    gap             30 m         0 to 60            the gap at which it begins to change lanes\n" in out
    assert "\n    target_speed    0 m/s        fixed              its speed\n" in out


def test_group_lists_its_entries(told):
    code, out, _ = told("junction")
    assert (code, [line for line in out.splitlines() if line in NAMES]) == (
        0,
        ["junction/crossing", "junction/oncoming-turn", "junction/merge"],
    )


def test_map_is_printed(told):
    code, out, err = told(*CUT_IN, *OVER)
    assert (code, err) == (0, "")
    assert out.splitlines()[:6] == [
        "r157/cut-in",
        "3 points: 0 avoided, 2 failed though a reference driver avoids it, 1 unavoidable, 0 not as asked",
        "",
        "gap [m]",
        "   0 30 60",
        "   #  X  X",
    ]


def test_preventable_failure_is_exit_code_1_on_request(told):
    assert told(*CUT_IN, *OVER, "--fail-on", "preventable")[0] == 1
    assert told(*CUT_IN, "--over", "gap=0:1:2", "--fail-on", "preventable")[0] == 0


def test_numbers_policy_and_property_are_taken_from_arguments(told):
    code, out, _ = told(
        "r157/side-vehicle", "--ads", "policies:Named:-4", "--over", "ego_speed=5:15:2", "--set", "offset=0.0",
        "--check", "policies:not_slow",
    )  # fmt: skip
    assert (code, "2 points: 0 avoided" in out) == (0, True)


def test_policy_of_an_environment_is_driven_with_its_config(told):
    side = ("--world", "highway-v0", "--config", '{"lanes_count": 2, "vehicles_count": 1}', "--set", "side=-1")
    code, out, _ = told(
        "r157/cut-in", "--ads", "policies:same", "--over", "gap=20:60:2", "--set", "ego_speed=20", *side
    )
    assert (code, out.split(":")[0]) == (0, "r157/cut-in ego_speed=20 side=-1 in highway-v0\n2 points"), out
    assert "0 avoided" in out
    assert "cannot be driven" not in out


def test_axes_are_the_numbers_of_a_finding(told, here):
    finding = plain_finding()
    write(here / f"{finding.id}.pafot.yaml", finding)
    code, out, _ = told(f"{finding.id}.pafot.yaml", *CUT_IN[1:], "--over", "npcs.0.1.speed=8:20:2")
    assert code == 0
    assert out.startswith(f"{finding.id}\n2 points: ")


def test_files_are_written_and_named(told, here):
    code, out, _ = told(*CUT_IN, *OVER, "--csv", "a.csv", "--html", "new/b.html", "--png", "c.png")
    assert (code, out.splitlines()[-3:]) == (0, ["wrote a.csv", "wrote new/b.html", "wrote c.png"])
    assert (here / "a.csv").read_text().startswith("gap,scenario,result,words\n0,r157/cut-in,unavoidable,")
    assert (here / "new" / "b.html").read_text().startswith("<!doctype html>")
    assert (here / "c.png").read_bytes().startswith(b"\x89PNG")


def test_against_an_earlier_map_only_worse_points_count(told):
    worse = ("--fail-on", "worse")
    assert told(*CUT_IN, *OVER, "--csv", "bad.csv")[0] == 0
    code, out, _ = told(*CUT_IN, *OVER, "--against", "bad.csv", "--csv", "new.csv", *worse)
    assert (code, "changed" in out) == (0, False)
    brakes = ("r157/cut-in", "--ads", "policies:Named:-0.5", "--over", "gap=40:60:2")
    assert told(*brakes, "--csv", "good.csv")[0] == 0
    code, out, _ = told(*CUT_IN, "--over", "gap=40:60:2", "--against", "good.csv", *worse)
    worse = "\nworse: gap 40 m, from avoided to failed though a reference driver avoids it\n"
    assert (code, worse in out) == (1, True)


def test_map_that_is_compared_with_is_not_overwritten(told, here):
    assert told(*CUT_IN, *OVER, "--csv", "a.csv")[0] == 0
    before = (here / "a.csv").read_bytes()
    (here / "hard.csv").hardlink_to(here / "a.csv")
    (here / "soft.csv").symlink_to("a.csv")
    for option, path in ("--csv", "a.csv"), ("--csv", here / "a.csv"), ("--csv", "hard.csv"), ("--html", "soft.csv"):
        code, out, err = told(*CUT_IN, *OVER, "--against", "a.csv", option, str(path))
        assert (code, out, "expected a file that this map does not overwrite" in err) == (2, "", True)
    assert (here / "a.csv").read_bytes() == before


@table("policy", ["brakes", "raises"])
def test_policy_that_meets_no_point_or_raises_does_not_pass(told, policy):
    stops = ("r157/cut-in", "--ads", f"policies:{policy}", *OVER)
    code, out, _ = told(*stops, "--set", "relative_speed=-3", "--fail-on", "preventable")
    note = (
        "no point came up as asked, so this map says nothing" if policy == "brakes" else "ADS error, such as gap 0 m: "
    )
    assert (code, note in out) == (1, True), out
    code, out, _ = told("r157/cut-in", "--ads", "policies:Named:-0.5", *OVER, "--csv", "good.csv")
    code, out, _ = told(*stops, "--against", "good.csv", "--fail-on", "worse")
    assert (code, "\nworse: gap 60 m, from avoided to " in out) == (1, True), out


def test_policy_with_another_speed_is_told_of(told):
    _, out, _ = told("r157/cut-in", "--ads", "policies:Named:0.5", "--over", "gap=20:30:2")
    assert "m/s off the speed asked for when a manoeuvre began" in out
    _, out, _ = told("r157/cut-in", "--ads", "policies:Named:2", "--over", "gap=20:30:2")
    assert "2 not as asked" in out
    assert "at 2 of 2 points the ego was up to " in out
    _, out, _ = told(*CUT_IN, "--over", "gap=30:60:2")
    assert "off the speed" not in out


def test_points_that_cannot_be_driven_are_counted(told):
    places = ("--over", "slot=-5:0:2", "--over", "speed=8:12:2", "--world", "intersection-v0")
    _, out, _ = told("junction/crossing", "--ads", f"{CUT_IN[2]}@planner", *places)
    assert "\n3 of the points not as asked cannot be driven, such as slot -5 s, speed 8 m/s: " in out, out


def highway(limit):
    return pafot.Highway(speed_limit=float(limit), duration=20.0)


class NoReference:
    speed_limit, longest_run = 30.0, 20.0
    rollout = to_dict = None


def test_map_is_driven_in_the_world_of_a_factory(told):
    code, out, err = told(*CUT_IN, *OVER, "--world", f"{__name__}:highway:36")
    assert (code, out.startswith("r157/cut-in in Highway speed_limit=36.0")) == (0, True), err
    code, _, err = told(*CUT_IN, *OVER, "--world", f"{__name__}:NoReference")
    assert (code, "reference drivers, which tell what can be avoided, received <" in err) == (2, True)
    with pytest.raises(RequestError, match=r"world: expected a factory of a world, received .*, which has no rollout"):
        pafot.sweep("r157/cut-in", "policies:Named", over={"gap": "10:20:2"}, world="fractions:Fraction")


@table(("before", "after"), [(None, "gap,scenario,result,words\n0,r157/cut-in,"), ("earlier", "earlier")])
def test_interrupted_map_saves_what_it_has_driven_but_over_no_other(told, here, before, after):
    (here / "stops.py").write_text(
        "count = 0\n\n\ndef make():\n    global count\n    count += 1\n    if count == 3:\n"
        "        raise KeyboardInterrupt\n    return lambda seen: (0.0, 0.0)\n"
    )
    sys.modules.pop("stops", None)
    path = here / "a.csv"
    path.unlink(missing_ok=True)
    if before is not None:
        path.write_text(before)
    code, out, err = told("r157/cut-in", "--ads", "stops:make", "--over", "gap=0:60:7", "--csv", "a.csv")
    what = "wrote the points driven so far to a.csv"
    what = what if before is None else "nothing was written, because there is a file already"
    assert (code, out, err) == (130, "", f"\nmap: interrupted; {what}\n")
    assert path.read_text().startswith(after)


@table(
    ("arguments", "text"),
    [
        (["r157/cutin", *CUT_IN[1:], *OVER], "map: catalogue: expected one of .*; did you mean 'r157/cut-in'"),
        ([*CUT_IN, *OVER, "--config", "{}"], "--config: expected an environment, received none; give --world"),
        ([*CUT_IN, *OVER, "--world", "highway-v0", "--config", "{"], "--config: expected JSON such as"),
        (["r158"], "map: catalogue: expected one of"),
        (["r157/cut-in", *OVER], "map: expected --ads with a policy and --over .*, received no --ads"),
        ([*CUT_IN], "received no --over; `map` without arguments lists the catalogue"),
        ([*CUT_IN, "--over", "gap"], "--over: expected different NAME=FIRST:LAST:COUNT"),
        ([*CUT_IN, "--over", "gap=0:60:1"], "over: gap: expected first:last:count"),
        ([*CUT_IN, "--over", "gap=0:60:201"], "2 to 200 of them, received '0:60:201'"),
        ([*CUT_IN, *OVER, "--set", "side=0"], r"side: expected 1 \(right\) or -1 \(left\), received 0"),
        (["r157/cut-in", "--ads", "policies:Named:fast", *OVER], "expected a factory of a policy, .* ValueError: "),
        ([*CUT_IN, "--over", "gpa=0:60:3"], "received 'gpa'; did you mean 'gap'"),
        ([*CUT_IN, *OVER, "--over", "side=-1:1:2", "--over", "ego_speed=5:6:2"], "expected one or two axes"),
        ([*CUT_IN, *OVER, "--set", "side"], "--set: expected different NAME=VALUE, such as gap=20, received 'side'"),
        ([*CUT_IN, *OVER, "--set", "side=left"], "--set: expected different NAME=VALUE"),
        ([*CUT_IN, *OVER, "--set", "side=1", "--set", "side=1"], "--set: expected different NAME=VALUE"),
        ([*CUT_IN, *OVER, "--set", "gap=1"], "gap: expected an axis or a value, received both"),
        ([*CUT_IN, *OVER, "--fail-on", "worse"], "--fail-on worse: expected --against with a saved map"),
        ([*CUT_IN, "--over", "gap=1:1.1:3"], "over: gap: expected values at least 0.1 apart"),
        ([*CUT_IN, *OVER, "--set", "world=3"], "r157/cut-in: expected one of the parameters"),
        ([*CUT_IN, *OVER, "--set", "side=nan"], "--set: expected different NAME=VALUE"),
        ([*CUT_IN, *OVER, "--set", "sid=1"], "received 'sid'; did you mean 'side'"),
        ([*CUT_IN, *OVER, "--set", "ego_speed=-9"], "expected a point that can be driven, received none: speed"),
        ([*CUT_IN, *OVER, "--world", "policies:Nam"], "--world: .* 'policies:Nam'; did you mean 'policies:Named'"),
        ([*CUT_IN, *OVER, "--world", "highway-v7"], "expected a registered environment, received 'highway-v7'"),
        ([*CUT_IN, *OVER, "--check", "policies:none"], "policies:none"),
        ([*CUT_IN, *OVER, "--against", "none.csv"], "against: none.csv: expected the file of a saved map"),
        (["r157/cut-in", "--ads", "policies:keep_speed", *OVER], "did you mean 'policies:keeps_speed'"),
        (["r157/cut-in", "--ads", "policies:number", *OVER], "policies:number"),
        (["a.pafot.yaml", *CUT_IN[1:], *OVER, "--set", "world=1"], "--set: expected a scenario of the catalogue"),
        (["none.pafot.yaml", *CUT_IN[1:], *OVER], "none.pafot.yaml: expected the file .* corpus list`"),
        (["junction/crossing", *CUT_IN[1:], "--over", "slot=0:1:2"], "command map takes --world inters"),
        ([*CUT_IN, *OVER, "--color", "red"], "unrecognized arguments: --color red"),
    ],
)  # fmt: skip
def test_wrong_argument_is_exit_code_2_with_the_way_out(told, arguments, text):
    code, out, err = told(*arguments)
    assert (code, out) == (2, "")
    assert re.search(text, err)


@pytest.mark.skipif(os.name == "nt", reason="Windows calls it a lack of permission")
@table(
    ("path", "fix"),
    [
        ("taken/a.csv", "there is a file where a folder should be: rename or delete it, or choose another file"),
        ("full", "there is a folder with that name: rename or delete it, or choose another file"),
        ("x" * 300, "shorten the names of the folders"),
    ],
)
def test_file_that_cannot_be_written_is_exit_code_2(told, here, path, fix):
    (here / "taken").touch()
    (here / "full").mkdir(exist_ok=True)
    for option in ("--csv", "--html"):
        code, out, err = told(*CUT_IN, "--over", "gap=0:1:2", option, path)
        assert (code, out) == (2, "")  # before anything is driven
        assert err.startswith(f"map: {path}: expected a file that can be written, received ")
        assert fix in err


def test_terminal_that_is_narrow_gets_a_narrow_map(told, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    _, out, _ = told(*CUT_IN, "--over", "gap=30:59:30")
    assert "\ngap [m]\n30 33 36 39 42 45 48 51 54   59\n " + "X" * 30 in out
    assert max(map(len, out.splitlines())) <= 40
