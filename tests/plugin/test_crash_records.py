"""The next session reports and saves what a process was running when it died."""


def test_crash_that_became_an_ordinary_failure_is_labelled(failing):
    failing.leave_crash("test_it.py::test_fails")
    failing.run(runs=0)
    failing.mend()
    result = failing.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    result.stdout.fnmatch_lines(["*collision at * instead of a process crash"])


def test_killed_session_causes_no_false_crash_of_replay(failing):
    failing.run_once()
    failing.leave_behind(f"test_it.py::test_fails[saved-{failing.only_id}]")
    for _ in range(2):
        result = failing.run(runs=0)
        result.assert_outcomes(failed=1, skipped=1)
        result.stdout.fnmatch_lines(["Result of the replay: still failing."])


def test_an_ads_that_raises_later_has_not_ended_its_process(project):
    """Its session was killed from outside while it drove, as by the end of a CI job."""
    project.write("""
def drive(observation):
    if observation.time > 1:
        raise KeyError("lane")
    return 0.0, 0.0

@pafot.search(SHORT, ads=lambda: drive)
def test_it(run):
    pass
""")
    project.leave_behind("test_it.py::test_it")
    result = project.run(runs=0)
    assert project.files == []
    result.stdout.fnmatch_lines(
        ["*completed when it was repeated. The process was probably killed from outside*"]
    )
