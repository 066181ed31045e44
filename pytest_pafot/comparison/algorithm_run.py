"""One run of one algorithm: a campaign without pytest, told as rows."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from pytest_pafot.attribution.near_misses import near_misses
from pytest_pafot.attribution.responsibility import Fault, is_ego_responsible, position_rule
from pytest_pafot.comparison.plan import Plan, ads_factory, world_of
from pytest_pafot.comparison.rows import Row
from pytest_pafot.comparison.setup_fault import check_set_up
from pytest_pafot.findings.finding import ads_failure, of_failure
from pytest_pafot.findings.signature import Failure, Signature
from pytest_pafot.run import Run
from pytest_pafot.scenario import Scenario
from pytest_pafot.searching import AlgorithmClass, Evaluation, run_campaign
from pytest_pafot.searching.events import Evaluated, GenerationFinished
from pytest_pafot.searching.fitness import Fitness, resolve
from pytest_pafot.searching.space import SearchSpace
from pytest_pafot.trace import AdsError, Outcome, Trace

UNBOUNDED = 10**9
"""Generations of a run whose budget is a time."""

COLLISION = Failure(kind="AssertionError", assertion="not run.collision")
"""The failure of a property that forbids collisions, under which collisions are told apart."""

Tick = Callable[[float], None]
"""Told the share of a run that is done, 0 to 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What the rows need to know of a run beyond its evaluation."""

    responsibility: str
    position_responsibility: str
    signature: str | None
    fault: Fault | None
    error: AdsError | None


@dataclass(slots=True)
class Simulator:
    """Simulates and judges scenarios, and counts the simulated time.

    Attributes:
        rollout: a scenario's trace.
        fitness: of a trace.
        blame: ``any`` or ``ego``.
        asks_for_near_misses: whether the algorithm reads what the ego nearly had to answer for.
        seconds: simulated so far [s].
    """

    rollout: Callable[[Scenario], Trace]
    fitness: Fitness
    blame: str
    asks_for_near_misses: bool = False
    seconds: float = 0.0

    def evaluate(self, scenarios: Sequence[Scenario]) -> list[Evaluation]:
        """The evaluations that a campaign asks for."""
        return [self._one(scenario) for scenario in scenarios]

    def _one(self, scenario: Scenario) -> Evaluation:
        trace = self.rollout(scenario)
        self.seconds += trace.duration
        facts = facts_of(trace)
        is_fault = trace.outcome in (Outcome.ADS_ERROR, Outcome.HANG)
        is_blamed = self.blame == "any" or facts.responsibility in ("ego", "both")
        failing = is_fault or (trace.outcome is Outcome.COLLISION and is_blamed)
        evaluation = Evaluation.of(
            trace,
            fitness=self.fitness(trace),
            failing=failing,
            kind=facts.signature if failing else None,
            fault=facts.fault if failing else None,
            near_misses=near_misses(trace) if self.asks_for_near_misses else (),
        )
        return replace(evaluation, note=facts)


def run_rows(plan: Plan, algorithm: str, run: int, tick: Tick = lambda share: None) -> Iterator[Row]:
    """Simulate one run, row by row as its scenarios are evaluated.

    Raises:
        PlanError: where the ADS fails alike at its first decision in the whole first generation.
    """
    world, factory, chosen = world_of(plan), ads_factory(plan.ads), plan.algorithm(algorithm)
    seed = plan.run_seed(algorithm, run)
    simulator = Simulator(
        rollout=lambda scenario: world.rollout(scenario, factory),
        fitness=_fitness(plan, chosen),
        blame=plan.blame,
        asks_for_near_misses=plan.blame == "ego" and chosen.reads_near_misses,
    )
    budget = math.inf if plan.seconds is None else plan.seconds
    generations = plan.generations or UNBOUNDED
    events = run_campaign(
        chosen.make(SearchSpace(**plan.space), **plan.parameters),
        simulator.evaluate,
        generations=generations,
        seed=seed,
        stop=lambda: simulator.seconds >= budget,
    )
    first: list[Evaluation] = []
    for event in events:
        if isinstance(event, GenerationFinished) and first:
            check_set_up(world, factory, first[0].scenario, [each.note.error for each in first])
            first.clear()
        if isinstance(event, Evaluated):
            if event.generation == 0 and event.local_generation == 0:
                first.append(event.evaluation)
            tick(max(event.generation / generations, simulator.seconds / budget))
            yield row_of(event, algorithm=algorithm, run=run, seed=seed, clock=simulator.seconds)
    tick(1.0)


def row_of(event: Evaluated, *, algorithm: str, run: int, seed: int, clock: float) -> Row:
    """The row of an event whose evaluation has facts."""
    evaluation, hit = event.evaluation, event.evaluation.collision
    facts: Facts = evaluation.note
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
        cell=None if hit is None else int(hit.cell),
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


def facts_of(trace: Trace) -> Facts:
    """Who is responsible for a run's collision, and which failure the run shows."""
    run = Run(trace)
    failure = ads_failure(run) or (COLLISION if run.collision is not None else None)
    return Facts(
        responsibility=run.attribution.responsibility,
        position_responsibility=position_rule(trace),
        signature=None if failure is None else signature_text(of_failure(run, failure)),
        fault=run.attribution.fault,
        error=trace.error,
    )


def signature_text(signature: Signature) -> str:
    """A text that is equal exactly for equal signatures, and can be read."""
    return f"{signature.slug}-{hashlib.sha256(repr(signature).encode()).hexdigest()[:6]}"


def _fitness(plan: Plan, algorithm: AlgorithmClass) -> Fitness:
    """Of the plan, or the algorithm's own. Blame steers all but AV-Fuzzer's, which its authors did not steer."""
    name = plan.fitness or algorithm.fitness
    is_steered = plan.blame == "ego" and name != "av-fuzzer"
    return resolve(name, responsible=is_ego_responsible if is_steered else None)
