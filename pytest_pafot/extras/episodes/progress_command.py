"""``python -m pytest_pafot progress``: compare the new version of a policy with the old one."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import shlex
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path
from statistics import median
from typing import Any, Self

import numpy as np

from pytest_pafot import Highway, Outcome, Run, World, WorldError, explore
from pytest_pafot.extending import (
    GenerationFinished,
    Policy,
    ProcessLostError,
    Saved,
    SetupFaultError,
    Severity,
    Verdict,
    WorkerPool,
    add_world_arguments,
    ads_factory,
    base_world,
    check_drives,
    check_function,
    chosen_world,
    drawn_space,
    files_below,
    judged_runs,
    replay_saved,
    require,
    same_policy,
    sample,
)
from pytest_pafot.extras.episodes.rate import CHUNK, EpisodeRow, driven, episodic, p_text
from pytest_pafot.extras.resumable import ResumableJob, Task, Tick, run_job, worker_count
from pytest_pafot.extras.revisions.revision import PROCESS, revision_at
from pytest_pafot.extras.revisions.revision_policy import RevisionPolicy
from pytest_pafot.extras.revisions.revision_process import Served
from pytest_pafot.support.errors import AdsFactoryError, RequestError, RevisionError, command
from pytest_pafot.support.files import way_out, write_whole
from pytest_pafot.support.proportions import LEVEL, difference, holm, mcnemar
from pytest_pafot.support.references import PLANNER, REVISION, described
from pytest_pafot.support.text import ascii_text, csv_text, one_line, plural, visible, wrapped_to
from pytest_pafot.support.versions import installed_versions

# Comparison of two versions of a policy in the same situations, as values and in words.

APART = "not told apart"


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """The result of one policy in one situation."""

    failed: bool | None = None  # None if unknown
    impact: float | None = None  # closing speed of the collision that made it fail [m/s]
    margins: Mapping[str, float] = field(default_factory=dict)  # the worst of each check with a bound, of a whole run

    @classmethod
    def of(cls, run: Run, verdict: Verdict) -> Self:
        """Return the result of a policy from a run and its verdict."""
        bounded = {each.name for each in verdict.checks if set(each.bounds.values()) != {None}}
        is_whole = run.collision is None and run.ads_error is None and run.outcome != "off_road"  # nothing cut it short
        margins = {name: worst for name, worst in verdict.margins if name in bounded and math.isfinite(worst)}
        failed = None if verdict.discarded or verdict.kind == "invalid" else verdict.failed
        severity = verdict.severity
        impact = severity.value if severity is not None and severity.kind == "collision" else None
        return cls(failed=failed, impact=impact, margins=margins if is_whole else {})


MEANINGS = {"common": " (both fail)", "introduced": " (only the new fails)", "fixed": " (only the old fails)"}
"""The explanation that the summary adds to the labels of saved scenarios."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRow:
    """The results of both policies in one situation: a random scenario, an episode, a saved or a found scenario."""

    part: str  # ``scenarios``, ``episodes``, ``saved`` or ``alone``
    name: str  # a number, a seed, or the id of a finding
    old: Result
    new: Result
    told: str = ""  # an error in an episode, the label of a saved scenario, the headline of a finding
    worse: str = ""  # how much worse the failure of a saved scenario became

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> Self:
        """Return the row from the data that ``dataclasses.asdict`` made of it."""
        return cls(**{**data, "old": Result(**data["old"]), "new": Result(**data["new"])})


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparedLine:
    """A line of the table, which compares both policies in one quantity, pair by pair."""

    what: str  # quantity that is compared
    words: tuple[str, str]  # words for it if the new policy is better, and if it is worse
    old: float  # number of pairs, or the median if there is a unit
    new: float
    better: int  # pairs in which the new policy is better
    worse: int
    pairs: int
    unit: str | None = None
    p: float = 1.0  # sign test, for failures McNemar's: two-sided, exact, adjusted for the number of lines

    @property
    def verdict(self) -> str:
        """The verdict of this line on the new policy: ``better``, ``worse`` or ``not told apart``."""
        return APART if self.p > LEVEL else "better" if self.better > self.worse else "worse"

    @property
    def interval(self) -> str:
        """The 95 % interval of the new policy's share minus the old policy's, in words; empty for medians."""
        low, high = difference(self.worse, self.better, self.pairs)
        return f"{100 * low:+.1f} to {100 * high:+.1f} points" if self.unit is None else ""

    @property
    def sentence(self) -> str:
        """The difference that the line claims, or the numbers of both policies if it claims no difference."""
        of = f" of {self.pairs}" if self.unit is None else f"{self.unit} in the median of {self.pairs}"
        old, new = (f"{value:.4g}" if self.unit is not None else str(value) for value in (self.old, self.new))
        if self.verdict == APART:
            how_sure = f"95 %: {self.interval}" if self.interval else f"better in {self.better}, worse in {self.worse}"
            return f"{self.what} ({new} against {old}{of}, {how_sure})"
        claim = f"{self.words[self.verdict == 'worse']} {self.what}"
        return f"{claim}: {new} instead of {old}{of} (p {p_text(self.p)})"


