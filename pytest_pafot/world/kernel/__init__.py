"""The kernel, which simulates runs: typed, plain Python that is compiled if there is a C compiler.

The types for the compiler are in the ``.pxd`` file next to each module; ``setup.py`` builds :data:`MODULES`. Without
compiled modules, or if the environment variable ``PAFOT_KERNEL`` is ``interpreted`` at the first import, the same files
run interpreted, some twenty times slower and with equal results. Where this package says that something is compiled, it
is in the kernel.
"""

from __future__ import annotations

import os
import sys
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import module_from_spec
from pathlib import Path

MODULES = (
    "driver", "action", "bodies", "lanes", "bends", "director", "crossing", "road_directors", "observation",
    "places", "road_sensor", "idm", "lane_network", "network_vehicle", "road_rules", "loop", "features",
)  # fmt: skip
"""The modules of this package, each after those that it imports."""
VARIABLE = "PAFOT_KERNEL"


def is_compiled() -> bool:
    """Return whether the kernel runs compiled; either all modules do or none, because they are built together."""
    from pytest_pafot.world.kernel import loop  # noqa: PLC0415  (imports the others)

    return not str(loop.__file__).endswith(".py")


def _load_interpreted() -> None:
    """Import the modules from their source, even if compiled ones are next to it."""
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
