"""The plugin together with other plugins, and with pytest's own options to stop early or to run nothing."""

import pytest

MANY = """
@pafot.search(SHORT, shrink_runs=0)
def test_many(run):
    pafot.check(1.0, name=f"cell {run.event_cell}", at_most=0.0)
"""

ONE_SIGNATURE = """
@pafot.search(SHORT, runs=1, shrink_runs=0)
def test_one(run):
    assert run.scenario.id == ""
"""
"""A test file whose search of one run has one finding."""

COUNTED = """
@pafot.search(SHORT, shrink_runs=0)
def test_counted(run):
    with open("runs.txt", "a") as file:
        file.write("run\\n")
    assert run.scenario.id == ""
"""


@pytest.mark.parametrize(
    "plugins", [["terminal"], ["cacheprovider", "capture", "junitxml", "logging"]], ids=" ".join
)
def test_findings_are_saved_without_some_builtin_plugins(failing, plugins):
    assert failing.run(*(f"-pno:{name}" for name in plugins)).ret == pytest.ExitCode.TESTS_FAILED
    assert len(failing.files) == 1


OTHERS = {
    "sugar": ["--force-sugar"],
    "randomly": [],
    "rerunfailures": ["--reruns=1"],
    "timeout": ["--timeout=60"],
    "pytest_cov": ["--cov=test_it", "--cov-report="],
}


def test_passing_search_without_cache_leaves_no_files(project):
    project.write("@pafot.search(SHORT)\ndef test_passes(run):\n    pass\n")
    project.run("-p", "no:cacheprovider").assert_outcomes(passed=1)
    expected = {"conftest.py", "test_it.py"}
    assert {path.name for path in project.path.iterdir()} - {"__pycache__"} == expected


@pytest.mark.parametrize("plugin", OTHERS)
def test_with_another_plugin_finds_are_reported_once(project, plugin):
    pytest.importorskip(plugin if plugin == "pytest_cov" else f"pytest_{plugin}")
    project.write(ONE_SIGNATURE)
    result = project.run(
        *OTHERS[plugin],
        "--junitxml=junit.xml",
        "-rA",
        plugins=(plugin,),
        # both plugins change the process in which they run
        apart=plugin in ("pytest_cov", "sugar"),
        runs=None,
    )
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    name = f"test_one[saved-{project.only_id}]"
    assert (project.path / "junit.xml").read_text().count(f'name="{name}"') == 1


def test_pdb_stops_in_function_at_first_finding(project):
    project.write(MANY)
    project.pytester.makepyfile(
        quiet="""
import pdb

class Quiet(pdb.Pdb):
    def interaction(self, frame, failure):
        traceback = getattr(failure, "__traceback__", failure)
        frames = []
        while traceback is not None:
            frames.append(traceback.tb_frame)
            traceback = traceback.tb_next
        while frames[-1].f_locals.get("__tracebackhide__"):  # as pytest's own debugger does
            frames.pop()
        print("STANDS IN", frames[-1].f_code.co_name)
"""
    )
    result = project.run("--pdb", "--pdbcls=quiet:Quiet", "--pafot-stop-after=1")
    result.stdout.fnmatch_lines(["*STANDS IN test_many"])
    assert len(project.files) == 1


def test_findings_are_on_the_disk_although_the_test_sees_replaced_functions_of_files(project):
    project.write("""
@pytest.fixture(autouse=True)
def replaced(monkeypatch):
    for name in ("builtins.open", "os.open", "os.replace"):
        monkeypatch.setattr(name, lambda *args, **kwargs: "replaced")
    monkeypatch.setattr("os.getpid", lambda: 0)  # the process is no copy of itself all the same

@pafot.search(SHORT, runs=1)
def test_one(run):
    assert open("any") != "replaced"
""")
    project.run(apart=True)
    assert project.files  # in which the assertion fails, which sees the replaced function