def _line(
    what: str, words: tuple[str, str], pairs: Iterable[tuple[float, float]], by: float = 0.0, unit: str | None = None
) -> ComparedLine:
    """Compare pairs (old, new) of numbers, where a difference of at most ``by`` counts as no difference.

    Higher numbers are worse, unless the first of the ``words`` is ``larger``.
    """
    pairs = list(pairs)
    rises, falls = (sum(sign * (new - old) > by for old, new in pairs) for sign in (1, -1))
    worse, better = (falls, rises) if words[0] == "larger" else (rises, falls)
    old, new = ((sum if unit is None else median)(side) for side in zip(*pairs, strict=True)) if pairs else (0.0, 0.0)
    p = mcnemar(worse, better)
    return ComparedLine(
        what=what, words=words, old=old, new=new, better=better, worse=worse, pairs=len(pairs), unit=unit, p=p
    )


def lines_of(rows: Iterable[PairRow]) -> list[ComparedLine]:
    """Compare two policies in all quantities for which there are pairs of results.

    Saved scenarios and scenarios that a search found are not included, because they were chosen for the failure of one
    of the two policies.
    """
    both = [row for row in rows if row.old.failed is not None and row.new.failed is not None]
    drawn = [row for row in both if row.part == "scenarios"]
    failures, crashes = (
        [(bool(row.old.failed), bool(row.new.failed)) for row in both if row.part == part]
        for part in ("scenarios", "episodes")
    )
    speeds = [(row.old.impact, row.new.impact) for row in drawn]
    impacts = [(old, new) for old, new in speeds if old is not None and new is not None]
    lines = [
        _line("failures of its own", ("fewer", "more"), failures),
        _line("crashes in ordinary traffic", ("fewer", "more"), crashes),
        _line("impacts where both fail", ("milder", "harder"), impacts, Severity.WORSE_BY["collision"], " m/s"),
    ]
    for name in sorted({name for row in drawn for name in row.old.margins}):
        of_both = [(row.old.margins, row.new.margins) for row in drawn]
        margins = [(old[name], new[name]) for old, new in of_both if name in old and name in new]
        lines.append(_line(f"margins of {name}", ("larger", "smaller"), margins, Severity.WORSE_BY["check"], ""))
    lines = [line for line in lines if line.pairs]
    adjusted = holm([line.p for line in lines])
    return [replace(line, p=p) for line, p in zip(lines, adjusted, strict=True)]


def verdict_of(lines: Iterable[ComparedLine]) -> str:
    """Return the verdict on the new policy: ``better``, ``worse``, ``better and worse`` or ``not told apart``."""
    return " and ".join(sorted({line.verdict for line in lines} - {APART})) or APART


def sentence_of(old: str, new: str, lines: Sequence[ComparedLine]) -> str:
    """Return a sentence that says in which quantities the new policy is better or worse, and in which neither."""
    claims = [line.sentence for line in lines if line.verdict != APART]
    others = ", ".join(line.sentence for line in lines if line.verdict == APART)
    if not claims:
        return f"{new} is {APART} from {old}: {others or 'no run says anything of both'}"
    others = f"; {APART}: {others}" if others else ""
    return f"{new} is {verdict_of(lines)} than {old}: {'; '.join(claims)}{others}"


