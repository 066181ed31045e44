"""The same exception in every run of the first generation is an error of the set-up, and no finding."""

import pytest

from pytest_pafot.findings.corpus import read

MISSPELT = """
@pafot.search(SHORT, ARGUMENTS)
def test_drive(run):
    assert not run.collided
"""

BROKEN = """
def drive(observation):
    BROKEN

@pafot.search(SHORT, ads=lambda: drive)
def test_drive(run):
    pass
"""

ALIKE = "*So it was in all 4 runs of the first generation*no finding*nothing was saved*"


def misspelt(arguments=""):
    return MISSPELT.replace("ARGUMENTS", arguments)


class TestAFaultOfTheSetUpIsOneErrorAndNoFile:
    @pytest.mark.parametrize("arguments", ["", "stop_after=1", "blame='ego'", "algorithm='random'", "population=2"])
    def test_in_the_test_function_with_the_line_and_the_name_that_is_meant(self, project, arguments):
        project.write(misspelt(arguments))
        result = project.run(generations=3)
        result.assert_outcomes(failed=1)
        result.stdout.fnmatch_lines(
            [
                "*assert not run.collided",
                "E*AttributeError: a run has no attribute 'collided'; did you mean `run.collision`?",
                "E*So it was in all * runs of the first generation*an error of the test function*finding is asserted.",
            ]
        )
        result.stdout.no_fnmatch_line("*pafot: found*")
        result.stdout.no_fnmatch_line("*During handling*")
        assert project.files == []
        assert not (project.path / "pafot_corpus").exists()

    @pytest.mark.parametrize("option", ["-x", "--maxfail=1", "--pafot-save=none", "-n1"])
    def test_whatever_the_session_does_with_failures(self, project, option):
        project.write(misspelt() + "\ndef test_other():\n    pass\n")
        project.run(option).stdout.fnmatch_lines(["E*AttributeError: *did you mean `run.collision`?", "*1 failed*"])
        assert project.files == []

    @pytest.mark.parametrize(
        ("broken", "told"),
        [
            ("return {}['lane'], 0.0", "the ADS failed: KeyError: 'lane'"),
            ("pytest.skip('no GPU')", "the ADS failed: Skipped: no GPU"),
            ("return None", "the ADS failed: BadAction: expected (acceleration *received None*"),
        ],
    )
    def test_in_an_ads_that_fails_at_its_first_decision(self, project, broken, told):
        project.write(BROKEN.replace("BROKEN", broken))
        result = project.run(generations=3)
        result.assert_outcomes(failed=1)
        result.stdout.fnmatch_lines([told, "*in all 4 runs of the first generation, before anything had happened*"])
        assert project.files == []

    def test_in_an_ads_that_decides_for_many_runs(self, project):
        project.write(
            """
class Batched:
    def __call__(self, observation):
        return self.batch([observation])[0]

    def batch(self, observations):
        return [(observation.ego.sped, 0.0) for observation in observations]

@pafot.search(SHORT, ads=Batched)
def test_drive(run):
    pass
"""
        )
        result = project.run(generations=3)
        result.assert_outcomes(failed=1)
        result.stdout.fnmatch_lines(["the ADS failed: AttributeError*", "*in batch", ALIKE])
        assert project.files == []

    def test_beside_scenarios_of_earlier_sessions_which_stay_and_fail_by_themselves(self, project):
        project.write(misspelt("stop_after=1").replace("not run.collided", "run.duration < 1"))
        project.run("--pafot-shrink-rollouts=0")
        contents = project.contents
        project.write(misspelt())
        project.run().assert_outcomes(failed=2)
        assert project.contents == contents
        assert len(contents) == 1


class TestNothingThatWasFoundIsLost:
    SOME = """
    seen = []

    @pafot.search(SHORT, shrink_rollouts=0)
    def test_drive(run):
        seen.append(run)
        if len(seen) < 3:
            raise ValueError("lane")
        LATER
    """

    def write(self, project, later):
        source = "\n".join(line.removeprefix("    ") for line in self.SOME.splitlines())
        project.write(source.replace("LATER", later))

    def test_where_a_later_run_of_the_first_generation_ends_otherwise(self, project):
        self.write(project, "return None")
        result = project.run()
        result.stdout.fnmatch_lines(["*pafot: found*", "*2 failing*"])
        assert {read(project.path / name).expect.failure for name in project.files} == {"ValueError"}

    def test_where_another_exception_comes_or_the_same_from_another_line(self, project):
        self.write(project, "raise ValueError('another line')")
        project.run()
        assert project.files

    @pytest.mark.parametrize("end", ["raise KeyboardInterrupt", "pytest.exit('enough')"])
    def test_where_the_session_is_interrupted_meanwhile(self, project, end):
        self.write(project, end)
        result = project.run(no_reraise_ctrlc=True)
        result.stdout.fnmatch_lines(["*pafot: found*", "*ended: interrupted"])
        assert project.files

    def test_where_the_process_dies_meanwhile(self, project):
        self.write(project, "import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
        project.run(subprocess=True)
        assert project.files

    def test_where_time_is_up_before_the_first_generation_is(self, project):
        self.write(project, "return None")
        project.run("--pafot-max-time=0").assert_outcomes(failed=2)
        assert len(project.files) == 1

    @pytest.mark.parametrize(
        "raised", ["assert run.duration < 0", "raise AssertionError('late')", "pytest.fail('late')"]
    )
    def test_where_it_was_asserted(self, project, raised):
        project.write(f"@pafot.search(SHORT, shrink_rollouts=0)\ndef test_drive(run):\n    {raised}\n")
        project.run()
        assert project.files

    def test_where_an_ads_fails_in_every_run_but_later_than_at_its_first_decision(self, project):
        project.write(BROKEN.replace("BROKEN", "return (0.0, 0.0) if observation.time < 1 else None"))
        project.run().assert_outcomes(failed=2)
        assert len(project.files) == 1
