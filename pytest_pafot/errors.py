"""The form of an error that the user can mend: what was expected of which value, what was received, and the way out."""

from __future__ import annotations


class FieldError(ValueError):
    """A value that breaks a rule.

    Attributes:
        field: path of the value, such as ``npcs[0][2].speed``; empty where it has none.
        expected, received: what should be there, and what is; empty where the text says it in its own way.
        fix: the way out; empty where it is plain.
    """

    def __init__(
        self, text: str = "", *, field: str = "", expected: str = "", received: str = "", fix: str = ""
    ) -> None:
        super().__init__(text or sentence(field, expected, received, fix))
        self.field, self.expected, self.received, self.fix = field, expected, received, fix


def sentence(field: str, expected: str, received: str, fix: str) -> str:
    """``field: expected this, received that; do so``, without the parts that are empty."""
    place, way_out = f"{field}: " if field else "", f"; {fix}" if fix else ""
    return f"{place}expected {expected}, received {received}{way_out}"
