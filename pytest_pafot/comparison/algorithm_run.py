"""The runs of a comparison: each run is a campaign of one algorithm, without pytest, whose scenarios become rows."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from pytest_pafot.attribution.responsibility import is_ego_responsible, position_rule
from pytest_pafot.commands.policy_reference import ads_factory, caution
from pytest_pafot.commands.resumable import ResumableJob, Task, Tick, claim, run_job
from pytest_pafot.comparison.plan import DIFFERENT, Plan
from pytest_pafot.execution.runner import runner_here
from pytest_pafot.findings.finding import ads_failure, event_of, first_decision_cause, of_failure
from pytest_pafot.findings.signature import Failure
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import AdsError, Outcome, Trace
from pytest_pafot.oracle.run import Run
from pytest_pafot.searching import Evaluation, run_campaign
from pytest_pafot.searching.events import Evaluated, GenerationFinished
from pytest_pafot.searching.fitness import Fitness, resolve
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.text import csv_text
from pytest_pafot.world.driving.ads import is_vehicle_class
from pytest_pafot.world.protocol import WorldLike, first_decision, reference_world

# Tidy results: one row per scenario; equal runs give equal text.


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A row of the results: one scenario that an algorithm requested."""

    algorithm: str  # name of the algorithm
    run: int  # number of the algorithm's run, from 0
    seed: int  # seed of the run
    generation: int  # of the main search, from 0
    local_generation: int  # of a local search, from 1; 0 in the main search
    index: int  # index in the generation, from 0
    scenario: str  # id of the scenario
    duplicate: bool  # True if the scenario was not simulated, because an earlier one of this search shows the result
    outcome: str  # how the run ended
    duration: float  # duration of the run [s]
    clock: float  # simulated time of the search until the end of the run [s]; duplicates take no time
    failing: bool  # whether the run counts as a failure, by the blame of the comparison
    collision_time: float | None  # time of the collision [s]; without a collision it and the next five are empty
    npc: int | None  # index of the NPC that collided
    cell: int | None  # cell of that NPC; empty if it crossed the ego's way
    zone: str | None  # zone in which that NPC crossed, such as ``crossing from the left``; otherwise empty
    side: str | None  # side of the ego that was hit
    closing_speed: float | None  # closing speed at the impact [m/s]
    responsibility: str  # by :func:`~pytest_pafot.attribution.responsibility.rss_rule`; ``none`` without a collision
    position_responsibility: str  # by the rule of the authors' code
    signature: str | None  # identity of a collision or of an ADS error; otherwise empty
    fitness: float | None  # the number that the search maximised; empty if there is none
    genes_started: int  # started genes of all NPCs
    genes_reached: int  # number of started genes whose cell or lane was reached
    executed: str  # the scenario as driven, in canonical text


COLUMNS = tuple(field.name for field in fields(Row))


def text_of(rows: Iterable[Row]) -> str:
    """Format rows as CSV."""
    return csv_text(COLUMNS, map(astuple, rows))


UNBOUNDED = 10**9  # generations of a run with a time budget

