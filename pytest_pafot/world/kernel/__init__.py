"""The kernel, which simulates runs: typed Python that is compiled if there is a C compiler.

The ``.pxd`` file next to each module has the C types. If the modules were not compiled from these sources, or if the
environment variable ``PAFOT_KERNEL`` is ``interpreted`` at the first import, the same files run interpreted. Then runs
take about twenty times longer, with equal results.
"""

from __future__ import annotations

from pytest_pafot.support import compiled


def is_compiled() -> bool:
    """Return whether the kernel runs compiled."""
    from pytest_pafot.world.kernel import loop  # noqa: PLC0415  (it is imported below)

    return not str(loop.__file__).endswith(".py")


compiled.load(__name__)
