"""The summary of a search, made from its state and its findings after the last run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

from pytest_pafot.searches.bench import Bench, left_out_text
from pytest_pafot.searches.events import KINDS, Ending, Paired, Search
from pytest_pafot.searches.harness import Harness
from pytest_pafot.searches.options import RUNS
from pytest_pafot.searches.results import Counts, State
from pytest_pafot.searches.store import Store
from pytest_pafot.support.errors import flag
from pytest_pafot.support.text import capitalised

# The endings after which there are enough runs for health warnings.
WITH_WARNINGS = Ending.GENERATIONS, Ending.RUNS, Ending.MAX_TIME


def summary_of(
    reason: Ending,
    *,
    node_id: str,
    state: State,
    bench: Bench,
    store: Store,
    paired: Paired | None,
    driver_notes: Sequence[str],
    process_notes: Sequence[str],
) -> Search:
    """Return the summary of a search that ended for a reason.

    Args:
        reason: why the search ended.
        node_id: the node id of the search.
        state, bench, store: the parts of the search.
        paired: the comparison with a reference, if there was one.
        driver_notes: notes on drivers and slow runs.
        process_notes: notes on processes, for the terminal.
    """
    harness = bench.harness
    settings = harness.request.settings
    counts = state.counts
    # The plan counts complete generations, but reports them only at its end.
    generations = state.generation
    if state.finished is not None:
        generations = state.finished.generations
    budgets = {"generations": settings.generations, "runs": settings.runs}
    decisions = {
        "search": counts.decisions,
        "confirm": bench.confirm_decisions,
        "shrink": state.shrink_decisions,
        "moment": state.moment_decisions,
    }
    more_runs = {
        "shrink": state.shrink_runs,
        "moment": state.moment_runs,
        "known": counts.health.reused,
    }
    return Search(
        node_id=node_id,
        reason=reason,
        algorithm=harness.request.algorithm.name,
        base_seed=settings.seed,
        seed=store.seed,
        generations=generations,
        asked={name: most for name, most in budgets.items() if most is not None},
        kinds=Counter({kind: counts.kinds[kind] for kind in KINDS}),
        outcomes=counts.outcomes,
        responsibilities=counts.responsibilities,
        more_runs=Counter(more_runs),
        decisions=Counter(decisions),
        random=_random_runs(reason, state),
        no_interaction=counts.health.no_interaction,
        reached=counts.health.reached_share,
        finds=tuple(replace(each, alike=state.alike(each.id)) for each in store.findings.values()),
        known=dict(state.covered),
        failures=tuple((id_, signature) for signature, id_ in state.failures.items()),
        drawn="" if state.space is None else state.space.described,
        against=harness.against_name,
        paired=paired,
        no_worse=store.dismissed,
        warnings=state.warnings(harness) if reason in WITH_WARNINGS else (),
        notes=(*driver_notes, *_notes(reason, state, bench, store)),
        seconds=state.seconds,
        process_notes=tuple(process_notes),
    )


def _random_runs(reason: Ending, state: State) -> Counter[str]:
    # After an error, the counts show nothing about the ego. If the search stops at a failure, its failure rate is too
    # high.
    fails = Counter[str]()
    if state.is_random and reason not in (Ending.ERROR, Ending.FINDINGS):
        fails = state.counts.fails
    return Counter(
        runs=fails.total(),
        at_fault=fails["ego"],
        otherwise=fails["check"] + fails["otherwise"],
        checks=fails["check"],
    )


def _notes(reason: Ending, state: State, bench: Bench, store: Store) -> Iterator[str]:
    harness = bench.harness
    health = state.counts.health
    # In this order, from what concerns the result to what concerns only its cost.
    notes = [
        state.counts.doubt,
        state.known_alone,
        _unused_roads(state, harness),
        _options_without_effect(state, harness),
    ]
    if state.runs and not harness.policy.drives_itself:
        notes.append(left_out_text(harness.world))
    # A warning about the same runs says more.
    if reason in WITH_WARNINGS and not health.hides_most:
        notes.append(health.early_ends)
    if state.runs:
        notes.append(harness.policy.loading_hint)
    yield from filter(None, notes)
    for signature, id_ in state.finds.items():
        if signature.worse_than is not None:
            most, known = bench.examiner.accepted[replace(signature, worse_than=None)]
            yield f"{id_} is worse than saved-{known}, which was accepted for impacts at up to {most:.1f} m/s"
    if reason is Ending.MAX_TIME:
        yield f"{reason} ended the search, so the same seed may find other failures"
    yield from _left_undone(reason, state.counts, bench, store)


def _options_without_effect(state: State, harness: Harness) -> str:
    lane = harness.request.space.get("ego_lane")
    if not state.runs:  # without a run, it is unclear whether the environment can be built
        return ""
    # What has an effect depends on who drives and on who simulates.
    given = harness.world.options_without_effect(
        drives_itself=harness.policy.drives_itself, simulates=harness.policy.simulates
    )
    given.pop(f"write ego_lane={lane!r}", None)  # the test specifies it already
    told = [f"{', '.join(names)} ({why})" for why, names in given.items() if names]
    if not told:
        return ""
    return f"these options of config= have no effect in a search: {'; '.join(told)}"


def _unused_roads(state: State, harness: Harness) -> str:
    # Without an NPC on other paths, the search shows nothing about traffic there.
    world = harness.world
    # For example the roads of a junction from which no NPC comes with these arguments.
    unused = world.unused_roads
    crosses = state.space is not None and state.space.zones
    if not unused or not state.runs or crosses:
        return ""
    verbs = {"crosses": "crosses", "joins": "joins", "oncoming": "comes towards"}
    none = " or ".join(f"{verb} it" for meeting, verb in verbs.items() if meeting in unused)
    where = getattr(world, "env_id", type(world).__name__)
    which = f"at {where}, all NPCs drive along the ego's path and none {none}"
    return f"{which}, so the search shows nothing about such traffic"


def _left_undone(reason: Ending, counts: Counts, bench: Bench, store: Store) -> Iterator[str]:
    request = bench.harness.request
    settings = request.settings
    left = []
    for each in store.findings.values():
        # After an interrupt, no finding states why it is not simplified.
        is_left = each.finding.shrunk is None if reason.is_broken_off else bool(each.unshrunk)
        if each.is_firm and is_left:
            left.append(each)
    is_limited = bench.budget.is_at_limit and not reason.is_broken_off
    if left and not is_limited and settings.shrink_runs != 0:
        what = "1 new finding was"
        if len(left) > 1:
            what = f"{len(left)} new findings were"
        first = ""
        if any(each.path for each in left):
            first = "delete the new files, and "
        again = capitalised(f"{first}search again with {request.option('seed', settings.seed)}")
        if reason.is_broken_off:
            yield f"the search ended before {what} simplified. {again}"
        else:
            yield f"{Ending.MAX_TIME} ended the search before {what} simplified. {again} and more time"
    if bench.budget.is_at_limit:
        more = f"delete the file, and search again with {flag('shrink_runs')}=N"
        yield f"simplifying stopped at its limit. To simplify further, {more}"
    # A short search that found something has done its work.
    found_nothing = not counts.kinds["failed"] and not store.count
    if settings.runs == RUNS and reason is Ending.RUNS and found_nothing:
        longer = request.option("runs", 10 * RUNS)
        yield f"a search with {RUNS} runs is short. Use {longer} for a longer one"
