"""Search the commit BASE and then the change, and accept the failures that both have. ``pafot.sh`` runs this file."""

import json
import os
import signal
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

SCRIPT = Path(__file__).resolve().with_name("pafot.sh")


def run(task, **given):
    """Run a task of ``pafot.sh`` and return its exit code. Forward signals, so that the task stops its processes."""
    with subprocess.Popen(["sh", SCRIPT, task, *sys.argv[1:]], **given) as process:
        for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: process.send_signal(number))
    return (
        process.returncode if 0 <= process.returncode < 128 else sys.exit(abs(process.returncode))
    )


def failures_of_base(there, environ):
    """Install and search BASE in its checkout. Return its failures, or a requirement that it does not meet."""
    # What BASE requires takes precedence over what is already installed.
    if environ.get("REQUIREMENTS"):
        own, outer = there / ".pafot-venv", sysconfig.get_path("purelib")
        venv.create(own, with_pip=True, symlinks=True)
        also = Path(sysconfig.get_path("purelib", vars={"base": str(own)}), "outer.pth")
        also.write_text(f"import site; site.addsitedir({outer!r})\n", encoding="utf-8")
        environ["PATH"] = f"{own / 'bin'}{os.pathsep}{environ['PATH']}"
        if run("install", cwd=there, env=environ):
            return "that can be installed"
    if run("search", cwd=there, env=environ) not in (0, 1, 5):
        return "whose tests can be run"
    findings = json.loads((there / "pafot.json").read_text(encoding="utf-8"))["findings"]
    return [each for each in findings if each["result"] in ("failed", "error") and each["file"]]


there, copies, base = Path(sys.argv.pop(1)), [], f"BASE={os.environ['BASE']}"
known = failures_of_base(
    there, {name: text for name, text in os.environ.items() if not name.startswith("GITHUB_")}
)
if isinstance(known, str):
    print(
        f"pafot.sh: expected {base} to be a commit {known}, received the error above. Fix it or set another BASE.",
        file=sys.stderr,
    )
    sys.exit(2)
# The search does not report copied failures as new. Do not copy failures of removed tests.
for each in known:
    file, (test, _, name) = each["file"], each["test"].partition("::")
    root = next(at for at in (there, *there.parents) if (at / file).is_file())  # pytest's rootdir
    copy, test = (Path(os.path.relpath(root / path, there)) for path in (file, test))
    is_there = (
        test.is_file()
        and f"def {name.partition('[')[0].rpartition('::')[2]}(" in test.read_text("utf-8")
    )
    if is_there and not copy.exists():
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes((root / file).read_bytes())
        copies.append(copy)
print(
    f"pafot.sh: accepted {len(known)} failure{'s' * (len(known) != 1)} already present in {base}",
    flush=True,
)
sys.argv += [f"--deselect={each['node_id']}" for each in known]
try:
    sys.exit(run("search"))
finally:
    for copy in copies:
        copy.unlink(missing_ok=True)
