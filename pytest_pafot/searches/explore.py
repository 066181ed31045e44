"""Searches without pytest, for scripts and comparisons."""

from __future__ import annotations

import hashlib
import math
import os
import tempfile
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NoReturn, Unpack

from pytest_pafot.algorithms.catalogue import AlgorithmClass, RandomSearch
from pytest_pafot.algorithms.evaluation import Evaluated
from pytest_pafot.algorithms.fitness import resolve
from pytest_pafot.algorithms.plan import Algorithm
from pytest_pafot.algorithms.space import SearchSpace
from pytest_pafot.corpus.layout import folder_of_test, link_below, refusal
from pytest_pafot.findings.finding import Finding, ads_failure, event_of, signature_of_failure
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.findings.verdict import Failure, Verdict
from pytest_pafot.oracle.run import Run
from pytest_pafot.searches import run_table
from pytest_pafot.searches.events import Listener, Search, SearchEvent
from pytest_pafot.searches.harness import Harness, reference_of, source_file
from pytest_pafot.searches.options import BY_NAME, OPTIONS, RUNS, Settings
from pytest_pafot.searches.replays import Replays
from pytest_pafot.searches.request import (
    CommonArguments,
    Request,
    SearchArguments,
    build_world,
    check_names,
    checked_request,
)
from pytest_pafot.searches.run_table import RunTable
from pytest_pafot.searches.search_session import Events, SearchSession, prepared
from pytest_pafot.support import monotonic
from pytest_pafot.support.errors import RequestError, check_asserts
from pytest_pafot.support.process import installed_versions
from pytest_pafot.world import Highway
from pytest_pafot.world.base_world import BaseWorld
from pytest_pafot.world.driving.policy import AdsFactory, Policy

PLACE = "pafot.explore"


