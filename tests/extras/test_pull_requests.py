"""The action on a pull request, which compares the policy with that of the main branch."""

import re

import pytest

from pytest_pafot.findings.neighbours import Breadth
from tests.helpers.actions import git, inputs_of, run_action
from tests.test_ci_script import (  # noqa: F401
    PLANNER,
    QUICK,
    TEST,
    begun_repository,
    commit,
    copied,
    record_of,
    repository,
    saved,
    summary,
)

pytestmark = pytest.mark.processes


class TestAPullRequest:
    """A pull request runs through the workflow, with a shorter search."""

    @pytest.fixture(autouse=True)
    def variables(self, copied):
        self.copied = copied

    def run(self, folder, summary, **changes):
        values = {"github.event.pull_request.base.sha": git(folder, "rev-parse", "main")}
        inputs = inputs_of("pull-request", "pull-request", values) | {"runs": "16", "seed": "5", "requirements": ""}
        summary.write_text("")
        code, printed = run_action(inputs | changes, folder, GITHUB_STEP_SUMMARY=str(summary), **self.copied)
        has_page = (folder / "pafot.html").exists() or "nothing" not in printed  # to write, or to compare
        for name in ("pafot.json", "pafot.xml", *["pafot.html"][:has_page]):
            assert (folder / name).is_file(), printed
        assert git(folder, "worktree", "list").count("\n") == 0
        return code, printed

    def test_pull_request_fails_until_its_regression_is_fixed(self, repository, summary):
        commit(repository, {"planner.py": PLANNER, "test_safety.py": TEST}, "A planner")
        git(repository, "switch", "-q", "-c", "closer")
        commit(repository, {"planner.py": PLANNER.replace("2.0  #", "0.6  #")}, "Keep less distance")

        code, printed = self.run(repository, summary)
        (file,) = saved(repository)
        record = record_of(repository)
        (find,), (ran,) = record.findings, record.searches
        assert (code, record.exit) == (1, 1)
        base = git(repository, "rev-parse", "main")
        against = f"rev:{base[:7]}"
        assert f"against {against}: introduces 1 failure, fixes 0, 0 as before" in " ".join(printed.split())
        assert (find.file, find.status, find.responsible) == (file, "new", "ego")
        assert find.against == against
        told, _, compared = summary.read_text().partition("\n**Compared**\n\n")
        head = git(repository, "rev-parse", "HEAD")[:7]
        assert re.fullmatch(
            rf"- rev:{base[:7]} and now \({head}\): 1 of \d+ files of the policy differ: planner.py\n", compared
        )
        counts = re.search(r"\nWorse than rev:&#8203;(\w+): of \d+ random scenarios, \d+ fail only now, .*\n", told)
        assert counts[1] == base[:7]
        assert told.replace(counts[0], "\n") == (
            "### pafot: 1 new\n\n"
            "1 search, 16 runs; repeat with `--pafot-runs=16 --pafot-seed=5`.\n"
            f"A run counts as a failure only if `{against}` passes it.\n"
            f"Of 16 random scenarios {ran.random_failing} failed by the ego's fault.\n\n"
            "**New**\n\n"
            f"- `test_safety.py::test_never_at_fault`: {find.headline}; {Breadth(**find.breadth)}\n"
            f"{''.join(f'  <br>{sentence}{chr(10)}' for sentence in find.sentences)}"
            f"  <br>`python -m pytest {file}`\n"
        )
        assert find.headline.startswith("collision after ")

        git(repository, "add", file)
        fixed = PLANNER.replace("Goes at 22 m/s", "Drives at 22 m/s")  # other text, and the conduct of the base
        commit(repository, {"planner.py": fixed}, "Keep the distance, with the find")
        code, printed = self.run(repository, summary)
        assert code == 0, printed
        assert "### pafot: nothing new, 1 fixed before\n" in summary.read_text()
        assert [(each.file, each.result) for each in record_of(repository).findings] == [(file, "passed")]

    def test_change_in_an_imported_module_is_a_regression(self, repository, summary):
        own, imported = PLANNER.replace("2.0  #", "HEADWAY  #"), "HEADWAY = 2.0\n"
        files = {"planner.py": f"from core import HEADWAY\n{own}", "core.py": imported, "test_safety.py": TEST}
        commit(repository, files, "A planner")
        git(repository, "switch", "-q", "-c", "closer")
        commit(repository, {"core.py": "HEADWAY = 0.0\n"}, "Keep less distance")
        code, printed = self.run(repository, summary, options=QUICK)
        assert (code, "introduces 1 failure, fixes 0, 0 as before" in " ".join(printed.split())) == (1, True), printed

    def test_change_of_no_part_of_the_policy_is_not_searched(self, repository, summary):
        commit(repository, {"planner.py": PLANNER, "test_safety.py": TEST}, "A planner")
        git(repository, "switch", "-q", "-c", "words")
        commit(repository, {"README.md": "It keeps its distance."}, "Say what it does")
        code, printed = self.run(repository, summary)
        assert (code, "nothing to compare" in " ".join(printed.split())) == (0, True), printed

    def test_every_failure_of_a_new_policy_counts(self, repository, summary):
        git(repository, "switch", "-q", "-c", "begins")
        commit(repository, {"planner.py": PLANNER.replace("2.0  #", "0.0  #"), "test_safety.py": TEST}, "A planner")
        code, printed = self.run(repository, summary, options=QUICK)
        assert "every failure counts" in " ".join(printed.split())
        assert "against rev" not in printed
        assert code == record_of(repository).exit

    def test_another_reference_can_be_named(self, repository, summary):
        slower = PLANNER.replace("22.0 -", "21.0 -")
        commit(repository, {"planner.py": PLANNER, "before.py": slower, "test_safety.py": TEST}, "A planner")
        code, printed = self.run(repository, summary, against="before:Planner", runs="4")
        assert (code, "against before:Planner: introduces 0 failures" in printed) == (0, True)

    def test_copy_of_a_policy_is_no_reference_of_its_own(self, repository, summary):
        commit(repository, {"planner.py": PLANNER, "before.py": PLANNER, "test_safety.py": TEST}, "A planner")
        code, printed = self.run(repository, summary, against="before:Planner", runs="4")
        assert (code, record_of(repository).exit) == (2, 4)
        assert "it would be compared with itself" in " ".join(printed.split())

    def test_ignored_weights_are_copied(self, repository, summary):
        reads = PLANNER.replace("2.0  #", "float(open('net.npz').read())  #")
        commit(
            repository, {"planner.py": reads, "test_safety.py": TEST, ".gitignore": "*.npz\npafot.json\n"}, "A planner"
        )
        (repository / "net.npz").write_text("2.0")
        git(repository, "switch", "-q", "-c", "closer")
        commit(repository, {"planner.py": reads.replace("open('net.npz').read()", "'0.0'")}, "Keep less distance")
        assert self.run(repository, summary, runs="4")[0] == 2
        code, printed = self.run(repository, summary, copy="net.npz", options=QUICK)
        assert (code, "introduces 1 failure" in printed) == (1, True), printed
