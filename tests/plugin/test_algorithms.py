"""Searches by other algorithms: the same items, files, replays and reports."""

import re
import sys

import pytest

# pytester forgets modules that a run imports; compiled ones of libraries cannot be loaded a second time
import pytest_pafot.searching.cma_es
import pytest_pafot.searching.map_elites
import pytest_pafot.searching.nsga2  # noqa: F401

TEST = "@pafot.search(SHORT, algorithm={!r}, stop_after=1)\ndef test_it(run):\n    assert not run.collision\n"


@pytest.mark.parametrize("algorithm", ["av-fuzzer", "random-manoeuvre"])
def test_a_find_without_cells_is_saved_confirmed_shrunk_and_replayed(project, algorithm):
    project.write(TEST.format(algorithm))
    result = project.run(generations=6)
    result.assert_outcomes(failed=2)
    result.stdout.no_fnmatch_line("*flaky*")
    text = project.only_file.read_text()
    assert re.search(r"- \{lane: (keep|left|right), speed: \d", text)
    assert f"algorithm: {algorithm}" in text
    assert "shrunk:" in text
    assert "{cell:" not in text
    again = project.run(generations=0)
    again.assert_outcomes(failed=1, skipped=1)
    again.stdout.fnmatch_lines(["*still failing*"])


@pytest.mark.parametrize("algorithm", ["nsga2", "map-elites", "cma-es"])
def test_the_algorithms_of_libraries_search_too(project, algorithm):
    project.write(TEST.format(algorithm))
    project.run(generations=8).assert_outcomes(failed=2)
    assert f"algorithm: {algorithm}" in project.only_file.read_text()


def test_a_find_without_cells_is_on_the_page(project):
    project.write(TEST.format("av-fuzzer"))
    project.run("--pafot-report=page.html", generations=6)
    page = (project.path / "page.html").read_text()
    assert re.search(r"<td>(keep lane|lane left|lane right)</td>", page)
    assert '"lane": "' in page or '"lane":"' in page


def test_av_fuzzer_climbs_its_own_fitness_unless_another_is_asked_for(project):
    project.write(
        "from pytest_pafot.plugin.options import request_of_mark\n"
        "def test_it(pytestconfig):\n"
        "    def fitness(**arguments):\n"
        "        return request_of_mark(pytestconfig, arguments, 1).fitness\n"
        "    assert fitness(algorithm='av-fuzzer') == 'av-fuzzer'\n"
        "    assert fitness(algorithm='av-fuzzer', fitness='default') == 'default'\n"
        "    assert fitness(algorithm='random') == fitness() == 'default'\n"
    )
    project.run().assert_outcomes(passed=1)


def test_a_library_that_is_not_installed_fails_the_item_with_the_command_that_installs_it(project, monkeypatch):
    for module in [name for name in sys.modules if name.partition(".")[0] == "cmaes" or name.endswith(".cma_es")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "cmaes", None)
    project.write(TEST.format("cma-es"))
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*pip install 'pytest-pafot?search?'*"])


@pytest.mark.parametrize("algorithm", ["av-fuzzer", "random-manoeuvre"])
def test_searches_that_know_no_grid_are_refused_where_a_road_is_not_straight(project, algorithm):
    road = "ads=lambda: lambda observation: 1, world=pafot.World('merge-v1')"
    project.write(f"@pafot.search(algorithm={algorithm!r}, {road})\ndef test_it(run):\n    pass\n")
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [f"*algorithm: expected one of distinct, * on a road that is not straight, received '{algorithm}', *"]
    )


def test_an_unknown_algorithm_is_answered_with_those_that_exist(project):
    project.write("@pafot.search(SHORT, algorithm='genetic')\ndef test_it(run):\n    pass\n")
    result = project.run()
    result.stdout.fnmatch_lines(["*expected distinct, pafot, *or cma-es, received 'genetic'*"])
