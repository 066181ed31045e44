"""The folders of saved scenarios: the corpus of a test file, with a folder for its module and one for each test.

Folder names are readable, distinct for distinct tests, and valid on every file system. This module reads no file.
"""

from __future__ import annotations

import hashlib
import os
import re
import string
from bisect import bisect_left
from itertools import groupby, islice, takewhile
from pathlib import Path

SUFFIX = ".pafot.yaml"
"""The suffix of a saved scenario's file; the name before it is the finding's id."""

CORPUS = "pafot_corpus"
"""The name of the folder next to a test file, unless the option ``corpus`` gives another name."""

FOUND = "pafot_found"
"""The name of the folder in which the command ``search`` saves what it finds. No test of a project runs its files."""

SEARCH_PART = "search"
"""The part of an item's name by which it is a search: ``test_x[1-search]``."""

MAX_NAME = 80
DIGEST = 10
_DIGITS = string.digits + string.ascii_lowercase

# Texts, compiled when they are used: most sessions use none of them.
_PLAIN = r"[a-z0-9_](?:[a-z0-9_.,=+-]*[a-z0-9_,=+-])?"
_WITH_PARAMETERS = r"([^@\[\]]+)\[([^@\[\]]+)\]"
_RESERVED = r"(?i:con|prn|aux|nul|com\d|lpt\d|conin|conout|clock)(?=[.@,=+~-]|$)"


def files_in(folder: Path) -> list[Path]:
    """Return the corpus files in a folder, sorted by name; none if the folder is missing or cannot be listed."""
    # A folder that cannot be listed has no items, and is no error yet: writing a finding into it reports the reason.
    return [path for path in entries_of(folder) if path.name.endswith(SUFFIX)]


def is_misnamed(name: str) -> bool:
    """Return whether a file's name has another suffix than a saved scenario, but one that was meant as such."""
    return name.lower().endswith((".yaml", ".yml")) and not name.endswith(SUFFIX)


def name_within(name: str) -> str:
    """Return the name of a saved scenario that a program has made longer, such as ``x.pafot.yaml.txt``, else nothing.

    The result may also be that of an original, of which the file is a backup or a temporary copy of an editor.
    """
    original, suffix, more = name.lstrip(".#").partition(SUFFIX)
    return original + suffix if original and more else ""


def entries_of(folder: Path) -> list[Path]:
    """Return all paths in a folder, sorted by name; none if the folder is missing or cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder, also for paths with which ``Path.is_dir`` raises.

    ``Path.is_dir`` raises if a link leads into a folder that this user may not read, or if its target is longer than a
    name may be. A pull request can contain such links, and they must not end the collection.
    """
    return os.path.isdir(path)  # noqa: PTH112


def files_below(root: Path = Path(CORPUS)) -> list[Path]:
    """Return all corpus files in and below a folder, by default the corpus here, sorted.

    Links to folders are not followed: they may be cyclic.
    """
    return sorted(Path(folder, name) for folder, _, names in os.walk(root) for name in names if name.endswith(SUFFIX))


def unlisted_below(root: Path) -> dict[Path, str]:
    """Return the folders in a tree that cannot be listed, each with the error; nothing sees their files.

    A file, or a link that leads nowhere, in the place of the whole tree is one of them: git writes a link as a file on
    Windows.
    """
    errors: list[OSError] = []
    for _ in os.walk(root, onerror=errors.append):
        pass
    fix = "let this user read it, restore it, or move it away"
    return {
        Path(error.filename): f"expected a folder that can be listed, received {error.strerror}; {fix}"
        for error in errors
        if os.path.lexists(error.filename)
    }


def folders_below(root: Path) -> list[Path]:
    """Return the folders with corpus files in a folder tree, whatever its layout is."""
    return sorted({path.parent for path in files_below(root)})


