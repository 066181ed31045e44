"""Searches by the algorithms of extras: the same items, files, replays and reports."""

from pytest_pafot.door import ALGORITHMS
from tests.plugin.test_algorithms import TEST, check_kinds


def test_the_algorithms_of_extras_search_too(project):
    algorithms = tuple(ALGORITHMS)
    project.write("\n".join(TEST.format(each).replace("test_it", f"test_{n}") for n, each in enumerate(algorithms)))
    project.run(generations=8).assert_outcomes(failed=2 * len(algorithms))
    for text, algorithm in zip(project.contents.values(), algorithms, strict=True):
        assert f"algorithm: {algorithm}" in text


def test_every_algorithm_searches_with_every_kind_it_supports(project):
    check_kinds(project, ALGORITHMS, refused=2)


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
