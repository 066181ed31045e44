"""The lines of a policy that tell the neighbours that fail from those that pass, by how often they ran in each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

LEAST_DIFFERENCE = 0.2
"""The smallest difference between the shares of failing and of passing runs in which a telling line ran."""

MOST_LINES = 3
"""The largest number of lines that are told of a finding."""


class Line(NamedTuple):
    """A line of source text: the path of its file, its number from 1, and the name of its function.

    The name of a method begins with its class.
    """

    file: str
    number: int
    function: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TellingLine:
    """A line that ran in more of the neighbours that fail than of those that pass.

    Attributes:
        file: path of its file, relative to the project.
        number: number of the line, from 1.
        function: name of its function.
        text: the line itself, without indentation.
        failing, of_failing: in how many of the neighbours that fail it ran, and their number.
        passing, of_passing: the same for those that pass.
    """

    file: str
    number: int
    function: str
    text: str
    failing: int
    of_failing: int
    passing: int
    of_passing: int

    def __str__(self) -> str:
        counts = f"{self.failing} of {self.of_failing} neighbours that fail, in {self.passing} of {self.of_passing}"
        return f"{self.file}:{self.number} in {self.function}: `{self.text}` ran in {counts} that pass"


class Ranked(NamedTuple):
    """A line, and in how many of the failing and of the passing runs it ran."""

    line: Line
    failing: int
    passing: int


def ranked(failing: Sequence[Mapping[Line, int]], passing: Sequence[Mapping[Line, int]]) -> list[Ranked]:
    """Return the lines that ran in a clearly larger share of the failing runs than of the passing ones.

    Each run is given by its lines, with the number of decisions in which each ran. The most telling line is first.
    They are ranked by Ochiai's coefficient: the failing runs with the line, divided by the square root of the number of
    failing runs times the number of runs with the line. Lines of one function that ran in the same runs, without a line
    between them that ran in others, are one place, which is its first line. Of lines with the same coefficient, the
    one that ran in fewer decisions is first: it is nearer to what is special about the failing runs.

    Source: Ochiai, 1957; Abreu, Zoeteweij, van Gemund, "On the Accuracy of Spectrum-based Fault Localization", 2007.
    """
    if not failing or not passing:
        return []
    runs: dict[Line, frozenset[int]] = {}
    for line in sorted(set().union(*failing, *passing)):
        runs[line] = frozenset(number for number, ran in enumerate((*failing, *passing)) if line in ran)
    found, before = [], Line("", 0, "")
    for line, its in runs.items():
        is_same_place = before[0::2] == line[0::2] and runs[before] == its
        before = line
        bad = sum(number < len(failing) for number in its)
        good = len(its) - bad
        if not is_same_place and bad / len(failing) - good / len(passing) >= LEAST_DIFFERENCE - 1e-9:
            found.append(Ranked(line, bad, good))

    def order(each: Ranked) -> tuple[float, int, Line]:
        decisions = sum(run.get(each.line, 0) for run in failing)
        return -each.failing / math.sqrt(each.failing + each.passing), decisions, each.line

    return sorted(found, key=order)
