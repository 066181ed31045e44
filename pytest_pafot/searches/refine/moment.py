"""The last decision that could have avoided a failure, and the conditions in the policy's code."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

from pytest_pafot.execution.runner import runner_for
from pytest_pafot.findings.decisions import (
    PARTS,
    Moment,
    deciding,
    differ,
    differing_parts,
    is_planners,
    moved_over,
    parts_of,
    placed,
    seen_of,
    text_of_any,
    vehicle_of,
)
from pytest_pafot.findings.shrink import OutOfBudget
from pytest_pafot.findings.sighting import Seen
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.model.trace import Trace
from pytest_pafot.searches.bench import Bench
from pytest_pafot.searches.events import Phase, Refining
from pytest_pafot.searches.harness import refusals
from pytest_pafot.searches.results import State
from pytest_pafot.support.errors import RequestError
from pytest_pafot.support.references import source_files
from pytest_pafot.world.driving.conditions import (
    Conditions,
    Parted,
    differing_numbers,
    group_conditions,
    parting,
)
from pytest_pafot.world.driving.policy import Aside, Policy, Question, beside, changed, without
from pytest_pafot.world.guard.chance import GENERATORS
from pytest_pafot.world.kernel.action import (
    checked_si_action,
    possible_acceleration,
    possible_steering,
)
from pytest_pafot.world.kernel.observation import Observation

# A function that calls a new policy during a run, without affecting the run. Its arguments are an NPC to hide in the
# complete run, or None, and a question about one decision, or None. It returns None if it cannot change an observation.
Ask = Callable[..., Refining[Aside | None]]

Additions = tuple[float, float, float]  # offsets of a vehicle's x [m], y [m] and speed [m/s]
# a change of a vehicle, in words and as offsets; None hides the vehicle
Change = tuple[str, Additions | None]

MANY = 1_000_000  # more lanes than any road has, since the run has already checked its actions

# The offset of positions [m] and speed [m/s] that shows which conditions depend on a vehicle. It is so small that the
# result of almost no condition changes.
NUDGE = 0.01
# Two decisions are different if they differ by at least this acceleration [m/s^2] or steering angle [rad].
LITTLE = {"acceleration": 1.0, "steering": 0.05}
# The functions that limit parts of a planner's decision to what an ego can do.
POSSIBLE = {"acceleration": possible_acceleration, "steering": possible_steering}


def with_moment(sighting: Seen, state: State, bench: Bench) -> Refining[Seen]:
    """Return a finding with the last decision that could have avoided the failure."""
    harness, run, expect = bench.harness, sighting.run, sighting.finding.expect
    # Nothing can be hidden from a vehicle class, which reads the road itself, or from a policy with the environment.
    # A saved finding of a process that died has no run either.
    if run is None or not harness.policy.only_observes:
        return sighting
    # With a reference, the moment is the first decision that differs from the reference's.
    if (
        harness.against is not None
        and (moment := _first_difference(run.trace, state, bench)) is not None
    ):
        return replace(sighting, moment=moment)
    trace, npc, number = run.trace, vehicle_of(run, expect), deciding(run, expect)
    # Without a vehicle to change, no decision can be shown to matter.
    if npc is None or number is None or not trace.actions:
        return sighting
    ask = partial(_decided_aside, sighting, trace, state, bench)
    # The run is simulated again with its recorded actions. New policies decide at the same time, once with the complete
    # observations and once without the vehicle.
    whole = yield from ask(None, Question(number=number))
    # A new policy must decide as in the recorded run. Otherwise, a difference would not be due to the vehicle.
    if whole is None or any(
        differ(action, whole.action_at(each)) for each, action in enumerate(trace.actions)
    ):
        return sighting
    # The decision in which the vehicle is invisible to the policy from the first tick on.
    without_it = None
    if harness.world.hides:  # otherwise, only the decision is reported
        without_it = yield from ask(npc, Question(number=number))
        if without_it is None:
            return sighting
    moment = yield from _moment_of(trace, npc, number, whole, without_it, ask)
    return replace(sighting, moment=moment)


def with_conditions(sighting: Seen, state: State, bench: Bench) -> Refining[Seen]:
    """Return a finding with the conditions that the policy's code evaluates in the decision of its ``moment``."""
    harness, moment, run = bench.harness, sighting.moment, sighting.run
    if moment is None or run is None:
        return sighting
    conditions = Conditions(source_files(harness.policy.factory), harness.root)
    if not conditions:
        return sighting
    trace = run.trace
    times = [round(tick / trace.physics_hz, 3) for tick in trace.decision_ticks]
    # The moment has only a time, because it is also read from JSON.
    number = times.index(moment.time)
    question = Question(number=number, conditions=conditions)
    ask = partial(_decided_aside, sighting, trace, state, bench, None)
    aside = yield from ask(question)
    if aside is None or any(
        differ(each, aside.action_at(at)) for at, each in enumerate(trace.actions[: number + 1])
    ):
        return sighting
    # Compare with a decision that perceives the vehicle in another position: where the moment reports a different
    # action or, without one, far away.
    compared: list[tuple[str, int | None, Question]] = []
    # What the new policy received, which perception may have changed.
    npc, seen = moment.npc, aside.at
    whom: dict[int, tuple[int, ...]] | None = None
    if isinstance(seen, Observation):
        # a condition is about the vehicles whose slightly different positions change its values
        whom = {}
        # In a fixed order, so that equal searches list the conditions in the same order.
        vehicles = sorted([*seen.ids, *(each.id for each in seen.crossing)])
        for other in vehicles if aside.conditions else ():
            nudged = yield from ask(replace(question, instead=_nudged(seen, other)))
            if nudged is None:
                continue
            for each in differing_numbers(aside.conditions, nudged.conditions):
                whom[each] = (*whom.get(each, ()), other)
        if npc is not None and npc in seen.ids:
            words, by = _compared(moment, _changes(seen, npc))
            compared.append(
                (f"with NPC {npc} {words}", npc, replace(question, instead=changed(seen, npc, by)))
            )
    # If that has no effect and the decision starts a change of lanes, compare with the decision before it.
    if number and number == moved_over(run):
        compared.append(
            (f"at {times[number - 1]:.1f} s", None, replace(question, number=number - 1))
        )
    first: dict[str, Parted] = {}
    for when, elsewhere, each_question in compared:
        # The first comparison that shows a deciding condition is enough.
        if not first and (asked := (yield from ask(each_question))) is not None:
            is_other = differ(trace.actions[number], asked.action_at(each_question.number))
            first = parting(
                aside.conditions,
                asked.conditions,
                when,
                is_other=is_other,
                npc=elsewhere,
                whom=whom or {},
            )
    groups = group_conditions(aside.conditions, first, npc=npc, whom=whom)
    return replace(sighting, moment=replace(moment, conditions=groups))


