"""The references of a session that are revisions: their copies, the processes of their policies, and what differs."""

from __future__ import annotations

import os
import re
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from pytest_pafot.campaign.harness import Harness, Reference, modules_behind, refusals
from pytest_pafot.campaign.options import REVISION
from pytest_pafot.campaign.request import AgainstError, Request, RequestError, build_space
from pytest_pafot.commands.revision import OF_COMMAND, Revision, files_line, revision_at, sides
from pytest_pafot.commands.revision_process import NO_TEST, digest_of, hashes_of, name_of
from pytest_pafot.corpus.layout import relative
from pytest_pafot.execution.pool import ProcessLostError
from pytest_pafot.execution.revision_policy import RevisionError, RevisionPolicy, rolled
from pytest_pafot.plugin import messages
from pytest_pafot.plugin.node_ids import base_id, qualified_name
from pytest_pafot.searching.space import sample

REVISIONS: pytest.StashKey[Revisions] = pytest.StashKey()
COPY = "--pafot-copy"


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
    _copies: dict[tuple[Path, str, str], Revision] = field(default_factory=dict)
    _known: dict[tuple[str, str], OfTest | RevisionError] = field(default_factory=dict)

    def of(self, item: pytest.Item, request: Request) -> OfTest:
        """Return the policy of an item's test in the revision that its request names.

        Raises:
            AgainstError: if there is no such revision, or its policy cannot be built.
        """
        key = (str(request.settings.against), base_id(item))
        if key not in self._known:
            for other in self._known.values():  # Only one process at a time, since models may be large.
                if isinstance(other, OfTest) and other.policy is not None:
                    other.policy.close()
            try:
                self._known[key] = self._built(item, request)
            except RevisionError as error:
                self._known[key] = error
        known = self._known[key]
        if isinstance(known, RevisionError):
            raise AgainstError(f"against: {known}")
        return known

    def _built(self, item: pytest.Item, request: Request) -> OfTest:
        here, file = (Path(os.path.realpath(path)) for path in (item.config.invocation_params.dir, item.path))
        named = os.environ.get(OF_COMMAND, "")
        revision = self._copy(here if named else file.parent, here, request)
        if named:
            return self._started(OfTest(revision, revision.named(named, here, copy=COPY)), may_be_new=True)
        test = put = file.relative_to(revision.history.root)
        if (revision.tree / test).exists():
            found = OfTest(revision, _session(item, revision, test, here), test.as_posix())
            try:
                return self._started(found, may_be_new=False)
            except RevisionError as error:
                if error.missing != NO_TEST:
                    raise
            put = put.with_stem(f"{put.stem}_of_now")  # not in place of the other tests of this revision
        # The revision has no such test: the present file is put into it, and all others remain as they were.
        (revision.tree / put).parent.mkdir(parents=True, exist_ok=True)
        (revision.tree / put).write_bytes(file.read_bytes())
        found = OfTest(revision, _session(item, revision, put, here), test.as_posix(), put.as_posix())
        return self._started(found, may_be_new=True)

    def _copy(self, folder: Path, here: Path, request: Request) -> Revision:
        """Return the copy of the revision of the repository around a folder; tests of one repository share it."""
        root = next((each for each in (folder, *folder.parents) if (each / ".git").exists()), folder)
        key = (root, str(request.settings.against), request.settings.copy or "")
        if key not in self._copies:
            _, text, paths = key
            self._copies[key] = self.stack.enter_context(revision_at(text, folder, here, paths, COPY))
        return self._copies[key]

    def _started(self, found: OfTest, *, may_be_new: bool) -> OfTest:
        """Start the process of a policy; if its revision does not have it and it may be new, return that it is new."""
        if found.policy is None:
            return found
        try:
            found.policy.built()
        except RevisionError as error:
            if may_be_new and found.revision.lacks(error.missing):
                return OfTest(found.revision, None)
            raise
        self.stack.callback(found.policy.close)
        return found


