"""On CI, named scenarios and sweeps are isolated like a search, and have to be collected and run."""

import pytest

from tests.plugin.test_gone_tests import replay
from tests.plugin.test_isolate import check_isolation
from tests.plugin.test_session_end import UNRUN, text_of

NAMED = '@pafot.catalogue("r157/cut-in", ads=Exits)\ndef test_it(run):\n    pass\n'
SWEPT = 'def test_it():\n    assert pafot.sweep("r157/cut-in", Exits, over={"gap": "10:60:3"}).errors == 0\n'


@pytest.mark.parametrize("test", [NAMED, SWEPT], ids=["catalogue", "sweep"])
@pytest.mark.parametrize("source", ["CI", "option"])
def test_what_is_no_search_is_isolated_as_well(project, monkeypatch, test, source):
    check_isolation(project, monkeypatch, source, test)


def test_no_session_passes_whose_named_scenarios_a_hook_leaves_out(project, monkeypatch):
    monkeypatch.setenv("CI", "true")
    conftest = project.path / "conftest.py"
    conftest.write_text(conftest.read_text() + UNRUN)
    project.write(NAMED.replace(", ads=Exits", ""))
    result = project.run()
    assert result.ret == 2
    assert "problem: 1 item did not run to the end, test_it.py::test_it[" in text_of(result)


def test_named_scenario_whose_function_is_no_test_is_told(project):
    project.write('class TestIt:\n    @pafot.catalogue("r157/cut-in")\n    def drives(self, run):\n        pass\n')
    replay(project).stdout.fnmatch_lines(["not run: test_it.py::TestIt::drives: expected a name that pytest collects*"])