def _nudged(seen: Observation, npc: int) -> Observation:
    # The vehicle may be on a path that crosses the ego's path.
    if npc in seen.ids:
        return changed(seen, npc, (NUDGE, NUDGE, NUDGE))
    places = ("distance", "ego_distance", "ahead", "right", "speed")
    crossing = list(seen.crossing)
    for index, each in enumerate(crossing):
        if each.id == npc:
            nudged = {name: getattr(each, name) + NUDGE for name in places}
            crossing[index] = each._replace(**nudged)
    return seen.replace(crossing=tuple(crossing))


def _compared(moment: Moment, changes: Sequence[Change]) -> Change:
    # Return the change that the moment reports, or a large one if no change has an effect.
    # The moment has described its change in words, so the change is found by its words.
    said = moment.otherwise or ""
    furthest = next(each for each in reversed(changes) if each[0].endswith("further away"))
    if not said and moment.hidden:
        return "hidden", None
    return next((each for each in changes if each[0] and said.startswith(f"{each[0]}: ")), furthest)


def _first_difference(trace: Trace, state: State, bench: Bench) -> Moment | None:
    # Return the first decision that differs from the reference's in the same scenario.
    harness, isolate = bench.harness, bench.harness.request.settings.isolate
    bench.budget.check()
    state.moment_runs += 1
    with (
        harness.reference_runner(harness.job(), bench.record, isolate=isolate)
        or nullcontext() as runner
    ):
        assert runner is not None  # noqa: S101  (the caller has a reference)
        run, _ = harness.run_reference(runner, trace.scenario)
    bench.record.clear()
    # The reference's process died, so nothing can be compared.
    if run is None:
        return None
    decisions = zip(trace.actions, run.trace.actions, strict=False)
    for number, (own, other) in enumerate(decisions):
        if differ(own, other):
            time = round(trace.decision_ticks[number] / trace.physics_hz, 3)
            return Moment(
                time=time, npc=None, action=text_of(own, other), reference=text_of(other, own)
            )
    return None


