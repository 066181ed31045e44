"""Live progress: lines in a log, one rewritten line on a terminal, and nothing in quiet sessions."""

import pytest

PASSES = "@pafot.search(SHORT)\ndef test_passes(run):\n    pass\n"

ON_A_TERMINAL = """
import pytest

@pytest.fixture
def ads():
    return lambda: lambda observation: (0.0, 0.0)

@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session):
    session.config.pluginmanager.get_plugin("terminalreporter").isatty = lambda: True
"""


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr("pytest_pafot.plugin.session.LOG_SECONDS", 0.0)
    monkeypatch.setattr("pytest_pafot.plugin.reporter.TERMINAL_SECONDS", 0.0)


def test_log_gets_whole_lines_during_the_search(project, impatient):
    project.write(PASSES)
    result = project.run(runs=8)
    result.stdout.fnmatch_lines(["pafot: *test_passes[[]search[]] 1/8 *"])


def test_a_log_is_not_flooded(project):
    project.write(PASSES)
    assert "1/8 runs" not in project.run(runs=8).stdout.str()


def test_a_quiet_session_shows_no_progress(project, impatient):
    project.write(PASSES)
    assert "/8 runs" not in project.run("-q", runs=8).stdout.str().partition("pafot =")[0]


def test_terminal_gets_one_line_rewritten_and_erased(project, impatient):
    project.pytester.makeconftest(ON_A_TERMINAL)
    project.write(PASSES)
    output = project.run(runs=8).stdout.str()
    assert "\rpafot: " in output.replace("\n", "\r")
    assert "1/8 runs, " in output


def test_a_session_with_finds_ends_at_100_percent(failing):
    result = failing.run_once()
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines(["FF *[[]100%[]]"])
