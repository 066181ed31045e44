"""Build the modules that have a ``.pxd`` file as compiled extensions, and prepare the README for a package index.

Without a C compiler, the modules run interpreted. If the environment variable ``PAFOT_PURE`` is 1, nothing is compiled,
and the wheel is one for all systems.
"""

import os
import re
import runpy
import sys
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
PACKAGE = Path("pytest_pafot")
KERNEL = runpy.run_path(str(ROOT / PACKAGE / "support" / "compiled.py"))
"""What the package knows of its compiled modules, and compares when it imports them."""
SOURCES = KERNEL["record"]()
"""The record of the sources as they are before they are read to be compiled."""
DIRECTIVES = {
    "language_level": 3,
    "annotation_typing": False,  # the types are in the .pxd files
}
SHARED = f"pytest_pafot.{KERNEL['SHARED']}"  # Cython's own code for arrays, compiled once instead of in each module
FLAGS = [
    *("-ffp-contract=off", "-fno-math-errno"),  # no fused multiply-add, for the same numbers as interpreted
    *("-O1", "-g0"),  # compiles in half the time of -O2 -g; a run takes 5 % longer
]


BUILD = "build"
"""The folder for generated and compiled files, as setuptools names it."""
EXAMPLES = "example_ads"
EXAMPLES_INSTALLED = f"pytest_pafot.{EXAMPLES}"  # a top-level package `example_ads` could clash with the user's own


class WithoutExampleTests(build_py):
    """Install the example policies without the tests that search them in a clone."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Return the modules of a package."""
        modules: list[tuple[str, str, str]] = super().find_package_modules(package, package_dir)
        return [each for each in modules if package != EXAMPLES_INSTALLED or each[1] not in ("conftest", "test_safety")]


def packages() -> list[str]:
    """Return the packages of ``pytest_pafot``, and the example policies, which are next to it in a clone."""
    examples = find_packages(include=[f"{EXAMPLES}*"])
    return [*find_packages(include=["pytest_pafot*"]), *(f"pytest_pafot.{name}" for name in examples)]


class AllOrNothing(build_ext):
    """Build all extensions or none: the modules are compiled against each other, so a part of them is useless."""

    def finalize_options(self) -> None:
        """Compile as many modules at once as there are processors, unless the caller gives a number."""
        super().finalize_options()
        self.parallel = self.parallel or True

    def run(self) -> None:
        """Compile all extensions, or remove what was built and warn. While files change, there is no record of them."""
        roots = Path(self.build_lib), Path()  # anyone who runs Python in a clone imports the clone's package
        records = [root / self.record() for root in roots]
        self.force = self.force or not records[0].exists()  # an interrupted build may have left a part of a file
        for record in records:
            record.unlink(missing_ok=True)
        try:
            super().run()
            self.copy_extensions_to_source()
            for record in records:
                record.write_text(SOURCES, encoding="utf-8")
        except Exception as error:  # noqa: BLE001  (compilers fail in many ways, and none of them is fatal)
            warnings.warn(f"pytest-pafot is installed without its compiled kernel: {error}", stacklevel=1)
            self.extensions.clear()
        built = {root / self.get_ext_filename(extension.name) for extension in self.extensions for root in roots}
        suffix = self.get_ext_filename("")
        for path in [path for root in roots for path in (root / PACKAGE).rglob(f"*{suffix}")]:
            if path not in built:  # or a module that is gone could still be imported
                path.unlink()

    def record(self) -> str:
        """Return the name of the file that says what the extensions were made from, next to one of them."""
        return f"{self.get_ext_filename(SHARED)}.txt"

    def get_output_mapping(self) -> dict[str, str]:
        """Return which built file is which one in the sources; some editable installations link these."""
        mapping: dict[str, str] = super().get_output_mapping()
        return mapping | ({str(Path(self.build_lib, self.record())): self.record()} if mapping else {})

    def build_extension(self, ext: Extension) -> None:
        """Compile a module, with FLAGS if the compiler is gcc or clang."""
        ext.depends = [*ext.depends, __file__]  # where FLAGS are
        ext.extra_compile_args = [] if self.compiler.compiler_type == "msvc" else FLAGS
        super().build_extension(ext)