def _decided_aside(
    sighting: Seen,
    trace: Trace,
    state: State,
    bench: Bench,
    npc: int | None,
    question: Question | None,
) -> Refining[Aside | None]:
    # Call a new policy during the run, without affecting the run.
    bench.budget.check()
    yield Phase(f"calling the policy again in {trace.executed.id}", sighting.id)
    state.moment_runs += 1
    from pytest_pafot.world.driving.environment import checked_action  # noqa: PLC0415  (it needs highway-env)

    harness, record, scenario = bench.harness, bench.record, trace.executed
    # A planner's world has no action space, and its actions are in SI units.
    space, isolate = harness.world.action_space, harness.request.settings.isolate
    check: Any = partial(checked_action, space=space)
    if space is None:
        check = partial(checked_si_action, lanes=MANY)
    if question is not None and not harness.world.hides:
        question = replace(question, is_noted=False)
    # The new policy writes its decisions here while the recorded actions drive the ego.
    aside = Aside()
    factory = beside(harness.policy.factory, trace.actions, check, aside, question)
    if npc is not None:
        factory = without(factory, npc)
    job = replace(harness.job(), policy=Policy(factory))
    try:
        with refusals(), runner_for(job, record, isolate=isolate) as runner:
            if isolate:

                def drive(scenario: Scenario, factory: Callable[..., Any]) -> Aside:
                    # The other process records the decisions in its copy, which it must send.
                    GENERATORS.run(job.world.rollout, scenario, factory)
                    return aside

                aside = runner.once_by(scenario, drive)
            else:
                runner.once(scenario)
            return aside
    # The factory may refuse to make a second policy, which is no error of the search.
    except RequestError:
        return None
    finally:
        bench.decisions_beside += aside.asked  # the runner of the search does not count them
        bench.budget.asked += aside.asked
        record.clear()


def _moment_of(
    trace: Trace, npc: int, number: int, whole: Aside, without_it: Aside | None, ask: Ask
) -> Refining[Moment]:
    seen, action = whole.at, whole.action_at(number)
    time = round(trace.decision_ticks[number] / trace.physics_hz, 3)
    if without_it is None:
        return Moment(time=time, npc=npc, was=seen_of(trace, npc, number), action=text_of(action))
    is_planner = isinstance(seen, Observation)
    # The position as the policy received it, which need not be the true one.
    where = ""
    if is_planner and npc in seen.ids:
        ego, other = seen.ego, seen.others[seen.ids.index(npc)]
        boxes = ((each.heading, each.length, each.width) for each in (ego, other))
        where = placed(other.x - ego.x, other.y - ego.y, other.speed - ego.speed, *boxes)
    elif is_planner and (crossing := [each for each in seen.crossing if each.id == npc]):
        (way,), own = crossing, (0.0, seen.ego.length, seen.ego.width)
        where = placed(
            way.ahead,
            way.right,
            way.speed - seen.ego.speed,
            own,
            (way.heading, way.length, way.width),
        )
    elif is_planner or _pickled(seen) == _pickled(without_it.at):
        where = "nowhere"
    else:
        where = seen_of(trace, npc, number)
    hidden = otherwise = None
    tries = [] if is_planner else [("", without_it.at)]
    if is_planner and npc in seen.ids:
        tries = [(words, changed(seen, npc, by)) for words, by in _changes(seen, npc)]
    for words, instead in tries:
        try:
            aside = yield from ask(None, Question(number=number, instead=instead))
        except OutOfBudget:  # Report nothing that was not tried.
            otherwise = None
            break
        # The result is valid only if the new policy decides like the run's policy until then. It may not, if it keeps
        # state of other runs in a module or a class.
        if aside is None or any(
            differ(each, aside.action_at(at)) for at, each in enumerate(trace.actions[:number])
        ):
            hidden = otherwise = None
            break
        # With all earlier decisions equal, only the changed vehicle can explain this one.
        answer = aside.action_at(number)
        if not words:
            hidden = text_of(answer, action) if differ(action, answer) else ""
            otherwise = "" if is_planner else None
        elif _is_other(action, answer):
            otherwise = f"{words}: {text_of(answer, action)}"
            break
    return Moment(
        time=time, npc=npc, seen=where, action=text_of(action), hidden=hidden, otherwise=otherwise
    )


