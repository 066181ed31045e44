"""The requirements that a test checks: their ids, what they ask for, and whose they are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from pytest_pafot.support.text import visible

MOST_ID, MOST_TEXT = 100, 300
"""The largest numbers of characters of an id, and of a title or an owner."""

EACH, ALL, TITLE, OWNER = "requirement", "requirements", "title", "owner"
"""The names of the properties in files for other tools, such as the file of ``--junitxml``.

StrictDoc and others read one ``requirement`` for each id, Xray one ``requirements`` with all ids and commas between.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Traced:
    """The requirements of a test, with their title and its owner, as its marks say.

    Attributes:
        requirements: ids of the requirements that the test checks; empty if it names none.
        title: what the requirements ask for; empty if nothing says it.
        owner: who answers for the test; empty if nobody is named.
    """

    requirements: tuple[str, ...] = ()
    title: str = ""
    owner: str = ""

    def __bool__(self) -> bool:
        """Return whether the marks name a requirement or an owner."""
        return bool(self.requirements or self.owner)

    @property
    def ids(self) -> str:
        """The ids on one line, with commas between them; empty if there are none."""
        return ", ".join(self.requirements)

    @property
    def described(self) -> str:
        """Ids, title and owner on one line."""
        named = ": ".join(filter(None, [self.ids, self.title if self.requirements else ""]))
        whose = f"owner {self.owner}" if self.owner else ""
        return f"{named} ({whose})" if named and whose else named or whose

    @property
    def properties(self) -> list[tuple[str, str]]:
        """The properties of an item, for pytest's reports."""
        if not self:
            return []
        one_each = [(EACH, id_) for id_ in self.requirements]
        all_at_once = [(ALL, ",".join(self.requirements))] if self.requirements else []
        others = ((TITLE, self.title if self.requirements else ""), (OWNER, self.owner))
        return [*one_each, *all_at_once, *((name, text) for name, text in others if text)]

    @classmethod
    def of_properties(cls, properties: Iterable[tuple[str, Any]]) -> Self:
        """Return what the properties of a report say, whether the marks of its test or the test itself set them."""
        found: dict[str, list[str]] = {}
        for name, value in ((name, value) for name, value in properties if name in (EACH, TITLE, OWNER)):
            found.setdefault(name, []).append(visible(str(value)))
        title, owner = (found.get(name, [""])[0] for name in (TITLE, OWNER))
        requirements = tuple(dict.fromkeys(found.get(EACH, ())))
        return cls(requirements=requirements, title=title if requirements else "", owner=owner)


def counted(failures: Iterable[tuple[Traced, bool]]) -> list[tuple[Traced, int]]:
    """Return each requirement with its number of failures, in the order of ids.

    ``failures`` has the requirements of each item, and whether it failed.
    """
    found: dict[str, tuple[Traced, int]] = {}
    for told, is_failure in failures:
        for id_ in told.requirements:
            named, before = found.get(id_, (replace(told, requirements=(id_,)), 0))
            found[id_] = named, before + is_failure
    return [found[id_] for id_ in sorted(found)]


def checked(arguments: Mapping[str, Any]) -> Traced:
    """Return the requirements that the arguments of a mark name.

    Raises:
        ValueError: if an id, the title or the owner is not a text of the right kind.
    """
    given = arguments.get(EACH, ())
    ids = [given] if isinstance(given, str) else list(given) if isinstance(given, (tuple, list)) else [given]
    for id_ in ids:
        if not _is_text(id_, MOST_ID) or "," in id_ or id_ != id_.strip():
            raise ValueError(
                f'requirement: expected an id such as "REQ-001", or a list of them, of at most {MOST_ID} printable '
                f"characters without commas, received {id_!r:.60}"
            )
    for name in (TITLE, OWNER):
        if name in arguments and not _is_text(arguments[name], MOST_TEXT):
            raise ValueError(
                f"{name}: expected a text of at most {MOST_TEXT} printable characters, received {arguments[name]!r:.60}"
            )
    title, owner = arguments.get(TITLE, ""), arguments.get(OWNER, "")
    return Traced(requirements=tuple(dict.fromkeys(ids)), title=title.strip(), owner=owner.strip())


def _is_text(value: object, most: int) -> bool:
    return isinstance(value, str) and len(value.strip()) > 0 and len(value) <= most and visible(value) == value
