"""A search that tested nothing fails, and one that tested little warns."""


def test_search_in_which_most_runs_are_rejected_fails(project):
    rejects = "int(run.scenario.id, 16) % 4 and pafot.reject()"
    project.write(f"@pafot.search(SHORT)\ndef test_rejects(run):\n    {rejects}\n")
    project.run(runs=16).assert_outcomes(failed=1)


def test_health_warnings_fail_only_in_strict_mode(project):
    project.write("""
def parked():
    return lambda observation: (-8.0, 0.0)

@pafot.search(npcs=1, genes=4, gene_seconds=10, ads=parked)
def test_parked(run): pass
""")
    project.run("--pafot-json=pafot.json", runs=8).assert_outcomes(passed=1)
    assert project.record.searches[0].warnings
    project.run("--pafot-strict-health", runs=8).assert_outcomes(failed=1)


STOPS = """
class Stops:
    near = False

    def __call__(self, observation):
        self.near |= observation.time > 0.3 and any(abs(v.x - observation.ego.x) < 99 for v in observation.others)
        return (-8.0 if self.near else 0.5 * (20.0 - observation.ego.speed)), 0.0

@pafot.search(npcs=1, genes=6, gene_seconds=10, ads=lambda: Stops(), shrink_runs=0)
def test_keeps_up(run):
    pafot.check(run.ego.speed.mean(), name="pace", at_least=5.0)
"""


def test_search_with_only_known_failures_says_so(project):
    project.write(STOPS)
    notes = []
    for seed in (1, 2):
        result = project.run("--pafot-json=pafot.json", runs=12, seed=seed)
        notes.append(any("saved-pace-" in each for each in project.record.searches[0].notes))
    result.assert_outcomes(passed=1, failed=1)
    assert notes == [False, True]


def test_listing_tests_does_not_import_the_simulation(project):
    project.pytester.makeconftest("""
import sys

def pytest_unconfigure():
    print("heavy:", *sorted({"numpy", "highway_env", "gymnasium", "yaml"} & set(sys.modules)))
""")
    project.write("@pafot.search\ndef test_a(run):\n    pass\n")
    result = project.run("--collect-only", fresh=True)
    result.stdout.fnmatch_lines(["pafot: 1 search*", "*test_a[[]search[]]*", "heavy:"])