def test_under_pdb_a_note_says_what_was_found(failing, monkeypatch):
    monkeypatch.setattr("pdb.Pdb.interaction", lambda *stands: None)
    result = failing.run("--pdb")
    result.stdout.fnmatch_lines([f"E  *: {failing.only_id}"])


def test_collect_only_lists_the_items_and_like_setup_plan_simulates_nothing(project):
    project.write(COUNTED)
    project.run_once("--pafot-stop-after=1")
    before = (project.path / "runs.txt").read_text()
    result = project.run("--collect-only", "-q", "--pafot-json=pafot.json")
    result.stdout.fnmatch_lines(
        [
            "test_it.py::test_counted[[]search[]]",
            f"test_it.py::test_counted[[]saved-{project.only_id}[]]",
        ]
    )
    assert project.run("--setup-plan").ret == pytest.ExitCode.OK
    assert (project.path / "runs.txt").read_text() == before
    assert not (project.path / "pafot.json").exists()


def test_another_plugin_may_deselect_what_is_no_item(project):
    more = "\ndef pytest_collection_modifyitems(config):\n    config.hook.pytest_deselected(items=[object()])\n"
    # as pytest-testmon does
    project.pytester.makeconftest((project.path / "conftest.py").read_text() + more)
    project.write("@pafot.search(SHORT, runs=1)\ndef test_passes(run):\n    pass\n")
    project.run().assert_outcomes(passed=1, deselected=1)


def test_last_failed_runs_findings_without_their_search_once_they_are_saved(failing):
    failing.run("--pafot-save=none")
    failing.run("--lf", "--pafot-save=none").assert_outcomes(failed=2)
    failing.run_once()
    result = failing.run("--lf", "-v")
    result.assert_outcomes(failed=1, deselected=1)
    result.stdout.fnmatch_lines([f"*saved-{failing.only_id}[]] FAILED*"])


def test_last_failed_repeats_search_once_findings_pass(failing):
    failing.run_once()
    failing.write("@pafot.search(SHORT)  # stop_after=1\ndef test_fails(run):\n    assert run\n")
    failing.run("--lf").assert_outcomes(passed=1, deselected=1)
    result = failing.run("--lf", "-v")
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["test_it.py::test_fails[[]search[]] PASSED*"])
    failing.run("--lf").assert_outcomes(passed=2)


def test_stepwise_restarts_after_a_finding_then_continues_there(project):
    project.write(ONE_SIGNATURE)
    project.run("--stepwise", runs=None)
    # pytest starts over whenever the number of tests has changed, which a finding does.
    project.run("--stepwise", runs=None).assert_outcomes(passed=1, failed=1)
    project.run("--stepwise", runs=None).assert_outcomes(failed=1, deselected=1)


def test_xfail_mark_covers_search_and_its_findings(project):
    project.write("@pytest.mark.xfail(reason='known')\n" + MANY.strip() + "\n")
    result = project.run()
    assert result.ret == pytest.ExitCode.OK
    result.assert_outcomes(xfailed=1 + len(project.files))


def test_the_marks_select_and_deselect_under_strict_markers(failing):
    failing.write("def test_other():\n    pass\n", name="test_other")
    failing.run("--strict-markers", "-m", "pafot").assert_outcomes(failed=2, deselected=1)
    failing.run("--strict-markers", "-m", "pafot_saved").assert_outcomes(failed=1, deselected=2)
    failing.run("--strict-markers", "-m", "not pafot").assert_outcomes(passed=1, deselected=2)


def test_other_plugins_randomness_changes_nothing(project, monkeypatch):
    pytest.importorskip("pytest_randomly")
    project.write(
        "@pafot.search(SHORT)\ndef test_a(run):\n    assert not run.scenario.id\n\ndef test_b():\n    pass\n"
    )
    project.run(runs=8)
    plain = project.contents
    project.forget()
    # no generator of this package comes from a replaced function
    monkeypatch.setattr("numpy.random.default_rng", None)
    project.run(runs=8, plugins=("randomly",))
    assert project.contents == plain