def text_of(old: str, new: str, rows: Sequence[PairRow], width: int) -> str:
    """Return the sentence on two policies, what differs and the notes, wrapped to a width."""
    lines = lines_of(rows)
    differences = []
    for line in lines:
        unit = "" if line.unit is None else f" [{line.unit.strip()}], median" if line.unit else ", median"
        before, after = (f"{each:.4g}" if line.unit is not None else str(each) for each in (line.old, line.new))
        differences.append(
            f"{line.what}{unit}: old {before}, new {after}; new better in {line.better}, worse in {line.worse} of "
            f"{line.pairs}; new - old {line.interval} (95 %); p {line.p:.2g} (Holm); {line.verdict}"
        )
    saved, notes = [row for row in rows if row.part == "saved"], []
    if saved:
        labels = Counter(row.told for row in saved).most_common()
        told = ", ".join(f"{count} {label}{MEANINGS.get(label, '')}" for label, count in labels)
        notes = [f"- {plural(len(saved), 'saved scenario')}: {told}"]
        notes += [f"  - introduced: {row.name}" for row in saved if row.told == "introduced"]
        notes += [f"  - worse: {row.name} {row.worse}" for row in saved if row.worse]
    for policy, is_new in ((new, True), (old, False)):
        found = [row for row in rows if row.part == "alone" and row.new.failed is is_new]
        notes += [f"- a search found {plural(len(found), 'kind')} of failure that only {policy} has"]
        notes += [f"  - {row.name}: {ascii_text(row.told)}" for row in found]
    errors = [row for row in rows if row.part == "episodes" and row.told]
    if errors:
        notes += [f"- errors in {plural(len(errors), 'episode')} count as crashes; seed {errors[0].name}: "]
        notes[-1] += ascii_text(errors[0].told)
    parts = [[f"{sentence_of(old, new, lines)}."], differences, notes]
    wrapped = ([part for text in texts for part in wrapped_to(text, width, phrases=True)] for texts in parts)
    return "\n\n".join(map("\n".join, wrapped)) + "\n"


EPISODES = 300
"""The number of episodes if the command names an environment and no number."""
FIRST = 10
"""The number of first scenarios: a policy that fails in all of them is refused, because it does not drive at all."""


OTHER_VERSION = f"give {REVISION}main, the policy of the branch main"
"""The way out in messages for a user who has no second version of a policy."""


def never_at_fault_in_a_collision(run: Run) -> None:
    """Assert that there is no collision, as the command ``search`` does if it receives no check."""
    require(not run.collision, "not run.collision", run.explain)


