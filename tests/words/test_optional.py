"""What the commands with optional libraries say: ``rate``, ``compare`` and ``export``."""

import re
import sys

import pytest

from pytest_pafot.commands.rate_command import Rate, compare_rates
from pytest_pafot.corpus.writer import text_of
from tests.findings.builders import plain_finding
from tests.optional.comparison import test_command as comparison
from tests.optional.comparison.test_command import undrawn  # noqa: F401
from tests.optional.conftest import copies  # noqa: F401
from tests.optional.export import test_export_command as export
from tests.optional.export.test_export_command import taken, undecided  # noqa: F401
from tests.optional.test_rate_command import (
    FEW,
    NO_ENVIRONMENTS,
    WRONG,
    crashing,  # noqa: F401
    episode,
    rate,
    rated,
    rated_in,
)

pytestmark = pytest.mark.optional

CSV = ("--to", "csv", "--ads", "constant_speed")


@pytest.fixture
def says(capsys, monkeypatch):
    """Return a function that calls a command in a wide terminal, and returns its exit code and what it says."""
    monkeypatch.setenv("COLUMNS", "999")

    def said(command, *arguments):
        capsys.readouterr()
        code = command(*arguments)
        out, error = capsys.readouterr()
        # the lines of test files change with every edit
        error = re.sub(r"(\.py:|\.py\", line )\d+", r"\1LINE", error)
        return f"exit code {code}\n{out}{error}"

    return said


def test_rates_and_comparisons_of_them(snapshot):
    first = rated("a", s0="collision", s1="collision", s2="collision", s9="ads_error")
    told = {"many": Rate("a", tuple(episode(seed, "collision") for seed in range(12))).lines}
    told["one not counted"] = rated("a", s1="collision", s4="collision", s5="ads_error").lines
    told["none counted"] = Rate("a", (episode(0, "ads_error"),)).lines
    told["compared"] = compare_rates(first, [rated("b", s2="collision", s9="collision")])
    told["with two"] = compare_rates(first, [rated("b"), rated("c", s1="collision")])
    assert told == snapshot


def test_arguments_of_rate_that_are_refused(snapshot, says):
    ads = ("--ads", "idm_mobil", "--episodes", "2")
    told = {" ".join(given): says(rate, *ads, *given) for given in WRONG}
    told |= {" ".join(given): says(rated_in, *given) for given in NO_ENVIRONMENTS}
    told["too few"] = says(rate, *FEW, "5")
    twice = ("--against", "constant_speed") * 2
    assert told | {"twice": says(rate, *ads, *twice)} == snapshot


def test_policies_that_fail_the_command_rate(snapshot, says, crashing):  # noqa: F811
    ten, limit = ("--ads", "idm_mobil", "--episodes", "10"), ("--fail-above", "2%")
    crashing({"idm_mobil": 3})
    told = {"above the limit": says(rate, *ten, *limit)}
    told["of two"] = says(rate, *ten, "--against", "constant_speed")
    crashing({}, first="ads_error")
    assert told | {"an error": says(rate, *ten, *limit)} == snapshot


def test_policies_that_do_not_fit_the_command_rate(snapshot, says):
    two = ("--episodes", "2")
    told = {"no planner": says(rate, "--ads", "constant_speed", *two)}
    told["ends"] = says(rate, "--ads", "idm_mobil", *two, "--config", '{"duration": 0}')
    told["raises"] = says(rate, "--ads", f"{rate.__module__}:fails", "--episodes", "200")
    assert told == snapshot


@pytest.mark.processes
@pytest.mark.usefixtures("undrawn", "copies")
def test_arguments_of_compare_that_are_refused(snapshot, says, tmp_path, monkeypatch):
    out = tmp_path / "out"
    told = {" ".join(given): says(comparison.compare, out, *given) for given in comparison.WRONG}
    for given in comparison.DECIDED:
        told[f"road {given}"] = says(comparison.compare_in, "road", out, "constant_speed", *given)
    failing = ("--ads", f"{comparison.__name__}:of_an_environment", "--runs", "1")
    told["fails in each run"] = says(comparison.compare, tmp_path, *failing)
    (tmp_path / "taken").touch()
    few = ("--algorithms", "random", "--runs", "1", "--seconds", "20")
    told["unwritable"] = says(comparison.compare, tmp_path / "taken", *few)
    says(comparison.compare, tmp_path, *few)
    told["compared before"] = says(comparison.compare, tmp_path, *few)
    monkeypatch.setitem(sys.modules, "pandas", None)
    assert told | {"no library": says(comparison.compare, out)} == snapshot


@pytest.mark.processes
@pytest.mark.usefixtures("undrawn")
def test_the_report_of_a_comparison(snapshot, says, tmp_path):
    few = ("--runs", "1", "--seconds", "60", "--seed", "4")
    told = says(comparison.compare, tmp_path, "--algorithms", "random,random@paper", *few)
    raising = ("--ads", f"{comparison.__name__}:raising_later", "--algorithms", "pafot", *few)
    says(comparison.compare, tmp_path / "raising", *raising)
    reports = [(folder / "report.md").read_text() for folder in (tmp_path, tmp_path / "raising")]
    assert [told, *reports] == snapshot


def test_exports_that_are_refused(snapshot, says, taken, undecided, monkeypatch):  # noqa: F811
    told = {" ".join(map(str, given)): says(export.export, *given) for given in export.IMPOSSIBLE}
    for name in export.UNWRITABLE:
        told[name[:9]] = says(export.export, export.FILE, *CSV, "--out", taken / name)
    told["undecided"] = says(undecided)
    told["undecided in another world"] = says(undecided, *export.OTHER_WORLD)
    path = taken / "front-2-1f3a9c.pafot.yaml"
    world = {"kind": "own", "class": "Road", "data": {"simulator": {}}}
    path.write_text(text_of(plain_finding(world=world)))
    told["a world of code"] = says(export.export, path, *CSV)
    other = ("--world", f"{export.__name__}:other_road")
    told["another world"] = says(export.export, path, *CSV, *other)
    monkeypatch.chdir(taken)
    for folder in ("a", "b"):
        (taken / folder).mkdir()
        (taken / folder / export.FILE.name).write_bytes(export.FILE.read_bytes())
    told["two files"] = says(export.export, "collision-xfail", *CSV)
    for name, module, library, _ in export.LIBRARIES:
        export.without(monkeypatch, module, library)
        told[library] = says(export.export, export.FILE, *CSV[2:], "--to", name)
    assert told == snapshot


def test_exported_run_that_differs_is_told(snapshot, says, tmp_path):
    given = (export.FILE, "--to", "csv", "--ads", "idm_mobil", "--out", tmp_path)
    world = ("--world", "pytest_pafot:Highway")
    assert [says(export.export, *given), says(export.export, *given, *world)] == snapshot
