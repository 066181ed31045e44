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
    world = {"kind": "own", "class": "Road", "data": {"simulator": {}}}
    path.write_text(text_of(plain_finding(world=world)))
    arguments = path, "--to", "csv", "--ads", "constant_speed", "--out", tmp_path
    assert export(*arguments) == 2
    assert "--world" in capsys.readouterr().err
    assert export(*arguments, "--world", f"{__name__}:other_road") == 2
    assert "OtherRoad" in capsys.readouterr().err
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
    code = export(FILE, "--to", "csv", "--ads", "constant_speed", "--out", tmp_path)
    assert code == 128 + signal.SIGTERM
    written = sorted(each.name for each in tmp_path.iterdir())
    assert written == ["collision-xfail.a", "collision-xfail.b"]
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
    assert "other/collision-xfail.pafot.yaml, tests/" in told


@pytest.fixture
def taken(tmp_path):
    """Return the folder of folders to which nothing can be exported."""
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "collision-xfail.csv").mkdir(parents=True)
    return tmp_path


UNWRITABLE = ["file", "file/new", "n" * 300, "taken"]


@pytest.mark.parametrize("below", UNWRITABLE)
def test_unwritable_folder_is_refused_in_one_line(below, taken, capsys):
    assert export(FILE, "--to", "csv", "--ads", "constant_speed", "--out", taken / below) == 2
    told, error = capsys.readouterr()
    assert (told, error[:15], error.count("\n")) == ("", "export: --out: ", 1)
    assert f" {taken / below}" in error


@pytest.mark.parametrize("world", [[], ["--world", "pytest_pafot:Highway"]])
def test_differing_run_is_exported_with_a_warning(tmp_path, capsys, world):
    assert export(FILE, "--to", "csv", "--ads", "idm_mobil", *world, "--out", tmp_path) == 0
    assert capsys.readouterr().err.startswith("export: collision-xfail ")


@pytest.fixture
def undecided(tmp_path):
    """Return a function that exports a scenario with a policy that raises, with the world of its file or another."""

    def run(*given):
        path = tmp_path / "front-2-1f3a9c.pafot.yaml"
        world = wrong() if given else pafot.Highway()
        path.write_text(text_of(plain_finding(world=world.to_dict())))
        ads = f"{__name__}:raising"
        return export(path, "--to", "csv", "--out", tmp_path / "out", "--ads", ads, *given)

    return run


OTHER_WORLD = ("--world", f"{__name__}:wrong")


@pytest.mark.parametrize("given", [(), OTHER_WORLD])
def test_policy_that_decides_nothing_in_the_world_is_refused_with_its_error(
    tmp_path, undecided, capsys, given
):
    assert undecided(*given) == 2
    out, error = capsys.readouterr()
    assert (out, "ValueError: no such observation" in error) == ("", True)
    assert not (tmp_path / "out").exists()


def wrong():
    return pafot.World("highway-v0", wrappers=[FlattenObservation])


def raising():
    def decide(seen):
        raise ValueError("no such observation")

    return decide


IMPOSSIBLE = [
    (FILE, "--to", "csv"),
    (FILE, "--to", "xslx", "--ads", "constant_speed"),
    ("no-such", "--to", "csv", "--ads", "constant_speed"),
    (FILE, "--to", "csv", "--ads", "no_such_policy"),
    (FILES / "crash.pafot.yaml", "--to", "csv", "--ads", "constant_speed"),
    (FILE, "--to", "csv", "--ads", "constant_speed", "--out", FILE),
]


@pytest.mark.parametrize("arguments", IMPOSSIBLE)
def test_impossible_export_is_refused(arguments, capsys):
    assert export(*arguments) == 2
    out, told = capsys.readouterr()
    assert (out, told[:8]) == ("", "export: ")


def interrupting():
    raise KeyboardInterrupt


def test_interrupted_export_prints_line_and_exits_with_130(tmp_path, capsys):
    assert (
        export(FILE, "--to", "csv", "--ads", f"{__name__}:interrupting", "--out", tmp_path) == 130
    )
    assert capsys.readouterr() == ("", "\nexport: interrupted\n")
    assert not list(tmp_path.iterdir())


LIBRARIES = [
    ("xosc", "openscenario", "scenariogeneration", "export"),
    ("mcap", "foxglove_mcap", "foxglove", "export"),
    ("commonroad", "commonroad_xml", "commonroad", "commonroad"),
]


@pytest.mark.parametrize(("name", "module", "library", "extra"), LIBRARIES)
def test_missing_library_error_names_the_extra_to_install(
    monkeypatch, capsys, name, module, library, extra
):
    without(monkeypatch, module, library)
    assert export(FILE, "--to", name, "--ads", "constant_speed") == 2
    error = capsys.readouterr().err
    assert (library in error, f"pip install 'pytest-pafot[{extra}]'" in error) == (True, True)


def without(monkeypatch, module, library):
    """Let a library be missing for a module of the exports."""
    for each in [known for known in sys.modules if known.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, each)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"pytest_pafot.export.{module}", raising=False)
