"""A search calls an ADS that is declared pure or copyable less often, and finds and saves the same."""

import json
import re
import sys

import pytest

PLANNERS = """
class Planner:
    def __init__(self):
        self.decisions = 0

    def __call__(self, observation):
        calls.append("call")
        self.decisions += 1
        return self.decided(observation)

    def decided(self, observation):
        return (0.3 - 0.01 * (observation.ego.speed - 20.0), 0.0)

class Pure(Planner):
    pure = True

class Integrating(Planner):
    def __init__(self):
        super().__init__()
        self.sums = [0.0]

    def decided(self, observation):
        self.sums[0] += 0.2 * (20.0 - observation.ego.speed)
        return (0.3 + 0.1 * (20.0 - observation.ego.speed) + 0.01 * self.sums[0], 0.0)

class Copyable(Integrating):
    copyable = True

calls = []
"""

SEARCH = """
@pafot.search(genes=4, gene_seconds=2, npcs=2, ego_lane=1, ego_speed=22, ads=ADS, shrink_rollouts=8, traffic="paper",
              vehicles="car")
def test_keeps_its_distance(run):
    pafot.check(run.min_distance, name=f"cell {run.event_cell}", at_least=1.0)

def test_calls():
    print("calls:", len(calls))
"""


def searched(project, ads, source=PLANNERS + SEARCH, args=()):
    """Return the findings as saved, the number of decisions, and the output of a search."""
    project.write(source.replace("ads=ADS", f"ads={ads}"))
    output = project.run_once("-s", *args, generations=2).stdout.str()
    finds = {
        name: "".join(line for line in text.splitlines(True) if "slowest" not in line)
        for name, text in project.contents.items()
    }
    project.forget()
    return finds, int(re.search(r"calls: (\d+)", output).group(1)), output


@pytest.mark.parametrize(("ads", "plain", "most"), [("Pure", "Planner", 0.9), ("Copyable", "Integrating", 0.95)])
def test_ads_is_asked_less_for_same_findings(project, ads, plain, most):
    source = PLANNERS + SEARCH.replace("shrink_rollouts=8", "shrink_rollouts=40")
    finds, calls, output = searched(project, f"lambda: {ads}()", source)
    plain_finds, plain_calls, plain_output = searched(project, plain, source)
    assert finds == plain_finds != {}
    assert calls < most * plain_calls
    assert "marked as pure" not in output
    counts = [re.findall(r"^  (\d+ runs.*) in ", text, re.MULTILINE) for text in (output, plain_output)]
    assert counts[0] == counts[1] != []


@pytest.mark.parametrize("ads", ["Pure", "Copyable", "Planner"])
def test_decisions_are_counted_as_often_as_the_ads_is_asked(project, ads):
    """All of them, for whatever they were needed: the owner of an expensive policy pays for each."""
    path = project.path / "results.json"
    _, calls, _ = searched(project, ads, args=[f"--pafot-json={path}", "--pafot-neighbours=5"])
    (search,) = json.loads(path.read_text())["searches"]
    purposes = ("decisions", "confirm_decisions", "shrink_decisions", "neighbour_decisions")
    assert sum(search[each] for each in purposes) == calls
    assert all(search[each] for each in purposes)
    assert (search["reused_decisions"] > 0.05 * calls) == (ads != "Planner")


def test_ads_wrongly_declared_pure_has_flaky_findings(project):
    stateful = """
class Stateful(Pure):
    def decided(self, observation):
        if self.decisions == 1 and observation.time > 0:
            raise LookupError("my first decision, and not at the start")
        return (0.0, 0.0)

@pafot.search(genes=4, gene_seconds=3, ads=Stateful, vehicles="car")
def test_drives(run):
    pass
"""
    project.write(PLANNERS + stateful)
    result = project.run(generations=6)
    result.stdout.fnmatch_lines(["*LookupError*", "*flaky: running it again gave a different run*"])
    assert len(project.files) == 1


def test_stateful_ads_shrunk_as_pure_retains_its_scenario(project):
    """Whatever a shorter scenario seemed to do, the file is from a run that made every decision."""
    stateful = """
class Stateful(Pure):
    def decided(self, observation):
        if self.decisions == 30:
            raise LookupError("my thirtieth decision")
        return (0.0, 0.0)

@pafot.search(genes=4, gene_seconds=3, ads=Stateful, stop_after=1)
def test_drives(run):
    pass
"""
    project.write(PLANNERS + stateful)
    project.run(generations=1)
    assert "flaky" not in project.only_file.read_text()
    result = project.run(generations=0)
    result.stdout.fnmatch_lines(["replayed 1 saved scenario: 1 still failing"])


MEMORIES = {
    "counter": "return (0.0 if self.decisions <= 12 else -2.0, 0.0)",
    "latch": """
        self.has_seen = getattr(self, "has_seen", False) or 1.0 < observation.time < 1.3
        return (0.0, 0.0) if self.has_seen else (-0.5, 0.0)""",
    "tracker": """
        before, self.before = getattr(self, "before", observation.ego.speed), observation.ego.speed
        return (0.4 - 2.0 * (observation.ego.speed - before), 0.0)""",
    "warm-up": "return (0.0 if self.decisions < 4 else -0.5, 0.0)",
}