def corpus_root(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """Return the corpus folder of a test file: next to the file, or below ``corpus`` if that is an absolute path."""
    folder = Path(corpus)
    if not folder.is_absolute():
        return test_file.parent / folder
    try:
        return folder / test_file.parent.relative_to(rootpath)
    except ValueError:
        return folder


def link_below(base: Path, path: Path) -> Path | None:
    """Return the first link on the way from a folder down to a path, the folder excluded; None without a link."""
    way = [each for each in (path, *path.parents) if each != base and each.is_relative_to(base)]
    return next((each for each in reversed(way) if os.path.islink(each)), None)  # noqa: PTH114  (see is_folder)


def chosen_folder(test_file: Path, corpus: str) -> Path:
    """Return the folder that the user has chosen for a corpus. A link below that folder may be part of a checkout."""
    return Path(corpus) if Path(corpus).is_absolute() else test_file.parent


def link_out(base: Path, root: Path, rootpath: Path) -> Path | None:
    """Return the link below ``base`` through which the corpus ``root`` is outside the project; None without one."""
    link = link_below(base, root)
    return None if link is None or is_inside(root, rootpath) else link


def is_inside(path: Path, rootpath: Path) -> bool:
    """Return whether a path is inside the rootdir after all links are followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(rootpath))


def is_corpus(path: Path, corpus: Path) -> bool:
    """Return whether a path is a folder that the option ``corpus`` names."""
    if corpus.is_absolute():
        return path == corpus
    return path.name == corpus.name and path.parts[-len(corpus.parts) :] == corpus.parts


def folder_of_module(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """Return the folder that contains the folders of all tests of a module."""
    return corpus_root(test_file, corpus, rootpath) / safe_name(test_file.stem)


def folder_of_test(test_file: Path, test_name: str, corpus: str, rootpath: Path) -> Path:
    """Return the folder of a test's findings. The name is like ``TestBraking::test_it[4-slow]``, with parameters."""
    return folder_of_module(test_file, corpus, rootpath) / safe_name(test_name)


def module_of_file(file: Path, corpus: str, rootpath: Path) -> Path | None:
    """Return the test file to which a corpus file belongs by its path; None if the path is in no corpus."""
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
    """Return the test file to which a module's folder in a corpus belongs; it may not exist."""
    return next((file for file in directory.glob("*.py") if safe_name(file.stem) == folder), directory / f"{folder}.py")


def relative(path: Path, rootpath: Path) -> str:
    """Return a path as it is printed: relative to the rootdir if it is inside the rootdir."""
    return path.relative_to(rootpath).as_posix() if path.is_relative_to(rootpath) else str(path)


def safe_name(text: str) -> str:
    """Return a name for a folder, made from any text such as the name of a test.

    ``test_it`` is unchanged. ``test_it[4-slow]`` becomes ``test_it@4-slow``, because square brackets have a meaning in
    paths for pytest and shells. A text with capitals ends with ``~`` and the lengths of its runs of small and capital
    letters in turn, because some file systems ignore case: ``test_REQ_1`` becomes ``test_REQ_1~43``. In such a text,
    ``::`` becomes a dot. A text with other characters, a name that Windows reserves, or a text of more than 80
    characters is simplified and ends with ``~`` and ten digits of a digest of the whole text, so distinct texts never
    share a name.
    """
    bracketed = re.fullmatch(_WITH_PARAMETERS, text)
    parts = bracketed.groups() if bracketed else (text,)
    suffix = ""
    if text.isascii() and text != text.lower() and "." not in parts[0]:  # "A.b" and "A::b" must differ
        parts = (parts[0].replace("::", "."), *parts[1:])
        suffix = f"~{_runs_of_case(text)}"
    name = "@".join(parts)
    plain = (part.lower() if suffix else part for part in parts)
    # The suffix is shorter than that with a digest, so that the two kinds differ.
    is_short = len(suffix) <= DIGEST and len(name + suffix) <= MAX_NAME
    if is_short and all(re.fullmatch(_PLAIN, each) for each in plain) and not re.match(_RESERVED, name):
        return name + suffix
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:DIGEST]
    readable = _readable(name)
    prefix = "_" if not readable or re.match(_RESERVED, readable) else ""
    return f"{prefix}{readable}~{digest}"


def _runs_of_case(text: str) -> str:
    """Return the lengths of the runs of small and capital letters in turn, up to the last capital, in base 36.

    They say which letters are capitals on a file system that ignores case. A run of 40 is written as 35, none, 5.
    """
    runs = [(is_capital, len(list(run))) for is_capital, run in groupby(filter(str.isalpha, text), str.isupper)]
    lengths = [0] * runs[0][0] + [length for _, length in runs[: None if runs[-1][0] else -1]]
    return "".join("z0" * (length // 35) + _DIGITS[length % 35] for length in lengths)


class TestFolders:
    """The folders in a module's folder, listed once; a test's are found without looking at all of them."""

    __test__ = False  # for pytest, which collects classes whose names begin with Test

    def __init__(self, module_folder: Path) -> None:
        self._sorted = sorted(entries_of(module_folder), key=_beginning)

    def of(self, test: str) -> list[Path]:
        """Return the folders that may belong to a test, see :func:`may_be_of`, sorted by name."""
        prefix = _readable(test).removeprefix("_")
        start = bisect_left(self._sorted, prefix, key=_beginning)
        begins = takewhile(lambda path: _beginning(path).startswith(prefix), islice(self._sorted, start, None))
        return sorted(path for path in begins if may_be_of(path.name, test))


def _beginning(folder: Path) -> str:
    return folder.name.removeprefix("_")  # safe_name may put one before the name of a test


def may_be_of(folder: str, test: str) -> bool:
    """Return whether a folder may belong to a test with parameters; ``test`` is the test's name without parameters."""
    if "~" not in folder:
        return folder.partition("@")[0] == safe_name(test)
    # _readable strips "-" and "." from the end of the test's name, but not if parameters follow.
    return re.match(rf"_?{re.escape(_readable(test).removeprefix('_'))}[-.]*[@~-]", folder) is not None


def _readable(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.,=+@-]+", "-", text.replace("::", "."))[: MAX_NAME - DIGEST - 2].strip("-.")


def around(part: str, name: str) -> tuple[str, str] | None:
    """Return the text before and after the last occurrence of a part in a parametrised name; None if there is none."""
    found = re.fullmatch(rf"(.*[\[-]){re.escape(part)}([\]-].*)", name, re.DOTALL)
    return None if found is None else (found[1], found[2])


def name_without(part: str, name: str) -> str:
    """Return a parametrised name, or a node id, without a part: ``test_x[1]`` for ``test_x[1-search]``."""
    parts = around(part, name)
    if parts is None:
        return name
    head, tail = parts
    if tail.startswith("-"):
        return head + tail[1:]
    return head[:-1] if head.endswith("[") else head[:-1] + tail


def refusal(link: Path) -> str:
    """Return the message that says why nothing is read, written or removed behind a link, and what to do."""
    return (
        f"expected a folder, received the link {link}, which may lead to files of other people; "
        "replace the link by the folder itself, or give the absolute path of the folder"
    )
