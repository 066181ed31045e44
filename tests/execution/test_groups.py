"""Groups of scenarios for other processes: their order, their sizes, and what follows if a process is lost."""

import pytest

from pytest_pafot.execution.groups import GROUP_SECONDS, Groups
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import CapturedOutput, GroupPart

POPULATION, AHEAD = 16, 512


class Search:
    """A search that may draw scenarios up to 512 places after the first one that is not learnt."""

    def __init__(self, runs=10**6, ahead=AHEAD):
        self.runs, self.ahead, self.place = runs, ahead, (0, 0)

    def population(self, generation):
        return POPULATION

    def can_draw(self, generation):
        return generation - self.place[0] < max(1, self.ahead // POPULATION)

    def needed(self, generation):
        return max(0, min(POPULATION, self.runs - generation * POPULATION))

    def searched(self, pool, groups):
        """Take all parts; yield each with its generation."""
        while sum(self.place[at] * size for at, size in ((0, POPULATION), (1, 1))) < self.runs:
            generation, index = self.place
            part, is_lost = groups.take(pool, generation, index)
            yield generation, part, is_lost
            self.place = (generation, part.stop) if part.stop < POPULATION else (generation + 1, 0)


class Pool:
    """A pool that answers at once. A run takes ``seconds``, and each process is lost in a task with a given place."""

    def __init__(self, size=4, seconds=0.001, deadly=(), error=None, failure=""):
        self.size, self.seconds, self.deadly, self.error = size, seconds, deadly, error
        self.added, self.failure = [], failure

    def add(self, places):
        self.added.append(places)

    def fetch(self, places):
        assert places in self.added
        if self.error is not None:
            return self.error
        if any((places.generation, index) in self.deadly for index in range(places.start, places.stop)):
            return ProcessLostError(places, pid=1, how="died")
        count = places.stop - places.start
        return [GroupPart(places.start, places.stop, counted=count)], CapturedOutput(), count * self.seconds


def all_parts(pool, search=None):
    search = search or Search(runs=1000)
    return list(search.searched(pool, Groups(search, search.needed)))


def places_of(parts):
    return [(generation, index) for generation, part, _ in parts for index in range(part.start, part.stop)]


@pytest.mark.parametrize("runs", [1, 15, 16, 17, 1000])
@pytest.mark.parametrize("size", [1, 2, 16])
def test_each_place_is_taken_once_in_order(runs, size):
    parts = all_parts(Pool(size), Search(runs))
    assert places_of(parts) == [divmod(number, POPULATION) for number in range(runs)]


@pytest.mark.parametrize("size", [2, 16])
def test_a_process_gets_whole_generations_while_the_search_can_draw_far_ahead(size):
    pool = Pool(size)
    all_parts(pool, Search(runs=10_000))
    sizes = [each.stop - each.start for each in pool.added]
    assert sizes.count(POPULATION) * POPULATION > 9_000


def test_all_processes_get_scenarios_where_few_can_be_drawn():
    pool = Pool(size=4)
    all_parts(pool, Search(runs=200, ahead=0))  # one generation at a time
    assert max(each.stop - each.start for each in pool.added) == POPULATION // 8


def test_groups_of_long_runs_are_smaller():
    pool = Pool(size=2, seconds=GROUP_SECONDS / 5)
    all_parts(pool)
    assert {each.stop - each.start for each in pool.added[100:200]} == {5, 1}  # 5, 5, 5 and 1 of each generation


def test_before_the_first_answer_a_group_is_one_scenario():
    pool = Pool(size=2)
    groups = Groups(search := Search(), search.needed)
    groups.take(pool, 0, 0)
    assert {each.stop - each.start for each in pool.added} == {1}


def test_scenarios_of_a_lost_process_are_left_to_the_session_one_by_one():
    parts = all_parts(Pool(deadly={(7, 3)}))
    assert places_of(parts) == [divmod(number, POPULATION) for number in range(1000)]
    lost = [(generation, part.start) for generation, part, is_lost in parts if is_lost]
    left = [(generation, part.start) for generation, part, _ in parts if part.counted is None]
    assert (7, 3) in lost
    assert lost == left
    assert {generation for generation, _ in lost} == {7}


def test_an_error_of_the_algorithm_in_a_process_is_raised():
    with pytest.raises(ZeroDivisionError, match="no parents"):
        all_parts(Pool(error=ZeroDivisionError("no parents")))


def test_the_session_runs_all_where_no_process_can_start():
    parts = all_parts(Pool(error=OSError("no processes"), failure="no processes"))
    assert {part.counted for _, part, _ in parts} == {None}
    assert len(parts) == 1000