@dataclass(frozen=True, kw_only=True)
class ProgressPlan:
    """The policies to compare, and the situations. A row of the results depends only on the plan and the row's name."""

    old: str  # as in ``rate``; a planner in SI units with an environment has ``@planner`` after its name
    new: str
    world_name: str | None = None  # the arguments --world and --config
    config: str | None = None
    scenarios: int = 200  # random ones; also the runs of each search for what only one policy fails
    episodes: int = 300
    saved: tuple[Path, ...] = ()
    check: str | None = None  # a function of a run, as ``module:function``; None for no collision
    seed: int = 0
    revision: RevisionPolicy | None = None  # the old policy, if ``old`` is a revision

    def __getstate__(self) -> dict[str, Any]:
        """Return the plan without its worlds, which a process makes itself: they may be code."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def traffic(self) -> Any:
        """The world of episodes in ordinary traffic, if it has them."""
        self.factory("new")  # whose module may register the environment
        return chosen_world(self.world_name, self.config)

    @cached_property
    def world(self) -> Any:
        """The world of the scenarios."""
        world = self.traffic
        if isinstance(world, World) and world.planner_hz is None and self.new.endswith(PLANNER):
            world = chosen_world(self.world_name, self.config, is_planner=True)
        return Highway() if world is None else world

    @property
    def holds(self) -> Callable[[Run], Any]:
        """The function that checks each run."""
        return never_at_fault_in_a_collision if self.check is None else check_function(self.check)

    @property
    def test(self) -> str:
        """The node id of the test that the command ``search`` would run, so that a seed finds the same failures."""
        name = never_at_fault_in_a_collision.__name__ if self.check is None else self.check.split(":")[-1]
        return f"test_safety.py::{name if name.startswith('test') else f'test_{name}'}"

    def factory(self, side: str) -> Callable[..., Any]:
        """Return the factory of the ``old`` or the ``new`` policy."""
        if side == "old" and self.revision is not None:
            return self.revision
        return ads_factory(getattr(self, side), side.upper())

    def judged(self, side: str, numbers: range) -> Iterator[tuple[Run, Verdict]]:
        """Run random scenarios with a policy; each scenario depends only on the seed and its number."""
        world = self.world
        space = base_world(world).space(drawn_space(world, {}))
        scenarios = [sample(space, np.random.default_rng((self.seed, number))) for number in numbers]
        return judged_runs(scenarios, world, self.factory(side), self.holds, blame="ego")

    @property
    def job(self) -> ResumableJob:
        """The job with its tasks; a task's name has its part and its number of situations, then the first situation."""
        episodes = self.episodes if isinstance(self.traffic, World) else 0
        sizes = {
            (f"{part}-{min(CHUNK, total - first)}", first): 2 * min(CHUNK, total - first)
            for part, total in (("scenarios", self.scenarios), ("episodes", episodes))
            for first in range(0, total, CHUNK)
        }
        sizes |= {("saved-1", number): 4 for number in range(len(self.saved))}
        sizes |= {(f"alone_{side}-1", 0): self.scenarios for side in ("new", "old")}
        return ResumableJob(
            command="progress", noun="comparison", units="runs", tasks=tuple(sizes), in_order=tuple(sizes), sizes=sizes,
            question={}, question_file="progress", text=partial(_text, self),
        )  # fmt: skip


def checked(plan: ProgressPlan) -> ProgressPlan:
    """Return the plan, if it can be run.

    Raises:
        RequestError: naming the first thing that is wrong.
        WorldError: if the environment cannot be used.
    """
    are_planners = [name.endswith(PLANNER) for name in (plan.old, plan.new)[plan.revision is not None :]]
    for is_wrong, problem in (
        (plan.scenarios < 1, f"--scenarios: expected a whole number, at least 1, received {plan.scenarios}"),
        (plan.episodes < 0, f"--episodes: expected a whole number, at least 0, received {plan.episodes}"),
        (plan.seed < 0, f"--seed: expected a whole number, at least 0, received {plan.seed}"),
        (plan.new == plan.old, f"NEW: expected another version than OLD, received {plan.new!r} again; {OTHER_VERSION}"),
        (plan.new.startswith(REVISION), f"NEW: expected the present policy, received {plan.new!r}; check it out"),
        (any(are_planners) and not all(are_planners), f"NEW: expected {PLANNER} after both names or none"),
    ):
        if is_wrong:
            raise RequestError(problem)
    if isinstance(plan.traffic, World):
        plan.traffic.environment.with_traffic()
    if same := same_policy(plan.factory("new"), plan.factory("old")):
        raise RequestError(f"OLD: {same}")
    for side in ("old", "new"):
        if side == "old" and plan.revision is not None:
            _check_set_up(plan, side)  # this policy drives in a process of its own already
        else:
            _check_apart(plan, side)
    return plan


