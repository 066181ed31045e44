"""What was in flight when a process died runs again, in a process of its own, before it is called a finding.

A process also dies because somebody ends it: a job that is cancelled, a system that is short of memory. The scenario
that it ran then says nothing of the ADS. Where the next session dies as well, it is no accident: something that builds
up from run to run, such as memory. That scenario is then called a finding after all, or nobody would hear of it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from pytest_pafot.execution.crash_records import Leftover
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.scenario_pool import Answer, ExecutionError, Job, LostRun
from pytest_pafot.execution.separate_runs import answers_apart
from pytest_pafot.scenario import Scenario
from pytest_pafot.trace import Outcome, Trace


@dataclass(frozen=True, slots=True, kw_only=True)
class Retried:
    """What came of the record of a process that died."""

    notes: tuple[str, ...] = ()
    """On what is not to blame."""
    pending: Leftover | None = None
    """To discard once the search is through; until then this session may die as well."""


def retry(
    leftover: Leftover,
    job: Job | None,
    judge: Callable[[Trace], object],
    *,
    isolate: bool,
    keep: Callable[[Leftover, Scenario, LostRun | None], object],
    run_here: Callable[[Leftover], object],
) -> Retried:
    """Keep what is to blame for the death of a process.

    A reference that drove when the process died is to blame itself, and what it drove in is not run again. Where no
    process can be made to try it in, one death is enough for a scenario that was alone in flight; and where
    the session that tried it died as well, that is enough too.

    Args:
        leftover: of the process; removed once all is said, unless it is pending.
        job: what the process ran; None where its world cannot be made again.
        judge, isolate: see :func:`answers_apart`.
        keep: saves a scenario in which a process died, and another one when it ran again, as far as that is known.
        run_here: runs what was in lock step in this process, with the scenario on disk, for the next session to retry.
    """
    if leftover.reference:
        note = (
            f"a process (pid {leftover.pid}) died while {leftover.reference} ran {leftover.scenario!r}, which is held "
            "against it and not against the ADS: mend it, or search with --pafot-isolate, where it may die"
        )
        return Retried(notes=(note,), pending=leftover)
    answers: dict[Scenario, Answer] | None = None
    if job is not None and not leftover.is_tried:
        with suppress(ExecutionError):  # The first run of the search says so.
            answers = answers_apart(job, leftover.scenarios, judge, isolate=isolate)
    if answers is None and leftover.is_lock_step:
        run_here(leftover)
        return Retried()
    guilty = [each for each in leftover.scenarios if answers is None or not _came_to_its_end(answers[each])]
    for scenario in guilty:
        answer = None if answers is None else answers[scenario]
        lost = answer if isinstance(answer, ProcessLostError) else None
        if lost is not None or not leftover.is_lock_step:
            keep(leftover, scenario, lost)
    if guilty:
        leftover.discard()
        return Retried()
    ran = f"{leftover.scenario!r},"
    if leftover.is_lock_step:
        ran = f"{len(leftover.scenarios)} scenarios in lock step, each of"
    note = (
        f"a process (pid {leftover.pid}) died while it ran {ran} which ran to its end when it was tried again: the "
        "process was killed from outside, or there was too little memory"
    )
    return Retried(notes=(note,), pending=leftover.tried())


def _came_to_its_end(answer: Answer) -> bool:
    """Whether a run did. One in which the ADS failed may have failed since it was another process."""
    return not isinstance(answer, Exception) and answer[0].outcome not in (Outcome.ADS_ERROR, Outcome.HANG)
