"""A search that tested nothing fails, and one that tested little warns."""


def test_a_search_in_which_no_scenario_gave_a_valid_run_fails(project):
    project.write("@pafot.search(SHORT)\ndef test_rejects_all(run):\n    pafot.reject()\n")
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["the search tested nothing:", "*none of * simulated scenarios gave a valid run*"])


def test_health_warnings_are_shown_and_fail_only_when_asked(project):
    project.write(
        """
def parked():
    return lambda observation: (-8.0, 0.0)

@pafot.search(npcs=1, genes=4, gene_seconds=10, ads=parked)
def test_parked(run):
    pass
"""
    )
    result = project.run(generations=2)
    result.assert_outcomes(passed=1)
    result.stdout.fnmatch_lines(["  warning: *"])
    result = project.run("--pafot-strict-health", generations=2)
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["health warnings (--pafot-strict-health):*"])


def test_an_ego_that_collides_before_anybody_can_have_caused_it_is_a_health_warning(project):
    project.write(
        """
def swerving():
    return lambda observation: (0.0, 1.0)

@pafot.search(npcs=8, genes=2, gene_seconds=5, ego_lane=1, ads=swerving)
def test_swerves(run):
    pass
"""
    )
    result = project.run(generations=2)
    result.stdout.fnmatch_lines(["  warning: * valid runs collided within the first*"])


def test_a_session_that_only_lists_marked_tests_does_not_wait_for_the_simulation(project):
    project.pytester.makeconftest(
        """
import sys

def pytest_unconfigure():
    print("heavy:", *sorted({"numpy", "highway_env", "gymnasium", "yaml"} & set(sys.modules)))
"""
    )
    project.write("@pafot.search\ndef test_a(run):\n    pass\n")
    result = project.run("--collect-only", fresh=True)
    result.stdout.fnmatch_lines(["pafot: 1 search, 0 saved scenarios*", "*test_a[[]search[]]*", "heavy:"])