def _pickled(seen: Any) -> Any:
    try:
        return pickle.dumps(seen)
    except Exception:  # noqa: BLE001  (a simulator's observation can be anything)
        return seen


def _is_other(action: Any, other: Any) -> bool:
    # A decision with slightly different values is the same decision.
    # Only the numbers of a planner can differ a little.
    if type(action) is not type(other) or not is_planners(action):
        return differ(action, other)
    here, there = parts_of(action), parts_of(other)

    def is_little(name: str) -> bool:
        if name not in LITTLE or here[name] is None or there[name] is None:
            return False
        return abs(POSSIBLE[name](here[name]) - POSSIBLE[name](there[name])) < LITTLE[name]

    return not all(is_little(name) for name in differing_parts(action, other))


def _changes(seen: Observation, npc: int) -> list[Change]:
    # The changes of a vehicle in words and as offsets, starting with the smallest. None hides the vehicle.
    other = seen.others[seen.ids.index(npc)]
    # A vehicle cannot be moved through the ego, so it is moved nearer by less than the gap.
    gap = other.x - seen.ego.x
    # each with its size, by which they are sorted
    found: list[tuple[float, str, Additions | None]] = [(0.0, "", None)]
    away, outwards = (1.0 if gap >= 0 else -1.0), (1.0 if other.y >= seen.ego.y else -1.0)
    for size in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        found.append((size, f"{size:g} m further away", (away * size, 0.0, 0.0)))
        if size < abs(gap):
            found.append((size, f"{size:g} m nearer", (-away * size, 0.0, 0.0)))
    for size in (0.25, 0.5, 1.0, 2.0, 4.0):
        found.append((4 * size, f"{size:g} m further to the side", (0.0, outwards * size, 0.0)))
        found.append((4 * size, f"{size:g} m less far to the side", (0.0, -outwards * size, 0.0)))
    for size in (0.5, 1.0, 2.0, 4.0, 8.0, 16.0):
        found.append((2 * size, f"{size:g} m/s faster", (0.0, 0.0, size)))
        if size <= other.speed:
            found.append((2 * size, f"{size:g} m/s slower", (0.0, 0.0, -size)))
    return [(words, by) for _, words, by in sorted(found, key=lambda each: each[0])]


def text_of(action: Any, other: Any = None) -> str:
    """Describe an action. For a planner, describe only the parts that differ from ``other`` or the defaults."""
    if action is None:
        return "no decision"
    if not is_planners(action):
        return text_of_any(action)[:80]
    parts, shown = parts_of(action), []
    for name in differing_parts(action, other):
        # A steering angle of a thousandth is not worth a word.
        least, form = PARTS.get(name, (0.0, "{}"))
        if parts[name] is None or (
            other is None and name == "steering" and abs(parts[name]) < least
        ):
            continue
        value, driven = (
            form.format(parts[name]),
            form.format(POSSIBLE.get(name, lambda same: same)(parts[name])),
        )
        limit = f", limited to {driven.split()[0]}" if driven != value else ""
        shown.append(f"{name.replace('_', ' ')} {value}{limit}")
    return ", ".join(shown)
