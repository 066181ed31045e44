"""The simulation kernel, in typed Python that is compiled if a C compiler is available.

The ``.pxd`` file next to each module declares the C types. If the compiled modules do not match these sources, or if
the environment variable ``PAFOT_KERNEL`` is ``interpreted`` at the first import, Python interprets the same files. Runs
then take about twenty times as long, with the same results.
"""

from __future__ import annotations

from pytest_pafot.support import compiled


def is_compiled() -> bool:
    """Return whether the compiled kernel is in use."""
    from pytest_pafot.world.kernel import loop  # noqa: PLC0415  (loaded below)

    return not str(loop.__file__).endswith(".py")


compiled.load(__name__)