@contextmanager
def _of_revision(plan: ProgressPlan, copy: Sequence[str]) -> Iterator[tuple[ProgressPlan, list[str], str]]:
    """Provide the plan with the policy of its revision, if it names one; lines on both sides; why they are the same.

    Raises:
        RequestError: if the revision does not have the policy.
        RevisionError: if there is no such revision, or its policy cannot be built.
    """
    if not plan.old.startswith(REVISION):
        yield plan, [], ""
        return
    here, name = Path.cwd().resolve(), plan.new.removesuffix(PLANNER)
    plan.factory("new")
    with revision_at(plan.old, here, here, shlex.join(copy), "--copy") as revision:
        policy = revision.policy(PROCESS, name)
        try:
            policy.start()
            # After a run, since a policy may open its weights late.
            next(replace(plan, revision=policy).judged("old", range(1)))
            seen, is_whole = policy.call(Served.hashes), policy.call(Served.is_whole)
            yield replace(plan, revision=policy), *revision.compared(seen, is_whole=is_whole)
        except RevisionError as error:
            if not revision.lacks(error.missing):
                raise
            raise RequestError(
                f"OLD: expected a revision with {name}, received {policy.label}, which lacks it"
            ) from None
        except ProcessLostError as error:
            raise RequestError(
                f"OLD: expected a policy that drives, received {policy.label}, which {error.how}"
            ) from None
        finally:
            policy.close()


def _check_apart(plan: ProgressPlan, side: str) -> None:
    """Check the set-up in another process, because a policy that ended this one would end the command with its code."""
    with WorkerPool[str, None](partial(_check_in_worker, plan), 1, patience=math.inf, grace=math.inf) as pool:
        pool.expect([side])
        answer = pool.fetch(side)
    if isinstance(answer, ProcessLostError):
        raise RequestError(f"{side.upper()}: expected a policy that drives, received one whose process {answer.how}")
    if isinstance(answer, (RequestError, AdsFactoryError)):
        raise answer
    if isinstance(answer, Exception):
        received = one_line(visible(f"{type(answer).__name__}: {answer}".partition("\n")[0]))
        raise RequestError(f"{side.upper()}: expected a policy that drives, received {received}") from None


def _check_in_worker(plan: ProgressPlan, side: str, tick: Tick) -> None:
    _check_set_up(plan, side)


def _check_set_up(plan: ProgressPlan, side: str) -> None:
    """Raise for a policy that never drives, and for a check that fails in all of the first runs."""
    try:
        check_drives(plan.judged(side, range(min(FIRST, plan.scenarios))))
    except SetupFaultError as fault:
        received = f"received {fault.received} in {fault.runs}"
        asked = fault.first_decision(plan.world, Policy(plan.factory(side)), of_si="", of_env="").strip()
        if not fault.verdict.is_ads:
            raise RequestError(f"--check: expected a function of a run that asserts, {received}; correct it") from None
        raise RequestError(
            f"{side.upper()}: expected a policy that drives, {received}, at its first decision. "
            f"{asked} A policy of an environment needs --world, and the --config that it "
            f"was trained with; a planner in SI units needs no --world, or {PLANNER} after its name"
        ) from None
    except (RequestError, WorldError, AdsFactoryError):
        raise
    except Exception as error:  # what a policy raises as it drives is part of its run
        received = f"one that raises {described(error)}"
        raise RequestError(
            f"{side.upper()}: expected a factory of a policy, received {received}; correct it"
        ) from error


def _text(plan: ProgressPlan, task: Task, tick: Tick) -> str:
    (part, _, size), rows = task[0].partition("-"), []
    for row in _rows(plan, part, range(task[1], task[1] + int(size)), tick):
        rows.append([json.dumps(asdict(row))])
        tick(min(1.0, len(rows) / int(size)))
    return csv_text(["row"], rows)


