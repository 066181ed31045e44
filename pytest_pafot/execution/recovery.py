"""What was in flight when a process died runs again, in a process of its own, before it is called a finding.

A process also dies because somebody ends it: a job that is cancelled, a system that is short of memory. The scenario
that it ran then says nothing of the ADS. Where the next session dies as well, it is no accident: something that builds
up from run to run, such as memory. That scenario is then called a finding after all, or nobody would hear of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pytest_pafot.execution.separate_process import answers_of
from pytest_pafot.execution.worker_pool import Answer, Lost
from pytest_pafot.trace import Outcome
from pytest_pafot.world import codec as worlds

if TYPE_CHECKING:
    from pytest_pafot.campaign.harness import Bench
    from pytest_pafot.execution.crash_records import Leftover
    from pytest_pafot.scenario import Scenario


@dataclass(frozen=True, slots=True, kw_only=True)
class Settled:
    """What came of the record of a process that died.

    Attributes:
        notes: on what is not to blame.
        pending: a record to discard once the search is through; until then this session may die as well.
    """

    notes: tuple[str, ...] = ()
    pending: Leftover | None = None


Keep = Callable[["Leftover", "Scenario", Lost | None], None]
"""Saves a scenario in which a process died, and another one when it ran again, as far as that is known."""


def settle(bench: Bench, leftover: Leftover, keep: Keep, rerun: Callable[[Leftover], None]) -> Settled:
    """Keep what is to blame for the death of a process.

    Where no process can be made to try it in, one death is enough for a scenario that was alone in flight; and where
    the session that tried it died as well, that is enough too.

    Args:
        bench: of the item whose search it was.
        leftover: of the process; removed once all is said, unless it is pending.
        keep: saves a scenario.
        rerun: runs what was in lock step in this process, with the scenario on disk, for the next session to settle.
    """
    scenarios = leftover.together or ((leftover.scenario,) if leftover.scenario else ())
    answers = None if leftover.is_tried else _answers(bench, leftover, scenarios)
    if answers is None and leftover.together:
        rerun(leftover)
        return Settled()
    fates = [(scenario, None if answers is None else answers[scenario]) for scenario in scenarios]
    for scenario, fate in fates:
        if isinstance(fate, Lost):
            keep(leftover, scenario, fate)
        elif not _is_innocent(fate) and not leftover.together:
            keep(leftover, scenario, None)
    if not all(_is_innocent(fate) for _, fate in fates):
        leftover.discard()
        return Settled()
    return Settled(notes=(_recovery(leftover),), pending=leftover.tried())


def _answers(bench: Bench, leftover: Leftover, scenarios: tuple[Scenario, ...]) -> dict[Scenario, Answer | Lost] | None:
    """What running each by itself shows; None where that cannot be tried.

    A death counts, also where the process that the crew tries it in again lives: it is not the first.
    """
    world = _world(bench, leftover)
    told = None if world is None else answers_of(bench, scenarios, world)
    return None if told is None else told[0] | {lost.scenario: lost for lost in told[1]}


def _world(bench: Bench, leftover: Leftover) -> Any:
    """That the process ran in; None where it cannot be made again."""
    if leftover.world in (None, bench.errand.plain_world):
        return bench.world
    if worlds.is_code(leftover.world):
        return None
    from pytest_pafot.world import WorldError, from_dict  # noqa: PLC0415

    try:
        return from_dict(dict(leftover.world))
    except (WorldError, TypeError, ValueError):
        return None


def _is_innocent(fate: Answer | Lost | None) -> bool:
    """Whether a run came to its end. One in which the ADS failed may have failed since it was another process."""
    trace = fate.trace if isinstance(fate, Answer) else None
    return trace is not None and trace.outcome not in (Outcome.ADS_ERROR, Outcome.HANG)


def _recovery(leftover: Leftover) -> str:
    ran = (
        f"{len(leftover.together)} scenarios in lock step, each of" if leftover.together else f"{leftover.scenario!r},"
    )
    return (
        f"a process (pid {leftover.pid}) died while it ran {ran} which ran to its end when it was tried again: the "
        "process was killed from outside, or there was too little memory"
    )
