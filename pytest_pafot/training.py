"""The public name of ``pytest_pafot.extras.training``: whoever imports this module receives that one."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from pytest_pafot.door import opened

sys.modules[__name__] = opened("pytest_pafot.extras.training")

if TYPE_CHECKING:

    def __getattr__(name: str) -> Any: ...