def _rows(plan: ProgressPlan, part: str, numbers: range, tick: Tick) -> Iterator[PairRow]:
    """Run some situations of one part with both policies, and yield a row for each of them."""
    if part == "scenarios":
        sides = (plan.judged(side, numbers) for side in ("old", "new"))
        for number, old, new in zip(numbers, *sides, strict=True):
            yield PairRow(part=part, name=str(number), old=Result.of(*old), new=Result.of(*new))
    elif part == "episodes":
        for seed in range(plan.seed + numbers.start, plan.seed + numbers.stop):
            is_planner, rows = plan.new.endswith(PLANNER), []
            for side in ("old", "new"):
                factory = plan.factory(side)
                if isinstance(factory, RevisionPolicy):
                    rows.append(factory.call(_driven, plan.traffic, side, is_planner, seed))
                else:
                    rows.append(driven(plan.traffic, side, factory, seed, is_planner=is_planner))
            old, new = (Result(failed=row.outcome != Outcome.SAFE) for row in rows)  # an error is as bad as a crash
            yield PairRow(part=part, name=str(seed), old=old, new=new, told=rows[1].error or rows[0].error)
    elif part == "saved":
        yield _replayed(plan, plan.saved[numbers[0]])
    else:  # the scenarios that a search has found in which only the policy of one side fails
        (side, other), runs = ("old", "new") if part == "alone_old" else ("new", "old"), 0

        def listen(event: object) -> None:
            nonlocal runs
            if isinstance(event, GenerationFinished):
                runs += len(event.population) - event.elites
                tick(min(1.0, runs / plan.scenarios))

        found = explore(
            plan.factory(side), against=plan.factory(other), holds=plan.holds, world=plan.world,
            blame="ego", runs=plan.scenarios, seed=plan.seed, node_id=plan.test, shrink_rollouts=0, pairs=1,
            on_event=listen,
        )  # fmt: skip
        old, new = Result(failed=side == "old"), Result(failed=side == "new")
        for each in found.sightings:
            yield PairRow(part="alone", name=each.finding.id, old=old, new=new, told=each.headline)


def _driven(built: Any, world: World, side: str, is_planner: bool, seed: int) -> EpisodeRow:
    """Drive an episode in the process of a revision."""
    return driven(world, side, built.factory, seed, is_planner=is_planner)


def _replayed(plan: ProgressPlan, file: Path) -> PairRow:
    """Replay a saved scenario with both policies, and return the row with the label of the new one."""
    saved, label, worse = Saved.read(file), "unreadable", ""
    finding = saved.finding
    if finding is not None:
        arguments = {"ads": plan.factory("new"), "against": plan.factory("old"), "world": plan.world, "blame": "ego"}
        try:
            now = replay_saved(saved, plan.holds, plan.test, **arguments)
            label, verdict = now.label, now.verdict
            made = {each.name for each in verdict.checks}
            is_asked = plan.check and (finding.expect.check is None or finding.expect.assertion in made)
            if finding.signature.is_property and verdict.kind == "passed" and not is_asked:
                label = "of another check"
            worse = verdict.worsening if label == "common" else ""
        except ProcessLostError:
            label = "crashing"
        except RequestError:
            label = "not to be run here"
    return PairRow(part="saved", name=saved.id, old=Result(), new=Result(), told=label, worse=worse)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    of_whom = "module:factory or module:factory:argument, such as policy:make:old.zip"
    of_old = f"the old version: {of_whom}; or {REVISION}REVISION, such as {REVISION}main: NEW as it is there"
    parser.add_argument("old", metavar="OLD", help=of_old)
    parser.add_argument("new", metavar="NEW", help=f"the new version: {of_whom.partition(',')[0]}")
    of_world = "an environment has ordinary traffic, too; for planners in SI units write "
    add_world_arguments(parser, f"{of_world}{PLANNER} after both names; default: a highway, in SI units")
    of_copy = f"with {REVISION}REVISION, files and folders that the policy needs and git ignores, such as weights"
    parser.add_argument("--copy", nargs="+", default=[], metavar="PATH", help=of_copy)
    of_scenarios = "random scenarios, and runs of each search for what only one version fails "
    of_scenarios += "(default: %(default)s)"
    parser.add_argument("--scenarios", type=int, default=200, metavar="N", help=of_scenarios)
    of_episodes = f"episodes of ordinary traffic, with an environment as --world (default: {EPISODES})"
    parser.add_argument("--episodes", type=int, metavar="N", help=of_episodes)
    of_corpus = "the folder of saved scenarios to replay (default: that in which searches save them, if it exists here)"
    parser.add_argument("--corpus", type=Path, metavar="FOLDER", help=of_corpus)
    of_check = "a function of a run, which asserts what must hold (default: that there is no collision)"
    parser.add_argument("--check", metavar="MODULE:FUNCTION", help=of_check)
    of_seed = "the seed of scenarios, episodes and searches (default: %(default)s)"
    parser.add_argument("--seed", type=int, default=0, metavar="N", help=of_seed)
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one for each core)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures for programs")
    of_exit = "worse: exit with 1 if any line is worse; not-better: exit with 1 unless the new version is better "
    of_exit += "or has the same policy (default: exit with 0 whatever the verdict)"
    parser.add_argument("--fail-on", choices=("worse", "not-better"), help=of_exit)


