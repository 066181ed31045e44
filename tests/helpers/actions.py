"""Run the repository's composite action as GitHub does, as far as a shell can: only the steps that are commands."""

import json
import os
import re
import socket
import socketserver
import subprocess
import sys
import tempfile
import threading
from contextlib import contextmanager
from pathlib import Path

import yaml

from tests.helpers.sessions import CORE, Copy, imported

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "ci" / "pafot.sh"
WORKFLOWS = {path.stem: path for path in sorted((ROOT / "ci" / "workflows").glob("*.yml"))}
EXPRESSION = re.compile(r"\$\{\{ *([^}]*?) *\}\}")
OWN = "./.github/actions/pafot"
"""The path to which users copy the action and by which workflows name it."""


def loaded(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def action():
    return loaded(ROOT / "action.yml")


def filled(text, values):
    """Replace the expressions in a text. KeyError if one has no value: the test or the file is wrong."""
    return EXPRESSION.sub(lambda found: str(values[found[1]]), str(text))


def steps_of(workflow):
    """Return the steps of a workflow, each with its job."""
    return [
        (job, step) for job in loaded(WORKFLOWS[workflow])["jobs"].values() for step in job["steps"]
    ]


def inputs_of(workflow, task, values=None):
    """Return the inputs that a workflow passes to the action for a task, with its expressions replaced."""
    (given,) = (
        step["with"] for _, step in steps_of(workflow) if step.get("with", {}).get("task") == task
    )
    return {name: filled(each, values or {}) for name, each in given.items()}


def environment(**variables):
    """Return a job's environment: the tests' Python, only this plugin, and no variables of a CI around the tests."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PAFOT_", "GITHUB_", "PYTEST_"))
    }
    kept.pop("CI", None)
    path = os.pathsep.join([str(Path(sys.executable).parent), kept.get("PATH", os.defpath)])
    named = {
        f"GIT_{who}_{what}": "a@b.c"
        for who in ("AUTHOR", "COMMITTER")
        for what in ("NAME", "EMAIL")
    }
    plugins = {
        "PYTHONPATH": str(ROOT),
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTEST_PLUGINS": "pytest_pafot.plugin",
    }
    return {
        **kept,
        **named,
        **plugins,
        "PATH": path,
        "CI": "true",
        "GIT_CONFIG_GLOBAL": os.devnull,
    } | variables


def run_action(inputs, folder, **variables):
    """Run the steps of the action in a folder up to the first that fails; return its exit code and all output."""
    declared = action()
    assert not inputs.keys() - declared["inputs"].keys()
    values = {
        f"inputs.{name}": inputs.get(name, each["default"])
        for name, each in declared["inputs"].items()
    }
    printed = ""
    for step in declared["runs"]["steps"]:
        if "run" not in step:
            continue
        own = {name: filled(value, values) for name, value in step["env"].items()}
        code, text = shell(step["run"], folder, GITHUB_ACTION_PATH=str(ROOT), **own, **variables)
        printed += text
        if code:
            return code, printed
    return 0, printed


def shell(command, folder, **variables):
    """Run a step's command and return its exit code and output."""
    bash = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", command]
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    done = subprocess.run(
        bash, cwd=folder, env=environment(**variables), **streams, text=True, check=False
    )
    return done.returncode, done.stdout


ASKING = """#!{python} -IS
import json, os, socket, sys
if sys.argv[1] != "-m":
    os.execv(sys.executable, [sys.executable, *sys.argv[1:]])
tests = socket.socket(socket.AF_UNIX)
tests.connect({address!r})
asked = [[sys.executable, *sys.argv[1:]], os.getcwd(), dict(os.environ)]
socket.send_fds(tests, [json.dumps(asked).encode()], [0, 1, 2])
sys.exit(tests.recv(1)[0])
"""
"""A Python that starts in a hundredth of the time of a session, and asks the tests' process for the session."""


class Asked(socketserver.BaseRequestHandler):
    def handle(self):
        text, streams, *_ = socket.recv_fds(self.request, 2**20, 3)
        command, folder, variables = json.loads(text)
        stdin, stdout, stderr = streams
        with Copy(
            command, cwd=folder, env=variables, stdin=stdin, stdout=stdout, stderr=stderr
        ) as process:
            self.request.send(bytes([process.wait() % 256]))
        for stream in streams:
            os.close(stream)


@contextmanager
def copies():
    """Yield variables with which a script's sessions, and this package's commands, are copies of this process.

    Signals do not reach a copy, and it is no interpreter of its own: see ``Copy``.
    """
    imported(*CORE)
    with tempfile.TemporaryDirectory() as folder:  # its name is short enough for a socket's
        python, address = Path(folder, "python"), str(Path(folder, "asked"))
        python.write_text(ASKING.format(python=sys.executable, address=address), encoding="utf-8")
        python.chmod(0o700)
        with socketserver.UnixStreamServer(address, Asked) as server:
            threading.Thread(target=server.serve_forever, args=(0.02,)).start()
            try:
                yield {"PATH": os.pathsep.join([folder, os.environ.get("PATH", os.defpath)])}
            finally:
                server.shutdown()  # or its thread would keep this process


def git(folder, *args):
    """Run git and return its output."""
    done = subprocess.run(
        ["git", *args], cwd=folder, env=environment(), capture_output=True, text=True, check=True
    )
    return done.stdout.strip()