@pytest.mark.parametrize("memory", MEMORIES)
def test_ads_wrongly_declared_pure_is_found_out_at_the_end(project, memory):
    source = (
        PLANNERS
        + f"""
class Remembering(Pure):
    def decided(self, observation):
        {MEMORIES[memory].strip()}
"""
    )
    search = SEARCH.replace("shrink_rollouts=8", "shrink_rollouts=40")
    _, _, output = searched(project, "lambda: Remembering()", source + search)
    assert " ".join(output.split()).count("warning: the ADS is marked as pure, but decided otherwise in ") == 1
    _, _, output = searched(project, "lambda: Remembering()", source.replace("(Pure)", "(Planner)") + search)
    assert "marked as pure" not in output


SHARED = {
    "a counter of the class": """
    count = 0

    def decided(self, observation):
        Sharing.count = 1 if observation.time == 0 else Sharing.count + 1
        return (super().decided(observation)[0] + 0.01 * (Sharing.count % 7), 0.0)""",
    "a list of all copies": """
    def __deepcopy__(self, memo):
        copied = Sharing()
        copied.sums = self.sums
        return copied""",
}


@pytest.mark.parametrize("shared", SHARED)
def test_copies_that_share_a_state_are_found_out_at_the_end(project, shared):
    source = PLANNERS + f"class Sharing(Copyable):{SHARED[shared]}\n"
    search = SEARCH.replace("shrink_rollouts=8", "shrink_rollouts=40").replace("gene_seconds=2", "gene_seconds=1")
    _, _, output = searched(project, "lambda: Sharing()", source + search)
    told = " ".join(output.split())
    assert told.count("warning: the ADS is marked as copyable, but decided otherwise in ") == 1
    assert "let `__deepcopy__` copy it, or remove `copyable`" in told
    _, _, output = searched(project, "lambda: Sharing()", source.replace("(Copyable)", "(Integrating)") + search)
    assert "marked as" not in output


def test_copyable_ads_finds_the_same_when_isolated(project):
    assert searched(project, "Copyable", args=["--pafot-isolate"])[0] == searched(project, "Integrating")[0] != {}


def test_copyable_ads_finds_the_same_in_several_sessions(project):
    finds = []
    for ads in ("Copyable", "Integrating"):
        project.write((PLANNERS + SEARCH).replace("ads=ADS", f"ads={ads}"))
        for runs in (3, 10):
            project.run(f"--pafot-runs={runs}", f"--pafot-resume=states-{ads}", generations=None)
        finds.append([re.sub(".*slowest.*", "", text) for text in project.contents.values()])
        project.forget()
    assert finds[0] == finds[1] != []


OWN_WORLD = """
class Own(pafot.Highway):
    def rollout(self, scenario, ads_factory):
        return super().rollout(scenario, ads_factory)
"""


@pytest.mark.parametrize(
    "search", ["decision_limit=1.0", "world=Own()"], ids=["a limit of time for decisions", "a world of ones own"]
)
def test_without_resuming_the_ads_makes_all_decisions_of_runs(project, search):
    source = PLANNERS + OWN_WORLD + SEARCH.replace("genes=4", f"{search}, genes=4")
    assert searched(project, "Pure", source)[:2] == searched(project, "Planner", source)[:2]
    assert searched(project, "Copyable", source)[:2] == searched(project, "Integrating", source)[:2]


def test_lock_step_finds_the_same_with_a_pure_ads(project):
    batched = """
class Batched(Planner):
    def batch(self, observations):
        return [self.decided(observation) for observation in observations]

class PureBatched(Batched):
    pure = True
"""
    finds, calls, _ = searched(project, "PureBatched", PLANNERS + batched + SEARCH)
    plain_finds, plain_calls, _ = searched(project, "Batched", PLANNERS + batched + SEARCH)
    assert finds == plain_finds != {}
    assert calls <= plain_calls  # hardly any run is made alone, and a batch decides on all of its runs


def test_row_mixing_ads_reuses_no_lock_step_decisions(project):
    mixing = """
class Mixing(Planner):
    def batch(self, observations):
        return [(0.3 + 0.1 * len(observations), 0.0) for observation in observations]

class PureMixing(Mixing):
    pure = True
"""
    finds, _, _ = searched(project, "PureMixing", PLANNERS + mixing + SEARCH)
    assert finds == searched(project, "Mixing", PLANNERS + mixing + SEARCH)[0] != {}
    assert not any("flaky" in text for text in finds.values())


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux alone")
def test_runs_of_other_processes_are_not_resumed(project):
    slow = """
import time

def slow():
    time.sleep(0.011)
    return KIND()
"""
    source = PLANNERS + slow + SEARCH.replace("=12", "=4").replace("ads=ADS", "ads=slow")
    for kind, plain in (("Pure", "Planner"), ("Copyable", "Integrating")):
        finds, _, output = searched(project, "", source.replace("KIND", kind), ["--pafot-workers=2"])
        assert finds == searched(project, "", source.replace("KIND", plain))[0] != {}
        assert "--pafot-workers=2: in use" in output
