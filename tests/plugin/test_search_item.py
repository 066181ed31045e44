"""The main job: a search finds, saves and reports; the next session replays."""

import re

import pytest


def test_a_search_fails_and_reports_each_find_under_the_id_of_its_replay(failing):
    result = failing.run_once()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines([f"FAILED test_it.py::test_fails[[]saved-{failing.only_id}[]]*"])
    result.stdout.fnmatch_lines(["FAILED test_it.py::test_fails[[]search[]]*"])


def test_the_search_lists_its_finds(failing):
    result = failing.run_once()
    result.stdout.fnmatch_lines(["1 new finding in 1 run, reported below", f"  {failing.only_id} (1 run)"])


def test_a_find_is_a_readable_file_beside_the_test(failing):
    failing.run_once()
    assert re.fullmatch(r"pafot_corpus/test_it/test_fails/[a-z0-9-]+\.pafot\.yaml", failing.files[0])
    assert "test: test_it.py::test_fails\n" in failing.only_file.read_text()


def test_a_find_is_announced_while_the_search_runs_and_its_report_has_the_file(failing):
    result = failing.run_once()
    result.stdout.fnmatch_lines(
        [
            f"pafot: found test_it.py::test_fails[[]saved-{failing.only_id}[]]",
            "  collision after 8.0 s at 5.8 m/s: NPC 1 ahead, NPC at fault",
            "FF*",
            f"saved as   {failing.files[0]}",
        ]
    )


def test_the_next_session_replays_the_find_under_the_same_id(failing):
    failing.run_once()
    result = failing.run_once(generations=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines([f"FAILED test_it.py::test_fails[[]saved-{failing.only_id}[]]*"])


def test_a_property_that_is_no_collision_is_searched_saved_and_replayed(project):
    project.write("@pafot.search(SHORT, stop_after=1)\ndef test_gap(run):\n    assert run.min_distance > 1000\n")
    project.run().assert_outcomes(failed=2)
    assert project.only_id.startswith("min-distance")
    project.run(generations=0).assert_outcomes(failed=1, skipped=1)


def test_a_search_that_finds_nothing_passes_and_says_what_it_did(project):
    project.write("@pafot.search(SHORT)\ndef test_passes(run):\n    assert run.duration > 0\n")
    result = project.run(generations=2)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["*runs in * s*0 failing*", "*from --pafot-seed=1 (profile local), 2 of 2 *"])
    assert project.files == []


def test_assertions_in_the_test_are_explained_as_pytest_does(failing):
    result = failing.run_once()
    result.stdout.fnmatch_lines(
        ["    assert run.duration < 1", "E   assert * < 1", "E    +  where * = <Run *>.duration"]
    )


def test_fixtures_are_evaluated_once_per_item_and_the_ads_once_per_scenario(project):
    project.write(
        """
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
"""
    )
    project.run(generations=2).assert_outcomes(passed=1)


def test_stop_after_ends_a_search_at_that_many_distinct_finds(project):
    check = 'pafot.check(1.0, name=f"cell {run.event_cell}", at_most=0.0)'
    project.write(f"@pafot.search(SHORT, shrink_rollouts=0)\ndef test_fails(run):\n    {check}\n")
    project.run("--pafot-stop-after=2", generations=20).assert_outcomes(failed=3)
    assert len(project.files) == 2


def test_save_none_reports_finds_and_writes_nothing(failing):
    result = failing.run("--pafot-save=none")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["  not saved: --pafot-save=none"])
    assert failing.files == []


def test_a_corpus_elsewhere_mirrors_the_folders_of_the_tests(failing):
    failing.pytester.mkdir("sub")
    (failing.path / "test_it.py").rename(failing.path / "sub" / "test_it.py")
    failing.run(f"--pafot-corpus={failing.path / 'all'}")
    assert failing.files[0].startswith("all/sub/test_it/test_fails/")
    failing.run(f"--pafot-corpus={failing.path / 'all'}", generations=0).assert_outcomes(failed=1, skipped=1)


def test_each_parametrisation_has_its_own_files(project):
    project.write(
        """
@pytest.mark.parametrize("limit", [0, 1000])
@pafot.search(SHORT, stop_after=1)
def test_short(run, limit):
    assert run.duration < limit
"""
    )
    project.run().assert_outcomes(failed=2, passed=1)
    assert project.only_file.parent.name == "test_short@0"
    result = project.run("-v", generations=0)
    result.assert_outcomes(failed=1, skipped=2)
    result.stdout.fnmatch_lines([f"test_it.py::test_short[[]0-saved-{project.only_id}[]] FAILED*"])


def test_a_parametrised_ads_fixture_gives_a_search_per_parameter(project):
    project.write(
        """
@pytest.fixture(params=["slow", "fast"])
def ads(request):
    acceleration = -2.0 if request.param == "slow" else 0.0
    return lambda: lambda observation: (acceleration, 0.0)

@pafot.search(SHORT, stop_after=1)
def test_brakes(run):
    assert run.hardest_brake < 1
"""
    )
    project.run().assert_outcomes(failed=2, passed=1)
    assert project.only_file.parent.name == "test_brakes@slow"


def test_blame_ego_counts_what_npcs_are_responsible_for_and_does_not_ask_the_test(project):
    project.write(
        """
@pytest.fixture
def ads():
    return lambda: lambda observation: (0.0, 0.0)

@pafot.search(npcs=4, genes=4, gene_seconds=5, blame="ego")
def test_fault(run):
    assert run.responsibility != "npc"
"""
    )
    result = project.run(generations=4)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["* npc at fault*"])


