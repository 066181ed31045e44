"""The health of a search: counts over its evaluations, which show whether it tested anything."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields

from pytest_pafot.model.trace import Outcome
from pytest_pafot.searching.evaluation import BARELY_MOVING, LEAVING, Evaluation
from pytest_pafot.searching.events import Evaluated, Event
from pytest_pafot.support.text import plural

BROKEN = (Outcome.ADS_ERROR, Outcome.HANG)  # outcomes of runs that an error of the ADS cut short
IMMEDIATE = 1.0  # [s]; driving hardly causes anything before this time
MOST_INVALID = 0.25  # share of the runs
MOST_USELESS = 0.5  # share of the valid runs for each kind of run that tests nothing, and of all for early ends
MOST_CLOSE = 0.1  # share of the runs that may end early with a vehicle close, or early without a note


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """Counts over the evaluations of a search. All but ``evaluated`` count only simulated scenarios."""

    evaluated: int = 0  # scenarios that the algorithm requested
    simulated: int = 0  # those of them that were run; the others were known
    invalid: int = 0  # runs in which two NPCs, or one and a fixed object, touched, or code of the user's failed
    errors: Counter[str] = field(default_factory=Counter)  # invalid runs in which code of the user's failed
    discarded: int = 0  # runs that the user's function declined
    genes_started: int = 0  # over all NPCs, like the next; without runs that an ADS error cut short
    genes_reached: int = 0
    valid: int = 0  # runs that were neither invalid nor discarded; the next three are among these
    failing: int = 0  # runs that failed, or whose process ended
    no_interaction: int = 0  # runs in which no NPC gave the ego a reason to react; without ADS errors, too
    barely_moved: int = 0  # runs that passed although the ego hardly drove
    ended: Counter[str] = field(default_factory=Counter)  # runs that ended early and did not fail, by what ended them
    at_once: int = 0  # those of them that are valid and ended within the first second
    close: int = 0  # those of them that ended with a vehicle within two seconds of the ego
    gap: float = math.inf  # the smallest gap to another vehicle in them [m]

    @classmethod
    def of(cls, events: Iterable[Event]) -> Health:
        """Count over the events of a campaign."""
        evaluated = [event for event in events if isinstance(event, Evaluated)]
        return cls.of_runs(len(evaluated), [event.evaluation for event in evaluated if not event.reused])

    @classmethod
    def of_runs(cls, evaluated: int, runs: Sequence[Evaluation]) -> Health:
        """Count over the evaluations of simulated scenarios; ``evaluated`` is the number of all scenarios."""
        invalid = [each for each in runs if each.outcome is Outcome.INVALID]
        # A run that ended its process teaches the algorithm nothing, but it is an error of the ADS.
        valid = [
            each for each in runs if each.outcome in BROKEN or not (each.outcome is Outcome.INVALID or each.discarded)
        ]
        driven = [each for each in valid if each.outcome not in BROKEN]
        whole = [each for each in runs if each.outcome not in BROKEN]
        early = [each for each in whole if each.ended and not (each.failing or each.outcome is Outcome.INVALID)]
        return cls(
            evaluated=evaluated,
            simulated=len(runs),
            invalid=len(invalid),
            errors=Counter([each.ended for each in invalid if each.ended]),
            discarded=len(runs) - len(valid) - len(invalid),
            genes_started=sum([each.genes_started for each in whole]),
            genes_reached=sum([each.genes_reached for each in whole]),
            valid=len(valid),
            failing=sum([each.failing for each in valid]),
            no_interaction=sum([not each.interaction for each in driven]),
            barely_moved=sum([each.barely_moved and not each.failing for each in driven]),
            ended=Counter([each.ended for each in early]),
            at_once=sum([each.duration <= IMMEDIATE and not each.discarded for each in early]),
            close=sum([each.is_close for each in early]),
            gap=min([each.gap for each in early], default=math.inf),
        )

    def __add__(self, other: Health) -> Health:
        """Return the health of two searches, or of two parts of one search, together."""
        sums = {name: getattr(self, name) + getattr(other, name) for name in _COUNTS}
        return Health(**sums, gap=min(self.gap, other.gap))

    @property
    def reused(self) -> int:
        """The number of scenarios that were not simulated, because an earlier run showed what they do."""
        return self.evaluated - self.simulated

    @property
    def vacuous(self) -> bool:
        """True if most runs cannot have shown anything: they were not valid, or ended within the first second."""
        return 2 * (self.valid - self.at_once) < self.simulated or not self.simulated

    @property
    def reached_share(self) -> float | None:
        """The share of started genes whose target was reached; None if none was started."""
        return self.genes_reached / self.genes_started if self.genes_started else None

    @property
    def early_ends(self) -> str:
        """A sentence on the runs that ended early without a collision; empty if they are few and no vehicle is close.

        Runs that end with a vehicle close hide most, so one of them is enough.
        """
        runs = self.ended.total()
        if not self.close and runs <= MOST_CLOSE * self.simulated:
            return ""
        (most, _), *others = first = self.ended.most_common(3)
        enders = " and ".join(f"{name} ({number})" for name, number in first) if others else most
        advice = 'correct what ended them, or let them go on with ends="duration" in a pafot.World'
        if most in LEAVING.values():
            advice = "check the units and axes of the world, and of what the ADS returns"
        return (
            f"{_percent(runs, self.simulated)} runs ended early without a collision, by {enders}, "
            f"{self.close} of them with a vehicle within two seconds of the ego; the smallest gap to a vehicle in "
            f"these runs was {self.gap:.1f} m; {advice}"
        )

    @property
    def hides_most(self) -> bool:
        """True if the search warns of early ends: of more than half of the runs, or a tenth with a vehicle close."""
        return self.ended.total() > MOST_USELESS * self.simulated or self.close > MOST_CLOSE * self.simulated

    def warnings(self) -> list[str]:
        """Return a warning, with advice, for each sign that the search tested too little; empty if there is none."""
        if self.simulated == 0:
            return ["no scenario was simulated, so nothing was tested; give the search generations and time"]
        found = []
        if self.errors:
            (most, _), *_ = self.errors.most_common(1)
            found.append(
                f"{plural(self.errors.total(), 'simulated scenario')} tested nothing; most often {most:.300}; correct "
                'it, or write ends="duration" in the world'
            )
        if self.vacuous:
            found.append(
                f"most of {plural(self.simulated, 'simulated scenario')} tested nothing: {self.invalid} were invalid, "
                f"{self.discarded} were rejected or skipped, {self.at_once} ended within the "
                "first second; use fewer NPCs, reject less, or correct what ends runs"
            )
        touched = self.invalid - self.errors.total()
        if touched > MOST_INVALID * self.simulated:
            found.append(
                f"{_percent(touched, self.simulated)} simulated scenarios tested nothing, because two NPCs, or an NPC "
                "and a fixed object, touched; use fewer NPCs, more lanes or shorter runs"
            )
        for count, what in ((self.no_interaction, ALONE), (self.barely_moved, STANDING)):
            if count > MOST_USELESS * self.valid:
                found.append(f"{_percent(count, self.valid)} valid runs {what}")
        return [*found, self.early_ends] if self.hides_most else found


ALONE = "never brought an NPC near the ego in its lane; raise the number of NPCs, the genes, or the speed_limit of NPCs"
STANDING = f"had an ego with a mean speed below {BARELY_MOVING:g} m/s; check the units of what the ADS returns"
_COUNTS = [each.name for each in fields(Health) if each.name != "gap"]


def _percent(part: int, whole: int) -> str:
    return f"{part / whole:.0%} ({part}) of {whole}".replace("%", " %", 1)
