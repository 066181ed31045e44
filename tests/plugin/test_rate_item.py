"""The mark ``@pafot.rate``: a test that fails if an ADS crashes too often in ordinary traffic."""

import pytest

import pytest_pafot.episodes.ordinary_traffic  # noqa: F401  pytester forgets modules that a run imports
from tests.helpers.sessions import section

WORLD = 'world=pafot.World("highway-fast-v0", {"vehicles_count": 8, "duration": 12})'


def rated(arguments, body="pass", parameters=""):
    return f"@pafot.rate({arguments})\ndef test_rate({parameters}):\n    {body}\n"


def test_rate_test_passes_only_if_crashes_are_rare(project):
    project.write(rated(f"at_most=0.9, episodes=8, planner=True, {WORLD}"))
    project.write(rated(f"at_most=0.1, episodes=8, planner=True, {WORLD}"), name="test_too_many")
    result = project.run()
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(["test_it.py::test_rate: 4 of 8 episodes crashed, 50.0 % (95 %: *"])
    result.stdout.fnmatch_lines(
        [
            "expected crashes in at most 10.0 % of the episodes, received: 50.0 %",
            "4 of 8 episodes crashed, *",
            "seeds of the crashes: 2, 4, 5, 7",
        ]
    )


def test_marks_take_the_name_of_a_policy_with_its_argument(project):
    project.pytester.makepyfile(named="class Planner:\n    def __init__(self, text):\n        assert text == 'a:b'\n"
                                "    def __call__(self, observation):\n        return 0.0, 0.0\n")  # fmt: skip
    name = "ads='named:Planner:a:b'"
    search = f"@pafot.search(SHORT, {name})\ndef test_search(run):\n    assert run.duration > 1\n"
    wrong = search.replace("Planner", "Planer").replace("test_search", "test_wrong")
    project.write(rated(f"at_most=0.9, episodes=1, planner=True, {name}, {WORLD}") + search + wrong)
    result = project.run("-ppytester", "-opythonpath=.", "--pafot-runs=2")
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["@pafot.search(ads=...): expected a factory in the module named, *'named:Planner'?"])


def test_the_function_may_look_at_the_rate_besides(project):
    project.write(
        "from example_ads import idm_mobil\n\n"
        + rated(f"at_most=0, ads=idm_mobil.make, episodes=5, {WORLD}", "assert rate.hours > 1", "rate")
    )
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*assert 0.01* > 1*"])


def test_rate_with_confidence_passes_only_with_enough_evidence(project):
    mark = f"ads=idm_mobil.make, confidence=0.9, {WORLD}"
    project.write(
        "from example_ads import idm_mobil\n\n" + rated(f"at_most=0.2, episodes=11, {mark}"), name="test_enough"
    )
    project.write(
        "from example_ads import idm_mobil\n\n" + rated(f"at_most=0.2, episodes=10, {mark}"), name="test_too_few"
    )
    result = project.run()
    result.assert_outcomes(passed=1, failed=1)
    result.stdout.fnmatch_lines(
        [
            "@pafot.rate(episodes=...): expected 11 or more: even without a crash, fewer episodes do not show with a "
            "confidence of 90 % that at most 20.0 % of episodes crash, received 10*"
        ]
    )


def test_an_ads_that_fails_fails_the_test(project):
    project.write(rated(f"at_most=0.9, episodes=2, {WORLD}"))  # without planner=True
    result = project.run()
    result.assert_outcomes(failed=1)
    told = " ".join(result.outlines)
    assert "expected an ADS that drives all episodes, received one that failed; planner=True says that it is a " in told


def test_excessive_rate_is_reported_in_fitting_lines_only(project, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    project.write(rated(f"at_most=0.1, episodes=10, planner=True, {WORLD}"))
    result = project.run()
    result.stdout.fnmatch_lines(["FAILED test_it.py::test_rate - expected crashes in at most 10.0 %*"])
    result.stdout.no_fnmatch_line("*traceback*")
    assert "4 of 10 episodes crashed, 40.0 % (95 %: 12.2 to 73.8 %); 136 an hour in 0.029 h" in result.outlines


WRONG = [
    (f"episodes=2, {WORLD}", "@pafot.rate(at_most=...): expected it to be given, as in at_most=0.02"),
    ("at_most=0.1", "@pafot.rate(world=...): expected it to be given"),
    ("at_most=0.1, world=pafot.Highway()", "@pafot.rate(world=...): expected an environment with its own traffic"),
    ('at_most=0.1, world="highway-v9"', "*did you mean 'highway-v0'*"),
    (f"at_most=2, {WORLD}", "@pafot.rate(at_most=...): expected a share of the episodes, from 0 to less than 1"),
    (f"at_most=0.1, episode=2, {WORLD}", "@pafot.rate(episode=...): did you mean 'episodes'?"),
    (f"at_most=0.1, episodes=0, {WORLD}", "@pafot.rate(episodes=...): expected a whole number, at least 1"),
    (f"at_most=0.1, planner='no', {WORLD}", "@pafot.rate(planner=...): expected True or False, received 'no'"),
    (f"at_most=0.1, confidence=95, {WORLD}", "@pafot.rate(confidence=...): expected a number between 0 and 1"),
]


def test_wrong_argument_fails_the_test_with_advice(project):
    tests = [rated(given).replace("test_rate", f"test_{number}") for number, (given, _) in enumerate(WRONG)]
    project.write("\n".join(tests))
    result = project.run()
    result.assert_outcomes(failed=len(WRONG))
    for number, (_, text) in enumerate(WRONG):
        pytest.LineMatcher(section(result, f"test_{number}").splitlines()).fnmatch_lines([f"{text}*"])


def test_bare_mark_fails_and_names_missing_argument(project):
    project.write("@pafot.rate\ndef test_rate(rate):\n    pass\n")
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["@pafot.rate(at_most=...): expected it to be given, as in at_most=0.02*"])


def test_positional_argument_fails_the_test_with_its_name(project):
    project.write(rated('"highway-fast-v0", at_most=0.1'))
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["@pafot.rate: expected keyword arguments only, received ('highway-fast-v0',); *"])


@pytest.mark.processes
@pytest.mark.parametrize("option", ["--pafot-workers=2", "--pafot-isolate"])
def test_other_processes_give_the_same_rate(project, option):
    project.write(
        "made = []\n\n"
        + rated(
            f"at_most=0.9, episodes=10, ads=make, planner=True, {WORLD}",
            'assert (rate.crashed, rate.notes[0]) == ((2, 4, 5, 7), "seeds of the crashes: 2, 4, 5, 7")\n'
            "    assert not made",
            "rate",
        ).replace("@pafot", "def make():\n    made.append(1)\n    return lambda seen: (0.0, 0.0)\n\n\n@pafot")
    )
    project.run(option).assert_outcomes(passed=1)


@pytest.mark.processes
def test_lost_process_is_reported_with_its_seed(project):
    project.write("import os\n\n" + rated(f"at_most=0.9, episodes=2, ads=lambda: os._exit(3), planner=True, {WORLD}"))
    result = project.run("--pafot-workers=2")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["the process (pid *) that ran 0 ended with exit code 3"])
