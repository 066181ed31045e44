"""The next session reports and saves what a process was running when it died."""

from tests.plugin.conftest import labels


def test_crash_that_became_an_ordinary_failure_is_labelled(failing):
    failing.leave_crash("test_it.py::test_fails")
    failing.run(runs=0)
    failing.mend()
    result = failing.run(runs=0)
    result.assert_outcomes(failed=1, skipped=1)
    assert labels(result) == "1 drifted"


def test_killed_session_causes_no_false_crash_of_replay(failing):
    failing.run_once()
    failing.leave_behind(f"test_it.py::test_fails[saved-{failing.only_id}]")
    for _ in range(2):
        result = failing.run(runs=0)
        result.assert_outcomes(failed=1, skipped=1)
        assert labels(result) == "1 still failing"