COLLISION = Failure(kind="AssertionError", assertion="not run.collision")
"""The failure of a test that forbids collisions; its signature tells different collisions apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunFacts:
    """Facts about a run that its evaluation lacks; rows and the check of the set-up need them."""

    responsibility: str
    position_responsibility: str
    signature: str | None
    zone: str | None
    error: AdsError | None


def run_all(plan: Plan, folder: Path, *, workers: int, told: TextIO, clock: Callable[[], float]) -> Path:
    """Do the runs that are not finished yet; return the file with all rows, by algorithm and run as in the plan.

    If algorithms have different scenarios, a warning says so before hours are spent on the runs.

    The arguments and the exceptions are as for :func:`run_job`.
    """
    job = ResumableJob(
        command="compare",
        noun="comparison",
        units="runs",
        tasks=plan.tasks,
        in_order=tuple((name, run) for name in plan.names for run in range(plan.runs)),
        question=plan.question,
        question_file="comparison.json",
        identities=plan.identities,
        text=partial(_text, plan),
        caution=caution([plan.ads]),
    )
    claim(job, folder)  # report an unusable folder before anything else
    if len(plan.scenarios) > 1:
        groups = "".join(f"  {', '.join(names)}: {which}\n" for which, names in plan.scenarios.items())
        told.write(f"compare: warning: {DIFFERENT}\n{groups}")
    return run_job(job, folder, workers=workers, told=told, clock=clock)


def _text(plan: Plan, task: Task, tick: Tick) -> str:
    return text_of(run_rows(plan, *task, tick))


def run_rows(plan: Plan, algorithm: str, run: int, tick: Tick = lambda share: None) -> Iterator[Row]:
    """Run one campaign of an algorithm, and yield a row for each scenario after its evaluation.

    Raises:
        RequestError: if the ADS fails for the same reason at its first decision in the whole first generation.
    """
    (world, _), factory, chosen = plan.setting(algorithm), ads_factory(plan.ads), plan.entrant(algorithm).algorithm
    seed, name = plan.run_seed(algorithm, run), plan.fitness or chosen.fitness
    # Blame affects all fitnesses except AV-Fuzzer's, which its authors used without it.
    is_steered = plan.blame != "any" and name != "av-fuzzer"
    fitness = resolve(name, responsible=is_ego_responsible if is_steered else None)
    budget = math.inf if plan.seconds is None else plan.seconds
    generations = plan.generations or UNBOUNDED
    seconds = 0.0

    with runner_here(world, factory) as runner:

        def evaluate(scenario: Scenario) -> Evaluation:
            nonlocal seconds
            trace = runner.run(scenario)
            seconds += trace.duration
            return evaluated(trace, fitness, plan.blame, world)

        events = run_campaign(
            plan.made(algorithm),
            evaluate,
            generations=generations,
            seed=seed,
            stop=lambda: seconds >= budget,
            foresee=runner.announce,
        )
        first: list[Evaluation] = []
        for event in events:
            if isinstance(event, GenerationFinished) and first:
                check_set_up(world, factory, first)
                first.clear()
            if isinstance(event, Evaluated):
                if event.generation == 0 and event.local_generation == 0:
                    first.append(event.evaluation)
                tick(max(event.generation / generations, seconds / budget))
                yield row_of(event, algorithm=algorithm, run=run, seed=seed, clock=seconds)
    tick(1.0)


def evaluated(trace: Trace, fitness: Fitness, blame: str, world: WorldLike) -> Evaluation:
    """Evaluate a run by who is responsible for its collision; the evaluation's note has its :class:`RunFacts`.

    The text of a signature begins with readable words, and two texts are equal only if the signatures are equal.
    """
    run, signature, mistake = Run(trace, world=reference_world(world)), None, None
    failure = ads_failure(run) or (COLLISION if run.collision is not None else None)
    if failure is not None:
        found = of_failure(run, failure)
        mistake = found.mistake
        signature = f"{mistake or found.slug}-{hashlib.sha256(repr(found).encode()).hexdigest()[:6]}"
    responsibility = run.attribution.responsibility
    is_blamed = blame == "any" or responsibility in ("ego", "both")
    failing = trace.outcome in (Outcome.ADS_ERROR, Outcome.HANG) or (trace.outcome is Outcome.COLLISION and is_blamed)
    if failing and run.collision is not None and blame == "preventable":
        failing = bool(run.preventable_by)
    evaluation = Evaluation.of(
        trace,
        fitness=fitness(trace),
        failing=failing,
        kind=signature if failing else None,
        mistake=mistake if failing else None,
    )
    facts = RunFacts(
        responsibility=responsibility,
        position_responsibility=position_rule(trace),
        signature=signature,
        zone=None if run.collision is None else event_of(run, failure).zone,
        error=trace.error,
    )
    return replace(evaluation, note=facts)


def row_of(event: Evaluated, *, algorithm: str, run: int, seed: int, clock: float) -> Row:
    """Return the row for an event whose evaluation has :class:`RunFacts`."""
    evaluation, hit = event.evaluation, event.evaluation.collision
    facts: RunFacts = evaluation.note
    return Row(
        algorithm=algorithm,
        run=run,
        seed=seed,
        generation=event.generation,
        local_generation=event.local_generation,
        index=event.index,
        scenario=evaluation.scenario.id,
        duplicate=event.reused,
        outcome=str(evaluation.outcome),
        duration=evaluation.duration,
        clock=clock,
        failing=evaluation.failing,
        collision_time=None if hit is None else hit.time,
        npc=None if hit is None else hit.npc,
        cell=None if hit is None or hit.cell is None else int(hit.cell),
        zone=facts.zone,
        side=None if hit is None else hit.side,
        closing_speed=None if hit is None else hit.closing_speed,
        responsibility=facts.responsibility,
        position_responsibility=facts.position_responsibility,
        signature=facts.signature,
        fitness=evaluation.fitness if math.isfinite(evaluation.fitness) else None,
        genes_started=evaluation.genes_started,
        genes_reached=evaluation.genes_reached,
        executed=evaluation.executed.canonical(),
    )


def check_set_up(world: WorldLike, factory: Callable[..., Any], first: Sequence[Evaluation]) -> None:
    """Check in the first generation that the ADS drives at all: an error of the set-up says nothing about algorithms.

    Raises:
        RequestError: if the ADS failed for the same reason at its first decision in all runs.
    """
    error: AdsError | None = first[0].note.error
    causes = {first_decision_cause(each.note.error) for each in first}
    if error is None or len(causes) > 1 or None in causes:
        return
    place = error.traceback.rfind("  File ")
    where = f"\n{error.traceback[place:].rstrip()}" if place >= 0 else ""
    asked, given = None if is_vehicle_class(factory) else first_decision(world, first[0].scenario), ""
    if asked is not None:
        others = (
            "A policy of a highway-env environment needs that environment, such as --env highway-v0."
            if asked.is_si
            else "With --env the environment has its default configuration, because config= cannot be given; a planner "
            "in SI units needs the road without --env."
        )
        given = f"{asked.text} {others}"
    raise RequestError(
        f"--ads: expected a policy that drives, received {error.kind}: {error.message}{where}\n\n"
        f"This happened in all {len(first)} runs of the first generation, at the first decision: it is an error of the "
        "set-up, which says nothing about the algorithms. Correct the ADS, its factory, or the world that it drives in "
        f"(--env and the options after it), and run the command again.\n\n{given}".rstrip()
    )
