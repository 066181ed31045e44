"""The main job: a search finds, saves and reports; the next session replays."""

import json
import re

import pytest


def test_search_fails_reports_its_finding_by_replay_id_and_saves_it_near_its_test(failing):
    result = failing.run_once()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines([f"FAILED test_it.py::test_fails[[]saved-{failing.only_id}[]]*"])
    result.stdout.fnmatch_lines(["FAILED test_it.py::test_fails[[]search[]]*"])
    result.stdout.fnmatch_lines(["1 new finding in 1 run, reported below", f"  {failing.only_id} (1 run)"])
    result.stdout.fnmatch_lines(
        ["    assert run.duration < 1", "E   assert * < 1", "E    +  where * = <Run *>.duration"]
    )
    assert re.fullmatch(r"pafot_corpus/test_it/test_fails/[a-z0-9-]+\.pafot\.yaml", failing.files[0])
    assert "test: test_it.py::test_fails\n" in failing.only_file.read_text()


TWO_KINDS = """
@pafot.search(SHORT)
def test_collides(run):
    assert not run.collision
    pafot.check(run.min_distance, name="gap", at_least=12.0)
"""


def announced(result):
    """Return the lines of each finding that were written before the result of its search."""
    lines = result.stdout.str().partition("= FAILURES =")[0].splitlines()
    begins = [number for number, line in enumerate(lines) if line.startswith("pafot: found ")]
    told = []
    for begin in begins:
        more = lines[begin + 1 :]
        told.append(more[: next(n for n, line in enumerate(more) if not line.startswith("  "))])
    return told


@pytest.mark.parametrize("args", [(), ("-n1",)], ids=["alone", "worker"])
def test_first_finding_is_told_whole_at_once_and_others_in_a_line(project, monkeypatch, args):
    if args:
        pytest.importorskip("xdist")
    monkeypatch.setenv("COLUMNS", "60")
    project.write(TWO_KINDS)
    result = project.run_once(*args, "--pafot-shrink-rollouts=0", "--pafot-json=out.json", runs=40, seed=2)
    first, *others = announced(result)
    assert len(others) == len(project.files) - 1 >= 1
    assert {len(lines) for lines in others} <= {1, 2}
    assert [line.split(":")[0] for line in first if not line.startswith("    ")] == [
        "  gap 2.0 < 12",
        "  no collision in 10.0 s",
        "  least time to contact",
        "  closest at 6.3 s",
        "  saved; run it with",
    ]
    assert max(map(len, first[:-1])) <= 60
    assert first[-1].rpartition(" ")[2] in project.files
    assert "run it with" not in (project.path / "out.json").read_text()


@pytest.mark.parametrize("args", [(), ("-n1",)], ids=["alone", "behind the dots of a worker"])
def test_only_the_first_finding_of_a_session_is_told_whole_at_once(project, args):
    if args:
        pytest.importorskip("xdist")
    test = "@pafot.search(SHORT)  # stop_after=1\ndef test_{}(run):\n    assert not run.collision\n\n"
    project.write(test.format("a") + test.format("b"))
    first, second = announced(project.run(*args, "--pafot-shrink-rollouts=0", runs=40, seed=2))
    assert any(line.startswith("  saved; run it with") for line in first)
    assert len(second) == 1


def test_first_collision_has_the_sentences_of_its_verdict(project):
    project.write("@pafot.search(SHORT)  # stop_after=1\ndef test_collides(run):\n    assert not run.collision\n")
    result = project.run_once("--pafot-shrink-rollouts=0", "--pafot-json=out.json", runs=40, seed=2)
    found = f"pafot: found test_it.py::test_collides[[]saved-{project.only_id}[]]"
    headline = "  collision after *.? s, closing at *.? m/s: NPC ? ahead, * at fault"
    result.stdout.fnmatch_lines([found, headline, "FF*", f"saved as   {project.files[0]}"])
    (lines,) = announced(result)
    (its,) = json.loads((project.path / "out.json").read_text())["findings"]
    told = " ".join(" ".join(lines[1:]).split())
    assert lines[0].startswith("  collision after")
    assert told.startswith(its["sentences"][0])
    assert its["sentences"][-1] in told
    assert "collision after" not in told


def test_quiet_session_tells_only_the_first_finding_in_short(project):
    project.write(TWO_KINDS)
    result = project.run_once("-q", "--pafot-shrink-rollouts=0", runs=40, seed=2)
    ((line,),) = announced(result)
    assert line == "  gap 2.0 < 12"
    project.forget()
    assert announced(project.run_once("-qq", "--pafot-shrink-rollouts=0", runs=40, seed=2)) == []


def test_search_without_findings_passes_with_a_summary_in_ascii(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    project.write("@pafot.search(SHORT)\ndef test_passes(run):\n    assert run.duration > 0\n")
    result = project.run(runs=8)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["*runs in * s*0 failing*", "*from --pafot-seed=1, ended: all runs done"])
    (begin,) = [number for number, line in enumerate(result.outlines) if line.strip("= ") == "pafot"]
    told = result.outlines[begin:]
    assert len(told) <= 11  # a dozen lines with the one that names the seed before the search
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
    failing.run(f"--pafot-corpus={failing.path / 'all'}", runs=0).assert_outcomes(failed=1, skipped=1)


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
    result = project.run(runs=100)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["* npc at fault*"])


def test_printed_fresh_base_seed_repeats_the_search(project):
    project.write("@pafot.search(SHORT)\ndef test_fails(run):\n    assert run.scenario.id == ''\n")
    output = project.run("--pafot-stop-after=1", seed=None).stdout.str()
    seed = re.search(r"from --pafot-seed=(\d+)", output).group(1)
    first = project.contents
    project.only_file.unlink()
    project.run("--pafot-stop-after=1", seed=seed)
    assert project.contents == first


SHORT_SEARCH = "*note: 100 runs are a short search; use --pafot-runs=1000 for a longer one"
KEEPS = "@pafot.search(SHORT)\ndef test_drive(run):\n    assert run.duration BOUND\n"


@pytest.mark.parametrize(("bound", "options"), [
    ("> 0", []), ("< 1", ["--pafot-shrink-rollouts=0"]), ("> 0", ["--pafot-generations=3"]),
    ("> 0", ["--pafot-max-time=0"]),
])  # fmt: skip
def test_only_a_short_default_search_without_findings_is_called_short(project, bound, options):
    project.write(KEEPS.replace("BOUND", bound))
    shown = project.run(*options, runs=None).stdout
    (shown.no_fnmatch_line if options else lambda line: shown.fnmatch_lines([line]))(SHORT_SEARCH)
