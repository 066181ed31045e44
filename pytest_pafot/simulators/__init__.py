"""Built-in simulators: :func:`pytest_pafot.metadrive` and :func:`pytest_pafot.sumo`."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__all__ = ["metadrive", "sumo"]

if TYPE_CHECKING:
    from pytest_pafot.simulators import metadrive, sumo
else:

    def __getattr__(name: str) -> Any:
        if name not in ("metadrive", "sumo"):
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return import_module(f"{__name__}.{name}")
