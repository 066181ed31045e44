"""Where the saved scenarios of tests lie: the corpus that serves a test file, the folder of a module and of a test.

Folder names are readable, distinct for distinct tests, and valid on every file system. Nothing here reads a file.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable
from pathlib import Path

SUFFIX = ".pafot.yaml"
"""Of the name of a saved scenario's file; what stands before it is the finding's id."""

CORPUS = "pafot_corpus"
"""Name of the folder beside a test file, unless the option ``corpus`` names another."""

MAX_NAME = 80
DIGEST = 10

_PLAIN = re.compile(r"[a-z0-9_](?:[a-z0-9_.,=+-]*[a-z0-9_,=+-])?")
_WITH_PARAMETERS = re.compile(r"([^@\[\]]+)\[([^@\[\]]+)\]")
_RESERVED = re.compile(r"(?:con|prn|aux|nul|com\d|lpt\d|conin|conout|clock)(?=[.@,=+~-]|$)", re.IGNORECASE)


def files_in(folder: Path) -> list[Path]:
    """The corpus files in a folder, sorted by name; none in one that is missing or cannot be listed."""
    # One that cannot be listed has no items; whoever writes a finding into it is told what is wrong with it.
    return [path for path in entries_of(folder) if path.name.endswith(SUFFIX)]


def modules_in(root: Path) -> list[Path]:
    """The folders of a corpus, each of a module, by name; none where there is no corpus."""
    return [path for path in entries_of(root) if is_folder(path)]


def entries_of(folder: Path) -> list[Path]:
    """All that a folder holds, by name; nothing where it is missing or cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder.

    ``Path.is_dir`` raises where a link leads into a folder that this user may not read, or its target is too long for a
    name. A pull request can bring such links, and none of them may end the collection.
    """
    return os.path.isdir(path)  # noqa: PTH112


def files_below(root: Path) -> list[Path]:
    """All corpus files at or below a folder, by path. No link to a folder is followed: it may lead back to itself."""
    return sorted(Path(folder, name) for folder, _, names in os.walk(root) for name in names if name.endswith(SUFFIX))


def folders_below(root: Path) -> list[Path]:
    """All folders at or below one that hold corpus files, whatever the layout."""
    return sorted({path.parent for path in files_below(root)})


def counterparts(place: Path, folders: Iterable[Path]) -> list[Path]:
    """The folders of tests that lie in their corpora as a folder does in another one, given by its path in that.

    It has the folder of the module and that of the test, and those above where the other has the corpora of several
    folders of test files.
    """
    parts = place.parts
    return [folder for folder in folders if len(parts) > 1 and folder.parts[-len(parts) :] == parts]


def corpus_root(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """The corpus that serves a test file: beside it, or for an absolute path in one place for all."""
    folder = Path(corpus)
    if not folder.is_absolute():
        return test_file.parent / folder
    try:
        return folder / test_file.parent.relative_to(rootpath)
    except ValueError:
        return folder


def link_below(base: Path, path: Path) -> Path | None:
    """The first link on the way from a folder, which may itself be one, down to a path; None where there is none."""
    way = [each for each in (path, *path.parents) if each != base and each.is_relative_to(base)]
    return next((each for each in reversed(way) if os.path.islink(each)), None)  # noqa: PTH114  (see is_folder)


def chosen_folder(test_file: Path, corpus: str) -> Path:
    """The folder on the way to a corpus that the user has chosen: a link below it may come from anybody."""
    return Path(corpus) if Path(corpus).is_absolute() else test_file.parent


def link_out(base: Path, root: Path, rootpath: Path) -> Path | None:
    """Return the link below a folder by which a corpus lies outside the project, or None."""
    link = link_below(base, root)
    return None if link is None or is_inside(root, rootpath) else link


def is_inside(path: Path, rootpath: Path) -> bool:
    """Return whether a path lies in the project once all links are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(rootpath))


def is_corpus(path: Path, corpus: Path) -> bool:
    """Whether a folder is one that a corpus option names."""
    if corpus.is_absolute():
        return path == corpus
    return path.name == corpus.name and path.parts[-len(corpus.parts) :] == corpus.parts


def folder_of_module(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """Where the folders of all tests of a module lie."""
    return corpus_root(test_file, corpus, rootpath) / safe_name(test_file.stem)


def folder_of_test(test_file: Path, test_name: str, corpus: str, rootpath: Path) -> Path:
    """Where the findings of one test lie; its name has class and parameters, as ``TestBraking::test_it[4-slow]``."""
    return folder_of_module(test_file, corpus, rootpath) / safe_name(test_name)


def module_of_file(file: Path, corpus: str, rootpath: Path) -> Path | None:
    """The test file that a corpus file belongs to, whatever its content; None outside of a corpus."""
    if len(file.parents) < 3:
        return None
    root, module = file.parents[2], file.parents[1].name
    folder = Path(corpus)
    if folder.is_absolute():
        directory = rootpath / root.relative_to(folder) if root.is_relative_to(folder) else None
    else:
        directory = root.parents[len(folder.parts) - 1] if is_corpus(root, folder) else None
    return None if directory is None else module_named(directory, module)


def module_named(directory: Path, folder: str) -> Path:
    """The test file of a directory whose corpus folder has this name; it may not exist."""
    return next((file for file in directory.glob("*.py") if safe_name(file.stem) == folder), directory / f"{folder}.py")


def relative(path: Path, rootpath: Path) -> str:
    """A path as people read it."""
    return path.relative_to(rootpath).as_posix() if path.is_relative_to(rootpath) else str(path)


def safe_name(text: str) -> str:
    """A folder name for any text.

    ``test_it`` stays as it is and ``test_it[4-slow]`` becomes ``test_it@4-slow``: pytest and shells give square
    brackets a meaning in paths. What has capitals (some file systems ignore case), other characters, a name that
    Windows reserves, or more than 80 characters, is made readable and ends with ``~`` and ten digits of a digest
    of the whole text, so that distinct texts never share a name.
    """
    bracketed = _WITH_PARAMETERS.fullmatch(text)
    parts = bracketed.groups() if bracketed else (text,)
    name = "@".join(parts)
    if all(map(_PLAIN.fullmatch, parts)) and len(name) <= MAX_NAME and not _RESERVED.match(name):
        return name
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:DIGEST]
    readable = _readable(name)
    prefix = "_" if not readable or _RESERVED.match(readable) else ""
    return f"{prefix}{readable}~{digest}"


def may_be_of(folder: str, test: str) -> bool:
    """Whether the folder of this name can be that of a test, given without parameters, or of one with parameters."""
    if "~" not in folder:
        return folder.partition("@")[0] == safe_name(test)
    # At its end "-" and "." are stripped, which stay where parameters follow.
    return re.match(rf"_?{re.escape(_readable(test).removeprefix('_'))}[-.]*[@~-]", folder) is not None


def _readable(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.,=+@-]+", "-", text.replace("::", "."))[: MAX_NAME - DIGEST - 2].strip("-.")
