"""A finding of an ADS with imperfect sight: a session's report about it, and about its replay with different sight."""

from pytest_pafot.corpus.reader import load

TEST = """
class Blind:
    def __call__(self, observation):
        return (-9.0 if observation.others else 1.0), 0.0

@pafot.search(SHORT, ads=pafot.Perception(Blind, PERCEPTION))  # stop_after=1
def test_fails(run):
    assert run.ego.speed.max() < 23
"""


def test_finding_names_needed_perception_and_replay_the_change(project, tmp_path):
    page = tmp_path / "page.html"
    project.write(TEST.replace("PERCEPTION", "latency=0.1, range=0.0"))
    told = project.run(f"--pafot-report={page}")
    told.stdout.fnmatch_lines(["only with a range of 0 m"])
    assert load(project.only_file).perception.needed == ("range",)
    assert "only with a range of 0 m" in page.read_text(encoding="utf-8")

    change = "found with a range of 0 m and 0.1 s of latency, run with"
    project.write(TEST.replace("PERCEPTION", "occlusion=True"))
    result = project.run(generations=0)
    result.assert_outcomes(passed=1, skipped=1)
    result.stdout.fnmatch_lines(["  drifted: *", f"    *{change} occlusion"])

    project.write(TEST.replace("PERCEPTION", "range=0.0"))
    result = project.run(generations=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines([f"replay: still failing, {change} a range of 0 m"])