class ExploreArguments(CommonArguments, total=False):
    """The types of the settings of :func:`explore`."""

    # options of a pytest session, which a script does not have
    corpus: str | os.PathLike[str]
    max_time: float | None
    stop_after: int | None
    workers: int | Literal["auto"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exploration:
    """The result of :func:`explore`.

    Attributes:
        findings: all distinct new failures, shrunk, each with the trace of a run that shows it.
        summary: the summary of the search, with runs, warnings and notes.
        events: the events of the algorithm and of the search, in order.
        runs: a row for each scenario, with the columns of ``run_table.COLUMNS``, for ``pandas.DataFrame(...)``.
    """

    findings: tuple[Finding, ...]
    summary: Search
    events: tuple[SearchEvent, ...] = field(repr=False)
    runs: tuple[dict[str, Any], ...] = field(repr=False)

    @property
    def sightings(self) -> tuple[Seen, ...]:
        """The last event about each finding, in the order of discovery."""
        last = {event.finding.id: event for event in self.events if isinstance(event, Seen)}
        return tuple(last[finding.id] for finding in self.findings)


def explore(
    ads: AdsFactory | str,
    *,
    holds: Callable[[Run], None],
    world: BaseWorld | str | None = None,
    runs: int | None = None,
    generations: int | None = None,
    seed: int = 0,
    node_id: str = "",
    on_event: Listener | None = None,
    **settings: Unpack[ExploreArguments],
) -> Exploration:
    """Search, without pytest, for scenarios in which a property fails.

    A search with the same node id, base seed and arguments as a test leads to the same findings.

    Args:
        ads: the factory, which is called once per run, a string ``module:factory[:argument]``, or a highway-env
            vehicle class.
        holds: the property: a function that receives a :class:`~pytest_pafot.oracle.run.Run` and asserts, like a
            test function. With several workers, it is called in their processes.
        world: the world, such as ``pafot.World("highway-v0")``, or a name such as ``"module:factory"``; by default
            ``pafot.Highway()``.
        runs: number of runs after which the search ends; by default 100 if ``generations`` is not given.
        generations: number of generations after which the search ends.
        seed: the base seed. The seed of the search is derived from it and from the node id.
        node_id: node id of the corresponding test, without ``[search]``; by default made from ``holds``.
        on_event: function that receives the search's events as they happen.
        settings: other arguments of ``@pafot.search``, and the options ``corpus``, ``max_time``, ``stop_after`` and
            ``workers``. With ``corpus=``, findings are saved below that folder, and failures that are already saved
            there do not count as new. Without it, no finding is saved.

    Raises:
        RequestError: if an argument is wrong, if assertions are disabled, or if nothing was found and most runs
            tested nothing.
        Exception: if every run of the first generation ends in the same exception, unless it is an assertion.
    """
    # With `python -O`, the property would assert nothing, and every search would pass.
    check_asserts(holds)
    budget = {
        "runs": RUNS if runs is None and generations is None else runs,
        "generations": generations,
    }
    request = request_of({"ads": ads, "world": world, "seed": seed, **budget, **settings})
    # The node id is part of the seed, so two properties of one script search different scenarios.
    name = node_id or f"explore.py::{getattr(holds, '__name__', 'holds')}"
    events: list[SearchEvent] = []
    table = RunTable()

    with tempfile.TemporaryDirectory(prefix="pafot-") as scratch:
        replays = replays_of(request, holds, name, Path(scratch))
        now = monotonic()
        with prepared(replays.harness, note=run_table.note_of) as parts:
            max_time = request.settings.max_time
            limit = math.inf if max_time is None else now + max_time
            session = SearchSession(
                watch=parts.watch(name, limit, progress_seconds=0.5), replays=replays
            )
            happens = Events(session.run())
            # An exception of the listener leaves the inner loop. The search then still reports what it
            # has found.
            while not happens.is_over:
                with happens:
                    for event in happens:
                        table.see(event)
                        events.append(event)
                        if on_event is not None:
                            on_event(event)
    result = happens.result
    # Only now, so that the temporary folder is removed and all processes have ended.
    if result.fault is not None:
        raise result.fault
    # A search that tested nothing must not look like one that found nothing.
    if result.is_vacuous and not result.count and request.settings.is_search:
        told = " Also, ".join(result.summary.warnings)
        raise RequestError(f"{PLACE}: expected runs that test the policy, but {told}")
    # The trace is kept only in memory, so a script can look at the run without repeating it.
    findings = tuple(
        replace(each.finding, trace=None if each.run is None else each.run.trace)
        for each in result.findings
    )
    return Exploration(
        findings=findings, summary=result.summary, events=tuple(events), runs=tuple(table.rows)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class AlgorithmRun:
    """One run of a search algorithm, for comparisons of algorithms.

    It evaluates scenarios as :func:`explore` does, but neither confirms nor shrinks findings.

    Attributes:
        algorithm: the algorithm.
        ads: the factory of the policy.
        holds: the property, as for :func:`explore`.
        world, space: the world, and the scenarios that the algorithm samples.
        blame, fitness: as for :func:`explore`, but the default fitness is the algorithm's own.
        seed: the seed that the algorithm itself uses, unlike the base seed of :func:`explore`.
        generations: number of generations after which the run ends. For a random search, a generation is as many
            runs as the paper's population.
        seconds: simulated time [s] after which no scenario starts.

    Raises:
        ValueError: if the algorithm does not support the space, or if the fitness does not exist.
        RequestError: if another argument is wrong.
    """

    COLUMNS: ClassVar[Mapping[str, str]] = MappingProxyType({
        **{name: meaning for name, meaning in run_table.COLUMNS.items() if name not in ("test", "run")},
        "index": "index in the generation, counted from 0",
        "clock": "simulated time from the start of the search to the end of the run [s]; reused results take no time",
        "cell": "cell of the NPC in the collision; empty if the NPC crossed the ego's path",
        "zone": "zone in which that NPC crossed, such as `crossing from the left`; otherwise empty",
        "position_responsibility": "who is responsible according to the rule in the authors' code",
        "signature": "identity of a collision, even of one that is no failure, or of an ADS error; otherwise empty",
        "genes_started": "number of genes that started, over all NPCs",
        "genes_reached": "number of these genes whose target was reached",
        "executed": "the scenario as executed, as a canonical string",
        "ended": "what ended the run early, without a collision; otherwise empty",
    })  # fmt: skip
    """The columns of :meth:`rows`, with their meanings."""

    algorithm: AlgorithmClass
    ads: Callable[..., Any]
    holds: Callable[[Run], None]
    world: Any
    space: SearchSpace
    seed: int
    blame: str = "any"
    fitness: str | None = None
    generations: int = 10**9
    seconds: float = math.inf

    def __post_init__(self) -> None:
        self._made()
        # Raises a ValueError for an unknown name. The search itself would report it as a RequestError.
        if self.fitness is not None:
            resolve(self.fitness)

    def _made(self) -> Algorithm[Any] | RandomSearch:
        return self.algorithm.make(self.space)

    def rows(self) -> list[run_table.Row]:
        """Run the algorithm, and return a row for each requested scenario.

        Raises:
            SetupFaultError: if the ADS always fails in the same way at its first decision.
        """
        # The class and not the name, because a comparison can contain algorithms of the user.
        given = {"ads": self.ads, "world": self.world, "algorithm": self.algorithm.made_by}
        request = request_of({**given, "fitness": self.fitness, "blame": self.blame})
        table, seconds = RunTable(seed=self.seed), 0.0
        # Otherwise, the same number of generations would be more scenarios for one algorithm than for
        # another.
        runs = POPULATION * self.generations if self.algorithm.draws_by_number else None

        def see(event: Any) -> None:
            nonlocal seconds
            table.see(event)
            if isinstance(event, Evaluated):
                evaluation = event.evaluation
                seconds += 0.0 if event.reused else evaluation.duration
                table.rows[-1] |= {
                    "index": event.index,
                    "clock": seconds,
                    "genes_started": evaluation.genes_started,
                    "genes_reached": evaluation.genes_reached,
                    "executed": evaluation.executed.canonical(),
                    "ended": evaluation.ended or None,
                }

        with tempfile.TemporaryDirectory(prefix="pafot-") as scratch:
            harness = replays_of(request, self.holds, "compare", Path(scratch)).harness
            # Blame affects all fitnesses except AV-Fuzzer's, which its authors used without blame.
            is_steered = request.fitness != "av-fuzzer"
            with prepared(harness, space=self.space, is_steered=is_steered, note=_note_of) as parts:
                events = parts.search(
                    self._made(),
                    generations=self.generations,
                    runs=runs,
                    seed=self.seed,
                    stop=lambda: seconds >= self.seconds,
                )
                # The loop can be left by an exception, and processes must end all the same.
                with closing(events):
                    for event in events:
                        see(event)
        return table.rows


# The number of scenarios in a generation of the paper's algorithm, and of a random search in a comparison.
POPULATION = 4

# The failure for the signatures of all collisions in an AlgorithmRun, including those that its property accepts.
COLLISION = Failure(kind="AssertionError", assertion="not run.collision")


def _note_of(run: Run, verdict: Verdict) -> run_table.Row:
    # The note of an evaluation, with the columns that only an AlgorithmRun has.
    hit, signature = run.collision, None
    failure = ads_failure(run) or (None if hit is None else COLLISION)
    if failure is not None:
        found = signature_of_failure(run, failure)
        # The string starts with readable words. Two strings are equal only if the signatures are equal.
        signature = (
            f"{found.mistake or found.slug}-{hashlib.sha256(repr(found).encode()).hexdigest()[:6]}"
        )
    return run_table.note_of(run, verdict) | {
        "cell": None if hit is None or hit.cell is None else int(hit.cell),
        "zone": None if hit is None else event_of(run, failure).zone,
        "position_responsibility": None if hit is None else run.second_opinion or "none",
        "signature": signature,
    }


def request_of(given: dict[str, Any]) -> Request:
    """Build and check the request for a search with some arguments of :func:`explore`."""
    known = {**SearchArguments.__annotations__, **ExploreArguments.__annotations__}
    for name in given:
        if name in BY_NAME and name not in known:
            raise RequestError(
                f"{PLACE}({name}=...): expected an argument of a search without pytest, received one that only works "
                "with pytest. Remove it"
            )
    check_names(
        [name for name in given if name not in ExploreArguments.__annotations__], place=PLACE
    )
    values: dict[str, Any] = {each.name: each.default for each in OPTIONS}
    values |= {"corpus": "", "save": "new" if given.get("corpus") else "none"}
    # In a fixed order, so that of several mistakes always the same one is reported.
    for name in sorted(given.keys() & values.keys()):
        try:
            values[name] = None if given[name] is None else BY_NAME[name].read(given[name])
        except RequestError as error:
            raise RequestError(f"{PLACE}({name}=...): {error}") from None
    return checked_request(given, Settings(**values), place=PLACE)


def replays_of(
    request: Request, holds: Callable[[Run], None], node_id: str, scratch: Path
) -> Replays:
    """Return the replays for a search without pytest, including its harness."""
    if isinstance(request.ads, str):
        raise request.error(
            "ads", f"expected a factory such as `lambda: MyPlanner()`, received {request.ads!r}"
        )
    settings, (module, _, test) = request.settings, node_id.partition("::")

    def fixture(name: str) -> NoReturn:
        raise request.error(
            "against", f"expected a factory, or its name as module:factory, received {name!r}"
        )

    # Without a corpus, findings are not saved, but the search and its replays need the folder where they would be.
    corpus = Path.cwd() / settings.corpus if settings.corpus else scratch / "corpus"
    folder = folder_of_test(Path(module), test, str(corpus), Path())
    # Files are written and removed in this folder, and a link may lead to files of someone else.
    link = link_below(corpus, folder)
    if link is not None:
        raise request.error("corpus", refusal(link))
    policy, world = Policy(request.ads), build_world(request, Highway())
    harness = Harness(
        request=request,
        world=world,
        policy=policy,
        test=holds,
        test_file=source_file(holds),
        node_id=node_id,
        saved_node_id=lambda id_: (
            f"{node_id.removesuffix(']')}{'-' if node_id.endswith(']') else '['}saved-{id_}]"
        ),
        folder=folder,
        records=scratch / "records",
        root=Path.cwd(),
        versions=installed_versions(world.packages),
        against=reference_of(settings.against, fixture, policy),
        needs_only_run=True,
    )
    return Replays(harness=harness)
