"""Names of the user's objects in texts."""

import functools
import re

import pytest

from pytest_pafot import Highway
from pytest_pafot.support.references import described, factory_named, imported, referred_to
from pytest_pafot.world import WorldError

MODULE = """\
import functools


class Planner:
    def __init__(self, *given):
        self.given = given


made = functools.partial(Planner, 1)
number = 5
"""


@pytest.fixture(autouse=True)
def modules(tmp_path, monkeypatch):
    (tmp_path / "named_here.py").write_text(MODULE)
    (tmp_path / "lacks_another.py").write_text("import no_such_library")
    (tmp_path / "exits_here.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize(("reference", "given"), [
    ("named_here:Planner", ()),
    ("named_here:made", (1,)),
    ("named_here:Planner:old.zip", ("old.zip",)),
    (r"named_here:Planner:C:\a b:c", (r"C:\a b:c",)),
    ("named_here:made: ", (1, " ")),
])  # fmt: skip
def test_factory_gets_all_behind_the_second_colon(reference, given):
    assert factory_named(reference)().given == given


WRONG = [
    "named_here", "named_here:", "named_here:Planner:", "named_here:number", "named_here:Planer:x", "named_here:zzz",
    "named_there:x", "named_here.py:Planner", "folder/named_here.py:Planner", "/folder/named_here.py:Planner",
    ".named_here:Planner", "lacks_another:x", "exits_here:x",
]  # fmt: skip


@pytest.mark.parametrize("reference", WRONG)
def test_wrong_name_is_an_error_that_names_it(reference):
    with pytest.raises(ValueError, match=re.escape(f"'{reference.removesuffix(':x')}")):
        factory_named(reference)


def test_module_without_a_name_is_none():
    with pytest.raises(ValueError, match="':x'"):
        imported(":x")


def test_place_of_an_error_is_in_the_users_code():
    """What refuses a value is not where to look, nor is the code that a dataclass makes of itself."""
    with pytest.raises(WorldError) as raised:
        Highway(lanes=99)
    here = raised.traceback[0].lineno + 1
    assert described(raised.value).endswith(f"received 99 ({__file__}:{here})")


def test_name_refers_to_any_object_of_a_module():
    assert referred_to("named_here:number") == 5
    assert referred_to("functools:partial") is functools.partial
