"""The kernel, which simulates runs: typed, plain Python that is compiled if there is a C compiler.

The types for the compiler are in the ``.pxd`` file next to each module. Without modules that were compiled from these
sources, or if the environment variable ``PAFOT_KERNEL`` is ``interpreted`` at the first import, the same files run
interpreted, some twenty times slower and with equal results. Where this package says that something is compiled, it is
in the kernel.
"""

from __future__ import annotations

from pytest_pafot.support import compiled


def is_compiled() -> bool:
    """Return whether the kernel runs compiled; either all modules do or none, because they are built together."""
    from pytest_pafot.world.kernel import loop  # noqa: PLC0415  (it is imported below)

    return not str(loop.__file__).endswith(".py")


compiled.load(__name__)
