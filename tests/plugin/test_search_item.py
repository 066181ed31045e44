"""The main job: a search finds, saves and reports; the next session replays."""

import re

import pytest


def test_search_fails_reports_its_finding_by_replay_id_and_saves_it_near_its_test(failing):
    result = failing.run_once()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines([
        f"replay pytest {failing.files[0]}",
        f"  {failing.only_id}: 1 run (new).",
        f"FAILED test_it.py::test_fails[[]search[]]*: {failing.only_id}",
        f"FAILED test_it.py::test_fails[[]saved-{failing.only_id}[]]*",
    ])  # fmt: skip
    assert re.fullmatch(
        r"pafot_corpus/test_it/test_fails/[a-z0-9-]+\.pafot\.yaml", failing.files[0]
    )
    assert "test: test_it.py::test_fails\n" in failing.only_file.read_text()


TWO_KINDS = """
@pafot.search(SHORT)
def test_collides(run):
    assert not run.collision
    pafot.check(run.min_distance, name="gap", at_least=12.0)
"""


def announced(result):
    """Return the lines on findings that were written before the result of their search."""
    return [
        line
        for line in result.stdout.str().partition("= FAILURES =")[0].splitlines()
        if "found" in line
    ]


@pytest.mark.parametrize("args", [(), ("-n1",)], ids=["alone", "behind the dots of a worker"])
def test_findings_are_told_at_once_in_a_line_each(project, monkeypatch, args):
    if args:
        pytest.importorskip("xdist")
    monkeypatch.setenv("COLUMNS", "60")
    project.write(TWO_KINDS)
    result = project.run_once(*args, "--pafot-shrink-runs=0", runs=40, seed=2)
    names = [name.rpartition("/")[2].removesuffix(".pafot.yaml") for name in project.files]
    found = r": test_it\.py::test_collides\[saved-(.*)\]$"
    told = [re.search(found, line)[1] for line in announced(result)]
    assert sorted(told) == sorted(names)
    assert len(told) > 1
    project.forget()
    assert announced(project.run_once("-q", "--pafot-shrink-runs=0", runs=40, seed=2)) == []


def test_block_on_a_collision_has_the_sentences_of_its_verdict(project):
    project.write(
        "@pafot.search(SHORT)  # stop_after=1\ndef test_collides(run):\n    assert not run.collision\n"
    )
    result = project.run_once("--pafot-shrink-runs=0", "--pafot-json=pafot.json", runs=40, seed=2)
    (its,) = project.record.findings
    headline = f"{its.headline.partition(';')[0]}."
    result.stdout.fnmatch_lines([headline, *its.sentences, f"replay pytest {project.files[0]}"])


