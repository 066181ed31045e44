"""The algorithms of extras have names, fitnesses and kinds of instructions like those of the core."""

from pytest_pafot import Highway, World
from pytest_pafot.door import ALGORITHMS
from pytest_pafot.extras.algorithms.av_fuzzer import AvFuzzerSearch
from pytest_pafot.searching import SearchSpace, resolve_algorithm
from pytest_pafot.searching.ask_tell import ResumableSearch
from tests.campaign.test_random_beginning import explored
from tests.campaign.test_request import space_of
from tests.searching.test_crossing_traffic import WITHOUT, check_grid, drawn_digest

CLASSES = {name: resolve_algorithm(name) for name in ALGORITHMS}


def test_algorithms_are_found_by_name():
    assert [each.name for each in CLASSES.values()] == list(ALGORITHMS)
    assert [each.make(SearchSpace(npcs=3)).name for each in CLASSES.values()] == list(ALGORITHMS)
    assert resolve_algorithm(AvFuzzerSearch) == CLASSES["av-fuzzer"]


def test_only_av_fuzzer_has_a_default_fitness_of_its_own():
    fitness = {name: each.fitness for name, each in CLASSES.items()}
    assert fitness == {**dict.fromkeys(ALGORITHMS, "default"), "av-fuzzer": "av-fuzzer"}


def test_none_of_them_can_go_on_in_a_later_session():
    assert not any(issubclass(each.made_by, ResumableSearch) for each in CLASSES.values())


def test_av_fuzzer_keeps_to_the_grid(make_evaluation):
    check_grid("av-fuzzer", make_evaluation)


def test_av_fuzzer_draws_without_zones_as_it_did_before(make_evaluation):
    drawn = {space: drawn_digest("av-fuzzer", WITHOUT[space], make_evaluation) for space in WITHOUT}
    assert drawn == {"papers": "b07ec34b17d5", "wide": "374eb7f4ea29", "bend": "ef9f486e8604"}


def test_searches_of_the_papers_have_its_space():
    space = space_of(Highway(), algorithm="av-fuzzer")
    assert (space.npcs, space.ego_lane, space.ego_speed, space.patterns) == (2, 1, 22.0, False)
    assert space_of(World("intersection-v0"), algorithm="av-fuzzer").crossings is None


def test_av_fuzzer_has_no_random_share():
    assert explored(runs=8, algorithm="av-fuzzer").summary.random_runs == 0
