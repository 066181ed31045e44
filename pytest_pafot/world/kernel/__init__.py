"""The part of a run that is stepped: typed, plain Python, which is compiled where there is a C compiler.

The types for the compiler stand in the ``.pxd`` file beside each module. Without compiled modules, or with the
environment variable ``PAFOT_KERNEL=interpreted`` at the first import, the same files run interpreted.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import module_from_spec
from pathlib import Path

MODULES = (
    "driver", "action", "bodies", "lanes", "bends", "director", "crossing", "observation", "idm", "loop", "traffic",
)  # fmt: skip
"""Of this package, each after those that it imports."""
VARIABLE = "PAFOT_KERNEL"


def is_compiled() -> bool:
    """Whether the kernel runs compiled; then all of its modules do, since one is built against the other."""
    from pytest_pafot.world.kernel import loop  # noqa: PLC0415  (imports the others)

    return not str(loop.__file__).endswith(".py")


def _load_interpreted() -> None:
    """Import the modules from their source, also where compiled ones lie beside it."""
    for name in MODULES:
        full = f"{__name__}.{name}"
        path = str(Path(__file__).with_name(f"{name}.py"))
        loader = SourceFileLoader(full, path)
        spec = ModuleSpec(full, loader, origin=path)
        spec.has_location = True
        module = sys.modules[full] = module_from_spec(spec)
        loader.exec_module(module)
        globals()[name] = module


if os.environ.get(VARIABLE) == "interpreted":
    _load_interpreted()
