"""Searches by the algorithms of extras: the same items, files, replays and reports."""

import sys

import pytest

from pytest_pafot.door import ALGORITHMS
from tests.plugin.test_algorithms import TEST, check_kinds


@pytest.fixture(scope="module")
def libraries():
    """Import the libraries of algorithms before pytester notes which modules it forgets after a session.

    Compiled libraries cannot be loaded a second time.
    """
    import cmaes  # noqa: F401
    import pymoo.operators.survival.rank_and_crowding  # noqa: F401
    import ribs.archives  # noqa: F401


def test_the_algorithms_of_extras_search_too(libraries, project):
    algorithms = tuple(ALGORITHMS)
    project.write("\n".join(TEST.format(each).replace("test_it", f"test_{n}") for n, each in enumerate(algorithms)))
    project.run(generations=8).assert_outcomes(failed=2 * len(algorithms))
    for text, algorithm in zip(project.contents.values(), algorithms, strict=True):
        assert f"algorithm: {algorithm}" in text


def test_every_algorithm_searches_with_every_kind_it_supports(libraries, project):
    check_kinds(project, ALGORITHMS, refused=4)


def test_av_fuzzer_uses_its_own_fitness_by_default(project):
    project.write(
        "from pytest_pafot.plugin.option_sources import request_of_mark\n"
        "def test_it(pytestconfig):\n"
        "    def fitness(**arguments):\n"
        "        return request_of_mark(pytestconfig, arguments, 1).fitness\n"
        "    assert fitness(algorithm='av-fuzzer') == 'av-fuzzer'\n"
        "    assert fitness(algorithm='av-fuzzer', fitness='default') == 'default'\n"
        "    assert fitness(algorithm='random') == fitness() == 'default'\n"
    )
    project.run().assert_outcomes(passed=1)


def test_missing_library_error_gives_the_install_command(project, monkeypatch):
    monkeypatch.setitem(sys.modules, "cmaes", None)
    project.write(TEST.format("cma-es"))
    result = project.run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*pip install 'pytest-pafot?search?'*"])
