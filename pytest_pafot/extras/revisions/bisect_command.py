"""``python -m pytest_pafot bisect``: find the commit of a policy that made a saved scenario fail."""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pytest_pafot import load
from pytest_pafot.extending import add_world_arguments, chosen_world
from pytest_pafot.extras.revisions.commits import History, copied, halved, inside
from pytest_pafot.extras.revisions.revision_policy import mapped
from pytest_pafot.support.errors import RequestError, command, flag
from pytest_pafot.support.interrupts import undisturbed
from pytest_pafot.support.text import one_line, plural, visible

TOLD = "PYTEST_PAFOT_BISECT"
"""The environment variable that passes paths to the pytest session in which a commit is tried."""

ALIVE = "PYTEST_PAFOT_ALIVE"
"""The environment variable with the descriptor of a pipe that closes when the command has ended, however it ends."""

SHOWN = 60  # the largest number of lines of a diff that are printed
VERDICTS = {True: "passes", False: "fails", None: "no verdict"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    rest = "--good REV [--bad REV] --policy PATH... [--copy PATH...] [--any-pass] [--timeout S] [--world WORLD]"
    parser.usage = f"%(prog)s FILE {rest}"  # argparse would put FILE last, where it reads it as one more PATH
    parser.add_argument("file", metavar="FILE", help="a saved scenario that fails now: its file, or its id")
    parser.add_argument("--good", required=True, metavar="REV", help="a commit in which it passed")
    of_bad = "a later commit in which it fails (default: %(default)s)"
    parser.add_argument("--bad", default="HEAD", metavar="REV", help=of_bad)
    of_policy = "the files and folders of the policy, taken from each commit; all other files stay as they are now"
    parser.add_argument("--policy", required=True, nargs="+", metavar="PATH", help=of_policy)
    of_copy = "files and folders that the test needs and git ignores, such as weights"
    parser.add_argument("--copy", nargs="+", default=[], metavar="PATH", help=of_copy)
    of_any = "let a commit also pass if its test passes because the situation of the file does not occur"
    parser.add_argument("--any-pass", action="store_true", help=of_any)
    of_timeout = "how long the replay of a commit may take [s] (default: %(default)g)"
    parser.add_argument("--timeout", type=_seconds, default=300.0, metavar="S", help=of_timeout)
    of_world = "the world in place of that of the test"
    add_world_arguments(parser, of_world, has_config=False)
    parser.epilog = "The exit code is 0 if one commit is left, and 1 if several are, because some have no verdict."


def _seconds(text: str) -> float:
    with suppress(ValueError):
        if 0 < (seconds := float(text)) < math.inf:
            return seconds
    raise argparse.ArgumentTypeError(f"expected seconds, more than 0, received {text!r}")


def run(arguments: argparse.Namespace, _: Sequence[str]) -> int:
    """Search for the commit that made a scenario fail; return the exit code: 0 if one commit is left, 1 if several."""
    here = Path(os.path.realpath(Path.cwd()))
    chosen_world(arguments.world)
    saved = load(arguments.file)
    found, test = saved.path, saved.finding.test.partition("::")[0]
    history = History.of(arguments.policy, here)
    file = inside(history.root, here, str(found), "FILE")
    extra = copied(history.root, here, arguments.copy, "--copy")
    good, bad = (history.named(revision) for revision in (arguments.good, arguments.bad))
    named, history = history.paths, history.with_whole_submodules(good, bad)
    if history.paths != named:
        _say(f"submodules are tried as a whole: {', '.join(map(visible, history.paths))}")
    commits = _commits(history, good, bad)
    above = (folder / test for folder in file.parents)
    own = [path for path in (file, *above) if history.is_policy(path.as_posix()) and (history.root / path).is_file()]
    if own:
        raise RequestError(
            f"--policy: expected only paths of the policy, received paths that contain {visible(own[0].as_posix())}, "
            "which must be the same in all commits; name the other files and folders one by one"
        )
    dirty = [visible(name) for name in history.uncommitted() if history.is_policy(name)]
    if dirty:
        _say(f"not committed, so not tried: {', '.join(dirty)}")
    _say(f"{plural(len(commits), 'commit')} of {', '.join(map(visible, history.paths))} after {good:.10}")
    with history.worktree([*extra, file.as_posix()]) as tree:
        trials = Trials(
            history, tree, tree / here.relative_to(history.root), tree / file, arguments.timeout, arguments.any_pass,
            arguments.world,
        )  # fmt: skip
        history.put(tree, bad)  # Its error, such as for a submodule that is not cloned, is that of all commits.
        if trials.passes(bad) is not False:
            hint = "commit your changes" if dirty else f"try `{command('pytest', found)}`, or another --bad"
            hint = hint if trials.passes(bad) else f"{hint}; files that git ignores need --copy, a slow test --timeout"
            raise RequestError(f"expected --bad to fail as the file says, received: {trials.why(bad)}; {hint}")
        for start, name in ((good, "--good"), (history.parents(commits[0])[0], "the commit before these")):
            if trials.passes(start) is not True:
                hint = ", or --any-pass if such a pass is enough" if trials.result(start).get("is_other") else ""
                raise RequestError(f"expected {name} to pass, received: {trials.why(start)}; give another --good{hint}")
        left = first_failing(history, trials, commits)
        return _conclude(history, trials, left)


def _commits(history: History, good: str, bad: str) -> list[str]:
    """Return the commits after ``good`` up to ``bad`` that change the policy.

    Raises:
        RequestError: if there is no such commit.
    """
    if not history.is_ancestor(good, bad):
        raise RequestError(
            f"expected a --good that is an ancestor of --bad, received {good:.10}, which is not an ancestor of "
            f"{bad:.10}; give an ancestor, such as the commit that `git merge-base` prints"
        )
    lost = [
        path for path in history.paths if not any(replace(history, paths=(path,)).content(at) for at in (good, bad))
    ]
    if lost:
        raise RequestError(
            f"--policy: expected paths in {good:.10} or {bad:.10}, received {', '.join(map(visible, lost))}"
        )
    commits = history.between(good, bad)
    if not commits:
        raise RequestError(
            f"--policy: expected paths that change from {good:.10} to {bad:.10}, received "
            f"{', '.join(map(visible, history.paths))}, which do not; add the paths of all that the policy imports"
        )
    return commits


def first_failing(history: History, trials: Trials, commits: Sequence[str]) -> Sequence[str]:
    """Return the commits among which the first failing commit is: one commit, or several without a verdict.

    If the first failing commit is a merge, and the merged branch fails as well, the branch is searched.
    """
    left = halved(commits, trials.passes)
    while len(left) == 1 and len(parents := history.parents(left[0])) > 1:
        fork = history.fork(parents[0], parents[1])
        if fork is None or trials.passes(fork) is not True or trials.passes(parents[1]) is not False:
            break  # The merge itself fails, not the branch.
        side = history.between(fork, parents[1])
        if trials.passes(history.parents(side[0])[0]) is not True:
            break
        left = halved(side, trials.passes)
    return left


@dataclass(frozen=True, slots=True)
class Trials:
    """Pytest sessions that replay the file with the policies of commits; equal policies share a session."""

    history: History
    tree: Path
    folder: Path  # the folder in the worktree in which the sessions run
    file: Path
    timeout: float  # [s]
    any_pass: bool  # True if a pass counts even if the situation did not occur
    world: str | None = None  # the world that --world names
    results: dict[str, dict[str, Any]] = field(default_factory=dict)  # results of the sessions, by the content

    def passes(self, commit: str) -> bool | None:
        """Return whether a commit passes; None if its session gave no verdict."""
        result = self.result(commit)
        verdict: bool | None = result["passes"]
        return True if self.any_pass and result.get("is_other") else verdict

    def why(self, commit: str) -> str:
        """Return how the replay of a commit ended, or why there is no replay."""
        return f"{VERDICTS[self.passes(commit)]}: {self.result(commit)['why']}"

    def result(self, commit: str) -> dict[str, Any]:
        """Return the result of a commit's session, or of the session of another commit with the same policy."""
        content = self.history.content(commit)
        if content not in self.results:
            try:
                self.history.put(self.tree, commit)
                self.results[content] = self._session()
            except RequestError as error:  # such as a folder where there is a file now
                self.results[content] = {"passes": None, "why": one_line(str(error))}
            _say(f"  {commit:.10} {self.why(commit)} | {self.history.described(commit, '%s')}")
        return self.results[content]

    def _session(self) -> dict[str, Any]:
        """Run a session with the policy in the worktree; return its result, or its last line as the reason."""
        told = self.tree.parent / "told.json"
        told.unlink(missing_ok=True)
        policy = [str(self.history.root / path) for path in self.history.paths]
        moved = [
            entry for entry in mapped(sys.path, self.history.root, self.tree) if Path(entry).is_relative_to(self.tree)
        ]
        above = [os.environ["PYTHONPATH"]] if os.environ.get("PYTHONPATH") else []
        environ = {
            **os.environ,
            TOLD: json.dumps({"file": str(told), "policy": policy, "world": self.world}),
            # First the worktree: otherwise an editable installation would import the user's own files.
            "PYTHONPATH": os.pathsep.join([*filter(os.path.isdir, moved), *above]),
            # Python takes a compiled file as valid if the source has the same size and time in seconds. Two commits
            # checked out within a second may agree in both.
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        plugins = ["-p", "pafot", "-p", "pytest_pafot.extras.revisions.bisect_session"]
        # A commit is judged by the saved scenario alone: a neighbour may fail before the change that is looked for.
        command = [sys.executable, "-m", "pytest", str(self.file), flag("replay_neighbours", 0), *plugins]
        self.folder.mkdir(parents=True, exist_ok=True)
        with _group(command, self.folder, environ) as session:
            try:
                words, _ = session.communicate(timeout=self.timeout)
            except subprocess.TimeoutExpired:
                return {"passes": None, "why": f"it did not end within {self.timeout:g} s"}
        if told.exists():
            found: dict[str, Any] = json.loads(told.read_text(encoding="utf-8"))
            return found
        lines = [line.strip() for line in words.splitlines() if line.strip()] or ["no word"]
        words = next((line[1:].strip() for line in lines if line.startswith("E ")), lines[-1])
        return {"passes": None, "why": one_line(visible(words))}


@contextmanager
def _group(command: Sequence[str], folder: Path, environ: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a program in this context. At the end, kill it and all processes that it started, if it still runs."""
    pipes: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with ExitStack() as stack:
        if os.name != "nt":
            alive, held = os.pipe()
            stack.callback(os.close, held)
            stack.callback(os.close, alive)
            environ, pipes["pass_fds"] = {**environ, ALIVE: str(alive)}, [alive]
        session = subprocess.Popen(  # noqa: S603  (no shell)
            command, cwd=folder, env=environ, text=True, errors="replace", start_new_session=True, **pipes
        )
        stack.enter_context(session)
        try:
            yield session
        finally:
            with undisturbed():
                if session.poll() is None:
                    os.killpg(session.pid, signal.SIGKILL) if hasattr(os, "killpg") else session.kill()
                    session.wait()  # Popen does not after Ctrl-C, and the worktree would go while it still runs.


def _conclude(history: History, trials: Trials, left: Sequence[str]) -> int:
    """Print the first failing commit, its diff, and the first decision that changed; return the exit code."""
    if len(left) > 1:
        _say(f"one of these {len(left)} commits is the first that fails; all except the last have no verdict:")
        _say("\n".join(f"  {history.described(each, '%H %s')}" for each in left))
        return 1
    before = history.parents(left[0])[0]
    _say(f"{history.described(left[0], '%H is the first that fails, by %an at %aI:')}")
    _say(f"  {history.described(left[0], '%s')}\n")
    lines = history.diff(before, left[0])
    more = [f"... and {plural(len(lines) - SHOWN, 'line')} more"] if len(lines) > SHOWN else []
    _say("\n".join([*lines[:SHOWN], *more, ""]))
    _say(parted(trials.result(before), trials.result(left[0])))
    return 0


def parted(before: dict[str, Any], now: dict[str, Any]) -> str:
    """Return a text on the first decision in which the replays of two commits differ; both are results of sessions."""
    if not (before.get("decisions") and now.get("decisions")):
        return f"decisions cannot be compared: before, {before['why']}; now, {now['why']}"
    pairs = enumerate(zip(before["decisions"], now["decisions"], strict=False))
    place, decisions = next(((place, pair) for place, pair in pairs if pair[0] != pair[1]), (0, None))
    if decisions is None:
        return "both decide the same as long as both drive"
    tick, speed = now["ticks"][place], now["speeds"][place]
    was, became = map(_decision, decisions)
    when = f"the first decision that differs is at tick {tick}, after {tick / now['hz']:.1f} s at {speed:.1f} m/s"
    return f"{when}\n  before: {was}\n  now:    {became}"


def _decision(decision: list[float] | str) -> str:
    if isinstance(decision, str):
        return one_line(visible(decision))
    return f"acceleration {decision[0]:.3g} m/s^2, steering {decision[1]:.3g} rad"


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
