"""The action and the workflows are valid, use only tested commands, and agree with each other."""

import re

import pytest

from tests.helpers.actions import EXPRESSION, OWN, ROOT, SCRIPT, WORKFLOWS, action, loaded, steps_of
from tests.helpers.tables import table

COMMANDS = [
    'sh "$GITHUB_ACTION_PATH/ci/pafot.sh" install',
    'sh "$GITHUB_ACTION_PATH/ci/pafot.sh" "$TASK"',
]
"""The commands that ``test_ci_script.py`` tests."""

TASKS = ["install", "replay", "search", "pull-request", "night"]
OTHERS = {"actions/checkout@v4", "actions/setup-python@v5", "actions/upload-artifact@v4"}
SCRIPT_TEXT = SCRIPT.read_text(encoding="utf-8")


def expressions(value):
    """Return all GitHub expressions in a document, including nested ones."""
    if isinstance(value, dict):
        return [each for inner in value.values() for each in expressions(inner)]
    if isinstance(value, list):
        return [each for inner in value for each in expressions(inner)]
    return EXPRESSION.findall(str(value))


def test_action_has_exactly_the_tested_commands_without_github_expressions():
    assert action()["runs"]["using"] == "composite"
    assert [step["run"] for step in steps() if "run" in step] == COMMANDS
    assert all(step["shell"] == "bash" for step in steps() if "run" in step)
    assert not [step for step in steps() if expressions(step.get("run", ""))]
    assert {step["uses"] for step in steps() if "uses" in step} <= OTHERS


def test_what_is_found_is_uploaded_whatever_happened():
    last = action()["runs"]["steps"][-1]
    assert (last["uses"], last["if"]) == ("actions/upload-artifact@v4", "always()")
    assert last["with"]["path"].split() == [
        "pafot.html",
        "pafot.json",
        "pafot.xml",
        "**/*.pafot.yaml",
    ]


def test_each_input_is_described_used_and_has_default():
    declared = action()["inputs"]
    conditions = [
        f"inputs.{name}"
        for name in re.findall(r"inputs\.([\w-]+)", str([s.get("if") for s in steps()]))
    ]
    assert {f"inputs.{name}" for name in declared} == {*expressions(steps()), *conditions}
    assert all(
        set(each) == {"description", "default"} and each["description"]
        for each in declared.values()
    )


def steps():
    return action()["runs"]["steps"]


def test_action_sets_every_variable_the_script_reads():
    set_ = {name for step in steps() for name in step.get("env", {})}
    read = set(re.findall(r"\$\{?([A-Z][A-Z_]+)", SCRIPT_TEXT)) - {"FILES", "FINDS", "PWD"}
    for_laptops = {"REMOTE", "GIT_NAME", "GIT_EMAIL", "GIT_INDEX_FILE"}
    assert set_ - {"TASK", "PYTEST_ADDOPTS"} <= read <= set_ | for_laptops


def test_tasks_are_the_same_in_script_and_action():
    assert re.findall(r"^  ([a-z-]+)\) ", SCRIPT_TEXT, re.MULTILINE) == TASKS
    assert re.findall(r"^#   sh ci/pafot.sh ([a-z-]+) ", SCRIPT_TEXT, re.MULTILINE) == TASKS
    description = action()["inputs"]["task"]["description"]
    assert all(task in description for task in TASKS if task != "install")


@pytest.mark.parametrize("name", WORKFLOWS)
def test_workflow_has_only_action_steps_with_valid_inputs(name):
    own = [step["with"] for _, step in steps_of(name) if step["uses"] == OWN]
    assert own
    assert all("run" not in step and step["uses"] in {OWN, *OTHERS} for _, step in steps_of(name))
    assert all(given.keys() <= action()["inputs"].keys() for given in own)
    assert all(given["task"] in TASKS for given in own)


@table("name", WORKFLOWS)
def test_job_has_timeout_minimal_permissions_and_all_of_the_history_that_it_needs(name):
    workflow = loaded(WORKFLOWS[name])
    for job in workflow["jobs"].values():
        rights = job.get("permissions", workflow["permissions"])
        keeps = any("branch" in step.get("with", {}) for step in job["steps"])
        assert rights == {"contents": "write" if keeps else "read"}
        assert job["timeout-minutes"] <= 360
        assert set(job.get("needs", "").split()) <= workflow["jobs"].keys()
        first, *others = job["steps"]
        needs_history = any({"base", "branch"} & step.get("with", {}).keys() for step in others)
        assert first["uses"] == "actions/checkout@v4"
        assert (first.get("with", {}).get("fetch-depth") == 0) == needs_history


def test_time_limit_leaves_room_for_installing_and_shrinking():
    limits = [
        (job["timeout-minutes"], step["with"]["limit"])
        for name in WORKFLOWS
        for job, step in steps_of(name)
        if "limit" in step.get("with", {})
    ]
    assert len(limits) == 1
    assert all(int(limit) <= 60 * (minutes - 25) for minutes, limit in limits)


def test_the_files_are_in_the_source_distribution():
    assert "include action.yml" in (ROOT / "MANIFEST.in").read_text()
    assert "graft ci" in (ROOT / "MANIFEST.in").read_text()
