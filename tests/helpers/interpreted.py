"""A second copy of the world room in this process, with the kernel interpreted even if it is compiled."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any
from unittest.mock import patch

ROOM = "pytest_pafot.world"


def _modules() -> dict[str, ModuleType]:
    return {
        name: module
        for name, module in sys.modules.items()
        if name == ROOM or name.startswith(f"{ROOM}.")
    }


class InterpretedWorld:
    """A second import of ``pytest_pafot.world``; inside :meth:`in_place`, imports find this copy."""

    def __init__(self) -> None:
        self._modules: dict[str, ModuleType] = {}
        with patch.dict(os.environ, {"PAFOT_KERNEL": "interpreted"}), self.in_place():
            self.room: Any = importlib.import_module(ROOM)
            assert not importlib.import_module(f"{ROOM}.kernel").is_compiled()

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Put the copy in the place of the room, because runs import some modules late."""
        package = importlib.import_module("pytest_pafot")
        importlib.import_module(ROOM)
        others = _modules()
        for name in others:
            del sys.modules[name]
        sys.modules.update(self._modules)
        try:
            yield
        finally:
            self._modules = _modules()
            for name in self._modules:
                del sys.modules[name]
            sys.modules.update(others)
            package.world = others[ROOM]  # type: ignore[attr-defined]
