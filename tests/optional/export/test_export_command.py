"""The command from its arguments to its files, and its errors."""

import shutil
import signal
import sys

import pytest
from gymnasium.wrappers import FlattenObservation

import pytest_pafot as pafot
from pytest_pafot.__main__ import main
from pytest_pafot.corpus.writer import text_of
from pytest_pafot.support.files import write_whole
from tests.findings.builders import plain_finding
from tests.helpers.puppets import Puppets
from tests.optional.export.conftest import FILES

FILE = FILES / "collision-xfail.pafot.yaml"


def export(*arguments):
    return main(["export", *map(str, arguments)])


def test_export_drives_scenario_and_prints_the_written_files(tmp_path, capsys):
    assert export(FILE, "--to", "csv", "--ads", "constant_speed", "--out", tmp_path / "new") == 0
    path = tmp_path / "new" / "collision-xfail.csv"
    assert capsys.readouterr() == (f"{path}\n", "")
    run = pafot.load(FILE).replay(lambda: lambda observation: (0.0, 0.0))
    assert len(path.read_text().splitlines()) == 1 + len(run.trace.sizes) * (run.trace.ticks + 1)


class Road(Puppets):
    """A simulator of the user's, which is code."""


class OtherRoad(Road):
    pass


def road():
    return pafot.SimulatorWorld(Road)


def other_road():
    return pafot.SimulatorWorld(OtherRoad)


def test_world_that_is_code_is_named(tmp_path, capsys):
    path = tmp_path / "front-2-1f3a9c.pafot.yaml"
    path.write_text(
        text_of(plain_finding(world={"kind": "own", "class": "Road", "data": {"simulator": {}}}))
    )
    arguments = path, "--to", "csv", "--ads", "constant_speed", "--out", tmp_path
    assert export(*arguments) == 2
    assert (
        "Because a file cannot contain code, pass the world itself with replay(ads, world=...) or --world\n"
        in (capsys.readouterr().err)
    )
    assert export(*arguments, "--world", f"{__name__}:other_road") == 2
    assert (
        "received a simulator of the class OtherRoad. A file cannot contain code, "
        in capsys.readouterr().err
    )
    assert export(*arguments, "--world", f"{__name__}:road") == 0
    assert (tmp_path / "front-2-1f3a9c.csv").exists()


def test_world_of_the_file_is_driven_though_its_environment_is_named(tmp_path, capsys):
    path = tmp_path / "front-2-1f3a9c.pafot.yaml"
    world = pafot.World("highway-v0", config={"lanes_count": 3}, planner_hz=5)
    path.write_text(text_of(plain_finding(world=world.to_dict())))
    arguments = path, "--to", "csv", "--ads", "constant_speed", "--out", tmp_path
    assert export(*arguments, "--world", "highway-fast-v0") == 2
    assert export(*arguments, "--world", "pytest_pafot:highway-v0") == 0
    assert (tmp_path / "front-2-1f3a9c.csv").exists()


def two_files(finding, trace):
    """Export two files, in a user's own format."""
    return {f"{finding.id}.a": b"a", f"{finding.id}.b": b"b"}


def test_an_interrupt_leaves_all_files_or_none(tmp_path, monkeypatch, capsys):
    def interrupted(path, content):
        signal.raise_signal(signal.SIGTERM)
        write_whole(path, content)

    monkeypatch.setattr("pytest_pafot.export.exporter.write_whole", interrupted)
    monkeypatch.setattr("pytest_pafot.export.exporter.csv_table", two_files)
    assert (
        export(FILE, "--to", "csv", "--ads", "constant_speed", "--out", tmp_path)
        == 128 + signal.SIGTERM
    )
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        "collision-xfail.a",
        "collision-xfail.b",
    ]
    assert capsys.readouterr().err == "\nexport: interrupted\n"


