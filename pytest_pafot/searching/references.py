"""``module:name``: a class or a function of the user's own where text is all that can be given."""

from __future__ import annotations

import difflib
from importlib import import_module
from typing import Any


def referred_to(reference: str) -> Any:
    """What a text such as ``module:name`` refers to.

    Raises:
        ValueError: where there is no such module, or no such name in it; without the place, which the caller knows.
    """
    module_name, _, name = reference.partition(":")
    try:
        module = import_module(module_name)
    except Exception as error:
        raise ValueError(
            f"expected a module that can be imported, received {reference!r} ({type(error).__name__}: {error}); give "
            "its whole name, and run where it is or put its folder on the path (pytest: `pythonpath = .`)"
        ) from error
    if not hasattr(module, name):
        near = difflib.get_close_matches(name, vars(module), n=1)
        hint = f"; did you mean {f'{module_name}:{near[0]}'!r}?" if near else f"; {module.__file__} has no such name"
        raise ValueError(f"expected a name in the module {module_name}, received {reference!r}{hint}")
    return getattr(module, name)
