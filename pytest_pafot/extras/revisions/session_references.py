"""The references of a session that are revisions: their copies, the processes of their policies, and what differs."""

from __future__ import annotations

import os
import re
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pytest_pafot import Scenario
from pytest_pafot.extending import ProcessLostError, refusals
from pytest_pafot.extras.revisions.revision import PROCESS, Revision, revision_at
from pytest_pafot.extras.revisions.revision_driver import RevisionDriver
from pytest_pafot.extras.revisions.revision_policy import RevisionPolicy, rolled
from pytest_pafot.extras.revisions.revision_process import NO_TEST, Served
from pytest_pafot.support.errors import OutOfTime, RequestError, RevisionError, flag

REVISIONS: pytest.StashKey[Revisions] = pytest.StashKey()
COPY = flag("copy")


@dataclass(frozen=True, slots=True)
class OfTest:
    """The policy of a test in a revision; ``policy`` is None if the revision does not have it yet."""

    revision: Revision
    policy: RevisionPolicy | None
    test: str = ""  # the path of the test file in the repository; empty for the policy of a command
    put: str = ""  # the path of the present test file in the copy, if the revision does not have the test


@dataclass(eq=False)
class Revisions:
    """The revisions of this process of a session. Each worker of pytest-xdist has its own."""

    stack: ExitStack
    copies: dict[tuple[Path, str, str], Revision] = field(default_factory=dict)
    known: dict[tuple[str, str], OfTest | RevisionError] = field(default_factory=dict)

    def built(self, item: pytest.Item, against: str, paths: str, name: str, named: str) -> OfTest:
        """Start the process of the policy of an item's test in a revision, which gets the present files of ``paths``.

        Raises:
            RevisionError: if there is no such revision, or its policy cannot be built.
        """
        # One copy of the revision is for all tests of a repository, since it may be large.
        here, file = (Path(os.path.realpath(path)) for path in (item.config.invocation_params.dir, item.path))
        folder = here if named else file.parent
        key = (next((each for each in (folder, *folder.parents) if (each / ".git").exists()), folder), against, paths)
        if key not in self.copies:
            self.copies[key] = self.stack.enter_context(revision_at(against, folder, here, paths, COPY))
        revision = self.copies[key]
        # A command names a policy. Else it is that of the revision's own test. If there is none, the present test file
        # is put into the revision, next to all others, which remain as they were.
        if named:
            tried = {"": revision.policy(PROCESS, named)}
        else:
            test = file.relative_to(revision.history.root)
            has_file = (revision.tree / test).exists()
            put = test.with_stem(f"{test.stem}_of_now") if has_file else test
            tried = {"": _of_test(item, revision, test, name)} if has_file else {}
            tried[put.as_posix()] = _of_test(item, revision, put, name)
        for put_at, policy in tried.items():
            if put_at:
                (revision.tree / put_at).parent.mkdir(parents=True, exist_ok=True)
                (revision.tree / put_at).write_bytes(file.read_bytes())
            self.stack.callback(policy.close)
            try:
                policy.start()
                break
            except OutOfTime:
                why = "it was not built before the time limit of the search was over; give the search more time"
                raise RevisionError(
                    f"{policy.label}: expected a process with its policy, received none: {why}"
                ) from None
            except RevisionError as error:
                is_last = bool(named or put_at) or error.missing.startswith("fixture:")
                if is_last and revision.lacks(error.missing):
                    return OfTest(revision, None)
                if is_last or error.missing != NO_TEST:
                    raise
        return OfTest(revision, policy, "" if named else test.as_posix(), put_at)


def _of_test(item: pytest.Item, revision: Revision, test: Path, name: str) -> RevisionPolicy:
    """Return the policy of an item's test in a revision, with the session of this test file there."""
    config, own = item.config, re.compile(rf"{re.escape(str(revision.history.root))}(?=/|$)")
    given = [str(arg) for arg in getattr(config, "workerinput", {}).get("mainargv", ("",))[1:]]
    given = given or [str(arg) for arg in config.invocation_params.args]
    others = {*map(str, config.getoption("file_or_dir", None) or ())}
    arguments = [own.sub(lambda _: str(revision.tree), arg) for arg in given if arg not in others]
    arguments += [str(revision.tree / test), *(["-n0"] if config.pluginmanager.has_plugin("xdist") else [])]
    return revision.policy("pytest_pafot.extras.revisions.revision_session", name, tuple(arguments))


def revision_of(
    item: pytest.Item, against: str, copy: str, test: str, name: str, named: str, *, place: str = "against: "
) -> OfTest:
    """Return the policy of an item's test in a revision.

    Args:
        item: the item.
        against: the revision, with its prefix.
        copy: the present files that the revision gets.
        test: the node id of the test, without the plugin's own part.
        name: the name of the test in its file.
        named: the policy that a command names, in place of that of a test; or empty.
        place: the beginning of messages.

    Raises:
        RevisionError: if there is no such revision, or its policy cannot be built.
    """
    stash = item.config.stash
    if REVISIONS not in stash:
        stash[REVISIONS] = Revisions(ExitStack())
        item.config.add_cleanup(stash[REVISIONS].stack.close)
    revisions, key = stash[REVISIONS], (against, test)
    if key not in revisions.known:
        for other in revisions.known.values():  # Only one process at a time, since models may be large.
            if isinstance(other, OfTest) and other.policy is not None:
                other.policy.close()
        try:
            revisions.known[key] = revisions.built(item, against, copy, name, named)
        except RevisionError as error:
            revisions.known[key] = error
    known = revisions.known[key]
    if isinstance(known, RevisionError):
        raise RevisionError(f"{place}{known}")
    return known


def driver_of(
    item: pytest.Item, revision: str, copy: str, test: str, name: str, named: str
) -> tuple[RevisionDriver, str]:
    """Return the factory of drivers of NPCs by the policy of an item's test in a revision, and the revision's label.

    The arguments are those of :func:`revision_of`.

    Raises:
        RevisionError: if there is no such revision, or its policy is new since then or cannot be built.
    """
    found = revision_of(item, revision, copy, test, name, named, place="")
    if found.policy is None:
        raise RevisionError(
            f"{found.revision.label}: expected a revision that has the policy, received one that lacks it; name a "
            "later one"
        )
    return RevisionDriver(found.policy), found.revision.label


def compared(found: OfTest, world: Any, scenario: Scenario) -> tuple[list[str], str]:
    """Return lines on both sides of a comparison with a revision; and a sentence if both policies are the same.

    The policy of the revision drives a scenario first, so that files that it opens late count as well.

    Raises:
        RevisionError: if the policy of the revision cannot be driven, or git fails.
    """
    revision, policy = found.revision, found.policy
    if policy is None:
        return [f"the policy is new since {revision.label}: every failure counts"], ""
    try:
        with refusals():
            policy.call(rolled, "rollout", world, scenario)
            seen = policy.call(Served.hashes)
            seen.pop(found.put, None)
            return revision.compared(seen, found.test, is_whole=policy.call(Served.is_whole))
    except OutOfTime:
        return [], ""  # The search has no time for a run either, and reports it.
    except ProcessLostError:
        return [], ""  # Each of its runs fails, which the search reports.
    except RequestError as error:
        text = str(error).removeprefix(f"{policy.label}: ").removeprefix("ads: ")
        raise RevisionError(f"against ({policy.label}): {text}") from None
