"""ADSs around the user's, or in its place.

An ADS may decide beside a run that is driven again by its recorded actions, and so see what the run's ADS saw.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any

from pytest_pafot.world.driving.conditions import Conditions, Evaluated
from pytest_pafot.world.driving.policy import AdsFactory, rewrapped
from pytest_pafot.world.guard.hang_guard import Around
from pytest_pafot.world.kernel.observation import Observation

Check = Callable[[Any], Any]
"""A function that returns an action as a run stores it, and raises an error for anything else."""


@dataclass(slots=True, kw_only=True)
class Aside:
    """The decisions of an ADS beside a run.

    Attributes:
        asked: the number of decisions that it was asked for.
        answers: its actions, one per decision; None where it raised an error.
        at: what it would have seen at the decision of a question, had nothing been changed; None without one.
        conditions: those that it evaluated in this decision, with their values, if the question is about them.
    """

    asked: int = 0
    answers: list[Any] = field(default_factory=list)
    at: Any = None
    conditions: list[Evaluated] = field(default_factory=list)

    def of(self, number: int) -> Any:
        """Return the action of a decision; None without one."""
        return self.answers[number] if number < len(self.answers) else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """A decision at which what an ADS sees is noted, or changed.

    Attributes:
        number: the number of the decision.
        instead: what it sees there instead; None for what there is to see.
        conditions: what records the conditions that it evaluates there; None if nothing does.
    """

    number: int
    instead: Any = None
    conditions: Conditions | None = None


class Shadow(Around):
    """An ADS of whose decisions a run is told nothing: the run gets the recorded actions."""

    def __init__(self, ads: Any, actions: Sequence[Any], check: Check, aside: Aside, question: Question | None) -> None:
        super().__init__(ads)
        self._actions, self._check, self._aside, self._question = actions, check, aside, question

    def __call__(self, observation: Any) -> Any:
        """Decide, note the decision, and return the recorded one."""
        aside, number = self._aside, len(self._aside.answers)
        question = self._question
        recording: AbstractContextManager[None] = nullcontext()
        if question is not None and question.instead is not None and question.number < number < len(self._actions):
            # What it would decide here says nothing about the question.
            aside.answers.append(self._actions[number])
            return self._actions[number]
        if question is not None and number == question.number:
            aside.at = copy.deepcopy(observation)  # the ADS may write into it
            observation = observation if question.instead is None else question.instead
            if question.conditions is not None:
                recording = question.conditions.recorded(self._ads, aside.conditions)
        aside.asked += 1
        try:
            with recording:
                answer = self._check(self._ads(observation))
        except Exception:  # noqa: BLE001  (an ADS may raise anything about an observation that it never had)
            answer = None
        aside.answers.append(answer)
        return self._actions[number] if number < len(self._actions) else answer


def beside(
    factory: AdsFactory, actions: Sequence[Any], check: Check, aside: Aside, question: Question | None = None
) -> AdsFactory:
    """Return a factory of ADSs that decide beside a run, which gets the recorded actions.

    Raises:
        AdsFactoryError: when it makes an ADS, if that is a vehicle class.
    """
    return wrapped(factory, lambda ads: Shadow(ads, actions, check, aside, question))


class _Ending(Around):
    """An ADS that raises an error instead of its next decision when it has made all that are of interest."""

    def __init__(self, ads: Any, decisions: int) -> None:
        super().__init__(ads)
        self._left = decisions

    def __call__(self, observation: Any) -> Any:
        if self._left <= 0:
            raise RuntimeError("no more decisions are of interest")
        self._left -= 1
        return self._ads(observation)


class Unseeing(Around):
    """An ADS that does not see one NPC of a scenario.

    It takes the NPC from a planner's observations. Those of an environment are made without it, see :func:`hide`.
    """

    def __init__(self, ads: Any, npc: int) -> None:
        super().__init__(ads)
        self.npc = npc

    def __call__(self, seen: Any) -> Any:
        """Decide without the NPC."""
        if isinstance(seen, Observation):
            seen = changed(seen, self.npc, None) if self.npc in seen.ids else seen
            seen = seen.replace(crossing=tuple([each for each in seen.crossing if each.id != self.npc]))
        return self._ads(seen)


def without(factory: AdsFactory, npc: int) -> AdsFactory:
    """Return a factory of the same ADSs, from which one NPC is hidden."""
    return wrapped(factory, lambda ads: Unseeing(ads, npc))


def ending_after(factory: AdsFactory, decisions: int) -> AdsFactory:
    """Return a factory of ADSs that raise an error after a number of decisions."""
    return wrapped(factory, lambda ads: _Ending(ads, decisions))


def repeating(action: Any) -> AdsFactory:
    """Return a factory of ADSs that always answer with the same action."""
    return lambda: lambda observation: action


def wrapped(factory: AdsFactory, wrap: Callable[[Any], Any]) -> AdsFactory:
    """Return a factory whose ADSs are wrapped, each in what ``wrap`` makes of it; they see what they see without.

    Raises:
        AdsFactoryError: when it makes an ADS, if that is a vehicle class.
    """

    def make(*observations: Any, **arguments: Any) -> Any:
        return rewrapped(factory(*observations, **arguments), wrap)

    return functools.wraps(factory, updated=())(make)


def changed(observation: Observation, npc: int, by: tuple[float, float, float] | None) -> Observation:
    """Return an observation in which a vehicle is elsewhere, or hidden; it must be among the ``others``.

    ``by`` is what is added to its x and y [m] and to its speed [m/s]; None hides it.
    """
    place, others = observation.ids.index(npc), list(observation.others)
    ids, lateral = list(observation.ids), list(observation.lateral_velocities)
    if by is None:
        del others[place], ids[place], lateral[place + 1]
    else:
        was, (x, y, speed) = others[place], by
        aside = [abs(centre - (was.y + y)) for centre in observation.lane_centres]
        others[place] = was._replace(x=was.x + x, y=was.y + y, speed=was.speed + speed, lane=aside.index(min(aside)))
    return observation.replace(others=tuple(others), ids=tuple(ids), lateral_velocities=tuple(lateral))
