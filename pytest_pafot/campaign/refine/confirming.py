"""The confirmation of the simplest scenario of a finding: it is run again, and its rate is compared."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

from pytest_pafot.campaign.bench import Bench
from pytest_pafot.campaign.events import Phase, Refining
from pytest_pafot.campaign.refine.runs import fails_again, failure_rate, is_as_often, shows
from pytest_pafot.campaign.refine.simplest import Simplest
from pytest_pafot.campaign.state import State
from pytest_pafot.campaign.verdict import Verdict
from pytest_pafot.findings.failure_rate import FEW_RUNS, KNOWN_RUNS, MANY_RUNS, SURE_ODDS, FailureRate
from pytest_pafot.findings.finding import ending
from pytest_pafot.findings.shrink import sort_key
from pytest_pafot.findings.sighting import ENDED_OTHERWISE, Sighting
from pytest_pafot.model.scenario import Scenario
from pytest_pafot.oracle.run import Run
from pytest_pafot.support.errors import OutOfTime


def confirm_simplest(
    sighting: Sighting, original: Scenario, simplest: Simplest, state: State, bench: Bench
) -> Refining[tuple[Simplest, Run, Verdict, str]]:
    """Run the simplest scenario of a finding again, or one on the way to it that fails as often as the finding.

    Return it with how often it fails, if that is by chance; its last run, with the verdict; and how that run differs
    from the finding, empty if it is confirmed.

    Raises:
        OutOfTime: if there was no time to find one that fails as often. Further attempts may lead to it.
    """
    __tracebackhide__ = True
    scenario, as_found, rate = simplest.scenario, simplest.as_found, sighting.finding.rate
    run, verdict, differs = _run_again(scenario, sighting, state, bench)
    if not differs and rate is not None and scenario == original != sighting.finding.scenario:
        rate = yield from failure_rate(sighting, original, state, bench)  # the file's is that of a simpler scenario
    elif not differs and as_found is not None and scenario not in (original, sighting.finding.scenario):
        as_often = yield from _failing_as_often(sighting, as_found, scenario, state, bench)
        if as_often is None and simplest.is_cut:
            raise OutOfTime
        if as_often is None:
            return simplest, run, verdict, f"what is simpler does not fail as often as in {as_found} runs"
        if as_often != scenario:
            shrunk = replace(simplest.shrunk, is_minimal=False)
            simplest = replace(simplest, scenario=as_often, shrunk=shrunk)
            run, verdict, differs = _run_again(as_often, sighting, state, bench)
        rate = yield from failure_rate(sighting, as_often, state, bench)
    return replace(simplest, rate=rate), run, verdict, differs


def _run_again(scenario: Scenario, sighting: Sighting, state: State, bench: Bench) -> tuple[Run, Verdict, str]:
    """Run a scenario from scratch; return the run, its verdict, and its difference from the finding, if any."""
    __tracebackhide__ = True
    for _ in range(MANY_RUNS if sighting.is_flaky else 1):
        run = bench.run(scenario)
        verdict = bench.finish(run)
        if is_shown := shows(sighting, run, verdict, state):
            break
    if not is_shown:
        otherwise = f"{ENDED_OTHERWISE}: {ending(run)}"
        return run, verdict, "the reference failed when it ran again" if verdict.kind == "common" else otherwise
    is_confirmed = sighting.is_flaky or (scenario == sighting.finding.scenario and not sighting.unshrunk)
    return run, verdict, "" if is_confirmed else bench.confirm(run)


def _failing_as_often(
    sighting: Sighting, as_found: FailureRate, simplest: Scenario, state: State, bench: Bench
) -> Refining[Scenario | None]:
    """Return the simplest scenario found on the way to ``simplest`` that fails about as often as the finding.

    Return None if there is none. ``as_found`` is how often the finding fails.

    Each step of shrinking was chosen by few runs, so among many candidates some were only lucky. The result is
    therefore compared again, in more runs with seeds by which nothing was chosen. If it fails more rarely, steps before
    it are tried at growing distances, and the last distance is bisected.
    """
    answers, steps = state.answers[sighting.id], list[Scenario]()
    for _, shown in answers:
        if shown is not None and (not steps or sort_key(shown[0]) < sort_key(steps[-1])):
            steps.append(shown[0])
    steps = steps[: steps.index(simplest) + 1]  # Later answers are from measuring the speeds at which it fails.
    unused = count(KNOWN_RUNS + 1 + len(answers) * FEW_RUNS, KNOWN_RUNS)  # the first seeds of each
    good, bad, back = -1, len(steps), 1  # -1 is the finding itself
    while good < bad - 1:
        yield Phase(f"comparing how often {sighting.id} fails", sighting.id)
        middle = max(bad - back, 0) if good < 0 else (good + bad) // 2
        try:
            several = fails_again(sighting, steps[middle], state, bench, next(unused))
            is_good = is_as_often(as_found, several, KNOWN_RUNS, SURE_ODDS)
        except OutOfTime:
            if good < 0:
                raise
            break  # What was good so far is simpler than the finding.
        good, bad = (middle, bad) if is_good else (good, middle)
        back *= 2
    return None if good < 0 else steps[good]
