"""Checks of the project, each in its own virtual environment. ``nox -l`` lists them.

The README, ``pyproject.toml`` and ``tests/quick.txt`` define the commands that ``.ci/run`` also uses.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import nox

PROJECT = nox.project.load_toml("pyproject.toml")
PYTHONS = nox.project.python_versions(PROJECT)
"""The Python versions that the project supports, oldest first."""
README = Path("README.md").read_text(encoding="utf-8")
QUICK = "@tests/quick.txt"
STAGES = "oracle or stories or processes or optional or long"

nox.options.sessions = ["lint", "types", f"quick-{PYTHONS[-1]}"]
nox.options.reuse_venv = "yes"


def readme_commands() -> list[list[str]]:
    """Return the README's commands that install the project and run its tests."""
    found = re.search(r"<!-- the tests -->\n```sh\n(.*)\n```", README)
    if found is None:
        raise SystemExit(
            "README.md: expected commands after <!-- the tests -->, received none. Restore them."
        )
    return [shlex.split(command) for command in found[1].split(" && ")]


def requirement(name: str) -> str:
    """Return the requirement for a package from the extra ``test``, including the version."""
    return next(
        each
        for each in PROJECT["project"]["optional-dependencies"]["test"]
        if re.match(rf"{name}\b", each)
    )


@nox.session(python=PYTHONS)
def tests(session: nox.Session) -> None:
    """Run the tests that the README's command runs."""
    install, run = readme_commands()
    session.run(*install)
    session.run(*run, *session.posargs)


@nox.session(python=PYTHONS[0])
def stages(session: nox.Session) -> None:
    """Run the tests that the README's command skips."""
    install, run = readme_commands()
    session.run(*install)
    session.run(*run, "-m", STAGES, *session.posargs)


@nox.session(python=PYTHONS)
def quick(session: nox.Session) -> None:
    """Run the quick tests, which cover everything that can differ between Python versions."""
    session.install(".", "pytest-xdist")
    session.run("python", "-m", "pytest", "-n", "2", QUICK, *session.posargs)


@nox.session(python=PYTHONS[0])
def lint(session: nox.Session) -> None:
    """Check the style and the format of the code."""
    session.install(requirement("ruff"))
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")


@nox.session(python=PYTHONS[0])
def types(session: nox.Session) -> None:
    """Check the types with mypy."""
    session.install(".[test]")
    session.run("mypy")


@nox.session(python=PYTHONS[0])
def docs(session: nox.Session) -> None:
    """Check all samples, tables, links and options in the documentation, and build the site."""
    session.install(".[test,docs]")
    session.run(
        "python",
        "-m",
        "pytest",
        "-n",
        "2",
        "-m",
        "stories or not stories",
        "tests/test_docs.py",
        *session.posargs,
    )
    session.run(*shlex.split("python -m sphinx -W --keep-going -n -b html docs build/site"))