def run(given: argparse.Namespace, _: Sequence[str]) -> int:
    """Compare the policies, print which is better, write the requested files, and return the exit code."""
    try:
        # Report what is wrong before anything is driven.
        path = given.json
        if path is not None and (not path.parent.is_dir() or path.is_dir()):
            raise RequestError(f"expected a file in a folder that exists, received {path}; give a different one")
        if given.corpus is not None and not given.corpus.is_dir():
            raise RequestError(f"--corpus: expected a folder, received {given.corpus}; give one that exists")
        episodes = EPISODES if given.episodes is None else given.episodes
        saved = files_below() if given.corpus is None else files_below(given.corpus)
        same = {name: getattr(given, name) for name in ("old", "new", "scenarios", "check", "seed")}
        same["episodes"] = episodes
        plan = ProgressPlan(
            world_name=given.world, config=given.config, saved=tuple(file.absolute() for file in saved), **same
        )
        if given.episodes is not None:
            if given.world is None:
                raise RequestError("--episodes: expected an environment, received none; give --world")
            episodic(plan.traffic, "--episodes", "leave --episodes out")
        workers, rows = worker_count(given.workers), []
        with _of_revision(plan, given.copy) as (plan, both, same_as):
            if not same_as:
                job = checked(plan).job
                workers = min(workers, len(job.tasks))
                with tempfile.TemporaryDirectory(prefix="pafot-") as folder:
                    results = run_job(job, Path(folder), workers=workers, stream=sys.stderr, clock=time.monotonic)
                    table = io.StringIO(results.read_text("utf-8"))
                rows = [PairRow.of_data(json.loads(each["row"])) for each in csv.DictReader(table)]
        old = plan.old if plan.revision is None else plan.revision.label
        lines = lines_of(rows)
        verdict, sentence = verdict_of(lines), same_as
        printed = f"{same_as}\n"
        if not same_as:
            sentence = sentence_of(old, plan.new, lines)
            printed = text_of(old, plan.new, rows, shutil.get_terminal_size().columns)
        more = "" if same_as else _hint(plan, rows, given.copy)
        more += "".join(["\n", *(f"- {line}\n" for line in both)]) if both else ""
        sys.stdout.write(printed + more)
        if given.json is not None:
            data = {
                **same,
                "old_commit": None if plan.revision is None else plan.revision.commit,
                "world": plan.world_name,
                "config": None if plan.config is None else json.loads(plan.config),
                "verdict": verdict,
                "sentence": sentence,
                "lines": [{**asdict(line), "verdict": line.verdict} for line in lines],
                "rows": [asdict(row) for row in rows],
                "versions": installed_versions(),
            }
            write_whole(given.json, json.dumps(data, indent=1) + "\n")
    except OSError as error:
        if isinstance(error, ChildProcessError):
            raise
        sys.stderr.write(f"progress: {error}; {way_out(error, 'or give another file')}\n")
        return 2
    is_failed = {"worse": "worse" in verdict, "not-better": verdict != "better" and not same_as}
    return int(is_failed.get(given.fail_on, False))


def _hint(plan: ProgressPlan, rows: Sequence[PairRow], copy: Sequence[str]) -> str:
    """Return the command that saves and explains failures that only the new policy has; empty without them."""
    if not any(row.part == "alone" and row.new.failed for row in rows):
        return ""
    old = plan.old.removesuffix(PLANNER)
    given = [] if plan.world_name is None else ["--world", plan.world_name]
    given += [] if plan.config is None else ["--config", plan.config]
    given += [] if plan.check is None else ["--check", plan.check]
    given += ["--runs", str(plan.scenarios), "--seed", str(plan.seed), "--against", old]
    given += ["--copy", *copy] if copy else []
    return f"\nsave and see it: `{command('pytest_pafot', 'search', plan.new, *given)}`\n"
