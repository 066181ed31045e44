"""What messages name as a way out: commands, options, packages and pages. A test runs what each of these can make."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence

OF_SEARCH = "PYTEST_PAFOT_SEARCH"
"""The environment variable with the command ``search`` that has started the pytest session, as it was typed."""


def command(*words: object) -> str:
    """Return a command of Python, such as ``python -m pytest_pafot corpus list``, as a shell reads it."""
    return shlex.join(["python", "-m", *map(str, words)])


def flag(name: str, value: object = None) -> str:
    """Return an option as pytest and the command ``search`` accept it, such as ``--pafot-max-time=5``."""
    option = f"--pafot-{name.replace('_', '-')}"
    return option if value is None else shlex.join([f"{option}={value}"])


def install(name: str) -> str:
    """Return the command that installs this package with the libraries of an optional part."""
    return f"pip install 'pytest-pafot[{name}]'"


def page(name: str) -> str:
    """Return where a page of the documentation is, such as ``guide/own-world.md``, in a clone of the repository."""
    return f"docs/{name}"


def rerun(words: Sequence[str], environ: Mapping[str, str], *options: str, saved: str = "") -> str:
    """Return the command that runs a part of a session again: pytest with ``words``, and with options.

    The command ``search`` leaves no test files that pytest could run. So in its session it is the command itself, or
    the command for only one saved scenario, whose id is ``saved``.
    """
    if not environ.get(OF_SEARCH):
        return shlex.join([*words, *options])
    given = shlex.split(environ[OF_SEARCH])
    end = given.index("--") if "--" in given else len(given)
    of_pytest = [*given[end + 1 :], *(["-k", saved] if saved else [])]
    return shlex.join([*given[:end], *options, *(["--", *of_pytest] if of_pytest else [])])