def has_to_translate_all(made: Path, now: str) -> bool:
    """Return whether Cython's own comparison of times would miss a change of a source.

    A source may be older than what was made from it, and yet another one: ``cp -p``, ``rsync`` and archives keep times.

    Args:
        made: what was translated by the last build that was not interrupted, and when.
        now: what is to be translated.
    """
    if not made.exists():
        return True
    other = {*now.splitlines()} - {*made.read_text(encoding="utf-8").splitlines()}
    changed = [PACKAGE / line.rpartition(" ")[2] for line in other]
    return any(not path.exists() or path.stat().st_mtime <= made.stat().st_mtime for path in changed)


def extensions() -> list[Extension]:
    """Return one extension per module, or none if Cython is missing or a wheel for all systems is built."""
    try:
        from Cython import __version__  # noqa: PLC0415
        from Cython.Build import cythonize  # noqa: PLC0415
    except ImportError:
        return []
    if os.environ.get("PAFOT_PURE", "") not in ("", "0"):
        return []
    found = [
        Extension(".".join(path.relative_to(ROOT).parts), [f"{path.relative_to(ROOT).as_posix()}.py"])
        for path in KERNEL["typed"](*KERNEL["FOLDERS"])
    ]
    made, now = Path(BUILD, "translated.txt"), f"{SOURCES}{DIRECTIVES} {__version__}\n"
    is_forced = has_to_translate_all(made, now)
    made.unlink(missing_ok=True)
    modules: list[Extension] = cythonize(
        [*found, Extension(SHARED, [f"{SHARED.replace('.', '/')}.c"])],
        compiler_directives=DIRECTIVES,
        build_dir=BUILD,
        nthreads=os.cpu_count() or 1,
        shared_utility_qualified_name=SHARED,
        force=is_forced,
    )
    made.write_text(now, encoding="utf-8")
    return modules


@contextmanager
def one_build_at_a_time() -> Iterator[None]:
    """Wait for another build in this folder to end: both write the same files, and remove some of them.

    The later build finds what the earlier one compiled. The operating system releases the lock of a killed build.
    """
    if os.name != "posix" or "develop" in sys.argv:  # `develop` runs pip, which runs this file
        yield
        return
    import fcntl  # noqa: PLC0415

    folder = Path(BUILD)
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        with suppress(OSError):  # some file systems have no locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


LINK = re.compile(r"(!?)\[([^][]*)\]\((?![a-z]+:|#)([^()\s]+)\)")
SOURCE = re.compile(r'\b(src|srcset)="(?![a-z]+:)([^"]+)"')
DRAWN = re.compile(r"<picture>.*?</picture>", re.DOTALL)


def long_description(readme: str, address: str | None, version: str) -> str:
    """Return the README for a page outside the repository: its relative links and pictures lead into the repository.

    Args:
        address: The repository's address; paths follow GitHub. Without an address, links become plain words and
            pictures are left out, so that no link is broken.
        version: The release. Its tag, such as ``v0.1.0``, has the same files as this package.
    """
    if address is None:
        return LINK.sub(lambda link: "" if link[1] else link[2], DRAWN.sub("", readme))
    text, raw = (f"{address.rstrip('/')}/{kind}/v{version}" for kind in ("blob", "raw"))
    linked = LINK.sub(lambda link: f"{link[1]}[{link[2]}]({raw if link[1] else text}/{link[3]})", readme)
    return SOURCE.sub(rf'\1="{raw}/\2"', linked)


if __name__ == "__main__":
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    with one_build_at_a_time():
        setup(
            packages=packages(),
            ext_modules=extensions(),
            cmdclass={"build_ext": AllOrNothing, "build_py": WithoutExampleTests},
            long_description=long_description(
                Path("README.md").read_text(encoding="utf-8"), project["urls"].get("Source"), project["version"]
            ),
            long_description_content_type="text/markdown",
        )
