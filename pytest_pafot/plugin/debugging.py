"""The debugger in the decision of a policy that could have avoided a failure, for ``--pafot-debug``."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import pytest

from pytest_pafot.campaign.replays import Replays
from pytest_pafot.corpus.saved import Saved
from pytest_pafot.findings.decisions import deciding, seen_of, vehicle_of
from pytest_pafot.plugin.session import is_worker
from pytest_pafot.support.errors import RequestError, flag
from pytest_pafot.world.driving.shadow import wrapped
from pytest_pafot.world.guard.failure import Around
from pytest_pafot.world.guard.own_worlds import base_world, rollout_of

ANY_TIME = 86_400.0
"""The time that a policy has for a decision in a debugger [s], which is the longest that a world accepts."""


class Stopping(Around):
    """An ADS in one of whose decisions the debugger opens."""

    def __init__(self, ads: Any, number: int, header: str) -> None:
        super().__init__(ads)
        self._left, self._header = number, header

    def __call__(self, observation: Any) -> Any:
        """Decide; at the decision, the debugger stops before the policy is called."""
        self._left -= 1
        if self._left == -1:
            pytest.set_trace(header=self._header)
        return self._ads(observation)


def stop_in_replay(item: pytest.Function, replays: Replays, saved: Saved) -> None:
    """Drive a saved scenario, and again with the debugger open in the decision that could have avoided its failure.

    Raises:
        RequestError: if there is no such decision, or no terminal in which a debugger could run.
    """
    __tracebackhide__ = True
    name, finding = flag("debug"), saved.finding
    if is_worker(item.config):
        raise RequestError(
            f"{name}: expected a session in one process, received a worker of pytest-xdist; leave out -n"
        )
    if finding is None or replays.harness.policy.drives_itself:
        raise RequestError(f"{name}: expected a policy that decides, received a vehicle class, which has no decisions")
    if finding.expect.is_crash:
        raise RequestError(
            f"{name}: expected a policy that drives, received a finding whose process dies; see its output"
        )
    world = replays.world_of(saved)
    given = world.given
    if is_dataclass(given) and "hang_limit" in {each.name for each in fields(given)}:
        world = base_world(replace(given, hang_limit=ANY_TIME))  # type: ignore[type-var]
    run, _ = replays.tried(saved, world, item.nodeid)
    number = deciding(run, finding.expect)
    if number is None:
        raise RequestError(
            f"{name}: expected a run with a decision that could have avoided the failure, received one without: "
            f"{run.explain().partition(chr(10))[0]}; set a breakpoint in the policy instead, and run pytest with --pdb"
        )
    npc = vehicle_of(run, finding.expect)
    where = "" if npc is None else f": NPC {npc} is {seen_of(run.trace, npc, number)}"
    time = run.trace.decision_ticks[number] / run.trace.physics_hz
    header = f"pafot: decision {number} at {time:.1f} s{where}; type s to step into the policy"
    ads = wrapped(replays.harness.policy.factory, lambda ads: Stopping(ads, number, header))
    rollout_of(world)(finding.scenario, ads)
