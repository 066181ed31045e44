"""What tests put in the place of Python's own functions: files, clocks and processes of ``mock`` or pyfakefs.

The user's code sees what its fixtures have put there. While this package works between two calls of that code, the
functions are Python's own, so that what is found is on the real disk.
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

_NAMES = "builtins io json multiprocessing os os.path pathlib secrets shutil signal subprocess tempfile time"
_OWN = [
    (owner, name, value)
    for owner in (*map(import_module, _NAMES.split()), pathlib.PurePath, pathlib.Path)
    for name, value in vars(owner).items()
    if name in ("__import__", "environ") or (name[:2] != "__" and (callable(value) or isinstance(value, classmethod)))
]


class _Replaced:
    """The replaced functions of this process. They are in their places, unless this package works."""

    def __init__(self) -> None:
        self._back: list[Callable[[], object]] = []  # puts them back, the last first; empty if none is put aside

    @contextmanager
    def shown(self, is_shown: bool) -> Iterator[None]:
        """Put aside in this context what is replaced; or put it back, if it is put aside."""
        if bool(self._back) != is_shown:
            yield
            return
        (self._put_back if is_shown else self._put_aside)()
        try:
            yield
        finally:
            (self._put_aside if is_shown else self._put_back)()

    def _put_aside(self) -> None:
        own = [each for each in _OWN if vars(each[0]).get(each[1]) is not each[2]]
        replaced = [(owner, name, vars(owner).get(name)) for owner, name, _ in own]
        self._back += [lambda: _put(replaced)] if replaced else []
        # pyfakefs replaces functions in each module, and these in the modules that are imported meanwhile.
        faked = getattr(sys.modules.get("pyfakefs.fake_filesystem_unittest"), "Patcher", None)
        if faked is not None and faked.PATCHER is not None and faked.PATCHER.is_patching:
            faked.PATCHER.pause()
            self._back.append(faked.PATCHER.resume)
        _put(own)

    def _put_back(self) -> None:
        while self._back:
            self._back.pop()()


def _put(places: Iterable[tuple[Any, str, object]]) -> None:
    for owner, name, value in places:
        delattr(owner, name) if value is None else setattr(owner, name, value)


REPLACED = _Replaced()
"""Those of this process."""
