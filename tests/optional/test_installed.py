"""A command of an extra runs with the installed package, in a folder that is no clone."""

from pathlib import Path

import pytest

from tests.test_installed import installed, run  # noqa: F401

pytestmark = pytest.mark.stories


def test_installed_comparison_of_example_policy_runs_anywhere(installed, tmp_path):
    arguments = "compare --ads idm_mobil --algorithms random --runs 1 --seconds 60 --workers 1 --out compared"
    done = run(installed, tmp_path, "-m", "pytest_pafot", *arguments.split())
    assert (done.returncode, done.stdout) == (0, str(Path("compared", "report.md")) + "\n"), (
        done.stderr
    )
