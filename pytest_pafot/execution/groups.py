"""Groups of scenarios that other processes draw, run and count themselves, and their order in the search.

The process of the session receives a few numbers for each group, and the trace of a run only where something failed.
Which processes run which group changes no result, because each of them draws the scenarios of a place alike.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from pytest_pafot.execution.pool import ProcessLostError, WorkerPool
from pytest_pafot.execution.scenario_pool import GroupPart, Places
from pytest_pafot.model.scenario import Scenario

GROUP_SECONDS = 0.5
"""The longest duration of the rollouts of a group, if it has more than one scenario [s]."""

WAITING = 8
"""The number of groups for each process that are under way or finished, but not requested yet."""


class Course(Protocol):
    """The places of a search: the order in which its scenarios are requested."""

    def scenario(self, generation: int, index: int) -> Scenario:
        """Return the scenario of a place."""

    def population(self, generation: int) -> int:
        """Return the number of scenarios in a generation."""

    def can_draw(self, generation: int) -> bool:
        """Return whether the search has learnt enough to draw a generation."""


class Groups:
    """The groups of one search: given to the processes of a pool, and taken in the order of their places.

    Args:
        course: the places of the search.
        needed: returns how many scenarios of a generation the limits of the search allow.
    """

    def __init__(self, course: Course, needed: Callable[[int], int]) -> None:
        self.course = course
        self._needed = needed
        self._next = (0, 0)  # the first place that was given to no process
        self._under_way: dict[tuple[int, int], Places] = {}  # by their first place
        self._parts: deque[GroupPart] = deque()  # of the group that is being taken
        self._lost = (0, 0)  # the place after the last group whose process was lost
        self.runs, self.seconds = 0, 0.0  # of the rollouts so far

    def take(self, pool: WorkerPool[Any, Any], generation: int, index: int) -> tuple[GroupPart, bool]:
        """Return the next part, from the place that the search requests, and whether its process was lost.

        Raises:
            OutOfTime: if the time of the search is over.
            Exception: any exception of the algorithm in the process.
        """
        if not self._parts:
            self._give(pool, generation, index)
            places = self._under_way.pop((generation, index))
            answer = pool.fetch(places)
            if isinstance(answer, tuple):
                parts, output, seconds = answer
                output.repeat()
                self._parts.extend(parts)
                self.runs, self.seconds = self.runs + places.stop - places.start, self.seconds + seconds
            elif not isinstance(answer, ProcessLostError) and not pool.failure:
                raise answer  # by the algorithm, which draws the scenarios
            else:  # One of its scenarios may be the cause, so each is run by itself.
                self._parts.extend(GroupPart(each, each + 1) for each in range(places.start, places.stop))
                self._lost = (generation, places.stop)
        part = self._parts.popleft()
        return part, (generation, part.start) < self._lost

    def _give(self, pool: WorkerPool[Any, Any], generation: int, index: int) -> None:
        self._next = max(self._next, (generation, index))  # the places before it were run in the session
        size = self._size(pool.size, generation, index)
        while len(self._under_way) < WAITING * pool.size:
            later, start = self._next
            if start >= self.course.population(later):
                self._next = later + 1, 0
                continue
            stop = min(start + size, self._needed(later))
            if start >= stop or not self.course.can_draw(later):
                return
            self._under_way[later, start] = places = Places(later, start, stop)
            self._next = later, stop
            pool.add(places)

    def _size(self, processes: int, generation: int, index: int) -> int:
        """Return the largest number of scenarios in a group, if the search requests a place next.

        A group is a whole generation if possible, because a process must draw all scenarios before those that it runs.
        But all processes must get some of the scenarios that can be drawn now, which include those under way; and
        groups with long runs are smaller.
        """
        mean = self.seconds / self.runs if self.runs else GROUP_SECONDS
        population = max(self.course.population(generation), self.course.population(generation + 1))
        most = min(round(GROUP_SECONDS / max(mean, 1e-9)), population)
        places = -index  # before the group's end, from the requested one on
        while places < 2 * processes * most and self.course.can_draw(generation) and (more := self._needed(generation)):
            places, generation = places + more, generation + 1
        return max(1, min(most, places // (2 * processes)))
