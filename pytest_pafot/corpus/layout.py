"""The names of the folders and files in which scenarios are saved.

The corpus next to a test file contains a folder for the module, which contains a folder for each test.
"""

from __future__ import annotations

import hashlib
import os
import re
import string
from bisect import bisect_left
from itertools import groupby
from pathlib import Path

SUFFIX = ".pafot.yaml"
"""The suffix of a corpus file. The name before it is the id of the finding."""

CORPUS = "pafot_corpus"
"""The default name of the folder next to a test file."""

FOUND = "pafot_found"
"""The folder in which the command ``search`` saves findings. The tests of a project do not replay them."""

SEARCH_PART = "search"
"""The part of an item's name that marks a search, as in ``test_x[1-search]``."""

MAX_NAME = 80
DIGEST = 10
_DIGITS = string.digits + string.ascii_lowercase

# Patterns as strings, which are compiled when they are used. Most sessions use none of them.
_PLAIN = r"[a-z0-9_](?:[a-z0-9_.,=+-]*[a-z0-9_,=+-])?"
_WITH_PARAMETERS = r"([^@\[\]]+)\[([^@\[\]]+)\]"
_RESERVED = r"(?i:con|prn|aux|nul|com\d|lpt\d|conin|conout|clock)(?=[.@,=+~-]|$)"


def files_in(folder: Path) -> list[Path]:
    """Return the corpus files in a folder, sorted by name."""
    # A folder that cannot be listed has no items and causes no error. Writing a finding into it will report the reason.
    return [path for path in entries_of(folder) if path.name.endswith(SUFFIX)]


def is_misnamed(name: str) -> bool:
    """Return whether a YAML file lacks the suffix of a corpus file."""
    return name.lower().endswith((".yaml", ".yml")) and not name.endswith(SUFFIX)


def name_within(name: str) -> str:
    """Return the original file name of a renamed copy such as ``x.pafot.yaml.txt``, or an empty string."""
    # Emacs puts ".#" before the name of a lock file. Backups and temporary copies have a longer suffix.
    original, _, more = name.lstrip(".#").partition(SUFFIX)
    if not original or not more:
        return ""
    return original + SUFFIX


def entries_of(folder: Path) -> list[Path]:
    """Return all paths in a folder, sorted. The list is empty if the folder cannot be listed."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder, even if ``Path.is_dir`` would raise an error."""
    # Path.is_dir raises if a link leads into a folder without read permission, or to a name that is too long.
    # A pull request can contain such links, and they must not end the collection.
    return os.path.isdir(path)  # noqa: PTH112


def files_below(root: Path = Path(CORPUS)) -> list[Path]:
    """Return all corpus files in a folder tree, sorted."""
    # os.walk does not follow links to folders, which may be cyclic.
    files = []
    for folder, _, names in os.walk(root):
        files += [Path(folder, name) for name in names if name.endswith(SUFFIX)]
    return sorted(files)


def unlisted_below(root: Path) -> dict[Path, str]:
    """Return the folders in a tree that cannot be listed, each with an error message."""
    errors: list[OSError] = []
    for _ in os.walk(root, onerror=errors.append):
        pass
    unlisted = {}
    for error in errors:
        # The root itself may be a file: on Windows, git writes a link as a file.
        if os.path.lexists(error.filename):
            expected = f"expected a folder that can be listed, received {error.strerror}"
            fix = "Make it readable for this user, restore it, or move it away"
            unlisted[Path(error.filename)] = f"{expected}. {fix}"
    return unlisted


def folders_below(root: Path) -> list[Path]:
    """Return all folders with corpus files in a folder tree, sorted."""
    return sorted({path.parent for path in files_below(root)})