def test_search_without_findings_passes_with_a_summary_in_ascii(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    project.write("@pafot.search(SHORT)\ndef test_passes(run):\n    assert run.duration > 0\n")
    result = project.run(runs=8)
    result.assert_outcomes(passed=1)
    (begin,) = [
        number for number, line in enumerate(result.outlines) if line.strip("= ") == "pafot"
    ]
    told = result.outlines[begin:]
    assert len(told) <= 10  # eight of the search, and one before and after it
    assert all(line.isascii() and len(line) <= 80 for line in told)
    assert project.files == []


def test_fixtures_run_once_per_item_ads_per_scenario(project):
    project.write("""
made = []

@pytest.fixture
def ads():
    def factory():
        made.append(1)
        return lambda observation: (0.0, 0.0)
    return factory

@pytest.fixture
def once():
    return []

@pafot.search(SHORT)
def test_counts(run, once, tmp_path):
    once.append(run.scenario)
    assert len(once) == len(made)
""")
    project.run(runs=8).assert_outcomes(passed=1)


def test_central_corpus_mirrors_the_folders_of_tests(failing):
    failing.pytester.mkdir("sub")
    (failing.path / "test_it.py").rename(failing.path / "sub" / "test_it.py")
    failing.run(f"--pafot-corpus={failing.path / 'all'}")
    assert failing.files[0].startswith("all/sub/test_it/test_fails/")
    failing.run(f"--pafot-corpus={failing.path / 'all'}", runs=0).assert_outcomes(
        failed=1, skipped=1
    )


def test_commands_name_the_folder_of_the_command_line(failing):
    option = f"--pafot-corpus={failing.path / 'all'}"
    result = failing.run(option)
    result.stdout.fnmatch_lines(
        [f"replay pytest {option} *.pafot.yaml", f"pytest {option} --pafot-runs=0 *"]
    )
    command = next(line for line in result.outlines if line.startswith("replay pytest")).split()[2:]
    failing.pytester.runpytest("-p", "pafot", *command).assert_outcomes(failed=1)
    failing.only_file.write_text("pafot: 3\n")  # unreadable
    failing.run(option, "--pafot-json=pafot.json", runs=0)
    assert failing.record.findings[0].replay.startswith(f"python -m pytest {option} ")


def test_each_parametrisation_of_a_test_or_its_ads_has_its_own_files(project):
    project.write("""
@pytest.fixture(params=["slow", "fast"])
def ads(request):
    acceleration = -2.0 if request.param == "slow" else 0.0
    return lambda: lambda observation: (acceleration, 0.0)

@pafot.search(SHORT)  # stop_after=1
def test_brakes(run):
    assert run.hardest_brake < 1

@pytest.mark.parametrize("limit", [0, 1000])
@pafot.search(SHORT, ads=lambda: lambda observation: (0.0, 0.0))
def test_short(run, limit):
    assert run.duration < limit
""")
    project.run().assert_outcomes(failed=4, passed=2)
    assert [name.split("/")[2] for name in project.files] == ["test_brakes@slow", "test_short@0"]
    result = project.run("-v", runs=0)
    result.assert_outcomes(failed=2, skipped=4)
    for name, part in zip(project.files, ("test_brakes[[]slow", "test_short[[]0"), strict=True):
        id_ = name.rpartition("/")[2].removesuffix(".pafot.yaml")
        result.stdout.fnmatch_lines([f"test_it.py::{part}-saved-{id_}[]] FAILED*"])


def test_blame_ego_skips_runs_caused_by_npcs(project):
    project.write("""
@pytest.fixture
def ads():
    return lambda: lambda observation: (-2.0 if observation.ego.speed > 12 else 0.3, 0.0)

@pafot.search(npcs=4, genes=4, gene_seconds=5, blame="ego")
def test_fault(run):
    assert run.responsibility != "npc"
""")
    project.run("--pafot-json=pafot.json", runs=100).assert_outcomes(passed=1)
    assert project.record.searches[0].kinds["npc"] == 1


def test_printed_fresh_base_seed_repeats_the_search(project):
    project.write("@pafot.search(SHORT)\ndef test_fails(run):\n    assert run.scenario.id == ''\n")
    output = project.run("--pafot-stop-after=1", seed=None).stdout.str()
    seed = re.search(r"--pafot-seed=(\d+) repeats", output).group(1)
    first = project.contents
    project.only_file.unlink()
    project.run("--pafot-stop-after=1", seed=seed)
    assert project.contents == first


SHORT_SEARCH = "*note: *--pafot-runs=1000*"
KEEPS = "@pafot.search(SHORT)\ndef test_drive(run):\n    assert run.duration BOUND\n"


@pytest.mark.parametrize(("bound", "options"), [
    ("> 0", []), ("< 1", ["--pafot-shrink-runs=0"]), ("> 0", ["--pafot-generations=3"]),
    ("> 0", ["--pafot-max-time=0"]),
])  # fmt: skip
def test_only_a_short_default_search_without_findings_is_called_short(project, bound, options):
    project.write(KEEPS.replace("BOUND", bound))
    shown = project.run(*options, runs=None).stdout
    (shown.no_fnmatch_line if options else lambda line: shown.fnmatch_lines([line]))(SHORT_SEARCH)
