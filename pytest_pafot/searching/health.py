"""The health of a search: counts over its evaluations, which show whether it tested anything."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields

from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching.evaluation import BARELY_MOVING, Evaluation
from pytest_pafot.searching.events import Evaluated, Event
from pytest_pafot.support.text import plural

MAX_INVALID_SHARE = 0.25
MIN_REACHED_SHARE = 0.2  # runs of four NPCs often end within a gene: a quarter to a half is usual
BROKEN = (Outcome.ADS_ERROR, Outcome.HANG)  # outcomes of runs that an error of the ADS cut short
IMMEDIATE = 1.0  # [s]; driving hardly causes a collision before this time
MAX_USELESS_SHARE = 0.5  # share of the valid runs, for each kind of run that tests nothing

USELESS = (
    (
        "never brought an NPC near the ego in its lane",
        "raise the number of NPCs or genes, or check that the ego drives on the lanes that the NPCs can use",
    ),
    (
        "left all NPCs more than 100 m behind the ego for half of the run or longer",
        "raise speed_limit to the ego's speed, or check that the ADS keeps the limit",
    ),
    (
        f"had an ego with a mean speed below {BARELY_MOVING:g} m/s",
        "check that {actions} and that the factory makes a fresh one",
    ),
    (
        "collided within the first second, before an NPC can have caused it",
        "check that the ego starts on a free lane and that {actions}",
    ),
    (
        "left the road within the first second, before an NPC can have caused it",
        "check the units and axes of the world, and that {actions}",
    ),
)
"""Kinds of runs that test nothing, with advice: no interaction, outran, barely moved, immediate collision or exit."""

IN_SI = "the ADS returns accelerations in m/s^2 and steers in rad"
IN_ENVIRONMENT = "the ADS returns the environment's actions as in its training"


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Counts over the evaluations of a search. All but ``evaluated`` count only simulated scenarios."""

    evaluated: int = 0  # scenarios that the algorithm requested
    simulated: int = 0  # those of them that were run; the others were known
    invalid: int = 0  # runs in which two NPCs, or one and a fixed object, touched, or code of the user's failed
    at_object: int = 0  # those of them in which no two NPCs touched
    users_errors: Counter[str] = field(default_factory=Counter)  # invalid runs in which code of the user's failed
    discarded: int = 0  # runs that the user's function declined, or whose process ended
    genes_started: int = 0  # over all NPCs, like the next; without runs that an ADS error cut short
    genes_reached: int = 0
    valid: int = 0  # runs that were neither invalid nor discarded; the counts below are among these
    failing: int = 0  # runs that the user's function rejected
    measured: int = 0  # runs whose fitness is a finite number
    # The next five leave out runs that an error of the ADS cut short.
    unmeasured: int = 0  # runs whose fitness is no finite number
    no_interaction: int = 0  # runs in which no NPC gave the ego a reason to react
    outran: int = 0  # runs in which the ego left all NPCs behind
    barely_moved: int = 0  # runs in which the ego hardly drove
    immediate: int = 0  # collisions within the first second
    off_at_once: int = 0  # runs in which the ego left the road within the first second
    over: Counter[str] = field(default_factory=Counter)  # runs that the environment ended within the first second
    goals: Counter[str] = field(default_factory=Counter)  # chains by the kind of places that they name

    @classmethod
    def of(cls, events: Iterable[Event]) -> Health:
        """Count over the events of a campaign."""
        evaluated = [event for event in events if isinstance(event, Evaluated)]
        return cls.of_runs(len(evaluated), [event.evaluation for event in evaluated if not event.reused])

    @classmethod
    def of_runs(cls, evaluated: int, runs: Sequence[Evaluation]) -> Health:
        """Count over the evaluations of simulated scenarios; ``evaluated`` is the number of all scenarios."""
        valid = [each for each in runs if not (each.outcome is Outcome.INVALID or each.discarded)]
        driven = [each for each in valid if each.outcome not in BROKEN]
        whole = [each for each in runs if each.outcome not in BROKEN]
        hits = [each for each in valid if each.outcome is Outcome.COLLISION]
        invalid = sum([each.outcome is Outcome.INVALID for each in runs])
        return cls(
            evaluated=evaluated,
            simulated=len(runs),
            invalid=invalid,
            at_object=sum([each.at_object for each in runs]),
            users_errors=Counter([each.users_error for each in runs if each.users_error]),
            discarded=len(runs) - len(valid) - invalid,
            genes_started=sum([each.genes_started for each in whole]),
            genes_reached=sum([each.genes_reached for each in whole]),
            valid=len(valid),
            failing=sum([each.failing for each in valid]),
            measured=sum([math.isfinite(each.fitness) for each in valid]),
            unmeasured=sum([not math.isfinite(each.fitness) for each in driven]),
            no_interaction=sum([not each.interaction for each in driven]),
            outran=sum([each.outran for each in driven]),
            barely_moved=sum([each.barely_moved for each in driven]),
            immediate=sum([each.duration < IMMEDIATE for each in hits]),
            off_at_once=sum([each.outcome is Outcome.OFF_ROAD and each.duration <= IMMEDIATE for each in driven]),
            over=Counter([each.ended for each in driven if each.ended and each.duration <= IMMEDIATE]),
            goals=Counter([npc[0].goal_kind for each in runs for npc in each.scenario.npcs]),
        )

    def counted(self, evaluation: Evaluation, *, reused: bool = False) -> Health:
        """Return the health with one more evaluation."""
        return self + Health.of_runs(1, () if reused else (evaluation,))

    def __add__(self, other: Health) -> Health:
        """Return the health of two searches, or of two parts of one search, together."""
        return Health(**{each.name: getattr(self, each.name) + getattr(other, each.name) for each in _FIELDS})

    @property
    def reused(self) -> int:
        """The number of scenarios that were not simulated, because an earlier run showed what they do."""
        return self.evaluated - self.simulated

    @property
    def vacuous(self) -> bool:
        """True if most runs cannot have shown anything: they were not valid, or ended at once, as off the road."""
        return 2 * (self.valid - self.over.total() - self.off_at_once) < self.simulated or not self.simulated

    @property
    def reached_share(self) -> float:
        """The share of started genes whose cell was reached; 0 if none was started."""
        return _share(self.genes_reached, self.genes_started)

    def warnings(self, known: int = 0, *, acts_in_si: bool = True) -> list[str]:
        """Return a warning, with advice, for each sign that the search tested too little; empty if there is none.

        ``known`` is the number of runs with a known failure. They are not counted as runs in which the ego stands or
        collides immediately. ``acts_in_si`` is False if the ADS's actions are those of an environment.
        """
        if self.simulated == 0:
            return ["no scenario was simulated, so nothing was tested; give the search generations and time"]
        found = []
        crash, remedy = "in a crash of NPCs", "use fewer NPCs or more lanes"
        if self.at_object:
            where = "where an NPC touched a fixed object"
            crash = where if self.at_object == self.invalid else f"{crash} or, {self.at_object} of them, {where},"
            remedy = "NPCs do not avoid objects: use shorter runs (duration= of the world), fewer NPCs or fewer objects"
        if failed := sum(self.users_errors.values()):
            (most, _), *_ = self.users_errors.most_common(1)
            where, remedy = (
                "when a method that ends episodes failed",
                'correct it, or write ends="duration" in the world',
            )
            crash = where if failed == self.invalid else f"{crash} or, {failed} of them, {where},"
            found.append(f"{plural(failed, 'simulated scenario')} tested nothing; most often {most:.300}; {remedy}")
        if self.vacuous:
            counts = {
                f"ended {crash}": self.invalid,
                "were rejected, skipped or ended their process": self.discarded,
                f"were ended within the first second by {', '.join(sorted(self.over))}": self.over.total(),
                "left the road within the first second": self.off_at_once,
            }
            told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
            found.append(
                f"most of {plural(self.simulated, 'simulated scenario')} tested nothing: {told}; use fewer NPCs, "
                'reject less, correct what ends runs, or write ends="duration" in the world'
            )
        if _share(self.invalid, self.simulated) > MAX_INVALID_SHARE:
            found.append(
                f"{_percent(self.invalid, self.simulated)} simulated scenarios ended {crash} and "
                f"tested nothing, which should be at most 25 %; {remedy}"
            )
        kinds = set(self.goals)
        goal = " or ".join(sorted(kinds))
        instructions = "Position-Instructions" if kinds == {"cell"} else "instructions"
        if kinds and self.genes_started and self.reached_share < MIN_REACHED_SHARE:
            found.append(
                f"NPCs reached the {goal} of only {_percent(self.genes_reached, self.genes_started)} {instructions} "
                "that they started; give them more time (gene_seconds) or a higher speed_limit "
                "than the ego's speed"
            )
        if self.unmeasured and not self.measured:
            found.append(
                f"the fitness was no finite number in any of {plural(self.valid, 'valid run')}, so it could not guide "
                "the search; let fitness= return a finite number for every run that it can measure"
            )
        useless = (self.no_interaction, self.outran, self.barely_moved, self.immediate, self.off_at_once)
        for count, spared, (what, advice) in zip(useless, (0, 0, known, known, known), USELESS, strict=True):
            if _share(count - spared, self.valid) > MAX_USELESS_SHARE:
                told = advice.format(actions=IN_SI if acts_in_si else IN_ENVIRONMENT)
                found.append(f"{_percent(count, self.valid)} valid runs {what}; {told}")
        return found


_FIELDS = fields(Health)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0


def _percent(part: int, whole: int) -> str:
    return f"{_share(part, whole):.0%} ({part}) of {whole}".replace("%", " %", 1)