def corpus_root(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """Return the corpus folder of a test file."""
    folder = Path(corpus)
    if not folder.is_absolute():
        return test_file.parent / folder
    try:
        # An absolute corpus mirrors the folders of the project, so test files with the same name do not share one.
        return folder / test_file.parent.relative_to(rootpath)
    except ValueError:
        return folder


def link_below(base: Path, path: Path) -> Path | None:
    """Return the topmost symbolic link on the way from a folder to a path below it, or None."""
    topmost = None
    for each in (path, *path.parents):
        if each == base or not each.is_relative_to(base):
            break
        if os.path.islink(each):  # noqa: PTH114  (see is_folder)
            topmost = each
    return topmost


def chosen_folder(test_file: Path, corpus: str) -> Path:
    """Return the folder that the user chose for the corpus. Links below it are not trusted."""
    if Path(corpus).is_absolute():
        return Path(corpus)
    return test_file.parent


def link_out(base: Path, root: Path, rootpath: Path) -> Path | None:
    """Return the link through which the path of a corpus folder leaves the project, or None."""
    # A link from one folder of the project to another is harmless.
    if is_inside(root, rootpath):
        return None
    return link_below(base, root)


def is_inside(path: Path, rootpath: Path) -> bool:
    """Return whether a path is inside the rootdir after all links are followed."""
    real = Path(os.path.realpath(path))
    return real.is_relative_to(os.path.realpath(rootpath))


def is_corpus(path: Path, corpus: Path) -> bool:
    """Return whether a folder is a corpus according to the option ``corpus``."""
    if corpus.is_absolute():
        return path == corpus
    end = path.parts[-len(corpus.parts) :]
    return path.name == corpus.name and end == corpus.parts


def folder_of_module(test_file: Path, corpus: str, rootpath: Path) -> Path:
    """Return the folder that contains the folders of a module's tests."""
    return corpus_root(test_file, corpus, rootpath) / safe_name(test_file.stem)


def folder_of_test(test_file: Path, test_name: str, corpus: str, rootpath: Path) -> Path:
    """Return the folder for the findings of a test such as ``TestBraking::test_it[4-slow]``."""
    return folder_of_module(test_file, corpus, rootpath) / safe_name(test_name)


def module_of_file(file: Path, corpus: str, rootpath: Path) -> Path | None:
    """Return the test file to which a corpus file belongs, or None if the file is not in a corpus."""
    if len(file.parents) < 3:
        return None
    # The path of a corpus file ends with module/test/file.
    root = file.parents[2]
    folder = Path(corpus)
    if folder.is_absolute() and root.is_relative_to(folder):
        directory = rootpath / root.relative_to(folder)
    elif not folder.is_absolute() and is_corpus(root, folder):
        directory = root.parents[len(folder.parts) - 1]
    else:
        return None
    return module_named(directory, file.parents[1].name)


def module_named(directory: Path, folder: str) -> Path:
    """Return the test file that belongs to a folder of a corpus, even if the test file does not exist."""
    for file in directory.glob("*.py"):
        if safe_name(file.stem) == folder:
            return file
    return directory / f"{folder}.py"


def relative(path: Path, rootpath: Path) -> str:
    """Return a path for messages, relative to the rootdir if possible."""
    if path.is_relative_to(rootpath):
        return path.relative_to(rootpath).as_posix()
    return str(path)


def safe_name(text: str) -> str:
    """Return a folder name for a string, valid on every file system and different for different strings.

    ``test_it`` is unchanged, and ``test_it[4-slow]`` becomes ``test_it@4-slow``. A name with capitals ends with ``~``
    and a code for their positions: ``test_REQ_1`` becomes ``test_REQ_1~43``. Any other name is simplified and ends
    with ``~`` and ten digits of a hash.
    """
    bracketed = re.fullmatch(_WITH_PARAMETERS, text)
    parts = [text]
    if bracketed:
        parts = [*bracketed.groups()]
    suffix = ""
    plain = parts
    # "A.b" and "A::b" must differ
    if text.isascii() and text != text.lower() and "." not in parts[0]:
        # Two names that differ only in case get different suffixes, because some file systems ignore case.
        parts[0] = parts[0].replace("::", ".")
        suffix = f"~{_runs_of_case(text)}"
        plain = [part.lower() for part in parts]
    # "@" replaces square brackets, which have a meaning in paths for pytest and for shells.
    name = "@".join(parts)
    is_reserved = re.match(_RESERVED, name)
    # The suffix is shorter than one with a digest, so that the two kinds of suffixes cannot be confused.
    is_short = len(suffix) <= DIGEST and len(name + suffix) <= MAX_NAME
    if is_short and not is_reserved and all(re.fullmatch(_PLAIN, each) for each in plain):
        return name + suffix
    # What remains are names with other characters, names that Windows reserves, and long names.
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:DIGEST]
    readable = _readable(name)
    if not readable or re.match(_RESERVED, readable):
        readable = f"_{readable}"
    return f"{readable}~{digest}"


def _runs_of_case(text: str) -> str:
    # Encode the positions of capitals as the lengths of runs of lower and upper case, in base 36.
    # A run of 35 or more is split by empty runs of the other case, so that each length is one digit.
    # The lower case after the last capital is not needed.
    letters = "".join(filter(str.isalpha, text)).rstrip(string.ascii_lowercase)
    code = "0" if letters[0].isupper() else ""
    for _, run in groupby(letters, str.isupper):
        length = len([*run])
        code += "z0" * (length // 35) + _DIGITS[length % 35]
    return code


class TestFolders:
    """The folders of a module's tests, listed once and looked up by the name of a test."""

    __test__ = False  # for pytest, which collects classes whose names begin with Test

    def __init__(self, module_folder: Path) -> None:
        self._sorted = sorted(entries_of(module_folder), key=_beginning)

    def folders_of(self, test: str) -> list[Path]:
        """Return the folders that can belong to a test, sorted by name."""
        prefix = _readable(test).removeprefix("_")
        start = bisect_left(self._sorted, prefix, key=_beginning)
        found = []
        for path in self._sorted[start:]:
            if not _beginning(path).startswith(prefix):
                break
            if may_be_of(path.name, test):
                found.append(path)
        return sorted(found)


def _beginning(folder: Path) -> str:
    return folder.name.removeprefix("_")  # safe_name may put one before the name of a test


def may_be_of(folder: str, test: str) -> bool:
    """Return whether a folder can belong to a test, regardless of the parameters."""
    if "~" not in folder:
        return folder.partition("@")[0] == safe_name(test)
    # _readable strips "-" and "." from the end of the test's name, but not if parameters follow.
    name = re.escape(_readable(test).removeprefix("_"))
    return re.match(rf"_?{name}[-.]*[@~-]", folder) is not None


def _readable(text: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_.,=+@-]+", "-", text.replace("::", "."))
    return name[: MAX_NAME - DIGEST - 2].strip("-.")


def around(part: str, name: str) -> tuple[str, str] | None:
    """Return the strings before and after a part of a parametrised name, or None if the name does not contain it."""
    found = re.fullmatch(rf"(.*[\[-]){re.escape(part)}([\]-].*)", name, re.DOTALL)
    if found is None:
        return None
    return found[1], found[2]


def name_without(part: str, name: str) -> str:
    """Remove a part from a node id: ``test_x[1-search]`` becomes ``test_x[1]``."""
    parts = around(part, name)
    if parts is None:
        return name
    head, tail = parts
    if tail.startswith("-"):
        return head + tail[1:]
    if head.endswith("["):
        return head[:-1]
    return head[:-1] + tail


def refusal(link: Path) -> str:
    """Return the error message for a link that is not followed."""
    return (
        f"expected a folder, received the link {link}, which may lead to files outside the project. "
        "Replace the link with the folder itself, or give the absolute path of the folder"
    )