def test_finding_is_located_by_its_name_in_folders(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "tests" / "corpus" / "test_a"
    folder.mkdir(parents=True)
    shutil.copy(FILE, folder)
    assert export("collision-xfail", "--to", "csv", "--ads", "constant_speed") == 0
    assert capsys.readouterr().out == "collision-xfail.csv\n"
    (tmp_path / "other").mkdir()
    shutil.copy(FILE, tmp_path / "other")
    assert export("collision-xfail", "--to", "csv", "--ads", "constant_speed") == 2
    told = capsys.readouterr().err
    assert (
        "an id that occurs in 2 files. Give one of the files: other/collision-xfail.pafot.yaml, tests/"
        in told
    )


@pytest.mark.parametrize(("below", "received"), [
    ("file", "{}: File exists. Rename or delete the file that has the same name as the folder, or give another"),
    ("file/new", "{}: Not a directory. Rename or delete the file that has the same name as the folder, or "
     "give another"),
    ("n" * 300, "{}: File name too long. Shorten the name of a folder, of the test or of a parameter, or"),
    ("taken", "{}/collision-xfail.csv: Is a directory. Rename or delete the folder that has this name, or"),
])  # fmt: skip
def test_unwritable_folder_is_refused_with_the_way_out(below, received, tmp_path, capsys):
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "collision-xfail.csv").mkdir(parents=True)
    out = tmp_path / below
    assert export(FILE, "--to", "csv", "--ads", "constant_speed", "--out", out) == 2
    told, error = capsys.readouterr()
    assert told == ""
    assert error.startswith(
        f"export: --out: expected a writable folder, received {received.format(out)}"
    )
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("world", "asked"), [([], ""), (["--world", "pytest_pafot:Highway"], " and the world")]
)
def test_differing_run_is_exported_with_a_warning(tmp_path, capsys, world, asked):
    assert export(FILE, "--to", "csv", "--ads", "idm_mobil", *world, "--out", tmp_path) == 0
    told = capsys.readouterr().err
    assert told.startswith(
        "export: collision-xfail was saved with collision at 6.3 s, but this run ended with "
    )
    assert told.endswith(f". Did you pass the policy{asked} of its test?\n")


@pytest.mark.parametrize(("given", "expected"), [
    ([], "the world of the file, received ValueError: no such observation. Use the policy of the test\n"),
    (["--world", f"{__name__}:wrong"], f"{__name__}:wrong, received ValueError: no such observation. Use the "
     "policy of the test, and its world if that is code\n"),
])  # fmt: skip
def test_policy_that_decides_nothing_in_the_world_is_refused_with_its_error(
    tmp_path, capsys, given, expected
):
    path, data = (
        tmp_path / "front-2-1f3a9c.pafot.yaml",
        wrong().to_dict() if given else pafot.Highway().to_dict(),
    )
    path.write_text(text_of(plain_finding(world=data)))
    out = tmp_path / "out"
    assert export(path, "--to", "csv", "--out", out, "--ads", f"{__name__}:raising", *given) == 2
    assert capsys.readouterr() == (
        "",
        f"export: --ads: expected a policy that drives in {expected}",
    )
    assert not out.exists()


def wrong():
    return pafot.World("highway-v0", wrappers=[FlattenObservation])


def raising():
    def decide(seen):
        raise ValueError("no such observation")

    return decide


@pytest.mark.parametrize(("arguments", "message"), [
    ((FILE, "--to", "csv"), r"--ads: expected the policy that drives the ego in the test "
     "test_golden.py::test_never_at_fault, such as --ads module:factory, received none. A file contains"),
    ((FILE, "--to", "xslx", "--ads", "constant_speed"), "--to: expected one of commonroad, csv, mcap, xosc, "
     "xosc-1.0, received 'xslx'"),
    (("no-such", "--to", "csv", "--ads", "constant_speed"), "received no such file or id. `python -m"),
    ((FILE, "--to", "csv", "--ads", "no_such_policy"), "--ads: expected one of "),
    ((FILES / "crash.pafot.yaml", "--to", "csv", "--ads", "constant_speed"), "received one in which a process died"),
    ((FILE, "--to", "csv", "--ads", "constant_speed", "--out", FILE), "export: "),
])  # fmt: skip
def test_impossible_export_is_refused_with_the_way_out(arguments, message, capsys):
    assert export(*arguments) == 2
    out, told = capsys.readouterr()
    assert out == ""
    assert told.startswith("export: ")
    assert message in told


def interrupting():
    raise KeyboardInterrupt


def test_interrupted_export_prints_line_and_exits_with_130(tmp_path, capsys):
    assert (
        export(FILE, "--to", "csv", "--ads", f"{__name__}:interrupting", "--out", tmp_path) == 130
    )
    assert capsys.readouterr() == ("", "\nexport: interrupted\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "module", "library", "extra"), [
    ("xosc", "openscenario", "scenariogeneration", "export"),
    ("mcap", "foxglove_mcap", "foxglove", "export"),
    ("commonroad", "commonroad_xml", "commonroad", "commonroad"),
])  # fmt: skip
def test_missing_library_error_names_the_extra_to_install(
    monkeypatch, capsys, name, module, library, extra
):
    for each in [known for known in sys.modules if known.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, each)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"pytest_pafot.export.{module}", raising=False)
    assert export(FILE, "--to", name, "--ads", "constant_speed") == 2
    assert capsys.readouterr().err == (
        f"export: --to {name}: expected the library {library}, received a Python environment without it. "
        f"Run `pip install 'pytest-pafot[{extra}]'`\n"
    )