def _session(item: pytest.Item, revision: Revision, test: Path, here: Path) -> RevisionPolicy:
    """Return the policy of an item's test in a revision, with the session of this test file there."""
    config, own = item.config, re.compile(rf"{re.escape(str(revision.history.root))}(?=/|$)")
    given = [str(arg) for arg in getattr(config, "workerinput", {}).get("mainargv", ("",))[1:]]
    given = given or [str(arg) for arg in config.invocation_params.args]
    others = {*map(str, config.getoption("file_or_dir", None) or ())}
    arguments = [own.sub(lambda _: str(revision.tree), arg) for arg in given if arg not in others]
    arguments += [str(revision.tree / test), *(["-n0"] if config.pluginmanager.has_plugin("xdist") else [])]
    program = "pytest_pafot.plugin.revision_session"
    return revision.policy(here, program, qualified_name(item), copy=COPY, session=tuple(arguments))


def revision_of(item: pytest.Item, request: Request) -> OfTest | None:
    """Return the policy of an item's test in the revision that its request names; None if it names none.

    Raises:
        AgainstError: if there is no such revision, or its policy cannot be built.
    """
    if not isinstance(request.settings.against, str) or not request.settings.against.startswith(REVISION):
        return None
    stash = item.config.stash
    if REVISIONS not in stash:
        stash[REVISIONS] = Revisions(ExitStack())
        item.config.add_cleanup(stash[REVISIONS].stack.close)
    return stash[REVISIONS].of(item, request)


def reference(found: OfTest) -> Reference | None:
    """Return the reference of a search; None if the policy is new."""
    policy = found.policy
    return None if policy is None else Reference(ads=policy, name=policy.label, commit=policy.commit)


def compare(item: pytest.Item, harness: Harness) -> None:
    """Send lines on both sides of a comparison. Skip the item if both policies are the same.

    The policy of a revision drives a run first, so that files that it opens late count as well.

    Raises:
        AgainstError: if the policy of the revision cannot be driven.
    """
    found, against = revision_of(item, harness.request), harness.against
    if not harness.request.settings.is_search or (found is None and against is None):
        return
    if found is None:
        for who, ads in ((against.shown, against.ads), ("now", harness.ads)) if against is not None else ():
            files = {relative(path, harness.root): digest_of(path) for path in sorted(modules_behind(ads))}
            messages.send(item, "compared", {"text": files_line(who, files)})
        return
    revision, policy = found.revision, found.policy
    if policy is None:
        messages.send(item, "compared", {"text": f"the policy is new since {revision.label}: every failure counts"})
        return
    scenario = sample(build_space(harness.request, harness.world), np.random.default_rng(0))
    try:
        with refusals():
            policy.call(rolled, "rollout", harness.world, scenario)
            seen = policy.call(hashes_of)
    except ProcessLostError:
        return  # Each of its runs fails, which the search reports.
    except RequestError as error:
        text = str(error).removeprefix(f"{policy.label}: ").removeprefix("ads: ")
        raise AgainstError(f"against ({policy.label}): {text}") from None
    seen.pop(found.put, None)
    there, now = policy.built()["factory"], name_of(harness.ads)
    is_outside = bool(now) and now == there and harness.ads.__module__ != item.module.__name__  # type: ignore[attr-defined]
    paths = {Path(os.path.realpath(each.path)) for each in item.session.items}
    root = revision.history.root
    tests = {each.relative_to(root).as_posix() for each in paths if each.is_relative_to(root)} - {found.test}
    differ = revision.differing(seen, found.test if is_outside or found.put else "", tests)
    for line in sides(revision, seen, differ):
        messages.send(item, "compared", {"text": line})
    if not differ:
        text = f"the policy is that of {revision.label}: nothing to compare"
        messages.send(item, "compared", {"text": text})
        pytest.skip(text)
