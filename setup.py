"""Build the modules that have a ``.pxd`` file as compiled extensions, and prepare the README for a package index.

Without a C compiler, the modules run interpreted. If the environment variable ``PAFOT_PURE`` is 1, nothing is compiled,
and the wheel works on all systems.
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
"""The names in the module that checks, on import, whether the compiled modules match the sources."""
SOURCES = KERNEL["record"]()
"""The record of the sources, created before the compiler reads them."""
DIRECTIVES = {
    "language_level": 3,
    "annotation_typing": False,  # the types are in the .pxd files
}
# Cython's own code for arrays, compiled once instead of in each module
SHARED = f"pytest_pafot.{KERNEL['SHARED']}"
FLAGS = [
    # no fused multiply-add, so interpreted modules return the same numbers
    *("-ffp-contract=off", "-fno-math-errno"),
    *("-O1", "-g0"),  # compiles in half the time of -O2 -g; a run takes 5 % longer
]


BUILD = "build"
"""The folder in which setuptools saves generated and compiled files."""
EXAMPLES = "example_ads"
# a top-level package `example_ads` could clash with the user's own
EXAMPLES_INSTALLED = f"pytest_pafot.{EXAMPLES}"


class WithoutExampleTests(build_py):
    """A command that copies the example policies without their tests."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Return the modules of a package, without the tests of the example policies."""
        modules: list[tuple[str, str, str]] = super().find_package_modules(package, package_dir)
        return [
            each
            for each in modules
            if package != EXAMPLES_INSTALLED or each[1] not in ("conftest", "test_safety")
        ]


def packages() -> list[str]:
    """Return the packages of ``pytest_pafot`` and the example policies, which a clone contains in a separate folder."""
    examples = find_packages(include=[f"{EXAMPLES}*"])
    return [
        *find_packages(include=["pytest_pafot*"]),
        *(f"pytest_pafot.{name}" for name in examples),
    ]


class AllOrNothing(build_ext):
    """A command that builds all extensions or none, because compiled modules depend on each other."""

    def finalize_options(self) -> None:
        """Compile as many modules in parallel as there are processors, unless the caller specifies a number."""
        super().finalize_options()
        self.parallel = self.parallel or True

    def run(self) -> None:
        """Compile all extensions. If this fails, warn and remove them. The record does not exist while files change."""
        # anyone who runs Python in a clone imports the clone's package
        roots = Path(self.build_lib), Path()
        records = [root / self.record() for root in roots]
        # an interrupted build may have left incomplete files
        self.force = self.force or not records[0].exists()
        for record in records:
            record.unlink(missing_ok=True)
        try:
            super().run()
            self.copy_extensions_to_source()
            for record in records:
                record.write_text(SOURCES, encoding="utf-8")
        except Exception as error:  # noqa: BLE001  (compilers fail in many ways, and none of them is fatal)
            warnings.warn(
                f"pytest-pafot is installed without its compiled kernel: {error}", stacklevel=1
            )
            self.extensions.clear()
        built = {
            root / self.get_ext_filename(extension.name)
            for extension in self.extensions
            for root in roots
        }
        suffix = self.get_ext_filename("")
        for path in [path for root in roots for path in (root / PACKAGE).rglob(f"*{suffix}")]:
            if path not in built:  # otherwise a deleted module could still be imported
                path.unlink()

    def record(self) -> str:
        """Return the name of the file that records the sources of the extensions, next to one of them."""
        return f"{self.get_ext_filename(SHARED)}.txt"

    def get_output_mapping(self) -> dict[str, str]:
        """Return the source folder's path for each built file, because some editable installations use links."""
        mapping: dict[str, str] = super().get_output_mapping()
        return mapping | (
            {str(Path(self.build_lib, self.record())): self.record()} if mapping else {}
        )

    def build_extension(self, ext: Extension) -> None:
        """Compile a module, with FLAGS if the compiler is gcc or clang."""
        ext.depends = [*ext.depends, __file__]  # contains FLAGS
        ext.extra_compile_args = [] if self.compiler.compiler_type == "msvc" else FLAGS
        super().build_extension(ext)


def has_to_translate_all(made: Path, now: str) -> bool:
    """Return whether Cython would miss a changed source, because Cython only compares modification times.

    A changed source can be older than its translation: ``cp -p``, ``rsync`` and archives preserve modification times.

    Args:
        made: A file with the record of the sources that the last complete build translated.
        now: The record of the current sources.
    """
    if not made.exists():
        return True
    other = {*now.splitlines()} - {*made.read_text(encoding="utf-8").splitlines()}
    changed = [PACKAGE / line.rpartition(" ")[2] for line in other]
    return any(
        not path.exists() or path.stat().st_mtime <= made.stat().st_mtime for path in changed
    )


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
        Extension(
            ".".join(path.relative_to(ROOT).parts), [f"{path.relative_to(ROOT).as_posix()}.py"]
        )
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
    """Wait until no other build runs in this folder, because builds write and remove the same files.

    The later build reuses the files that the earlier one compiled. If a build is killed, the operating system releases
    the lock.
    """
    if os.name != "posix" or "develop" in sys.argv:  # `develop` runs pip, which runs this file
        yield
        return
    import fcntl  # noqa: PLC0415

    folder = Path(BUILD)
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        with suppress(OSError):  # some file systems do not support locks
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


LINK = re.compile(r"(!?)\[([^][]*)\]\((?![a-z]+:|#)([^()\s]+)\)")
SOURCE = re.compile(r'\b(src|srcset)="(?![a-z]+:)([^"]+)"')
DRAWN = re.compile(r"<picture>.*?</picture>", re.DOTALL)


def long_description(readme: str, address: str | None, version: str) -> str:
    """Return the README with absolute links and pictures, for a page outside the repository.

    Args:
        address: The repository's address. The links have the same form as on GitHub. If None, links become plain text
            and pictures are omitted, so that no link is broken.
        version: The version of the release. Links lead to the files with its tag, such as ``v0.1.0``.
    """
    if address is None:
        return LINK.sub(lambda link: "" if link[1] else link[2], DRAWN.sub("", readme))
    text, raw = (f"{address.rstrip('/')}/{kind}/v{version}" for kind in ("blob", "raw"))
    linked = LINK.sub(
        lambda link: f"{link[1]}[{link[2]}]({raw if link[1] else text}/{link[3]})", readme
    )
    return SOURCE.sub(rf'\1="{raw}/\2"', linked)


if __name__ == "__main__":
    project = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
    with one_build_at_a_time():
        setup(
            packages=packages(),
            ext_modules=extensions(),
            cmdclass={"build_ext": AllOrNothing, "build_py": WithoutExampleTests},
            long_description=long_description(
                Path("README.md").read_text(encoding="utf-8"),
                project["urls"].get("Source"),
                project["version"],
            ),
            long_description_content_type="text/markdown",
        )