def test_an_ads_that_raises_is_a_find_of_its_own_with_its_traceback(project):
    project.write(
        """
class Broken:
    def __call__(self, observation):
        return {}["missing key"] if observation.time > 1 else (0.0, 0.0)

@pafot.search(SHORT, ads=Broken, stop_after=1)
def test_runs(run):
    pass
"""
    )
    result = project.run()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["the ADS failed: KeyError: *", "*return {}*missing key*"])
    assert project.only_id.startswith("ads-error")
    project.run(generations=0).assert_outcomes(failed=1, skipped=1)


def test_a_slow_decision_is_a_find_only_where_a_limit_is_set(project):
    project.write(
        """
import time

def ads():
    return lambda observation: (time.sleep(0.002), (0.0, 0.0))[1]

@pafot.search(genes=1, gene_seconds=1, ads=ads)
def test_any_time(run):
    pass

@pafot.search(genes=1, gene_seconds=1, ads=ads, decision_limit=0.001, stop_after=1)
def test_in_time(run):
    pass
"""
    )
    result = project.run()
    result.assert_outcomes(failed=2, passed=1)
    result.stdout.fnmatch_lines(["*SlowDecision*depends on wall-clock time*"])
    assert "failure: SlowDecision" in project.only_file.read_text()


def test_a_hang_is_a_find_that_depends_on_time(project):
    project.write(
        """
import time

def ads():
    return lambda observation: time.sleep(5)

@pafot.search(world=pafot.Highway(duration=5.0, hang_limit=0.05), ads=ads, stop_after=1)
def test_decides(run):
    pass
"""
    )
    result = project.run()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["*the ADS failed: *(depends on wall-clock time)*"])


def test_max_time_shorter_than_one_run_still_runs_one(project):
    project.write("@pafot.search(SHORT)\ndef test_passes(run):\n    pass\n")
    result = project.run("--pafot-max-time=0", generations=50)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["  1 run in *", "*--pafot-max-time", "*note: cut by --pafot-max-time*"])


def test_the_same_seed_gives_the_same_files_and_another_seed_others(project):
    project.write("@pafot.search(SHORT)\ndef test_fails(run):\n    assert run.scenario.id == ''\n")
    project.run(generations=3)
    first = project.contents
    project.forget()
    project.run(generations=3)
    assert project.contents == first
    project.forget()
    project.run(generations=3, seed=2)
    assert project.contents != first


def test_pytest_takes_a_corpus_file_and_runs_that_item_alone(saved):
    result = saved.run("-v", saved.files[0])
    result.assert_outcomes(failed=1, deselected=1)
    result.stdout.fnmatch_lines([f"test_it.py::test_fails[[]saved-{saved.only_id}[]] FAILED*"])


def test_a_corpus_file_beside_other_arguments_adds_its_item(saved):
    saved.write("def test_other():\n    pass\n", name="test_other")
    saved.run("test_other.py", saved.files[0]).assert_outcomes(failed=1, passed=1, deselected=1)


def test_a_fresh_base_seed_is_printed_so_that_it_can_be_repeated(project):
    project.write("@pafot.search(SHORT)\ndef test_fails(run):\n    assert run.scenario.id == ''\n")
    output = project.run("--pafot-stop-after=1", seed=None).stdout.str()
    seed = re.search(r"from --pafot-seed=(\d+)", output).group(1)
    first = project.contents
    project.only_file.unlink()
    project.run("--pafot-stop-after=1", seed=seed)
    assert project.contents == first


def test_a_fitness_is_a_name_or_weights_or_a_function_of_a_trace(project):
    each = ["'paper'", "pafot.Weights(ttc=2.0)", "lambda trace: -trace.duration"]
    tests = (f"@pafot.search(SHORT, fitness={given})\ndef test_{n}(run):\n    pass\n" for n, given in enumerate(each))
    project.write("\n".join(tests))
    project.run(generations=2).assert_outcomes(passed=len(each))


SHORT_SEARCH = "*note: 40 runs are a short search; use --pafot-runs=400 for a longer one"
KEEPS = "@pafot.search(SHORT)\ndef test_drive(run):\n    assert run.duration BOUND\n"


def test_a_search_that_finds_nothing_in_the_few_runs_of_its_default_says_so(project):
    project.write(KEEPS.replace("BOUND", "> 0"))
    project.run(generations=None).stdout.fnmatch_lines([SHORT_SEARCH])


@pytest.mark.parametrize(
    ("bound", "options"),
    [
        ("< 1", ["--pafot-shrink-rollouts=0"]),
        ("> 0", ["--pafot-generations=3"]),
        ("> 0", ["--pafot-profile=ci", "--pafot-runs=40"]),
        ("> 0", ["--pafot-max-time=0"]),
    ],
)
def test_no_other_search_is_called_short(project, bound, options):
    project.write(KEEPS.replace("BOUND", bound))
    project.run(*options, generations=None).stdout.no_fnmatch_line("*short search*")


def test_the_output_is_ascii_and_its_own_lines_fit_in_80_columns(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    project.write("@pafot.search(SHORT)\ndef test_a(run):\n    pass\n")
    lines = project.run("-v", generations=2).outlines
    section = lines[next(index for index, line in enumerate(lines) if " pafot " in line) :]
    assert all(line.isascii() for line in section)
    assert max(map(len, section)) <= 80
